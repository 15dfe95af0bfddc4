"""What a format of files that come in is: how it is recognised, what it needs beside it, how it is read.

A new format is one file with a subclass of `MotionFormat` or `AnnotationFormat`, and one line in `registry.py`; the
contract test in `tests/contract/test_input_formats.py` asks for a good file of it and does the rest.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.npz import array_names, is_npz
from pasdedeux.formats.source_motion import SourceMotion

_LOOKED_AT_BYTES = 200_000


class FileStart:
    """What formats are recognised by: the beginning of a file, looked at once for all of them.

    Args:
        data: The file.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data

    @cached_property
    def array_names(self) -> frozenset[str]:
        """Names of the arrays of an npz archive; none of any other file.  A damaged archive is a FormatError."""
        return array_names(self._data) if is_npz(self._data) else frozenset()

    @cached_property
    def text(self) -> str:
        """The first 200 kB as text, without leading blanks; empty for an npz archive."""
        if is_npz(self._data):
            return ""
        return self._data[:_LOOKED_AT_BYTES].decode("utf-8-sig", errors="replace").lstrip()

    @cached_property
    def first_row(self) -> str:
        """The first line that is neither empty nor a comment (#)."""
        lines = (line.strip() for line in self.text.splitlines())
        return next((line for line in lines if line and not line.startswith("#")), "")

    @property
    def is_json(self) -> bool:
        """Whether it begins as a JSON object or list."""
        return self.text[:1] in ("{", "[")


@dataclass(frozen=True)
class MotionHead:
    """What can be told of a motion file without the arithmetic of its frames.

    Args:
        rest: Its skeleton with one frame of rest, and what it says of rate, unit and axis.
        num_frames: Its length.
    """

    rest: SourceMotion
    num_frames: int


class FileFormat(ABC):
    """One format of files: bytes in, values out, never a path.

    Attributes:
        name: Name in a study (`format = "bvh"`) and in the column `source_format`.
        recognised_by: What its files have that others have not, in words, for a message about a file of no format.
        suffixes: Endings of such files, lower case with the dot: which files of a folder are looked at.
    """

    name: ClassVar[str]
    recognised_by: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]

    @abstractmethod
    def recognises(self, start: FileStart) -> bool:
        """Tell from its content whether a file is of this format; true for no good file of another format."""


class MotionFormat(FileFormat):
    """A format of motions of one person.

    What a file does not say of rate, unit or up axis is None in its `SourceMotion`, and asked for or guessed later.

    Attributes:
        companion: What must lie beside a file, in words ("skeleton"); empty when a file stands alone.
        has_rotations: False when files hold positions only, so that rotations are swings.
    """

    companion: ClassVar[str] = ""
    has_rotations: ClassVar[bool] = True

    def companion_names(self, name: str) -> Sequence[str]:
        """Return where the companion of a file of this name may lie, relative to its folder, likeliest first."""
        return ()

    def is_companion(self, start: FileStart) -> bool:
        """Tell whether a file, of no format itself, is what files of this format need beside them."""
        return False

    @abstractmethod
    def read(self, data: bytes, companion: bytes = b"") -> SourceMotion:
        """Read everything; `companion` is empty for formats that need none.

        Raises:
            FormatError: The file or its companion is mangled; says the line, or the frame, and what is wrong.
        """

    def read_head(self, data: bytes, companion: bytes = b"") -> MotionHead:
        """Return skeleton and length after checking the file as far as that is cheap; reads everything unless better.

        Raises:
            FormatError: As `read`.
        """
        source = self.read(data, companion)
        rest = SourceMotion.at_rest(
            source.skeleton, source.rest_offsets, rate_hz=source.rate_hz, metres_per_unit=source.metres_per_unit
        )
        return MotionHead(rest=rest, num_frames=source.num_frames)


class AnnotationFormat(FileFormat):
    """A format of 2D poses.

    Attributes:
        is_file_per_frame: Whether a source is a folder with a file for each frame.
    """

    is_file_per_frame: ClassVar[bool] = False

    @abstractmethod
    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read a source from its files by name: one, or those of all frames.

        Args:
            files: Content of each file by its name, without folders.
            sequence_id: Name of the sequence where the files do not name any.
            layout: Keypoint layout asked for; "auto" takes what the files say or what their keypoints tell.
            skip_unreadable: Leave out frames whose file is damaged, and name the file, instead of refusing.

        Raises:
            FormatError: A file is mangled; says the line, the frame or the entry, and what is wrong.
            InputError: The files are not of the layout asked for, or hold nobody.
        """

    def frame_numbers(self, names: Sequence[str]) -> list[int]:
        """Return the frame that each file is of, where names tell it and the content does not; empty for others."""
        return []
