"""Sources of 2D poses: found and checked before any work, and read."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats import (
    AnnotatedFrames,
    OpenPoseFrame,
    check_anatomy,
    guess_format,
    join_openpose_frames,
    openpose_frame_number,
    read_annotation_csv,
    read_annotation_npz,
    read_coco,
    read_openpose_frame,
)
from tasks.ingest.parameters import AnnotationOptions
from tasks.ingest.sources import load_file
from tasks.stage import SourceFile

__all__ = ["AnnotationSource", "ReadAnnotations", "file_frames", "find_annotations", "read_annotations"]

FORMATS = ("openpose", "coco", "annotation_csv", "annotation_npz")


@dataclass(frozen=True)
class AnnotationSource:
    """The files of a source of 2D poses and their format."""

    files: tuple[SourceFile, ...]
    format: str


@dataclass(frozen=True)
class ReadAnnotations:
    """The rows of a source, and the files that could not be read and were skipped."""

    frames: AnnotatedFrames
    skipped: tuple[str, ...]


_checked: set[tuple[str, ...]] = set()
_MAX_CHECKED = 1000


def find_annotations(options: AnnotationOptions) -> AnnotationSource:
    """Find a source's files and read them once, so that bad input is refused before any work.

    Raises:
        InputError: The path does not exist, a file is mangled, or the layout is not the one asked for.
    """
    try:
        if options.path.is_dir():
            paths = sorted(path for path in options.path.iterdir() if path.suffix.lower() == ".json")
            if not paths:
                raise InputError(f"folder {options.path} holds no .json files")
            if options.format not in {"auto", "openpose"}:
                raise InputError(f"a folder is a folder of OpenPose files, not of the format '{options.format}'")
            kind = "openpose"
        else:
            paths = [options.path]
            kind = options.format
        loaded = [load_file(path) for path in paths]
        if kind == "auto":
            kind = guess_format(loaded[0].data)
        if kind not in FORMATS:
            raise InputError(f"{options.path.name} is a file of the kind '{kind}', not one of 2D poses")
        files = tuple(item.file for item in loaded)
        digest = hashlib.sha256("".join(file.sha256 for file in files).encode()).hexdigest()
        check = (options.id, kind, options.layout, options.on_unreadable, digest)
        if check not in _checked:
            read_annotations(options, kind, [(Path(item.file.path).name, item.data) for item in loaded])
            if len(_checked) >= _MAX_CHECKED:
                _checked.clear()
            _checked.add(check)
    except InputError as error:
        raise type(error)(f"annotations {options.id}: {error}") from None
    return AnnotationSource(files=files, format=kind)


def file_frames(source: AnnotationSource) -> list[int]:
    """Return the frame of each file of a source that has one file per frame; empty for others."""
    return _frame_numbers([file.path for file in source.files]) if source.format == "openpose" else []


def read_annotations(options: AnnotationOptions, kind: str, files: Sequence[tuple[str, bytes]]) -> ReadAnnotations:
    """Read a source of 2D poses from its files, given as (name, bytes).

    Raises:
        InputError: A file is mangled (named), or the keypoints are not in the layout asked for.
    """
    skipped: list[str] = []
    if kind == "openpose":
        frames = _read_openpose(options, files, skipped)
    else:
        name, data = files[0]
        try:
            frames = _read_table(options, kind, data)
        except InputError as error:
            raise type(error)(f"{name}: {error}") from None
    if options.layout not in {"auto", frames.layout}:
        raise InputError(f"the study says layout '{options.layout}', but the keypoints are '{frames.layout}'")
    check_anatomy(frames)
    own = f"{options.id}."
    names = tuple(n if n == options.id or n.startswith(own) else own + n for n in frames.sequence_id)
    frames = replace(frames, sequence_id=names)
    return ReadAnnotations(frames=frames, skipped=tuple(skipped))


def _read_table(options: AnnotationOptions, kind: str, data: bytes) -> AnnotatedFrames:
    if kind == "coco":
        return read_coco(data, sequence_id=options.id)
    if kind == "annotation_csv":
        return read_annotation_csv(data, sequence_id=options.id, layout=options.layout)
    return read_annotation_npz(data, sequence_id=options.id, layout=options.layout)


def _read_openpose(
    options: AnnotationOptions, files: Sequence[tuple[str, bytes]], skipped: list[str]
) -> AnnotatedFrames:
    frames: list[tuple[int, OpenPoseFrame]] = []
    for number, (name, data) in zip(_frame_numbers([name for name, _ in files]), files, strict=True):
        try:
            frame = read_openpose_frame(data)
        except FormatError as error:
            if options.on_unreadable == "skip":
                skipped.append(name)
                continue
            raise FormatError(f'{name}: {error} (set on_unreadable = "skip" to go on without it)') from None
        frames.append((number, frame))
    return join_openpose_frames(frames, sequence_id=options.id, layout=options.layout)


def _frame_numbers(names: Sequence[str]) -> list[int]:
    """Return the frame that each file is of, by its name; one without a number is where it stands."""
    numbers = [openpose_frame_number(name) for name in names]
    return [index if number is None else number for index, number in enumerate(numbers)]
