"""The protocol of input formats: recognition, companion files, reading.

A new format is one file with a `MotionFormat` or an `AnnotationFormat`, and one line in `registry.py`; the contract
test in `tests/contract/test_input_formats.py` asks for a good file of it and does the rest.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from pasdedeux.errors import FormatError, named
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import Detection, join_detections
from pasdedeux.formats.image_names import places_of_names
from pasdedeux.formats.npz import array_names, is_npz
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import find_delimiter, wide_encoding
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import KeypointLayout

LOOKED_AT_BYTES = 200_000
"""Bytes of a text by which its format is told."""


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
        """Names of the arrays of an npz archive; none of any other file.  A damaged archive is a FormatError."""
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
        """The first line that is neither empty nor a comment (#)."""
        lines = (line.strip() for line in self.text.splitlines())
        return next((line for line in lines if line and not line.startswith("#")), "")

    @cached_property
    def columns(self) -> list[str]:
        """The cells of the first row as columns of a table, in lower case."""
        cells = self.first_row.split(find_delimiter(self.first_row))
        return [cell.strip().strip('"').lower() for cell in cells]

    @property
    def is_json(self) -> bool:
        """Whether it begins as a JSON object or list."""
        return self.text[:1] in ("{", "[")

    @cached_property
    def is_by_frame(self) -> bool:
        """Whether it is a JSON object of lists or objects by numbers or names with numbers, such as images."""
        return re.match(r'\{\s*"[^"]*\d[^"]*"\s*:\s*[\[{]', self.text) is not None

    @cached_property
    def has_points(self) -> bool:
        """Whether it is JSON of objects with a number `x`."""
        return self.is_json and re.search(r'"x"\s*:\s*-?\d', self.text) is not None

    def has_key(self, *keys: str) -> bool:
        """Whether it is JSON with one of these keys."""
        return self.is_json and any(f'"{key}"' in self.text for key in keys)


@dataclass(frozen=True)
class MotionHead:
    """Head of a motion file, read without converting its rotations.

    Args:
        rest: Its skeleton with one frame of rest, and what it says of rate, unit and axis.
        num_frames: Its length.
    """

    rest: SourceMotion
    num_frames: int


@dataclass(frozen=True, kw_only=True)
class FileFormat:
    """One format of files: bytes in, values out, never a path.

    Args:
        name: Name in a study (`format = "bvh"`) and in the column `source_format`.
        suffixes: Endings of such files, lower case with the dot: which files of a folder are inspected.
        recognises: Tells from its content whether a file is of this format; true for no good file of another format.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[FileStart], bool]


@dataclass(frozen=True, kw_only=True)
class MotionFormat(FileFormat):
    """A format of motions of one person.

    What a file does not say of rate, unit or up axis is None in its `SourceMotion`, and asked for or guessed later.
    Readers raise a FormatError when the file or its companion is mangled, which says the line, or the frame, and what
    is wrong.

    Args:
        read: Reads everything, of the file and its companion, which is empty for formats that need none.
        head: Returns skeleton and length after checking the file, where that is cheaper than to read everything.
        companion: What must lie beside a file, in words ("skeleton"); empty when a file stands alone.
        companion_names: Returns where the companion of a file of this name may lie, relative to its folder, likeliest
            first.
        is_companion: Tells whether a file, of no format itself, is what files of this format need beside them.
        check_companion: Reads such a companion and refuses a mangled one, so that faults get its own name.
        has_rotations: False when files hold positions only, so that rotations are swings.
        read_other: Reads the person of a number, from 0, of a file that may hold several; `read` reads the first.
        count_people: Returns how many people a file holds.
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
        """Read the person that a take means where it names the file for the `number`-th time, from 0.

        Raises:
            FormatError: The file holds several people, and fewer than that; or as `read`.
        """
        if number == 0 or self.read_other is None:
            return self.read(data, companion)
        count = self.count_people(data)
        if number >= count:
            held = counted(count, "person")
            raise FormatError(f"person {number}: it holds {held}; the take names it more often")
        return self.read_other(data, companion, number)

    def read_people(self, data: bytes, companion: bytes = b"") -> list[SourceMotion]:
        """Read everybody of a file."""
        return [self.read_person(number, data, companion) for number in range(self.count_people(data))]

    def read_head(self, data: bytes, companion: bytes = b"", *, number: int = 0) -> MotionHead:
        """Return skeleton and length of a person, as `read_person` counts them, after checking the file."""
        if self.head and number == 0:
            return self.head(data, companion)
        source = self.read_person(number, data, companion)
        return MotionHead(source.rest, source.num_frames)


@dataclass(frozen=True, kw_only=True)
class AnnotationFormat(FileFormat):
    """A format of 2D poses: a source is one file, or a folder with a file for each image.

    Readers raise a FormatError when a file is mangled, which says the line, the frame or the entry, and what is wrong.

    Args:
        read_file: Reads a source that is one file: the file, the name of the sequence where the file names none, the
            layout that is asked for or "auto".
        read_people: Returns the people of the file of one image, without those who have no keypoint.
    """

    read_file: Callable[[bytes, str, str | KeypointLayout], AnnotatedFrames] | None = None
    read_people: Callable[[bytes], list[Detection]] | None = None

    @property
    def is_file_per_frame(self) -> bool:
        """Whether a source is a folder with a file for each image."""
        return self.read_people is not None

    def frame_numbers(self, names: Sequence[str]) -> list[int]:
        """Return the frame number of each file of a camera from its name; empty if the content states it."""
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
        """Read a source from its files, given by name: one file, or one per frame.

        The last of several may be cut off, because its writer was stopped: it is skipped.

        Args:
            files: Content of each file by its name, without folders.
            sequence_id: Name of the sequence where the files do not name any.
            layout: Keypoint layout asked for; "auto" takes what the files say or what their keypoints show.
            skip_unreadable: Skip frames whose file is damaged, and name the file, instead of refusing.
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
