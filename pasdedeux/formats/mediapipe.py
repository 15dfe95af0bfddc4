"""Reading MediaPipe's 33 pose landmarks as programs export them: JSON of frames, and tables by landmark or by frame.

MediaPipe itself writes no file.  What is read is what people's programs have in common: a frame is a list of points, in
order or by name, alone or one list for each person; a table has a row for each landmark (`frame, landmark_id, x, y, z,
visibility`) or a row for each frame (`nose_x, nose_y, ...` or `x0, y0, z0, v0, ...`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError, named
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import UNKNOWN, Detection, join_detections, known_footage
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.text import MAX_COUNT, Lines, decode, parse_json, parse_number, parse_triples, shorten
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, KeypointLayout

_NAMES = KEYPOINT_LAYOUTS["mediapipe33"].keypoint_names
_LIST_KEYS = ("frames", "poses", "results", "data", "landmarks", "pose_landmarks")
_POSE_KEYS = ("landmarks", "pose_landmarks", "poselandmarks", "landmark", "keypoints", "pose")
_FRAME_KEYS = ("frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_num")
_PERSON_KEYS = ("person", "person_id", "track_id", "pose_index", "pose_id")
_VIDEO_KEYS = ("video", "video_name", "sequence", "filename")
_LANDMARK_KEYS = ("landmark_name", "landmark", "landmark_id", "landmark_index", "landmark_idx")
_SEEN_KEYS = ("visibility", "vis", "v", "confidence", "score")
_COLUMN = re.compile(
    r"(?P<axis>x|y|z|v|vis|visibility)_?(?P<index>\d{1,2})|(?P<name>.+?)_(?P<of>x|y|z|v|vis|visibility)"
)
_MIN_COLUMNS = 12
"""Landmarks that a table with a row for each frame has at least."""


def read_mediapipe(data: bytes | str, sequence_id: str, layout: str | KeypointLayout = "auto") -> AnnotatedFrames:
    """Read landmarks, whose coordinates may be shares of the image; what is missing or at (0, 0) is not detected.

    Without a number of its own, a frame is where it stands.  Points in order may be another detector's.
    """
    what = "file of landmarks"
    footage = UNKNOWN
    if decode(data, what).lstrip()[:1] in ("{", "["):
        content = parse_json(data, what)
        footage = known_footage(content)
        detections = list(_of_frames(content))
    else:
        with Lines(data, what) as lines:
            detections = _of_table(lines)
    videos = {one.place[0] for one in detections}
    if len(videos) == 1:
        detections = [replace(one, place=("", one.place[1])) for one in detections]
    return join_detections(
        detections,
        sequence_id=sequence_id,
        layout=layout,
        sizes_px=dict.fromkeys(videos, footage.image_size_px) if footage.image_size_px else {},
        rate_hz=footage.rate_hz,
    )


def _is_mediapipe(start: FileStart) -> bool:
    """Tell whether the file is JSON of landmarks, or a table whose columns are theirs."""
    if start.is_json:
        return not start.has_key("people") and (start.has_points or start.has_key("landmarks", "pose_landmarks"))
    header = [cell.strip().strip('"').lower() for cell in start.first_row.split(",")]
    is_by_landmark = {"x", "y"} <= set(header) and bool(set(header) & set(_LANDMARK_KEYS))
    return is_by_landmark or len(_columns_by_landmark(header)) >= _MIN_COLUMNS


MEDIAPIPE = AnnotationFormat(
    name="mediapipe",
    suffixes=(".json", ".csv"),
    recognises=_is_mediapipe,
    read_file=read_mediapipe,
)
"""MediaPipe's landmarks; JSON may state rate and image size, which shares of the image need."""


def _first(content: Mapping[str, Any], keys: Sequence[str]) -> Any:
    """Return what stands under the first of these keys that is there, None under none."""
    return next((content[key] for key in keys if content.get(key) is not None), None)


def _of_frames(content: Any) -> Iterator[Detection]:
    """Yield the people of JSON: a list of frames, an object with one, an object by frame numbers, or one frame."""
    frames = content
    if isinstance(content, dict):
        is_by_number = all(re.fullmatch(r"[0-9]{1,9}", key) for key in content)
        numbered = [{"frame": int(key), "landmarks": one} for key, one in content.items()] if is_by_number else None
        frames = next((content[key] for key in _LIST_KEYS if isinstance(content.get(key), list)), numbered)
    if not isinstance(frames, list):
        raise FormatError("this is no file of landmarks: it has no list of frames")
    for index, frame in enumerate([frames] if _is_pose(frames) else frames):
        where = f"frame {index}"
        with named(where):
            low = {str(key).lower(): value for key, value in frame.items()} if isinstance(frame, dict) else {}
            stated, person = _first(low, _FRAME_KEYS), _first(low, _PERSON_KEYS)
            number = index if stated is None else stated
            if type(number) is not int or not 0 <= number <= MAX_COUNT:
                raise FormatError(f"its number is {shorten(number)}; allowed: whole numbers to {MAX_COUNT}")
            if low and not any(key in low for key in _POSE_KEYS) and not _is_pose(low):
                has_world = any("world" in key for key in low)
                raise FormatError("no landmarks of the image are there" + (", only of the world" if has_world else ""))
            own = person if isinstance(person, int) and 0 <= person <= MAX_COUNT else None
            for pose in _poses(low or frame):
                yield Detection(("", number), own, pose, where)


def _is_point(value: Any) -> bool:
    if isinstance(value, dict):
        return "x" in value and "y" in value
    return isinstance(value, list) and 2 <= len(value) <= 5 and all(isinstance(one, int | float) for one in value)


def _is_pose(value: Any) -> bool:
    """Tell whether a value is the points of one person: a list in order, or an object by name."""
    points = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    return len(points) > 2 and all(_is_point(point) for point in points)


def _poses(value: Any) -> Iterator[Array]:
    """Yield the points (33, 3) of everybody in a value."""
    if value is None or value in ([], {}):
        return
    if _is_pose(value):
        if isinstance(value, dict):
            table = np.zeros((len(_NAMES), 3))
            table[[_known_landmark(name) for name in value]] = np.concatenate(list(map(_triple, value.values())))
            yield table
        else:
            yield np.concatenate(list(map(_triple, value)))
    elif isinstance(value, list):
        for one in value:
            yield from _poses(one)
    elif isinstance(value, dict) and any(key in value for key in _POSE_KEYS):
        yield from _poses(next(value[key] for key in _POSE_KEYS if key in value))
    else:
        raise FormatError("something is no list of points with x and y")


def _triple(point: Any) -> Array:
    """Return x, y and visibility (1, 3) of a point: an object, or x, y, z and perhaps visibility."""
    if isinstance(point, dict):
        seen = _first(point, _SEEN_KEYS)
        values = [point["x"], point["y"], 1.0 if seen is None else seen]
    else:
        values = [*point[:2], point[3] if len(point) > 3 else 1.0]
    return parse_triples([math.nan if one is None else one for one in values], "a point")


def _landmark(name: str) -> int | None:
    """Return the landmark of a name as MediaPipe's languages spell it, or of a number."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip())
    plain = re.sub(r"[^a-z0-9]+", "_", plain.lower()).strip("_").removeprefix("landmark_")
    plain = plain.replace("foot_index", "big_toe")
    if plain.isdigit() and int(plain) < len(_NAMES):
        return int(plain)
    return _NAMES.index(plain) if plain in _NAMES else None


def _known_landmark(name: str) -> int:
    landmark = _landmark(name)
    if landmark is None:
        raise FormatError(f"'{shorten(name)}' is no landmark; known: {', '.join(_NAMES)}")
    return landmark


def _of_table(lines: Lines) -> list[Detection]:
    """Return the people of a table."""
    header, rows = lines.table(())
    frame_key, person_key, video_key, landmark_key, seen_key = (
        next((key for key in keys if key in header), None)
        for keys in (_FRAME_KEYS, _PERSON_KEYS, _VIDEO_KEYS, _LANDMARK_KEYS, _SEEN_KEYS)
    )
    columns = _columns_by_landmark(header)
    if landmark_key is None and len(columns) < _MIN_COLUMNS:
        raise FormatError("no columns of landmarks; known: landmark, x and y, or nose_x, nose_y ...")
    if landmark_key is not None and (frame_key is None or not {"x", "y"} <= set(header)):
        raise FormatError("a row for each landmark needs the columns frame, x and y")
    people: dict[tuple[str, int, int | None], Detection] = {}
    for position, row in enumerate(rows):
        frame = position if frame_key is None else _count(row[frame_key], frame_key)
        person = None if person_key is None else _count(row[person_key], person_key)
        place = (row[video_key] if video_key else "", frame)
        one = Detection(place, person, np.zeros((len(_NAMES), 3)), f"line {lines.number}")
        table = people.setdefault((*place, person), one).table
        points = columns if landmark_key is None else {_known_landmark(row[landmark_key]): ("x", "y", seen_key)}
        for landmark, keys in points.items():
            table[landmark] = [1.0 if key is None else _number(row[key], key) for key in keys]
    if not people:
        raise InputError("this table of landmarks has no rows: nobody was detected")
    return list(people.values())


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


def _number(token: str, what: str) -> float:
    return math.nan if token.lower() in ("", "nan", "none") else parse_number(token, what)


def _count(token: str, what: str) -> int:
    value = parse_number(token, what, 0, MAX_COUNT)
    if value != int(value):
        raise FormatError(f"{what} is {shorten(token)}; allowed: whole numbers from 0")
    return int(value)
