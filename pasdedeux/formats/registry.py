"""The formats that files come in: one line for each, tried in this order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.asf_amc import ASF_AMC
from pasdedeux.formats.bvh import BVH, ROTATION_ROWS
from pasdedeux.formats.c3d import C3D
from pasdedeux.formats.expi import EXPI
from pasdedeux.formats.file_format import AnnotationFormat, FileStart, MotionFormat
from pasdedeux.formats.poses2d.annotated_frames import (
    AnnotatedFrames,
    check_anatomy,
    check_inside,
    in_pixels,
    in_size,
    without_doubtful,
)
from pasdedeux.formats.poses2d.annotation_csv import ANNOTATION_CSV
from pasdedeux.formats.poses2d.annotation_npz import ANNOTATION_NPZ
from pasdedeux.formats.poses2d.coco import COCO, IMAGE_RESULTS
from pasdedeux.formats.poses2d.cvat import CVAT
from pasdedeux.formats.poses2d.detections import UNKNOWN, Footage
from pasdedeux.formats.poses2d.openpose import OPENPOSE
from pasdedeux.formats.poses2d.points import POINTS
from pasdedeux.formats.poses2d.yolo import YOLO
from pasdedeux.formats.positions_npz import POSITIONS_NPZ
from pasdedeux.formats.smpl import SMPL
from pasdedeux.formats.text import shorten
from pasdedeux.formats.trc import TRC
from pasdedeux.formats.unsupported import refuse_foreign
from pasdedeux.skeletons.layouts import KeypointLayout

F = TypeVar("F", MotionFormat, AnnotationFormat)

MOTION_FORMATS: Mapping[str, MotionFormat] = {
    kind.name: kind for kind in (BVH, ASF_AMC, ROTATION_ROWS, POSITIONS_NPZ, EXPI, C3D, TRC, SMPL)
}
ANNOTATION_FORMATS: Mapping[str, AnnotationFormat] = {
    kind.name: kind for kind in (OPENPOSE, COCO, IMAGE_RESULTS, POINTS, CVAT, YOLO, ANNOTATION_CSV, ANNOTATION_NPZ)
}


def recognise_format(data: bytes) -> MotionFormat | AnnotationFormat:
    """Detect the format of a file from its content; the name does not matter."""
    if not data.strip():
        raise FormatError("this file is empty")
    refuse_foreign(data)
    start = FileStart(data)
    known: list[MotionFormat | AnnotationFormat] = [*MOTION_FORMATS.values(), *ANNOTATION_FORMATS.values()]
    for kind in known:
        if kind.recognises(start):
            return kind
    for kind in MOTION_FORMATS.values():
        if kind.is_companion(start):
            raise FormatError(f"this is the {kind.companion} of files of the format '{kind.name}', not a motion itself")
    if start.has_key("asset") and start.has_key("meshes", "nodes"):
        refuse_foreign(b"glTF")
    shown = shorten(start.first_row) if start.first_row.isprintable() and "\ufffd" not in start.first_row else ""
    holds = f"text that begins with '{shown}'" if shown else "binary data"
    raise FormatError(
        f"this file is none of the known formats, it holds {holds}; motions are read from BVH, ASF/AMC, C3D, TRC and "
        "npz, 2D poses from JSON, CSV, XML, text of YOLO and npz (docs/formats-and-units.md)"
    )


def find_format(known: Mapping[str, F], name: str, data: bytes) -> F:
    """Return the format of this name; "auto" detects it from the content."""
    refuse_foreign(data)
    if name != "auto":
        return known[name]
    recognised = recognise_format(data).name
    if recognised not in known:
        what = "a motion of one person" if known is MOTION_FORMATS else "one of 2D poses"
        raise FormatError(f"this is a file of the kind '{recognised}', not {what}")
    return known[recognised]


def read_annotations(
    kind: AnnotationFormat,
    files: Mapping[str, bytes],
    *,
    source_id: str,
    layout: str | KeypointLayout = "auto",
    stated: Footage = UNKNOWN,
    video: Footage = UNKNOWN,
    min_confidence: float | None = 0.0,
    skip_unreadable: bool = False,
    frame_offset: int = 0,
) -> AnnotatedFrames:
    """Read a source of 2D poses in pixels and check that they look like people; its name starts sequence names.

    Args:
        kind: Format of the files.
        files: Content of each file by its name.
        source_id: Name of the source; prefix of the sequence names in the files.
        layout: Requested keypoint layout, or "auto".
        stated: Footage that the study states; overrides the files.
        video: Footage that the video file beside them states; used if neither study nor files state it.
        min_confidence: Keypoints of a lower confidence are missing; None for the default, see `without_doubtful`.
        skip_unreadable: Skip frames whose file is damaged.
        frame_offset: Added to frame numbers; -1 for tools that count from 1.

    Raises:
        InputError: A file is damaged (it is named), the keypoints have another layout than the requested one, do not
            look like people, or lie in an image of unknown or another size; or a frame number becomes negative.
    """
    frames = kind.read(files, sequence_id=source_id, layout=layout, skip_unreadable=skip_unreadable)
    if isinstance(layout, str) and layout not in {"auto", frames.layout}:
        raise InputError(f"the study says layout '{layout}', but the keypoints are '{frames.layout}'")
    if frames.frame.min() + frame_offset < 0:
        raise InputError(f"frame {frames.frame.min()} would be {frames.frame.min() + frame_offset} (frame_offset)")
    frames = replace(frames, frame=frames.frame + frame_offset)
    frames = clean_annotations(frames, stated=stated, video=video, min_confidence=min_confidence)
    prefix = f"{source_id}."
    names = {
        name: name if name == source_id or name.startswith(prefix) else prefix + name
        for name in set(frames.sequence_id)
    }
    return replace(
        frames,
        sequence_id=tuple(names[name] for name in frames.sequence_id),
        image_size_px={names[name]: size for name, size in frames.image_size_px.items() if name in names},
        focal_px={names[name]: focal for name, focal in frames.focal_px.items() if name in names},
    )


def clean_annotations(
    frames: AnnotatedFrames, *, stated: Footage = UNKNOWN, video: Footage = UNKNOWN, min_confidence: float | None = 0.0
) -> AnnotatedFrames:
    """Convert 2D poses to pixels, add properties of the footage, and remove doubtful keypoints.

    Raises:
        InputError: They do not look like people, or lie in an image of unknown or another size.
    """
    known = _with_footage(frames, stated, video)
    pixels = in_pixels(known)
    if pixels is known:
        pixels = _with_footage(in_size(frames, stated.image_size_px), stated, video)
    frames = check_inside(without_doubtful(pixels, min_confidence))
    check_anatomy(frames)
    return frames


def _with_footage(frames: AnnotatedFrames, stated: Footage, video: Footage) -> AnnotatedFrames:
    """Return annotations with rate, image size and focal length where known."""
    sizes, focals = dict(frames.image_size_px), dict(frames.focal_px)
    for name in set(frames.sequence_id):
        size = stated.image_size_px or sizes.get(name) or video.image_size_px
        if size:
            sizes[name] = size
        if focal_px := stated.focal_of(size):
            focals[name] = focal_px
    rate_hz = stated.rate_hz or frames.rate_hz or video.rate_hz
    return replace(frames, image_size_px=sizes, focal_px=focals, rate_hz=rate_hz)
