"""Errors of the science. All have one root and survive pickling."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral


class PasdedeuxError(Exception):
    """Root of all errors that are raised on purpose; the message is one clear sentence."""


class InputError(PasdedeuxError):
    """A user's value is not allowed: the message names the value and the allowed ones."""


class FormatError(InputError):
    """A file breaks its format: the message names the line or frame, the fault, and the allowed form."""


class NobodyError(InputError):
    """A source of 2D poses shows nobody, or nobody that can be tracked."""


def check_positive(value: float, what: str) -> None:
    """Refuse a number that is not positive or not finite."""
    if not 0 < value < float("inf"):
        raise InputError(f"{what} is {value}, it must be positive")


def check_whole(value: object, what: str, *, minimum: int) -> None:
    """Refuse a value that is not a whole number or is below the minimum."""
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or value < minimum:  # type: ignore[operator]
        raise InputError(f"{what} is {value!r}; it must be a whole number, {minimum} or more")


@contextmanager
def named(where: str) -> Iterator[None]:
    """Prefix an InputError with its subject, such as the file or the take."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{where}: {error}") from None
