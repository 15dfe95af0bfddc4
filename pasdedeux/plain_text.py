"""Text for people: counts with their nouns, and harmless forms of text by others (names, notes, credits)."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

_HIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters and marks that change the direction of text; not tabs and line ends."""
_FORMULA = re.compile(r"\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\n]")
"""Start of a cell that a spreadsheet would compute."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(inf|nan)", re.IGNORECASE)
_MARKS = str.maketrans({"<": "&lt;", ">": "&gt;", "|": "\\|", "[": "\\[", "]": "\\]", "\n": " ", "\t": " "})


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural with an s; "person" becomes "people".

    >>> counted(1, "shard"), counted(1200, "shard"), counted(2, "person")
    ('1 shard', '1200 shards', '2 people')
    """
    if number == 1:
        return f"1 {noun}"
    return f"{number} people" if noun == "person" else f"{number} {noun}s"


def together(names: Sequence[str]) -> str:
    """Join names as a sentence does.

    >>> together(["a", "b", "c"])
    'a, b and c'
    """
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def visible(text: str, *, is_line: bool = False) -> str:
    r"""Return text with control characters escaped; for a line, tabs and line ends too.

    Escapes are those of JSON, so JSON does not change.

    >>> visible("a\x1b]0;b")
    'a\\u001b]0;b'
    """
    text = _HIDDEN.sub(lambda match: f"\\u{ord(match[0]):04x}", text)
    return text.replace("\n", "\\n").replace("\t", "\\t") if is_line else text


def cell_text(text: str) -> str:
    """Return the text of a CSV cell, with an apostrophe before a formula; numbers do not change.

    Text that has apostrophes before a formula gets one more, so that `from_cell` returns it.

    >>> cell_text("=HYPERLINK(1)"), cell_text("-0.5"), cell_text("waltz"), cell_text("'=a")
    ("'=HYPERLINK(1)", '-0.5', 'waltz', "''=a")
    """
    text = visible(text)
    return f"'{text}" if _FORMULA.match(text.lstrip("'")) and not _NUMBER.fullmatch(text) else text


def from_cell(cell: str) -> str:
    """Return the text from which `cell_text` made a cell.

    >>> from_cell("'=a"), from_cell("'tis")
    ('=a', "'tis")
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell.lstrip("'")) else cell


def csv_line(*cells: object) -> str:
    r"""Return a line of CSV without its line end; cells with line ends are quoted.

    >>> csv_line("-walk", -1, "a, b"), csv_line("a\nb", 2)
    ('\'-walk,-1,"a, b"', '"a\nb",2')
    """
    line = io.StringIO()
    # Python 3.11 quotes only the line end of the writer itself.
    csv.writer(line, lineterminator="\n").writerow([cell_text(str(cell)) for cell in cells])
    return line.getvalue()[:-1]


def markdown_text(text: str) -> str:
    """Return text for a line of Markdown, with HTML, links, pictures and table cells escaped.

    >>> markdown_text("<script>")
    '&lt;script&gt;'
    """
    return visible(text).translate(_MARKS)


def markdown_value(value: object) -> str:
    """Return a value as text for a Markdown template; values marked as safe are Markdown already."""
    return str(value) if hasattr(value, "__html__") else markdown_text(str(value))
