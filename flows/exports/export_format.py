"""What a format is in which the store gives out what it holds."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Reference, Store, TableData, iter_rows
from storage_schema.columns import is_plain_name
from tasks.curation import content_columns, rejected_names, without

RestPose = Literal["source", "standing"]
Units = Literal["cm", "m", "source"]


@dataclass(frozen=True)
class Export:
    """What is to be given out.

    Args:
        store: Store that holds it.
        text: The reference as it was given.
        reference: The reference.
        refs: The artifacts that it names.
        rest_pose: Rest pose of the skeletons of takes and variants: the source's, or a standing T-pose.
        units: Lengths of their BVH files: centimetres, metres, or the units of each source's file.
        selected: Rows that were made of what is named, and are given out in its place.
        rejected: What somebody rejected of this table: content by name, see `tasks.curation`.
    """

    store: Store
    text: str
    reference: Reference
    refs: tuple[ArtifactRef, ...]
    rest_pose: RestPose = "source"
    units: Units = "cm"
    selected: TableData | None = None
    rejected: Mapping[str, str] = field(default_factory=dict)

    def batches(self) -> Iterator[TableData]:
        """Return the rows to be given out, some 10,000 at a time."""
        rows = iter_rows(self.text, self.store) if self.selected is None else iter((self.selected,))
        return (without(one, self.left_out) for one in rows)

    @cached_property
    def left_out(self) -> Collection[str]:
        """The names of what is left out."""
        rows = iter_rows(replace(self.reference, row=None), self.store, columns=content_columns(self.reference.table))
        return rejected_names(self.rejected, rows)


@dataclass(frozen=True)
class ExportFormat:
    """One format of files that go out.  Licence and credits are written beside the files for all of them.

    Args:
        write: Writes the files into a folder that is there, at paths of `FileNames`, and returns them.  Lengths, axes,
            rate and joint names are in the files or their format fixes them: nothing leaves without units.
        can_write: Tells whether it can hold what a reference names.
        writes: What it can write, in words, after "allowed are".
        has_rest_pose: Whether it writes skeletons, so that their rest pose and units can be chosen.
    """

    write: Callable[[Export, Path], Iterable[Path]]
    can_write: Callable[[Reference], bool] = lambda _: True
    writes: str = "all tables"
    has_rest_pose: bool = False


class FileNames:
    """Paths of the files of a folder, made of the names of what is in them: none twice, and none elsewhere.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._times = Counter[str]()

    def path(self, *parts: str | int, suffix: str) -> Path:
        """Return a path, with a number where it was given before: take a_b, variant c and take a, variant b_c.

        Raises:
            InputError: A part, which may come from rows that somebody else wrote, is no plain name.
        """
        for part in parts:
            if not is_plain_name(str(part)):
                raise InputError(
                    f"{json.dumps(part)[:80]} is to be part of a file's name: up to 200 letters, digits, '.', '_' and "
                    "'-' are allowed; what was to be exported names a take, sequence, variant or model so"
                )
        name = "_".join(map(str, parts))
        self._times[name] += 1
        number = f".{self._times[name]}" if self._times[name] > 1 else ""
        return self._folder / f"{name}{number}{suffix}"


def names_pairs(reference: Reference) -> bool:
    """Return whether a reference names pairs of one moment: seeds, or one draw."""
    return reference.table == "seeds" or (reference.table == "draws" and reference.row is not None)


def write_text(path: Path, text: str) -> Path:
    """Write a text file and return its path."""
    path.write_text(text, encoding="utf-8")
    return path
