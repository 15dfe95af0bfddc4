"""Choices of a person to accept or reject: a small text file with one choice a line, named by a study.

A choice is about one thing with one content: `reject variants waltz/A-uniform-0.80 3fa9c1d2e4b5 feet slide`.  It
survives a rebuild that gives the same content; other content is undecided.  A clip of a reconstruction is named by its
frames, first and last: `reject motions video/fit@120-180 0a12...`.  Spaces in a name are written `%20`.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, unquote

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.settings import NOT_A_KEY, Settings
from storage_schema import (
    TABLES,
    CorruptArtifact,
    MissingArtifact,
    Reference,
    Store,
    TableData,
    iter_rows,
    open_run,
    read_latest,
)
from storage_schema.datasets import open_dataset
from storage_schema.runs import STUDY_FILE
from tasks.files.user_files import read_text_file

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
"""Tables whose items can be chosen, and the columns that name an item there."""
POSITIONS: Mapping[str, str] = {
    **dict.fromkeys(("variants", "poses", "motions"), "body22_m"),
    **dict.fromkeys(("lifted_pairs", "draws", "seeds", "in_betweens"), "pair17_m"),
    "annotations": "pair17_px",
}
"""The column with the content of an item of these tables."""
CLIPPED = ("motions",)
"""Tables whose clips can be chosen, too."""
SECTION = "curation"
UNDECIDED = "undecided"
_CLIP = re.compile(r"(.+)@(\d+)-(\d+)")
_NOT_IN_A_WORD = re.compile(r"[\s%]")
_DIGITS = 12
_HEADER = "# decision table name content reason\n"


class CurationSettings(Settings):
    """The `[curation]` section: items accepted or rejected by a person."""

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
        """Return its subject, without the content."""
        return f"{self.table} {self.name}"

    @property
    def words(self) -> str:
        """Return the decision and its reason."""
        return f"{self.decision}ed{f': {self.reason}' if self.reason else ''}"

    @property
    def line(self) -> str:
        """Return it as a line of the file."""
        name = _NOT_IN_A_WORD.sub(lambda character: quote(character[0]), self.name)
        return " ".join(f"{self.decision} {self.table} {name} {self.content} {self.reason}".split())


def content_of(values: Any) -> str:
    """Return the digest of positions (row, ...), in single precision as stored."""
    data = np.ascontiguousarray(values, dtype="<f4").tobytes()
    return hashlib.sha256(data).hexdigest()[:_DIGITS]


def read_choices(path: Path) -> dict[str, Choice]:
    """Return the choices of a file by their subject; none if there is no file.

    Raises:
        InputError: A line is none: names the file and the line.
    """
    if not path.exists():
        return {}
    lines = read_text_file(path).splitlines()
    choices: dict[str, Choice] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        decision, table, name, content, reason = [*line.split(maxsplit=4), *[""] * 5][:5]
        if decision not in DECISIONS or table not in IDENTITY or len(content) != _DIGITS:
            raise InputError(
                f"{path.name}, line {number}: a choice is '{'|'.join(DECISIONS)} TABLE NAME CONTENT [REASON]', where "
                f"CONTENT has {_DIGITS} digits and TABLE is one of {', '.join(IDENTITY)}; found '{line[:60]}'"
            )
        choice = Choice(decision, table, unquote(name), content, reason)
        choices[choice.about] = choice
    return choices


def write_choices(path: Path, choices: Iterable[Choice]) -> None:
    """Write a file of choices in order, keeping its comments at the top; equal choices give equal files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    there = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    comments = [f"{line}\n" for line in there if line.startswith("#") and f"{line}\n" != _HEADER]
    new = path.with_name(f".{path.name}.new")
    lines = [_HEADER, *comments, *sorted(f"{choice.line}\n" for choice in choices)]
    new.write_text("".join(lines), encoding="utf-8")
    new.replace(path)


def as_settings(choices: Mapping[str, Choice]) -> dict[str, str]:
    """Return choices as a study has them."""
    return {
        about: f"{choice.decision} {choice.content} {choice.reason}".rstrip()
        for about, choice in sorted(choices.items())
    }


def choices_in(path: Path) -> dict[str, str]:
    """Return the choices of a named file, as a study has them.

    Raises:
        InputError: There is no such file, or a line is no choice.
    """
    if not path.exists():
        raise InputError(f"there is no file {path}")
    return as_settings(read_choices(path))


def choices_for(store: Store, reference: Reference, file: Path | None = None) -> dict[str, str]:
    """Return choices as a study has them: from this file, a study's current file, or as released with a dataset.

    Raises:
        InputError: The file is not there, or holds something else.
    """
    if file is not None:
        return choices_in(file)
    if reference.dataset:
        return recorded_choices(open_dataset(store, reference.dataset).path)
    if not reference.study:
        return {}
    try:
        last = read_latest(store, reference.study)
        section = {} if last is None else json.loads(open_run(store, last.run_id).read(STUDY_FILE)).get(SECTION, {})
    except (CorruptArtifact, MissingArtifact, ValueError):  # the record is gone: nothing is said
        return {}
    path = section.get("file")
    return choices_in(Path(path)) if path and Path(path).is_file() else section.get("choices", {})


def recorded_choices(folder: Path) -> dict[str, str]:
    """Return the choices that went with a dataset in this folder; none where its study is not with it."""
    path = folder / STUDY_FILE
    sections: dict[str, Any] = json.loads(path.read_bytes()) if path.is_file() else {}
    choices: dict[str, str] = sections.get(SECTION, {}).get("choices", {})
    return choices


def rejections(settings: Mapping[str, str], table: str) -> dict[str, str]:
    """Return the content of each thing of a table that was rejected, by its name."""
    choices = {about.partition(" ")[2]: said.split() for about, said in settings.items() if about.split()[0] == table}
    return {name: said[1] for name, said in choices.items() if said[0] == "reject"}


def content_columns(table: str) -> list[str] | None:
    """Return the columns by which a thing of a table, and its content, are known; None of a table without things."""
    frame = ["frame"] if table in CLIPPED else []
    return [*IDENTITY[table], *frame, POSITIONS[table]] if table in IDENTITY else None


def names_of(data: TableData) -> np.ndarray:
    """Return the name of the item of each row (row,)."""
    columns = (np.asarray(data[name]).astype(str) for name in IDENTITY[data.table.name])
    return np.array(["/".join(names) for names in zip(*columns, strict=True)])


def clip_name(name: str, first: int, last: int) -> str:
    """Return the name of a clip of a thing, by its first and its last frame.

    >>> clip_name("video/fit", 12, 40)
    'video/fit@12-40'
    """
    return f"{name}@{first}-{last}"


def clip_of(name: str) -> tuple[str, tuple[int, int] | None]:
    """Return the name of the whole motion, and the first and last frame if the name is of a clip.

    >>> clip_of("video/fit@12-40"), clip_of("waltz")
    (('video/fit', (12, 40)), ('waltz', None))
    """
    match = _CLIP.fullmatch(name)
    return (name, None) if match is None else (match[1], (int(match[2]), int(match[3])))


def rows_of_item(data: TableData, name: str, names: np.ndarray) -> np.ndarray:
    """Return which rows (row,) belong to an item; for a clip, those in its frames.

    Args:
        data: The rows; their frames are needed if the name is that of a clip.
        name: Its name.
        names: Names of the rows, from `names_of`.
    """
    whole, clip = clip_of(name) if data.table.name in CLIPPED else (name, None)
    if clip is None:
        return np.asarray(names == name)
    frame = np.asarray(data["frame"])
    return np.asarray((names == whole) & (frame >= clip[0]) & (frame <= clip[1]))


def thing_at(data: TableData, row: int, clip: tuple[int, int] | None = None) -> tuple[str, str]:
    """Return name and content of the item at a row that is accepted or rejected.

    Args:
        data: Rows with the columns that `content_columns` names: all of the item, and perhaps others.
        row: One of them.
        clip: Only from this frame to that one.

    Raises:
        InputError: Clips of this table cannot be chosen, or the thing has no such frames.
    """
    names = names_of(data)
    name = str(names[row])
    if clip is not None:
        refuse_clips(data.table.name)
        there = int(data["frame"].min()), int(data["frame"].max())
        if not there[0] <= clip[0] <= clip[1] <= there[1]:
            raise InputError(f"{name} has the frames {there[0]} to {there[1]}; there is no clip {clip[0]}-{clip[1]}")
        name = clip_name(name, *clip)
    return name, content_of(data[POSITIONS[data.table.name]][rows_of_item(data, name, names)])


def refuse_clips(table: str) -> None:
    """Raise an InputError where clips of a table cannot be chosen."""
    if table not in CLIPPED:
        raise InputError(f"clips are chosen of {', '.join(CLIPPED)}, not of {table}")


def rejected_names(rejected: Mapping[str, str], batches: Iterable[TableData]) -> Collection[str]:
    """Return the names of rejected items that still have the content that was judged.

    Args:
        rejected: Result of `rejections`; if it is empty, nothing is read.
        batches: Rows with the columns that `content_columns` names.
    """
    parts: dict[str, list[Any]] = {}
    for data in batches if rejected else ():
        names, positions = names_of(data), data[POSITIONS[data.table.name]]
        there = set(names.tolist())
        for name in (name for name in rejected if {name, clip_of(name)[0]} & there):
            if (is_rejected := rows_of_item(data, name, names)).any():
                parts.setdefault(name, []).append(positions[is_rejected])
    return {name for name, values in parts.items() if content_of(np.concatenate(values)) == rejected[name]}


def names_left_out(store: Store, reference: Reference, choices: Mapping[str, str]) -> Collection[str]:
    """Return the names of rejected items of a reference; an item is judged with all of its rows."""
    whole = replace(reference, row=None)
    rows = iter_rows(whole, store, columns=content_columns(whole.table))
    return rejected_names(rejections(choices, whole.table), rows)


def without(data: TableData, names: Collection[str]) -> TableData:
    """Return the rows that belong to no item with one of these names."""
    if not names or data.table.name not in IDENTITY:
        return data
    return TableData(TABLES[data.table.name], data.rows.take(rows_without(data, names)))


def rows_without(data: TableData, names: Collection[str]) -> np.ndarray:
    """Return which rows (n,) belong to no item with one of these names."""
    if not names:
        return np.arange(data.num_rows)
    row_names = names_of(data)
    is_out = np.isin(row_names, list(names))
    for name in names if data.table.name in CLIPPED else ():
        is_out |= rows_of_item(data, name, row_names)
    return np.flatnonzero(~is_out)


class Choosing:
    """A file of choices. It is read again before each change, so that concurrent edits are not lost.

    Raises:
        InputError: The file holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        read_choices(self.path)

    def about(self, table: str, name: str) -> Choice | None:
        """Return the choice on an item, for any content."""
        return read_choices(self.path).get(f"{table} {name}")

    def clips(self, table: str, name: str) -> dict[tuple[int, int], Choice]:
        """Return the choices on clips of an item by first and last frame, in order; empty if clips cannot be chosen."""
        chosen = (choice for choice in read_choices(self.path).values() if choice.table == table and table in CLIPPED)
        by_clip = {clip_of(choice.name): choice for choice in chosen}
        return dict(sorted((frames, choice) for (whole, frames), choice in by_clip.items() if whole == name and frames))

    def words(self, table: str, name: str, content: str) -> str:
        """Return the choice in words, and whether it was made for this content."""
        choice = self.about(table, name)
        if choice is None:
            return UNDECIDED
        is_same = choice.content == content
        return choice.words if is_same else f"{choice.words} (it had other content then: choose again)"

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
