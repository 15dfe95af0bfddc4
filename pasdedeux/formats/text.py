"""Shared parts of text readers: lines, tables, JSON and numbers, with clear errors."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError
from pasdedeux.formats.unsupported import refuse_foreign
from pasdedeux.plain_text import counted

MAX_MAGNITUDE = 1e7
"""Largest absolute value of a length, angle or pixel in a file; a file with larger values is damaged."""
MAX_COUNT = 1_000_000_000
"""Largest frame number, person number or count in a file."""

_MISSING = frozenset({"", "nan", "null", "none", "na", "n/a"})
"""Cells of tables that mean that there is no number, in lower case."""

_FEW_FRAMES, _FEW_SHARE = 10, 0.05
"""Number of frames, or share of them, by which a file may be shorter than stated."""
_MAX_TOKEN_SHOWN = 40
_LOOKED_AT_LETTERS = 40
_PADDING = "\0\x1a"
"""Characters that old programs append to a text."""
_DELIMITERS = ",;\t"
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")

N = TypeVar("N", int, float)


class Lines:
    r"""The lines of a file, read once from first to last; in a `with`, a FormatError gets the current line number.

    Lines are counted as in an editor, with Windows, Unix and old Mac line ends.

    >>> with Lines(b"a\rb", "file") as lines:
    ...     for line in lines:
    ...         raise FormatError(f"'{line}' is not known")
    Traceback (most recent call last):
    pasdedeux.errors.FormatError: line 1: 'a' is not known

    Raises:
        FormatError: The data is empty or binary.
    """

    def __init__(self, data: bytes | str, what: str) -> None:
        self._texts = decode(data, what).replace("\r\n", "\n").replace("\r", "\n").split("\n")
        self.number = 0

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, FormatError):
            raise FormatError(f"line {self.number}: {error}") from None

    def __iter__(self) -> Iterator[str]:
        """Yield the remaining lines."""
        while self.number < len(self._texts):
            self.number += 1
            yield self._texts[self.number - 1]

    def words(self, comment: str | None = None) -> Iterator[list[str]]:
        """Yield the words of each remaining line that has any, without comments."""
        for text in self:
            words = (text.partition(comment)[0] if comment else text).split()
            if words:
                yield words

    def put_back(self, text: str) -> None:
        """Put the last line back as this text, to be read again."""
        self.number -= 1
        self._texts[self.number] = text

    def skip_to(self, beginning: re.Pattern[str]) -> None:
        """Skip the lines before the next one that matches; none if no line matches."""
        rest = range(self.number, len(self._texts))
        self.number = next((number for number in rest if beginning.match(self._texts[number])), self.number)

    def up_to(self, ending: re.Pattern[str]) -> str:
        """Return the remaining lines up to the first that matches, or all, without consuming them."""
        rest = range(self.number, len(self._texts))
        stop = next((number + 1 for number in rest if ending.match(self._texts[number])), len(self._texts))
        return "\n".join(self._texts[self.number : stop])

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield key and value of the next lines that are comments (`# key: value`) or blank; both may be empty."""
        while self.number < len(self._texts) and self._texts[self.number].strip()[:1] in ("", "#"):
            self.number += 1
            key, _, value = self._texts[self.number - 1].strip()[1:].partition(":")
            yield key.strip().lower(), value.strip()

    def table(self, needed: Collection[str], known: Collection[str] = ()) -> tuple[list[str], Iterator[dict[str, str]]]:
        """Read the remaining lines as CSV: column names, in lower case, and rows; blank lines are skipped.

        Args:
            needed: Required columns.
            known: Other allowed columns; any if empty.
        """
        for _ in self.notes():
            pass
        rows = self.rows()
        columns = [name.lower() for name in next(rows, [])]
        if not columns:
            raise FormatError("the file ends without a header line")
        for name in columns:
            if (name and columns.count(name) > 1) or (known and name not in {*known, *needed}):
                allowed = f"; known: {', '.join(known)}" if known else ""
                raise FormatError(f"column '{shorten(name)}' is unknown or double{allowed}")
        for name in needed:
            if name not in columns:
                raise FormatError(f"column '{name}' is missing; needed: {', '.join(needed)}")
        return columns, (dict(zip(columns, _fitting(row, columns), strict=True)) for row in rows)

    def numbers(self, columns: Sequence[str], comment: tuple[str, ...] = ()) -> npt.NDArray[np.float64]:
        """Read the remaining lines as numbers (row, column); blank lines and comments are skipped.

        A row may be on several lines, and several whole rows on one line.

        Raises:
            FormatError: There is no row, or a row has another number of values or a value that is not a finite number.
        """
        start, rows = self.number, [text for text in self if text.strip() and not text.lstrip().startswith(comment)]
        try:
            values = np.loadtxt(rows, comments=None, ndmin=2) if rows else np.empty((0, 0))
        except ValueError:
            pass
        else:
            if rows and values.shape[1] == len(columns) and bool((np.abs(values) <= MAX_MAGNITUDE).all()):
                return values
        numbers: list[float] = []
        self.number = begun = start
        for words in self.words():
            words = words[: next((at for at, word in enumerate(words) if word.startswith(comment)), len(words))]
            at = len(numbers) % len(columns)
            if at + len(words) > len(columns) and (at or len(words) % len(columns)):
                self.number = begun if at else self.number
                break
            begun = self.number
            for word in words:
                row, column = divmod(len(numbers), len(columns))
                numbers.append(parse_number(word, f"{columns[column]} in frame {row}"))
        else:
            words = []
        at = len(numbers) % len(columns)
        if at or words:
            self.number = begun if at else self.number
            raise FormatError(f"{counted(at or len(words), 'value')} where {len(columns)} are needed")
        if not numbers:
            raise FormatError("the file ends without a frame")
        return np.array(numbers).reshape(-1, len(columns))

    def rows(self) -> Iterator[list[str]]:
        """Yield the cells of the remaining lines that are not blank."""
        last = self.number
        delimiter = find_delimiter(next((text for text in self._texts[last:] if text.strip()), ""))
        try:
            for cells in csv.reader(self, strict=True, delimiter=delimiter):
                last, row = self.number, [cell.strip() for cell in cells]
                if delimiter != ",":
                    row = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in row]
                if any(row):
                    yield row
        except csv.Error as error:
            self.number = last + 1  # the first line of the row: an open quote runs to the end of the file
            raise FormatError(f"this is not valid CSV: {error}") from None


def find_delimiter(header: str) -> str:
    """Return the delimiter of a table from its first line: a comma, a semicolon or a tab."""
    return max(_DELIMITERS, key=header.count)


def _fitting(values: list[str], columns: Sequence[str]) -> list[str]:
    if len(values) != len(columns):
        raise FormatError(f"{counted(len(values), 'value')} where {len(columns)} are needed")
    return values


def decode(data: bytes | str, what: str) -> str:
    """Return the text of `data`: UTF-8 or UTF-16 with or without a byte order mark, else Latin-1."""
    if isinstance(data, str):
        text = data
    else:
        refuse_foreign(data)
        wide = wide_encoding(data)
        try:
            text = data.decode(wide or "utf-8-sig").removeprefix("\ufeff")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    text = text.rstrip(_PADDING)
    if not text.strip():
        raise FormatError(f"this {what} is empty")
    if "\0" in text:
        raise FormatError(f"this is not a {what}: it holds binary data (a zero byte)")
    return text


def wide_encoding(data: bytes) -> str:
    """Return the UTF-16 encoding of a text, judged by its beginning; empty for any other."""
    start = data[: 2 * _LOOKED_AT_LETTERS]
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    for encoding, zeros, letters in (("utf-16-le", start[1::2], start[::2]), ("utf-16-be", start[::2], start[1::2])):
        if zeros and letters.isascii() and not any(zeros) and all(letters):
            return encoding
    return ""


def shorten(token: object) -> str:
    """Return a token for a message, cut to 40 characters."""
    text = str(token)
    return text if len(text) <= _MAX_TOKEN_SHOWN else text[:_MAX_TOKEN_SHOWN] + "..."


def parse_number(token: str, what: str, low: float = -MAX_MAGNITUDE, high: float = MAX_MAGNITUDE) -> float:
    """Parse a finite number within a range."""
    try:
        if "_" in token or not token.isascii():
            raise ValueError
        value = float(token)
    except ValueError:
        raise FormatError(f"{what}: '{shorten(token)}' is not a number") from None
    if not math.isfinite(value):
        raise FormatError(f"{what}: '{shorten(token)}' is not a finite number")
    return check_range(value, what, low, high)


def parse_cell(token: str, what: str) -> float:
    """Parse the number in a cell of a table; NaN if the cell means that there is none."""
    return math.nan if token.lower() in _MISSING else parse_number(token, what)


def floats_of(words: Iterable[str]) -> list[float]:
    """Parse words as numbers, also infinity and NaN; empty if a word is not a number."""
    try:
        return list(map(float, words))
    except ValueError:
        return []


def parse_integer(token: str, what: str, low: int = 0, high: int = MAX_COUNT) -> int:
    """Parse a whole number within a range."""
    digits = token.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 18):
        raise FormatError(f"{what}: '{shorten(token)}' is not a whole number")
    return check_range(int(token), what, low, high)


def compare_count(stated: int, held: int) -> str:
    """Return a note if the stated number of frames differs from the number of whole frames in the file, else "".

    Raises:
        FormatError: Too many frames are missing: the file was cut off.
    """
    if held < stated - max(_FEW_FRAMES, _FEW_SHARE * stated):
        raise FormatError(f"the file ends after {held} of {stated} frames: it was cut off")
    return f"it states {counted(stated, 'frame')} and holds {held}, which are read" if held != stated else ""


def check_range(value: N, what: str, low: float, high: float) -> N:
    """Check that a value is in a range, and return it."""
    if not low <= value <= high:
        raise FormatError(f"{what} is {value:.10g}; allowed: {low:.10g} to {high:.10g}")
    return value


def parse_numbers(tokens: Sequence[str], what: str, count: int) -> list[float]:
    """Parse exactly `count` finite numbers."""
    if len(tokens) != count:
        raise FormatError(f"{what} needs {counted(count, 'number')}, found {len(tokens)}")
    return [parse_number(token, what) for token in tokens]


def parse_triples(numbers: list[Any], what: str) -> npt.NDArray[np.float64]:
    """Return the triples (K, 3) of a flat JSON list of keypoints; NaN and null mean "not detected"."""
    numbers = [math.nan if n is None else n for n in numbers]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and not abs(n) > MAX_MAGNITUDE for n in numbers):
        raise FormatError(f"{what} holds a value that is no number or absurdly large")
    return np.array(numbers, dtype=np.float64).reshape(-1, 3)


def parse_json(data: bytes | str, what: str) -> Any:
    """Parse JSON; NaN is allowed, because some detectors write it, but not infinity."""
    text = decode(data, what)

    def refuse(constant: str) -> float:
        if constant == "NaN":
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
