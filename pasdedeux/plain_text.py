"""Text for people: numbers with nouns, and what others wrote (names, notes, credits) made harmless."""

from __future__ import annotations

import csv
import io
import re

_HIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Controls of terminals, and marks that change the order in which text is read; not tabs and ends of lines."""
_FORMULA = re.compile(r"\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\n]")
"""Begins what a table program computes instead of showing it."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(inf|nan)", re.IGNORECASE)
_MARKS = str.maketrans({"<": "&lt;", ">": "&gt;", "|": "\\|", "[": "\\[", "]": "\\]", "\n": " ", "\t": " "})


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, which makes its plural with an s; people are people.

    >>> counted(1, "shard"), counted(1200, "shard"), counted(2, "person")
    ('1 shard', '1200 shards', '2 people')
    """
    if number == 1:
        return f"1 {noun}"
    return f"{number} people" if noun == "person" else f"{number} {noun}s"


def visible(text: str, *, is_line: bool = False) -> str:
    r"""Return text with controls of terminals written out, for a line also tabs and ends of lines.

    It is written as JSON does, so JSON stays the same.

    >>> visible("a\x1b]0;b")
    'a\\u001b]0;b'
    """
    text = _HIDDEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
    return text.replace("\n", "\\n").replace("\t", "\\t") if is_line else text


def cell_text(text: str) -> str:
    """Return the text of a CSV cell, with an apostrophe before what would be a formula; numbers stay as they are.

    Text that begins with apostrophes and then a formula gets one more, so that `from_cell` returns it.

    >>> cell_text("=HYPERLINK(1)"), cell_text("-0.5"), cell_text("waltz"), cell_text("'=a")
    ("'=HYPERLINK(1)", '-0.5', 'waltz', "''=a")
    """
    text = visible(text)
    return f"'{text}" if _FORMULA.match(text.lstrip("'")) and not _NUMBER.fullmatch(text) else text


def from_cell(cell: str) -> str:
    """Return the text that `cell_text` gave a cell of.

    >>> from_cell("'=a"), from_cell("'tis")
    ('=a', "'tis")
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell.lstrip("'")) else cell


def csv_line(*cells: object) -> str:
    r"""Return a line of CSV, without its end; a cell that has ends of lines is quoted.

    >>> csv_line("-walk", -1, "a, b"), csv_line("a\nb", 2)
    ('\'-walk,-1,"a, b"', '"a\nb",2')
    """
    line = io.StringIO()
    # Python 3.11 quotes an end of a line only where it is the writer's own.
    csv.writer(line, lineterminator="\n").writerow([cell_text(str(cell)) for cell in cells])
    return line.getvalue()[:-1]


def markdown_text(text: str) -> str:
    """Return text for a line of Markdown: no HTML, link, picture or cell of a table comes of it.

    >>> markdown_text("<script>")
    '&lt;script&gt;'
    """
    return visible(text).translate(_MARKS)


def markdown_value(value: object) -> str:
    """Return what a template of Markdown gets for a value; what is Markdown already is marked as safe."""
    return str(value) if hasattr(value, "__html__") else markdown_text(str(value))
