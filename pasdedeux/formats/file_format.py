"""The protocol of input formats: recognition, companion files, reading.

A new format is one file with a `MotionFormat` or an `AnnotationFormat`, and one line in `registry.py`.  The contract
test, `tests/contract/test_input_formats.py`, needs one good file of the format.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from pasdedeux.errors import FormatError, named
from pasdedeux.formats.npz import array_names, is_npz
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.detections import Detection, join_detections
from pasdedeux.formats.poses2d.image_names import places_of_names
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import find_delimiter, wide_encoding
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import KeypointLayout

LOOKED_AT_BYTES = 200_000
"""Length of the part of a text file that format recognition reads."""


class FileStart:
    """The beginning of a file, inspected once for all formats."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    @property
    def head(self) -> bytes:
        """The first bytes."""
        return self._data[:16]

    @cached_property
    def array_names(self) -> frozenset[str]:
        """Names of the arrays of an npz archive; empty for other files.  A damaged archive raises a FormatError."""
        return array_names(self._data) if is_npz(self._data) else frozenset()

    @cached_property
    def text(self) -> str:
        """The first 200 kB as text, without leading blanks; empty for an npz archive."""
        if is_npz(self._data):
            return ""
        start = self._data[:LOOKED_AT_BYTES]
        wide = wide_encoding(start)
        return start.decode(wide or "utf-8-sig", errors="replace").removeprefix("\ufeff").lstrip()

    @cached_property
    def first_row(self) -> str:
        """First line that is neither empty nor a comment (#)."""
        lines = (line.strip() for line in self.text.splitlines())
        return next((line for line in lines if line and not line.startswith("#")), "")

    @cached_property
    def columns(self) -> list[str]:
        """Cells of the first row, in lower case: the column names if the file is a table."""
        cells = self.first_row.split(find_delimiter(self.first_row))
        return [cell.strip().strip('"').lower() for cell in cells]

    @property
    def is_json(self) -> bool:
        """Whether the text begins like a JSON object or list."""
        return self.text[:1] in ("{", "[")

    @cached_property
    def is_by_frame(self) -> bool:
        """Whether it is a JSON object of nested values whose keys contain numbers, such as frames or images."""
        return re.match(r'\{\s*"[^"]*\d[^"]*"\s*:\s*[\[{]', self.text) is not None

    @cached_property
    def has_points(self) -> bool:
        """Whether it is JSON with objects that have a number `x`."""
        return self.is_json and re.search(r'"x"\s*:\s*-?\d', self.text) is not None

    def has_key(self, *keys: str) -> bool:
        """Return whether it is JSON with one of these keys."""
        return self.is_json and any(f'"{key}"' in self.text for key in keys)


@dataclass(frozen=True)
class MotionHead:
    """Head of a motion file, read without converting its rotations.

    Args:
        rest: One frame of the rest pose, with the rate and unit that the file states.
        num_frames: Number of frames in the file.
    """

    rest: SourceMotion
    num_frames: int


@dataclass(frozen=True, kw_only=True)
class FileFormat:
    """One format of files: bytes in, values out, never a path.

    Args:
        name: Name in a study (`format = "bvh"`) and in the column `source_format`.
        suffixes: File name endings, lower case with the dot; only such files of a folder are inspected.
        recognises: Returns whether the content is of this format; must be false for valid files of other formats.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[FileStart], bool]


@dataclass(frozen=True, kw_only=True)
class MotionFormat(FileFormat):
    """A format of motions of one person.

    Rate and unit are None in the `SourceMotion` if the file does not state them; they are set or guessed later.
    If the file or its companion is damaged, readers raise a FormatError with the line or frame and the fault.

    Args:
        read: Reads the whole file and its companion (empty bytes for formats without one).
        head: Checks the file and returns skeleton and length; set it if that is cheaper than reading everything.
        companion: Name of the second file that a motion needs, such as "skeleton"; empty if it needs none.
        companion_names: Returns possible paths of the companion of a file, relative to its folder, likeliest first.
        is_companion: Returns whether a file, which is of no format itself, is a companion of this format.
        check_companion: Reads a companion and refuses a damaged one, so that the error names the right file.
        has_rotations: False if files hold positions only; rotations are then swings without twist.
        read_other: Reads one person, counted from 0, of a file that may hold several; `read` reads the first.
        count_people: Returns the number of people in a file.
    """

    read: Callable[[bytes, bytes], SourceMotion]
    head: Callable[[bytes, bytes], MotionHead] | None = None
    companion: str = ""
    companion_names: Callable[[str], Sequence[str]] = lambda name: ()
    is_companion: Callable[[FileStart], bool] = lambda start: False
    has_rotations: bool = True
    check_companion: Callable[[bytes], object] = lambda data: None
    read_other: Callable[[bytes, bytes, int], SourceMotion] | None = None
    count_people: Callable[[bytes], int] = lambda data: 1

    def read_person(self, number: int, data: bytes, companion: bytes = b"") -> SourceMotion:
        """Read the person to use when a take names the same file for the `number`-th time, counted from 0.

        Raises:
            FormatError: The format can hold several people and the file holds too few; or as `read`.
        """
        if number == 0 or self.read_other is None:
            return self.read(data, companion)
        count = self.count_people(data)
        if number >= count:
            held = counted(count, "person")
            raise FormatError(f"person {number}: it holds {held}; the take names it more often")
        return self.read_other(data, companion, number)

    def read_people(self, data: bytes, companion: bytes = b"") -> list[SourceMotion]:
        """Read all people of a file."""
        return [self.read_person(number, data, companion) for number in range(self.count_people(data))]

    def read_head(self, data: bytes, companion: bytes = b"", *, number: int = 0) -> MotionHead:
        """Check the file and return skeleton and length of a person, counted as in `read_person`."""
        if self.head and number == 0:
            return self.head(data, companion)
        source = self.read_person(number, data, companion)
        return MotionHead(source.rest, source.num_frames)


@dataclass(frozen=True, kw_only=True)
class AnnotationFormat(FileFormat):
    """A format of 2D poses: a source is one file, or a folder with a file for each image.

    If a file is damaged, readers raise a FormatError with the line, frame or entry and the fault.

    Args:
        read_file: Reads a source that is one file.  Takes the content, the name of the sequence if the file names none,
            and the requested layout or "auto".
        read_people: Returns the people in the file of one image, except those without keypoints.
    """

    read_file: Callable[[bytes, str, str | KeypointLayout], AnnotatedFrames] | None = None
    read_people: Callable[[bytes], list[Detection]] | None = None

    @property
    def is_file_per_frame(self) -> bool:
        """Whether a source is a folder with a file for each image."""
        return self.read_people is not None

    def frame_numbers(self, names: Sequence[str]) -> list[int]:
        """Return the frame number in the name of each file of a camera; empty if the content states the frame."""
        places = places_of_names(names) if self.is_file_per_frame else {}
        return [places[name][1] for name in names if name in places]

    def read(
        self,
        files: Mapping[str, bytes],
        *,
        sequence_id: str,
        layout: str | KeypointLayout = "auto",
        skip_unreadable: bool = False,
    ) -> AnnotatedFrames:
        """Read a source from its files: one file, or one per frame.

        A damaged last file of several is skipped, because its writer may have been stopped.

        Args:
            files: Content of each file by its name, without folders.
            sequence_id: Name of the sequence if the files name none.
            layout: Requested keypoint layout; "auto" takes the stated layout or detects it from the keypoints.
            skip_unreadable: Skip and list damaged files instead of raising an error.
        """
        if self.read_people is None:
            assert self.read_file is not None
            ((name, data),) = files.items()
            with named(name):
                return self.read_file(data, sequence_id, layout)
        people_seen: list[Detection] = []
        skipped: list[str] = []
        numbers = self.frame_numbers(list(files))
        for number, (name, data) in zip(numbers, files.items(), strict=True):
            try:
                people = self.read_people(data)
                people_seen += [
                    replace(person, place=("", number), where=f"{name}: {person.where}") for person in people
                ]
            except FormatError as error:
                if not skip_unreadable and (number < max(numbers) or len(files) == 1):
                    raise FormatError(f'{name}: {error} (set on_unreadable = "skip" to go on without it)') from None
                skipped.append(name)
        return join_detections(people_seen, sequence_id=sequence_id, layout=layout, skipped=skipped)
