"""The npz format of this project for 2D annotations, for programs.

`keypoints_px` (row, K, 2), `confidence` (row, K), `frame` (row,), `person` (row,), `layout` (text) or `joint_names`
(K,) in any order, and optionally `sequence` (row,) of texts, `image_size_px` (2,), `rate_hz`, `focal_px`.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.npz import get_array, read_npz
from pasdedeux.formats.poses2d.annotated_frames import (
    FOCAL_PX,
    MAX_IMAGE_PX,
    RATE_HZ,
    AnnotatedFrames,
    get_keypoint_layout,
)
from pasdedeux.formats.poses2d.detections import MAX_CONFIDENCE, Detection, arrange
from pasdedeux.formats.text import MAX_COUNT, MAX_MAGNITUDE, check_range
from pasdedeux.skeletons.layouts import KeypointLayout


def read_annotation_npz(
    data: bytes, sequence_id: str = "sequence", layout: str | KeypointLayout = "auto"
) -> AnnotatedFrames:
    """Read our npz of 2D annotations."""
    arrays = read_npz(data, "annotation archive")
    names = tuple(map(str, get_array(arrays, "joint_names", "U", (None,)))) if "joint_names" in arrays else None
    if layout == "auto" and names is None:
        layout = str(get_array(arrays, "layout", "U", ()).item())
    frame = get_array(arrays, "frame", "iu", (None,))
    rows, num_keypoints = len(frame), len(names) if names else get_keypoint_layout(layout).num_keypoints
    person = get_array(arrays, "person", "iu", (rows,))
    keypoints = get_array(arrays, "keypoints_px", "fiu", (rows, num_keypoints, 2)).astype(np.float64)
    confidence = get_array(arrays, "confidence", "fiu", (rows, num_keypoints)).astype(np.float64)
    if rows == 0:
        raise FormatError("array 'frame' has no rows")
    pixels = keypoints[~np.isnan(keypoints)]
    for name, values, low, high in (
        ("frame", frame, 0, MAX_COUNT),
        ("person", person, 0, MAX_COUNT),
        ("keypoints_px", pixels, -MAX_MAGNITUDE, MAX_MAGNITUDE),
        ("confidence", confidence, 0, MAX_CONFIDENCE),
    ):
        if not ((values >= low) & (values <= high)).all():
            raise FormatError(f"array '{name}' holds a value outside {low:g} to {high:g}")
    sequence = (sequence_id,) * rows
    if "sequence" in arrays:
        sequence = tuple(str(name) for name in get_array(arrays, "sequence", "U", (rows,)))
    size = rate_hz = focal_px = None
    if "image_size_px" in arrays:
        sides = get_array(arrays, "image_size_px", "iu", (2,)).tolist()
        width, height = (check_range(side, "a side of 'image_size_px'", 1, MAX_IMAGE_PX) for side in sides)
        size = (width, height)
    if "rate_hz" in arrays:
        rate_hz = check_range(float(get_array(arrays, "rate_hz", "fiu", ())), "'rate_hz'", *RATE_HZ)
    if "focal_px" in arrays:
        focal_px = check_range(float(get_array(arrays, "focal_px", "fiu", ())), "'focal_px'", *FOCAL_PX)
    table = np.concatenate([keypoints, confidence[..., None]], axis=-1)
    listed = zip(sequence, frame.tolist(), person.tolist(), table, strict=True)
    detections = [Detection((name, at), who, points, f"frame {at}", None, names) for name, at, who, points in listed]
    arranged = arrange(detections, layout)
    return AnnotatedFrames.of(
        arranged.layout,
        sequence_id=sequence,
        frame=frame.astype(np.int64),
        person_id=person.astype(np.int64),
        keypoints_px=arranged.table[..., :2],
        confidence=arranged.table[..., 2],
        image_size_px=dict.fromkeys(sequence, size) if size else {},
        rate_hz=rate_hz,
        focal_px=dict.fromkeys(sequence, focal_px) if focal_px else {},
        remarks=arranged.remarks,
    )


ANNOTATION_NPZ = AnnotationFormat(
    name="annotation_npz",
    suffixes=(".npz",),
    recognises=lambda start: "keypoints_px" in start.array_names,
    read_file=read_annotation_npz,
)
"""Our npz, which states its layout and may state image size, rate and focal length."""
