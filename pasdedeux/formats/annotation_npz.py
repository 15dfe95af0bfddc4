"""Our own npz of 2D annotations, for programs.

`keypoints_px` (row, K, 2), `confidence` (row, K), `frame` (row,), `person` (row,), `layout` (text), and optionally
`sequence` (row,) of texts, `image_size_px` (2,), `rate_hz`, `focal_px`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import (
    MAX_FOCAL_PX,
    MAX_IMAGE_PX,
    MAX_RATE_HZ,
    AnnotatedFrames,
    get_keypoint_layout,
)
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.text import MAX_MAGNITUDE


class AnnotationNpz(AnnotationFormat):
    """Our npz: it states its layout, and may state image size and rate."""

    name = "annotation_npz"
    recognised_by = "npz archive with 'keypoints_px'"
    suffixes = (".npz",)

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is an archive with the array keypoints_px."""
        return "keypoints_px" in start.array_names

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the one file."""
        (data,) = files.values()
        return read_annotation_npz(data, sequence_id=sequence_id, layout=layout)


def read_annotation_npz(data: bytes, *, sequence_id: str = "sequence", layout: str = "auto") -> AnnotatedFrames:
    """Read our npz of 2D annotations.

    Raises:
        FormatError: The archive is damaged, an array is missing or has a wrong shape or type, or a value is absurd.
    """
    what = "annotation archive"
    arrays = read_npz(data, what)

    def get(name: str, kinds: str, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
        if name not in arrays:
            raise FormatError(f"this {what} has no array '{name}'")
        array = arrays[name]
        fits = len(array.shape) == len(shape) and all(w in (None, h) for w, h in zip(shape, array.shape, strict=True))
        if array.dtype.kind not in kinds or not fits:
            wanted = tuple("any" if axis is None else axis for axis in shape)
            raise FormatError(
                f"array '{name}' has type {array.dtype} and shape {array.shape}; the shape {wanted} is needed"
            )
        return array

    if layout == "auto":
        layout = str(get("layout", "U", ()).item())
    num_keypoints = get_keypoint_layout(layout).num_keypoints
    frame = get("frame", "iu", (None,)).astype(np.int64)
    rows = len(frame)
    if rows == 0:
        raise FormatError(f"this {what} has no rows")
    person = get("person", "iu", (rows,)).astype(np.int64)
    if (frame < 0).any() or (person < 0).any() or (frame > 1_000_000_000).any() or (person > 1_000_000_000).any():
        raise FormatError("a frame or person number lies outside 0..1000000000")
    keypoints = get("keypoints_px", "fiu", (rows, num_keypoints, 2)).astype(np.float64)
    confidence = get("confidence", "fiu", (rows, num_keypoints)).astype(np.float64)
    if np.isinf(keypoints).any() or (np.abs(keypoints[np.isfinite(keypoints)]) > MAX_MAGNITUDE).any():
        raise FormatError("array 'keypoints_px' holds an infinite or absurdly large value")
    if not ((confidence >= 0) & (confidence <= 10)).all():
        raise FormatError("array 'confidence' holds a value outside 0..10")
    sequence = (
        tuple(str(name) for name in get("sequence", "U", (rows,))) if "sequence" in arrays else (sequence_id,) * rows
    )
    size = get("image_size_px", "iu", (2,)) if "image_size_px" in arrays else None
    numbers: dict[str, float | None] = {"rate_hz": None, "focal_px": None}
    for name, highest in (("rate_hz", MAX_RATE_HZ), ("focal_px", MAX_FOCAL_PX)):
        if name in arrays:
            numbers[name] = value = float(get(name, "fiu", ()).item())
            if not 0 < value <= highest:
                raise FormatError(f"'{name}' is {value}; allowed: above 0 to {highest:g}")
    if size is not None and not ((size > 0) & (size <= MAX_IMAGE_PX)).all():
        raise FormatError(f"the image size is {size.tolist()}; allowed: 1 to {MAX_IMAGE_PX}")
    return AnnotatedFrames(
        layout=layout,
        sequence_id=sequence,
        frame=frame,
        person_id=person,
        keypoints_px=keypoints,
        confidence=confidence,
        image_size_px={} if size is None else dict.fromkeys(sequence, (int(size[0]), int(size[1]))),
        rate_hz=numbers["rate_hz"],
        focal_px=dict.fromkeys(sequence, numbers["focal_px"]) if numbers["focal_px"] else {},
    )
