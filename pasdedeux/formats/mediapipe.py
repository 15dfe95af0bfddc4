"""Reading MediaPipe's 33 pose landmarks as programs export them: JSON of frames, and tables by landmark or by frame.

MediaPipe itself writes no file.  What is read is what people's programs have in common: a frame is a list of points, in
order or by name, alone or one list for each person; a table has a row for each landmark (`frame, landmark_id, x, y, z,
visibility`) or a row for each frame (`nose_x, nose_y, ...` or `x0, y0, z0, v0, ...`).
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import MAX_FRAME, UNKNOWN, Detection, join_detections, known_footage
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import decode, parse_json, parse_number, parse_triples, shorten, split_lines
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS

_NAMES = KEYPOINT_LAYOUTS["mediapipe33"].keypoint_names
_LIST_KEYS = ("frames", "poses", "results", "data", "landmarks", "pose_landmarks")
_POSE_KEYS = ("landmarks", "pose_landmarks", "poselandmarks", "landmark", "keypoints", "pose")
_FRAME_KEYS = ("frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_num")
_PERSON_KEYS = ("person", "person_id", "track_id", "pose_index", "pose_id")
_VIDEO_KEYS = ("video", "video_name", "sequence", "filename")
_LANDMARK_KEYS = ("landmark_name", "landmark", "landmark_id", "landmark_index", "landmark_idx")
_SEEN_KEYS = ("visibility", "vis", "v", "confidence", "score")
_POINT = re.compile(r'"x"\s*:\s*-?\d')
_COLUMN = re.compile(
    r"(?P<axis>x|y|z|v|vis|visibility)_?(?P<index>\d{1,2})|(?P<name>.+?)_(?P<of>x|y|z|v|vis|visibility)"
)
_MIN_COLUMNS = 12
"""Landmarks that a table with a row for each frame has at least."""


class MediaPipe(AnnotationFormat):
    """MediaPipe's landmarks; JSON may state rate and image size, which shares of the image need."""

    name = "mediapipe"
    recognised_by = "JSON of 'landmarks' or points with 'x' and 'y', or CSV with a column landmark or nose_x or x0"
    suffixes = (".json", ".csv")

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the file is JSON of landmarks, or a table whose columns are theirs."""
        if start.is_json:
            has_key = '"landmarks"' in start.text or '"pose_landmarks"' in start.text or _POINT.search(start.text)
            return '"people"' not in start.text and bool(has_key)
        header = [cell.strip().strip('"').lower() for cell in start.first_row.split(",")]
        is_by_landmark = {"x", "y"} <= set(header) and bool(set(header) & set(_LANDMARK_KEYS))
        return is_by_landmark or len(_columns_by_landmark(header)) >= _MIN_COLUMNS

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the one file."""
        (data,) = files.values()
        return read_mediapipe(data, sequence_id=sequence_id, layout=layout)


def read_mediapipe(data: bytes | str, *, sequence_id: str, layout: str = "auto") -> AnnotatedFrames:
    """Read landmarks, whose coordinates may be shares of the image; what is missing or at (0, 0) is not detected.

    Without a number of its own, a frame is where it stands.  Points in order may be another detector's.

    Raises:
        FormatError: The file is mangled, or is none of these forms; says the line or the frame.
        InputError: It holds nobody.
    """
    text = decode(data, "file of landmarks")
    footage = UNKNOWN
    if text.lstrip()[:1] in ("{", "["):
        content = parse_json(text, "file of landmarks", has_nan=True)
        footage = known_footage(content)
        detections = list(_of_frames(content))
    else:
        detections = list(_of_table(text))
    videos = {one.place[0] for one in detections}
    if len(videos) == 1:
        detections = [Detection(("", one.place[1]), one.person_id, one.table, one.where) for one in detections]
    return join_detections(
        detections,
        sequence_id=sequence_id,
        layout=layout,
        sizes_px=dict.fromkeys(videos, footage.image_size_px) if footage.image_size_px else {},
        rate_hz=footage.rate_hz,
    )


def _of_frames(content: Any) -> Iterator[Detection]:
    """Yield the people of JSON: a list of frames, an object with one, an object by frame numbers, or one frame."""
    frames = content
    if isinstance(content, dict):
        listed = next((content[key] for key in _LIST_KEYS if isinstance(content.get(key), list)), None)
        by_number = list(content.items()) if all(re.fullmatch(r"[0-9]{1,9}", key) for key in content) else []
        frames = listed if listed is not None else [{"frame": int(key), "landmarks": one} for key, one in by_number]
    if not isinstance(frames, list) or (not frames and content not in ([], {}) and not _has_empty_list(content)):
        raise FormatError("this is no file of landmarks: it has no list of frames")
    if _is_pose(frames):
        frames = [frames]
    for index, frame in enumerate(frames):
        where = f"frame {index}"
        low = {str(key).lower(): value for key, value in frame.items()} if isinstance(frame, dict) else {}
        number = next((low[key] for key in _FRAME_KEYS if low.get(key) is not None), index)
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= MAX_FRAME:
            raise FormatError(f"{where}: its number is {shorten(str(number))}; allowed: whole numbers to {MAX_FRAME}")
        person = next((low[key] for key in _PERSON_KEYS if low.get(key) is not None), None)
        if low and not any(key in low for key in _POSE_KEYS) and not _is_pose(low):
            has_world = any("world" in key for key in low)
            raise FormatError(f"{where} has no landmarks of the image" + (", only of the world" if has_world else ""))
        for pose in _poses(low if isinstance(frame, dict) else frame, where):
            own = person if isinstance(person, int) and 0 <= person <= MAX_FRAME else None
            yield Detection(("", number), own, pose, where)


def _has_empty_list(content: Any) -> bool:
    return isinstance(content, dict) and any(content.get(key) == [] for key in _LIST_KEYS)


def _is_point(value: Any) -> bool:
    if isinstance(value, dict):
        return "x" in value and "y" in value
    return isinstance(value, list) and 2 <= len(value) <= 5 and all(isinstance(one, int | float) for one in value)


def _is_pose(value: Any) -> bool:
    """Tell whether a value is the points of one person: a list in order, or an object by name."""
    points = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    return len(points) > 2 and all(_is_point(point) for point in points)


def _poses(value: Any, where: str) -> Iterator[Array]:
    """Yield the points (33, 3) of everybody in a value."""
    if value is None or value in ([], {}):
        return
    if _is_pose(value):
        yield _table(value, where)
    elif isinstance(value, list):
        for one in value:
            yield from _poses(one, where)
    elif isinstance(value, dict) and any(key in value for key in _POSE_KEYS):
        yield from _poses(next(value[key] for key in _POSE_KEYS if key in value), where)
    else:
        raise FormatError(f"{where} holds something that is no list of points with x and y")


def _table(points: Any, where: str) -> Array:
    if isinstance(points, dict):
        table = np.zeros((len(_NAMES), 3))
        for name, point in points.items():
            if _landmark(name) is None:
                raise FormatError(f"{where}: '{shorten(str(name))}' is no landmark; known: {', '.join(_NAMES)}")
            table[_landmark(name)] = _triple(point, where)
        return table
    return np.concatenate([_triple(point, where) for point in points])


def _triple(point: Any, where: str) -> Array:
    """Return x, y and visibility (1, 3) of a point: an object, or x, y, z and perhaps visibility."""
    if isinstance(point, dict):
        seen = next((point[key] for key in _SEEN_KEYS if point.get(key) is not None), 1.0)
        values = [point["x"], point["y"], seen]
    else:
        values = [*point[:2], point[3] if len(point) > 3 else 1.0]
    return parse_triples([math.nan if one is None else one for one in values], where)


def _landmark(name: str) -> int | None:
    """Return the landmark of a name as MediaPipe's languages spell it, or of a number."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip())
    plain = re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_").removeprefix("landmark_")
    plain = plain.replace("foot_index", "big_toe")
    if plain.isdigit() and int(plain) < len(_NAMES):
        return int(plain)
    return _NAMES.index(plain) if plain in _NAMES else None


def _of_table(text: str) -> Iterator[Detection]:
    """Yield the people of a table."""
    try:
        rows = list(csv.reader(split_lines(text), strict=True))
    except csv.Error as error:
        raise FormatError(f"this table of landmarks is not valid CSV: {error}") from None
    start = next((index for index, cells in enumerate(rows) if any(cells) and not cells[0].startswith("#")), None)
    if start is None:
        raise FormatError(f"line {len(rows)}: the file ends without a header line")
    header = [cell.strip().lower() for cell in rows[start]]
    found: dict[str, str | None] = {
        what: next((key for key in keys if key in header), None)
        for what, keys in (("frame", _FRAME_KEYS), ("person", _PERSON_KEYS), ("video", _VIDEO_KEYS))
    }
    own = next((key for key in _LANDMARK_KEYS if key in header), None)
    columns = _columns_by_landmark(header) if own is None else {}
    seen_key = next((key for key in _SEEN_KEYS if key in header), None)
    if own is None and len(columns) < _MIN_COLUMNS:
        raise FormatError(f"line {start + 1}: no columns of landmarks; known: landmark, x and y, or nose_x, nose_y ...")
    if own is not None and (found["frame"] is None or not {"x", "y"} <= set(header)):
        raise FormatError(f"line {start + 1}: a row for each landmark needs the columns frame, x and y")
    people: dict[tuple[str, int, int | None], tuple[Array, str]] = {}
    position = 0
    for line, cells in enumerate(rows[start + 1 :], start=start + 2):
        if not any(cell.strip() for cell in cells):
            continue
        where = f"line {line}"
        if len(cells) != len(header):
            raise FormatError(f"{where}: {len(cells)} values, the header has {len(header)} columns")
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        frame = position if found["frame"] is None else _count(row[found["frame"]], f"{where}: {found['frame']}")
        person = None if found["person"] is None else _count(row[found["person"]], f"{where}: {found['person']}")
        key = (row[found["video"]] if found["video"] else "", frame, person)
        table, _ = people.setdefault(key, (np.zeros((len(_NAMES), 3)), where))
        points = {row[own]: ("x", "y", seen_key)} if own is not None else columns
        for name, (x, y, seen) in points.items():
            landmark = _landmark(str(name))
            if landmark is None:
                raise FormatError(f"{where}: '{shorten(str(name))}' is no landmark; known: {', '.join(_NAMES)}")
            table[landmark] = [_number(row[one], where) for one in (x, y)] + [
                _number(row[seen], where) if seen else 1.0
            ]
        position += 1
    if not people:
        raise InputError("this table of landmarks has no rows: nobody was detected")
    for (video, frame, person), (table, where) in people.items():
        yield Detection((video, frame), person, table, where)


def _columns_by_landmark(header: list[str]) -> dict[int, tuple[str, str, str | None]]:
    """Return the columns of x, y and visibility of each landmark, where a table has a row for each frame."""
    found: dict[int, dict[str, str]] = {}
    numbers = []
    for column in header:
        match = _COLUMN.fullmatch(column)
        landmark = _landmark(match["index"] or match["name"]) if match else None
        if match is None or (landmark is None and match["index"] != str(len(_NAMES))):
            continue
        number = int(match["index"]) if match["index"] else int(landmark or 0)
        numbers.append(number)
        found.setdefault(number, {})[(match["axis"] or match["of"])[0]] = column
    shift = 1 if numbers and max(numbers) == len(_NAMES) else 0
    return {
        number - shift: (axes["x"], axes["y"], axes.get("v"))
        for number, axes in found.items()
        if "x" in axes and "y" in axes and number >= shift
    }


def _number(token: str, where: str) -> float:
    return math.nan if token.lower() in ("", "nan", "none") else parse_number(token, where)


def _count(token: str, where: str) -> int:
    value = parse_number(token, where, max_magnitude=MAX_FRAME)
    if value < 0 or value != int(value):
        raise FormatError(f"{where} is {shorten(token)}; whole numbers from 0 are allowed")
    return int(value)
