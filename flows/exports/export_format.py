"""The protocol of export formats."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pasdedeux.errors import InputError
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Reference, SourceCredit, Store, TableData, iter_rows
from storage_schema.columns import is_plain_name
from tasks.files.curation import names_left_out, without

RestPose = Literal["source", "standing"]
Units = Literal["cm", "m", "source"]
Rate = Literal["study", "source"]
POSED_OPTIONS = frozenset({"verdict", "all_methods"})
"""Options of every format of poses."""
NOT_GOOD = "not_good"
"""Folder of results with a worse verdict than requested."""


@dataclass(frozen=True)
class Export:
    """An export: rows, options and credits.

    Args:
        store: Store that holds it.
        text: The text of the reference.
        reference: The reference.
        refs: The artifacts that it names.
        rest_pose: Rest pose of the skeletons of takes and variants: the source's, or a standing T-pose.
        units: Lengths of their BVH files: centimetres, metres, or the units of each source's file.
        selected: Selected rows, which are exported instead of those of the reference.
        rate: Rate of takes and variants: the study's, or that of each take's source.
        verdict: The worst level in the folder itself; worse results get a separate folder.
        all_methods: Results of all methods that lift or reconstruct, also of baselines, instead of the product.
        footage: Video for drawing results on; None for blank frames.
        body_model: Body model for parameters.
        sources: Licences and credits of the rows.
        choices: Accepted and rejected items, in the form of a study, see `tasks.files.curation`.
        make_rows: Makes the rows, for a table that is in no store.
    """

    store: Store
    text: str
    reference: Reference
    refs: tuple[ArtifactRef, ...]
    rest_pose: RestPose = "source"
    units: Units = "cm"
    selected: TableData | None = None
    rate: Rate = "study"
    verdict: Level = Level.FAIL
    all_methods: bool = False
    footage: Path | None = None
    body_model: Path | None = None
    sources: tuple[SourceCredit, ...] = ()
    choices: Mapping[str, str] = field(default_factory=dict)
    make_rows: Callable[[Export], Iterator[TableData]] | None = None

    @property
    def credit(self) -> str:
        """Licence and credit of every source in one line."""
        return "; ".join(
            f"{source.name}, licence: {source.licence}, credit: {source.credit}" for source in self.sources
        )

    def batches(self) -> Iterator[TableData]:
        """Return the rows to export, some 10,000 at a time."""
        if self.make_rows is not None:
            return self.make_rows(self)
        rows = iter_rows(self.text, self.store) if self.selected is None else iter((self.selected,))
        return (without(row, self.left_out) for row in rows)

    @cached_property
    def left_out(self) -> Collection[str]:
        """The names of excluded rows."""
        return names_left_out(self.store, self.reference, self.choices)


@dataclass(frozen=True)
class ExportFormat:
    """A format of exported files; licence and credits are written for all formats.

    Args:
        write: Writes the files into an existing folder, at paths of `FileNames`, and returns them. Lengths, axes, rate
            and joint names are in the files, unless the format fixes them.
        can_write: Returns whether it can hold the rows of a reference.
        writes: The tables that it can write, in words, after "allowed are".
        has_rest_pose: Whether it writes skeletons with a choice of rest pose and units.
        options: Further options that it has: verdict, all_methods, footage, body_model.
    """

    write: Callable[[Export, Path], Iterable[Path]]
    can_write: Callable[[Reference], bool] = lambda _: True
    writes: str = "all tables"
    has_rest_pose: bool = False
    options: frozenset[str] = frozenset()


class FileNames:
    """Unique paths of the files of a folder, made of the names of their contents.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._times = Counter[str]()

    def path(self, *parts: str | int, suffix: str, who: str = "", is_apart: bool = False) -> Path:
        """Return a path, with a number if it was returned before: take a_b, variant c and take a, variant b_c.

        Results with a worse verdict than requested are apart. `who` is the person of a file, after a dot.

        Raises:
            InputError: A part, which may come from foreign rows, is no plain name.
        """
        for part in parts:
            if not is_plain_name(str(part)):
                raise InputError(
                    f"{json.dumps(part)[:80]} is to be part of a file's name: up to 200 letters, digits, '.', '_' and "
                    "'-' are allowed; it is the name of a take, sequence, variant or model of this export"
                )
        name = "_".join(map(str, parts)) + (f".{who}" if who else "")
        self._times[name] += 1
        number = f".{self._times[name]}" if self._times[name] > 1 else ""
        folder = self._folder / NOT_GOOD if is_apart else self._folder
        folder.mkdir(exist_ok=True)
        return folder / f"{name}{number}{suffix}"


def names_pairs(reference: Reference) -> bool:
    """Return whether a reference names pairs of one moment: seeds, or one draw."""
    return reference.table == "seeds" or (reference.table == "draws" and reference.row is not None)


_LINE = re.compile(r"(?P<name>[A-Za-z0-9_./-]+): \S.*")


def write_units(out: Path, said: Iterable[str], lines: Mapping[str, str]) -> Path:
    """Write the text about exported files, added to that of earlier exports in the folder.

    Args:
        out: The folder.
        said: Sentences on all files of a kind.
        lines: A line for each file, by its name.
    """
    path = out / "UNITS.txt"
    before = path.read_text("utf-8", errors="replace").partition("\n\n") if path.is_file() else ("", "", "")
    sentences = dict.fromkeys([*before[0].splitlines(), *said])
    known = {match["name"]: line for line in before[2].splitlines() if (match := _LINE.match(line))}
    each = known | {name: f"{name}: {line}" for name, line in lines.items()}
    return write_text(path, "\n".join([*sentences, "", *(each[name] for name in sorted(each))]) + "\n")


_CODECS = {".mp4": "vp09", ".avi": "MJPG"}


def write_film(path: Path, images: Iterable[Any], rate_hz: float) -> Path:
    """Write images (height, width, 3), BGR, as a film and return its path; a failure leaves no file.

    MP4 is written as VP9, which browsers play; the last row and column of an odd size are left out.

    Raises:
        InputError: Films of this name or size cannot be written here.
    """
    import cv2  # here, as the import takes a quarter of a second

    part, video = path.with_name(f".part-{path.name}"), None
    codec = cv2.VideoWriter.fourcc(*_CODECS.get(path.suffix.lower(), "mp4v"))
    try:
        for image in images:
            height, width = (length - length % 2 for length in image.shape[:2])
            if video is None:
                video = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, codec, rate_hz, (width, height))
                if not video.isOpened():
                    raise InputError(f"no film of {width} x {height} can be written as {path}; films are .mp4 or .avi")
            video.write(image[:height, :width])
        if video is not None:
            video.release()
            part.replace(path)
    finally:
        if video is not None:
            video.release()
        part.unlink(missing_ok=True)
    return path


def write_text(path: Path, text: str) -> Path:
    """Write a text file and return its path."""
    path.write_text(text, encoding="utf-8")
    return path
