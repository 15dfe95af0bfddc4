"""Our own formats for 2D annotations: a CSV that a spreadsheet can write, and an npz for programs.

CSV: a header line and a row per keypoint, columns in any order::

    # layout: pair17
    # image_size: 1920x1080
    # rate_hz: 30
    sequence,frame,person,joint,x,y,confidence
    clip1,0,0,left_knee,812.5,640.0,0.93

The lines that start with `#` may be left out: the layout is then told from the joints' names.  `confidence` may be left
out (1).  Empty or NaN x and y, or confidence 0, mean missing; keypoints that are not listed are missing.

npz: `keypoints_px` (row, K, 2), `confidence` (row, K), `frame` (row,), `person` (row,), `layout` (text), and optionally
`sequence` (row,) of texts, `image_size_px` (2,), `rate_hz`.
"""

from __future__ import annotations

import csv
import io
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import AnnotatedFrames, get_keypoint_layout
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.text import MAX_MAGNITUDE, decode, parse_integer, parse_number, shorten, split_lines
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS

__all__ = ["read_annotation_csv", "read_annotation_npz", "write_annotation_csv", "write_annotation_npz"]

COLUMNS = ("sequence", "frame", "person", "joint", "x", "y", "confidence")
_NEEDED = ("frame", "person", "joint", "x", "y")
_MAX_RATE_HZ = 100_000.0
_MAX_IMAGE_PX = 100_000


def read_annotation_csv(data: bytes | str, *, sequence_id: str = "sequence", layout: str = "auto") -> AnnotatedFrames:
    """Read our CSV of 2D annotations.

    Args:
        data: The file.
        sequence_id: Name of the sequence where the file has no column for it.
        layout: Layout of the keypoints; "auto" takes the one the file states or the only one that has all its joints.

    Raises:
        FormatError: The file is mangled, or its layout cannot be told; the line is named.
    """
    lines = split_lines(decode(data, "annotation table"))
    notes: dict[str, tuple[int, str]] = {}
    start = 0
    while start < len(lines) and (not lines[start].strip() or lines[start].lstrip().startswith("#")):
        key, _, value = lines[start].lstrip().removeprefix("#").partition(":")
        notes[key.strip().lower()] = (start + 1, value.strip())
        start += 1
    if start == len(lines):
        raise FormatError(f"line {start}: the file ends without a header line")
    try:
        table = list(csv.reader(lines[start:], strict=True))
    except csv.Error as error:
        raise FormatError(f"this annotation table is not valid CSV: {error}") from None
    header = [name.strip().lower() for name in table[0]]
    for name in header:
        if name not in COLUMNS or header.count(name) > 1:
            raise FormatError(
                f"line {start + 1}: column '{shorten(name)}' is unknown or double; known: {', '.join(COLUMNS)}"
            )
    missing = [name for name in _NEEDED if name not in header]
    if missing:
        raise FormatError(f"line {start + 1}: column '{missing[0]}' is missing; needed: {', '.join(_NEEDED)}")

    people: dict[tuple[str, int, int], dict[str, tuple[float, float, float]]] = {}
    for offset, cells in enumerate(table[1:], start=start + 2):
        if not cells or not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise FormatError(f"line {offset}: {len(cells)} values, the header has {len(header)} columns")
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        person_key = (
            row.get("sequence") or sequence_id,
            _count(row["frame"], f"line {offset}: frame"),
            _count(row["person"], f"line {offset}: person"),
        )
        joints = people.setdefault(person_key, {})
        if row["joint"] in joints:
            raise FormatError(
                f"line {offset}: '{shorten(row['joint'])}' twice for person {person_key[2]} in frame {person_key[1]}"
            )
        joints[row["joint"]] = _keypoint(row, offset)
    if not people:
        raise FormatError("this annotation table has no rows")

    joint_names = {name for joints in people.values() for name in joints}
    if layout == "auto":
        layout = notes["layout"][1] if "layout" in notes else _layout_of(joint_names)
    known = get_keypoint_layout(layout)
    unknown = sorted(joint_names - set(known.keypoint_names))
    if unknown:
        raise FormatError(
            f"joint '{shorten(unknown[0])}' is not in the layout '{layout}'; known: {', '.join(known.keypoint_names)}"
        )
    keypoints = np.full((len(people), known.num_keypoints, 2), np.nan)
    confidence = np.zeros((len(people), known.num_keypoints))
    for index, joints in enumerate(people.values()):
        for name, (x, y, trust) in joints.items():
            column = known.keypoint_names.index(name)
            keypoints[index, column] = x, y
            confidence[index, column] = trust
    return AnnotatedFrames(
        layout=layout,
        sequence_id=tuple(key[0] for key in people),
        frame=np.array([key[1] for key in people], dtype=np.int64),
        person_id=np.array([key[2] for key in people], dtype=np.int64),
        keypoints_px=keypoints,
        confidence=confidence,
        image_size_px=_image_size(notes),
        rate_hz=_rate(notes),
    )


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
    rate = float(get("rate_hz", "fiu", ()).item()) if "rate_hz" in arrays else None
    if rate is not None and not 0 < rate <= _MAX_RATE_HZ:
        raise FormatError(f"the frame rate is {rate}; allowed: above 0 to {_MAX_RATE_HZ:g}")
    if size is not None and not ((size > 0) & (size <= _MAX_IMAGE_PX)).all():
        raise FormatError(f"the image size is {size.tolist()}; allowed: 1 to {_MAX_IMAGE_PX}")
    return AnnotatedFrames(
        layout=layout,
        sequence_id=sequence,
        frame=frame,
        person_id=person,
        keypoints_px=keypoints,
        confidence=confidence,
        image_size_px=None if size is None else (int(size[0]), int(size[1])),
        rate_hz=rate,
    )


def write_annotation_csv(frames: AnnotatedFrames) -> str:
    """Return annotations as our CSV; missing keypoints are left out, a person without any keeps one empty row."""
    names = get_keypoint_layout(frames.layout).keypoint_names
    out = io.StringIO()
    out.write(f"# layout: {frames.layout}\n")
    if frames.image_size_px:
        out.write(f"# image_size: {frames.image_size_px[0]}x{frames.image_size_px[1]}\n")
    if frames.rate_hz:
        out.write(f"# rate_hz: {frames.rate_hz!r}\n")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in range(frames.num_rows):
        head = [frames.sequence_id[row], int(frames.frame[row]), int(frames.person_id[row])]
        seen = [column for column in range(len(names)) if frames.confidence[row, column] > 0]
        for column in seen:
            x, y = frames.keypoints_px[row, column]
            writer.writerow(
                [*head, names[column], repr(float(x)), repr(float(y)), repr(float(frames.confidence[row, column]))]
            )
        if not seen:
            writer.writerow([*head, names[0], "", "", 0])
    return out.getvalue()


def write_annotation_npz(frames: AnnotatedFrames) -> bytes:
    """Return annotations as our npz."""
    arrays: dict[str, Any] = {
        "layout": np.array(frames.layout),
        "sequence": np.array(frames.sequence_id),
        "frame": frames.frame,
        "person": frames.person_id,
        "keypoints_px": frames.keypoints_px,
        "confidence": frames.confidence,
    }
    if frames.image_size_px:
        arrays["image_size_px"] = np.array(frames.image_size_px)
    if frames.rate_hz:
        arrays["rate_hz"] = np.array(frames.rate_hz)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def _count(token: str, where: str) -> int:
    value = parse_integer(token, where)
    if value < 0:
        raise FormatError(f"{where} is {value}; at least 0 is allowed")
    return value


def _keypoint(row: dict[str, str], line: int) -> tuple[float, float, float]:
    """Return x, y and confidence of a row; NaN and 0 where it says missing."""
    token = row.get("confidence", "1")
    confidence = parse_number(token, f"line {line}: confidence") if token else 0.0
    if not 0 <= confidence <= 10:
        raise FormatError(f"line {line}: the confidence is {confidence:g}; allowed: 0 to 10")
    x, y = (
        math.nan if row[axis].lower() in {"", "nan"} else parse_number(row[axis], f"line {line}: {axis}")
        for axis in "xy"
    )
    is_missing = confidence == 0 or math.isnan(x) or math.isnan(y)
    return (math.nan, math.nan, 0.0) if is_missing else (x, y, confidence)


def _layout_of(joint_names: set[str]) -> str:
    exact = [name for name, layout in KEYPOINT_LAYOUTS.items() if set(layout.keypoint_names) == joint_names]
    fitting = exact or [
        name for name, layout in KEYPOINT_LAYOUTS.items() if joint_names.issubset(layout.keypoint_names)
    ]
    if len(fitting) != 1:
        why = f"fit {', '.join(fitting)}" if fitting else f"fit none of {', '.join(KEYPOINT_LAYOUTS)}"
        raise FormatError(f"the layout cannot be told: the joints {why}; say it in a line '# layout: NAME'")
    return fitting[0]


def _image_size(notes: dict[str, tuple[int, str]]) -> tuple[int, int] | None:
    if "image_size" not in notes:
        return None
    line, text = notes["image_size"]
    width, _, height = text.lower().partition("x")
    size = (_count(width.strip(), f"line {line}: image width"), _count(height.strip(), f"line {line}: image height"))
    if not all(0 < side <= _MAX_IMAGE_PX for side in size):
        raise FormatError(f"line {line}: the image size is {text}; allowed: 1 to {_MAX_IMAGE_PX}")
    return size


def _rate(notes: dict[str, tuple[int, str]]) -> float | None:
    if "rate_hz" not in notes:
        return None
    line, text = notes["rate_hz"]
    rate = parse_number(text, f"line {line}: rate_hz")
    if not 0 < rate <= _MAX_RATE_HZ:
        raise FormatError(f"line {line}: the frame rate is {rate:g}; allowed: above 0 to {_MAX_RATE_HZ:g}")
    return rate
