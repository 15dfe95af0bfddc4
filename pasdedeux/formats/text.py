"""What every text reader needs: decoding, JSON and numbers that fail with one clear sentence."""

from __future__ import annotations

import csv
import json
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError

MAX_MAGNITUDE = 1e7
"""Greatest absolute value of a length, angle or pixel that a file may hold; beyond it the file is damaged."""

_MAX_TOKEN_SHOWN = 40


def decode(data: bytes | str, what: str) -> str:
    """Return the text of `data`: UTF-8 with or without a byte order mark, else Latin-1.

    Raises:
        FormatError: The data is empty or binary.
    """
    if isinstance(data, str):
        text = data
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    if not text.strip():
        raise FormatError(f"this {what} is empty")
    if "\0" in text:
        raise FormatError(f"this is not a {what}: it holds binary data (a zero byte)")
    return text


def split_lines(text: str) -> list[str]:
    """Split text into lines as an editor counts them: Windows, Unix and old Mac line ends."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def parse_table(text: str) -> tuple[tuple[str, ...], list[tuple[int, dict[str, str | None]]]]:
    r"""Return the columns of a CSV with a header, and line and cells of each row; None for cells that a row has not.

    >>> parse_table("a,b\r1,2\r3")
    (('a', 'b'), [(2, {'a': '1', 'b': '2'}), (3, {'a': '3', 'b': None})])

    Raises:
        FormatError: It is not valid CSV, or a row has more cells than there are columns.
    """
    reader = csv.DictReader(split_lines(text), strict=True)
    rows = []
    try:
        for row in reader:
            if None in row:
                raise FormatError(f"line {reader.line_num}: there are more values than columns")
            rows.append((reader.line_num, dict(row)))
    except csv.Error as error:
        raise FormatError(f"line {reader.line_num + 1}: this is not valid CSV: {error}") from None
    return tuple(reader.fieldnames or ()), rows


def shorten(token: str) -> str:
    """Return a token for a message, at most 40 characters of it."""
    return token if len(token) <= _MAX_TOKEN_SHOWN else token[:_MAX_TOKEN_SHOWN] + "..."


def parse_number(token: str, where: str, *, max_magnitude: float = MAX_MAGNITUDE) -> float:
    """Return the finite number that a token spells.

    Raises:
        FormatError: It spells none, or one that is not finite or absurdly large; `where` is put in front.
    """
    try:
        if "_" in token:
            raise ValueError
        value = float(token)
    except ValueError:
        raise FormatError(f"{where}: '{shorten(token)}' is not a number") from None
    if not math.isfinite(value):
        raise FormatError(f"{where}: '{shorten(token)}' is not a finite number")
    if abs(value) > max_magnitude:
        raise FormatError(f"{where}: {value:g} is absurdly large; values up to {max_magnitude:g} are allowed")
    return value


def parse_integer(token: str, where: str) -> int:
    """Return the whole number of at most nine digits that a token spells.

    Raises:
        FormatError: It spells none; `where` is put in front.
    """
    digits = token.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 9):
        raise FormatError(f"{where}: '{shorten(token)}' is not a whole number of at most nine digits")
    return int(token)


def parse_triples(numbers: list[Any], where: str) -> npt.NDArray[np.float64]:
    """Return keypoints of a JSON list as rows x, y and a third number, (K, 3); NaN is how some write "not detected".

    Raises:
        FormatError: A value is no number or absurdly large; `where` is put in front.
    """
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and not abs(n) > MAX_MAGNITUDE for n in numbers):
        raise FormatError(f"{where} holds a value that is no number or absurdly large")
    return np.array(numbers, dtype=np.float64).reshape(-1, 3)


def parse_json(data: bytes | str, what: str, *, has_nan: bool = False) -> Any:
    """Return the value of a JSON text; NaN and infinity are refused, as JSON does not know them.

    Args:
        data: The text.
        what: What it is, for messages.
        has_nan: Whether NaN may stand for what was not detected, as some detectors write it.

    Raises:
        FormatError: The text is empty, truncated, nested too deeply or otherwise not JSON; the line is named.
    """
    text = decode(data, what)

    def refuse(constant: str) -> float:
        if has_nan and constant == "NaN":
            return math.nan
        raise FormatError(f"this {what} holds {constant}, which is not a finite number")

    try:
        return json.loads(text, parse_constant=refuse)
    except json.JSONDecodeError as error:
        raise FormatError(
            f"this {what} is not valid JSON: line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except RecursionError:
        raise FormatError(f"this {what} is nested too deeply to be read") from None
    except ValueError:
        raise FormatError(f"this {what} holds a number with too many digits") from None
