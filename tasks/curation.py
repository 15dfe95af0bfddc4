"""What a person accepted or rejected: a small text file, a line a choice, that a study names.

A choice is about one thing with one content: `reject variants waltz/A-uniform-0.80 3fa9c1d2e4b5 feet slide`.  It
survives a rebuild that gives the same content; of other content nobody has said anything yet.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.settings import NOT_A_KEY, Settings
from storage_schema import TABLES, Reference, Store, TableData, iter_rows

Decision = Literal["accept", "reject"]
DECISIONS: tuple[Decision, ...] = ("accept", "reject")
IDENTITY: Mapping[str, tuple[str, ...]] = {
    "variants": ("take_id", "variant_id"),
    "poses": ("take_id",),
    "motions": ("sequence_id", "method"),
    "lifted_pairs": ("sequence_id", "frame", "person_id", "partner_id", "method"),
    "draws": ("density", "seed_index", "chain", "draw"),
    "seeds": ("seed_index",),
    "annotations": ("sequence_id",),
    "in_betweens": ("sequence_id", "method"),
}
"""Tables that choices are about, and the columns that name a thing there."""
POSITIONS: Mapping[str, str] = {
    **dict.fromkeys(("variants", "poses", "motions"), "body22_m"),
    **dict.fromkeys(("lifted_pairs", "draws", "seeds", "in_betweens"), "pair17_m"),
    "annotations": "pair17_px",
}
"""The column that is the content of such a thing."""
UNDECIDED = "undecided"
_DIGITS = 12
_HEADER = "# decision table name content reason\n"


class CurationSettings(Settings):
    """The `[curation]` section: what a person accepted or rejected."""

    file: Path | None = Field(None, description="Text file of choices, as `view` and `curate` write it")
    choices: dict[str, str] = Field(
        {}, description="What the file says, by what each choice is about", json_schema_extra=NOT_A_KEY
    )


@dataclass(frozen=True)
class Choice:
    """One choice; the content is the beginning of a sha256 over positions."""

    decision: Decision
    table: str
    name: str
    content: str
    reason: str = ""

    @property
    def about(self) -> str:
        """Return what it is about, content aside."""
        return f"{self.table} {self.name}"

    @property
    def line(self) -> str:
        """Return it as a line of the file."""
        return " ".join(f"{self.decision} {self.about} {self.content} {self.reason}".split())


def content_of(values: Any) -> str:
    """Return the digest of positions (row, ...), in single precision as stored."""
    data = np.ascontiguousarray(values, dtype="<f4").tobytes()
    return hashlib.sha256(data).hexdigest()[:_DIGITS]


def read_choices(path: Path) -> dict[str, Choice]:
    """Return the choices of a file by what they are about; none where there is no file.

    Raises:
        InputError: A line is none: names the file and the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: this is no text file of choices") from None
    found: dict[str, Choice] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        decision, table, name, content, reason = [*line.split(maxsplit=4), *[""] * 5][:5]
        if decision not in DECISIONS or table not in IDENTITY or len(content) != _DIGITS:
            raise InputError(
                f"{path.name}, line {number}: a choice is '{'|'.join(DECISIONS)} TABLE NAME CONTENT [REASON]' with a "
                f"content of {_DIGITS} digits and a table of {', '.join(IDENTITY)}; found '{line[:60]}'"
            )
        choice = Choice(decision, table, name, content, reason)
        found[choice.about] = choice
    return found


def write_choices(path: Path, choices: Iterable[Choice]) -> None:
    """Write a file of choices, in order, after the comments that it has: two new files of the same are the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    there = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    comments = [f"{line}\n" for line in there if line.startswith("#") and f"{line}\n" != _HEADER]
    new = path.with_name(f".{path.name}.new")
    lines = [_HEADER, *comments, *sorted(f"{one.line}\n" for one in choices)]
    new.write_text("".join(lines), encoding="utf-8")
    new.replace(path)


def as_settings(choices: Mapping[str, Choice]) -> dict[str, str]:
    """Return choices as a study has them."""
    return {about: f"{one.decision} {one.content} {one.reason}".rstrip() for about, one in sorted(choices.items())}


def choices_in(path: Path) -> dict[str, str]:
    """Return the choices of a file that somebody named, as a study has them.

    Raises:
        InputError: There is no such file, or a line is no choice.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    return as_settings(read_choices(path))


def rejections(settings: Mapping[str, str], table: str) -> dict[str, str]:
    """Return the content of each thing of a table that was rejected, by its name."""
    found = {about.partition(" ")[2]: said.split() for about, said in settings.items() if about.split()[0] == table}
    return {name: said[1] for name, said in found.items() if said[0] == "reject"}


def content_columns(table: str) -> list[str] | None:
    """Return the columns by which a thing of a table, and its content, are known; None of a table without things."""
    return [*IDENTITY[table], POSITIONS[table]] if table in IDENTITY else None


def names_of(data: TableData) -> np.ndarray:
    """Return the name of what each row is of (row,)."""
    columns = (np.asarray(data[name]).astype(str) for name in IDENTITY[data.table.name])
    return np.array(["/".join(one) for one in zip(*columns, strict=True)])


def rejected_names(rejected: Mapping[str, str], batches: Iterable[TableData]) -> Collection[str]:
    """Return the names of what is rejected and has the content that was looked at.

    Args:
        rejected: What `rejections` gave; where that is nothing, nothing is read.
        batches: Rows with the columns that `content_columns` names.
    """
    parts: dict[str, list[Any]] = {}
    for data in batches if rejected else ():
        names = names_of(data)
        for name in rejected.keys() & set(names.tolist()):
            parts.setdefault(name, []).append(data[POSITIONS[data.table.name]][names == name])
    return {name for name, values in parts.items() if content_of(np.concatenate(values)) == rejected[name]}


def names_left_out(store: Store, reference: Reference, choices: Mapping[str, str]) -> Collection[str]:
    """Return the names of what is rejected of what a reference names; a thing is looked at with all of its rows."""
    whole = replace(reference, row=None)
    rows = iter_rows(whole, store, columns=content_columns(whole.table))
    return rejected_names(rejections(choices, whole.table), rows)


def without(data: TableData, names: Collection[str]) -> TableData:
    """Return the rows that are of nothing with one of these names."""
    if not names or data.table.name not in IDENTITY:
        return data
    return TableData(TABLES[data.table.name], data.rows.take(rows_without(data, names)))


def rows_without(data: TableData, names: Collection[str]) -> np.ndarray:
    """Return which rows (n,) are of nothing with one of these names."""
    return np.flatnonzero(~np.isin(names_of(data), list(names))) if names else np.arange(data.num_rows)


class Choosing:
    """A file of choices, read again before each change: two people, or a person and an editor, lose nothing.

    Raises:
        InputError: The file holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        read_choices(self.path)

    def about(self, table: str, name: str) -> Choice | None:
        """Return what was chosen, whatever the content was."""
        return read_choices(self.path).get(f"{table} {name}")

    def words(self, table: str, name: str, content: str) -> str:
        """Return what was chosen in words, and whether it was of this content."""
        choice = self.about(table, name)
        if choice is None:
            return UNDECIDED
        said = f"{choice.decision}ed{f': {choice.reason}' if choice.reason else ''}"
        return said if choice.content == content else f"{said} (it had other content then: choose again)"

    def decide(
        self, decision: Decision | Literal["undo"], table: str, name: str, content: str, reason: str = ""
    ) -> str:
        """Write a choice, or forget it, and say so."""
        choices = read_choices(self.path)
        if decision == "undo":
            choices.pop(f"{table} {name}", None)
        else:
            choice = Choice(decision, table, name, content, reason)
            choices[choice.about] = choice
        write_choices(self.path, choices.values())
        return f"{table} {name}: {UNDECIDED if decision == 'undo' else f'{decision}ed'}; {len(choices)} in {self.path}"
