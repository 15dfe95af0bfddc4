"""Reading landmarks of MediaPipe and keypoints of other detectors in JSON and tables.

MediaPipe itself writes no file; the common forms of other programs are read.  In JSON, a frame is a list of points, in
order or by name, alone or one list for each person.  A table has a row for each landmark (`frame, landmark_id, x, y, z,
visibility`) or for each frame (`nose_x, nose_y, ...` or `x0, y0, z0, v0, ...`; with several people `p1_nose_x`), also
below the header rows of DeepLabCut (`scorer`, `individuals`, `bodyparts`, `coords`).

JSON may have frames by number or image with people by number or name, as in AlphaPose's variants of OpenPose, or people
by number (`person_0`) with frames.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError, named
from pasdedeux.formats.file_format import AnnotationFormat, FileStart
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.detections import (
    MIN_NAMED,
    UNKNOWN,
    Detection,
    join_detections,
    known_footage,
    names_in_order,
)
from pasdedeux.formats.poses2d.image_names import FramePlace, places_of_names
from pasdedeux.formats.text import (
    MAX_COUNT,
    Lines,
    decode,
    parse_cell,
    parse_json,
    parse_number,
    parse_triples,
    shorten,
)
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, LAYOUTS_OF_COUNT, KeypointLayout

Names = tuple[str, ...] | None
_NAMES = KEYPOINT_LAYOUTS["mediapipe33"].keypoint_names
_LIST_KEYS = ("frames", "poses", "results", "data", "landmarks", "pose_landmarks")
_POSE_KEYS = (
    *("landmarks", "pose_landmarks", "poselandmarks", "landmark", "keypoints", "pose"),
    *("people", "bodies", "pose_keypoints_2d", "joints"),
)
_FRAME_KEYS = ("frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_num", "frame_no")
_PERSON_KEYS = ("person", "person_id", "track_id", "pose_index", "pose_id", "individual", "id")
_VIDEO_KEYS = ("video", "video_name", "sequence", "filename")
_IMAGE_KEYS = ("image", "image_name", "image_file", "img", "img_name", "filename", "file_name", "file", *_FRAME_KEYS)
_PERSON = re.compile(
    r"(?:p|id|ind|person|people|player|dancer|track|subject|actor|individual|body)[ _-]?\d+", re.IGNORECASE
)
_IMAGE = re.compile(r"\.(?:jpe?g|png|bmp|tiff?|webp)$", re.IGNORECASE)
_LANDMARK_KEYS = (
    *("landmark_name", "landmark", "landmark_id", "landmark_index", "landmark_idx"),
    *("keypoint_name", "keypoint", "keypoint_id", "bodypart", "joint_name", "joint_id"),
)
_SEEN_KEYS = ("visibility", "vis", "v", "confidence", "score", "likelihood", "conf")
_AXIS = r"x|y|z|v|vis|visibility|c|s|conf|confidence|score|likelihood|p"
_COLUMN = re.compile(
    rf"(?:(?P<who>(?:p|person|player|dancer|id|ind)_?\d+)[_.: -])?"
    rf"(?:(?P<axis>{_AXIS})_?(?P<index>\d{{1,3}})|(?P<name>.+?)[_.: -](?P<of>{_AXIS})"
    rf"|(?P<by>{_AXIS})_(?P<of_name>\D.+?))"
    r"(?:_px)?"
)
_LISTS = re.compile(
    r"(?:\[\s*(?:\[\s*\]\s*,\s*)*){2,5}(?:-?\d|null|NaN)"
    r'|\[\s*(?:\{\s*\}\s*,\s*)*(?:\{\s*"[^"]*"\s*:\s*){2}\[\s*(?:-?\d|null|NaN)'
)
"""Beginning of JSON that has only lists of numbers: lists of frames, or of objects of people with named joints."""


def read_landmarks(data: bytes | str, sequence_id: str, layout: str | KeypointLayout = "auto") -> AnnotatedFrames:
    """Read landmarks in pixels or relative to the image; missing points and points at (0, 0) are not detected.

    A frame without a number is numbered by its position.  Unnamed points may be of another detector.
    """
    what = "file of landmarks"
    footage = UNKNOWN
    if decode(data, what).lstrip()[:1] in ("{", "["):
        content = parse_json(data, what)
        footage = known_footage(content)
        detections = list(_of_frames(content))
    else:
        is_deeplabcut = decode(data, what).lstrip()[:6].lower() == "scorer"
        with Lines(data, what) as lines:
            detections = _of_table(lines, is_deeplabcut=is_deeplabcut)
    videos = {detection.place[0] for detection in detections}
    if len(videos) == 1:
        detections = [replace(detection, place=("", detection.place[1])) for detection in detections]
    return join_detections(
        detections,
        sequence_id=sequence_id,
        layout=layout,
        sizes_px=dict.fromkeys({detection.place[0] for detection in detections}, size)
        if (size := footage.image_size_px)
        else {},
        rate_hz=footage.rate_hz,
        may_be_cut=True,
    )


def _is_points(start: FileStart) -> bool:
    """Return whether the file is JSON of landmarks or of lists of points, or a table with such columns."""
    if start.is_json:
        if start.has_key("people") and not start.is_by_frame:
            return False
        if start.has_points or start.has_key("landmarks", "pose_landmarks"):
            return True
        has_lists = start.is_by_frame or _LISTS.match(start.text) is not None
        return has_lists and not start.has_key("annotations", "image_id")
    if start.columns[0] == "scorer":
        return True
    keys = {_plain(column) for column in start.columns}
    if {"x", "y", "joint"} <= keys:  # our own
        return False
    is_by_landmark = {"x", "y"} <= keys and any(_plain(key) in keys for key in _LANDMARK_KEYS)
    return is_by_landmark or any(len(points) >= MIN_NAMED for points in _columns_by_landmark(start.columns).values())


POINTS = AnnotationFormat(
    name="points",
    suffixes=(".json", ".csv"),
    recognises=_is_points,
    read_file=read_landmarks,
)
"""Points by frame; JSON may state rate and image size, which relative coordinates need."""


def _first(content: Mapping[str, Any], keys: Sequence[str]) -> Any:
    """Return the value of the first of these keys that is there and not null, else None."""
    return next((content[key] for key in keys if content.get(key) is not None), None)


def _of_frames(content: Any) -> Iterator[Detection]:
    """Yield the people of JSON: a list of frames, an object with one, an object by frame numbers, or one frame."""
    content = frames = _by_frame(content)
    if isinstance(content, dict):
        are_frames = not _is_pose(content) and all(
            _is_nested(inner) and re.search(r"\d", key) for key, inner in content.items()
        )
        are_numbers = all(re.fullmatch(r"[0-9]{1,9}", key) for key in content)
        places = (
            {key: ("", int(key)) for key in content} if are_numbers else places_of_names(content if are_frames else ())
        )
        named_frames = [{"frame": frame, "landmarks": content[key]} for key, (_, frame) in places.items()]
        frames = next((content[key] for key in _LIST_KEYS if isinstance(content.get(key), list)), named_frames or None)
        if len({video for video, _ in places.values()}) > 1:
            raise FormatError("its names of images are of several videos; give each a file")
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
            are_people = bool(low) and all(map(_is_pose, low.values()))
            if low and not any(key in low for key in _POSE_KEYS) and not _is_pose(low) and not are_people:
                has_world = any("world" in key for key in low)
                raise FormatError("no landmarks of the image are there" + (", only of the world" if has_world else ""))
            is_number = isinstance(person, int) and 0 <= person <= MAX_COUNT
            person_id = person if is_number or (isinstance(person, str) and person) else None
            for who, pose, names in _poses(frame if are_people else low or frame):
                yield Detection(("", number), person_id if who is None else who, pose, where, names=names)


def _by_frame(content: Any) -> Any:
    """Convert people with frames to frames with people; return other content unchanged."""
    are_people = isinstance(content, dict) and content and all(map(_PERSON.fullmatch, content))
    if not are_people or not all(map(_is_nested, content.values())):
        return content
    frames: dict[str, dict[str, Any]] = {}
    for person, poses in content.items():
        is_one = _is_pose(poses) or not any(map(_is_nested, poses.values() if isinstance(poses, dict) else poses))
        by_frame = {0: poses} if is_one else poses if isinstance(poses, dict) else dict(enumerate(poses))
        for frame, pose in by_frame.items():
            if pose is not None:
                frames.setdefault(str(frame), {})[person] = pose
    return frames


def _is_point(value: Any) -> bool:
    if isinstance(value, dict):
        return "x" in value and "y" in value
    is_numbers = isinstance(value, list) and all(
        element is None or isinstance(element, int | float) for element in value
    )
    return is_numbers and 2 <= len(value) <= 5


def _is_nested(value: Any) -> bool:
    return isinstance(value, list | dict)


def _is_pose(value: Any) -> bool:
    """Return whether a value is the points of one person: a list in order, or an object by name."""
    points = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    return len(points) > 2 and all(_is_point(point) for point in points)


def _poses(value: Any, person: int | str | None = None) -> Iterator[tuple[int | str | None, Array, Names]]:
    """Yield number or name, points (K, 3) and names of the points of each person; None for missing values."""
    if value is None or value in ([], {}):
        return
    if isinstance(value, list) and len(value) / 3 in LAYOUTS_OF_COUNT and not any(map(_is_nested, value)):
        yield person, parse_triples(value, "a list of x, y, confidence"), None
    elif _is_pose(value):
        points = list(value.values()) if isinstance(value, dict) else value
        names = (
            list(value)
            if isinstance(value, dict)
            else [_first(point, ("name", "part")) for point in points if isinstance(point, dict)]
        )
        has_names = len(names) == len(points) and all(isinstance(name, str) and name for name in names)
        yield person, _table(points), tuple(names) if has_names else None
    elif isinstance(value, list):
        for element in value:
            yield from _poses(element, person)
    elif isinstance(value, dict) and any(key in value for key in _POSE_KEYS):
        yield from _poses(next(value[key] for key in _POSE_KEYS if key in value), person)
    elif isinstance(value, dict) and all(map(_is_nested, value.values())):
        for key, inner in value.items():
            yield from _poses(inner, int(key) if re.fullmatch(r"[0-9]{1,9}", key) else key)
    else:
        raise FormatError("a pose must be a list of points with x and y")


def _table(points: Sequence[Any]) -> Array:
    """Return x, y and visibility (K, 3) of points: objects, or lists of x, y and optionally z and visibility.

    The third of three numbers is a confidence if all of them are within 0 to 1, else a depth.
    """
    thirds = [point[2] for point in points if isinstance(point, list) and len(point) == 3]
    has_depth = any(third is not None and not 0 <= third <= 1 for third in thirds)
    values: list[Any] = []
    for point in points:
        if isinstance(point, dict):
            seen = _first(point, _SEEN_KEYS)
            values += [point["x"], point["y"], 1.0 if seen is None else seen]
        else:
            at = 3 if len(point) > 3 else 2 if len(point) == 3 and not has_depth else None
            values += [*point[:2], 1.0 if at is None else point[at]]
    return parse_triples(values, "a point")


def _of_table(lines: Lines, *, is_deeplabcut: bool) -> list[Detection]:
    """Return the people of a table."""
    header, rows = _deeplabcut(lines) if is_deeplabcut else lines.table(())
    plain = {_plain(column): column for column in reversed(header)}
    frame_key, person_key, video_key, landmark_key, seen_key = (
        next((plain[_plain(key)] for key in keys if _plain(key) in plain), None)
        for keys in (_FRAME_KEYS, _PERSON_KEYS, _VIDEO_KEYS, _LANDMARK_KEYS, _SEEN_KEYS)
    )
    by_person = _columns_by_landmark(header)
    cells = [(lines.number, row) for row in rows]
    keys = (plain[_plain(key)] for key in _IMAGE_KEYS if _plain(key) in plain)
    image_key = next((key for key in keys if cells and all(_IMAGE.search(row[key]) for _, row in cells)), None)
    video_key = None if video_key == image_key else video_key
    places: Mapping[str, FramePlace] = {}
    if image_key is not None and frame_key in (None, image_key):
        frame_key, places = image_key, places_of_names(row[image_key] for _, row in cells)
    if landmark_key is None and not any(len(points) >= MIN_NAMED for points in by_person.values()):
        raise FormatError("no columns of landmarks; known: landmark, x and y, or nose_x, nose_y ...")
    if landmark_key is not None and (frame_key is None or not {"x", "y"} <= set(plain)):
        raise FormatError("a row for each landmark needs the columns frame, x and y")
    people: dict[tuple[str, int, int | str | None, int], tuple[int, dict[str, list[float]]]] = {}
    seen: Counter[tuple[str, int, int | str | None]] = Counter()
    for position, (line, row) in enumerate(cells):
        lines.number = line  # for errors
        in_video, frame = places.get(row[frame_key], ("", None)) if frame_key else ("", position)
        if frame is None:
            frame = _count(row[str(frame_key)], str(frame_key))
        person = None if person_key is None else _person(row[person_key], person_key)
        video = row[video_key] if video_key else in_video
        if landmark_key is not None:
            name = row[landmark_key]
            if name.isdigit() and int(name) >= len(_NAMES):
                raise FormatError(f"'{shorten(name)}' is no landmark; known: 0 to {len(_NAMES) - 1}, or names")
            values = [_value(row, key) for key in (plain["x"], plain["y"], seen_key)]
            place = (video, frame, person)
            # Among people without numbers, the next one begins when a landmark is repeated.
            seen[place] += name in people.get((*place, seen[place]), (line, {}))[1] and person is None
            _, points = people.setdefault((*place, seen[place]), (line, {}))
            if name in points:
                raise FormatError(f"'{shorten(name)}' twice for person {person} in frame {frame}")
            points[name] = values
            continue
        for who, columns in by_person.items():
            place = (video, frame, person if person is not None or len(by_person) == 1 else who)
            points = {name: [_value(row, column) for column in axes] for name, axes in columns.items()}
            people[(*place, seen[place])] = (line, points)
            seen[place] += 1
    if not people:
        raise InputError("this table of landmarks has no rows: nobody was detected")
    names = names_in_order((name for _, points in people.values() for name in points), first=0)
    missing = [math.nan, math.nan, 0.0]
    detections = []
    for (video, frame, person, _), (line, points) in people.items():
        table = np.array([points.get(name, missing) for name in names])
        detections.append(Detection((video, frame), person, table, f"line {line}", names=names))
    return detections


def _deeplabcut(lines: Lines) -> tuple[list[str], list[dict[str, str]]]:
    """Return columns and rows of a table of DeepLabCut, whose first rows describe the columns."""
    rows, head = lines.rows(), dict[str, list[str]]()
    while "coords" not in head:
        row = next(rows, None)
        if row is None:
            raise FormatError("the table of DeepLabCut has no row 'coords'")
        head[row[0].lower()] = row
    if "bodyparts" not in head or len(set(map(len, head.values()))) > 1:
        raise FormatError("the table of DeepLabCut has no row 'bodyparts' as long as 'coords'")
    who = head.get("individuals", [""] * len(head["coords"]))
    index = [at for at, axis in enumerate(head["coords"]) if at == 0 or not axis]
    people = (
        {name: f"p{number}_" for number, name in enumerate(dict.fromkeys(who[len(index) :]))} if any(who) else {"": ""}
    )
    columns = zip(who, head["bodyparts"], head["coords"], strict=True)
    header = [f"{people.get(name, '')}{part}_{axis}".lower() for name, part, axis in columns][len(index) :]
    read = [([row[at] for at in index], row[len(index) :], lines.number) for row in rows]
    images = ["/".join(filter(None, words)) for words, _, _ in read]
    places = {} if all(map(str.isdigit, images)) else places_of_names(images)
    frames = [str(places[image][1]) if places else image for image in images]
    named_rows = []
    for frame, (_, row, number) in zip(frames, read, strict=True):
        if len(row) != len(header):
            raise FormatError(f"row {number} has {counted(len(row), 'value')} where {len(header)} are needed")
        named_rows.append({"frame": frame, **dict(zip(header, row, strict=True))})
    return ["frame", *header], named_rows


def _columns_by_landmark(header: Sequence[str]) -> dict[str, dict[str, tuple[str, str, str | None]]]:
    """Return the columns of x, y and visibility of each landmark of each person, for tables with a row per frame."""
    by_person: dict[str, dict[str, dict[str, str]]] = {}
    for column in header:
        if match := _COLUMN.fullmatch(column):
            name = match["index"] or match["name"] or match["of_name"]
            axis = match["axis"] or match["of"] or match["by"]
            axes = by_person.setdefault(match["who"] or "", {}).setdefault(name.lstrip("0") or "0", {})
            axes[axis if axis in ("x", "y", "z") else "v"] = column
    people = {}
    for who, names in by_person.items():
        both = {name: axes for name, axes in names.items() if {"x", "y"} <= axes.keys()}
        points = {name: (axes["x"], axes["y"], axes.get("v")) for name, axes in both.items()}
        numbered = {int(name): columns for name, columns in points.items() if name.isdigit()}
        shift = min(1, min(numbered, default=0))
        people[who] = {str(number - shift): columns for number, columns in numbered.items()} or points
    most = max(map(len, people.values()), default=0)
    return {who: points for who, points in people.items() if 2 * len(points) > most}


def _plain(column: str) -> str:
    return re.sub(r"[\W_]+", "", column.lower())


def _value(row: Mapping[str, str], key: str | None) -> float:
    return 1.0 if key is None else parse_cell(row[key], key)


def _person(token: str, what: str) -> int | str:
    return token if any(map(str.isalpha, token)) else _count(token, what)


def _count(token: str, what: str) -> int:
    value = parse_number(token, what, 0, MAX_COUNT)
    if value != int(value):
        raise FormatError(f"{what} is {shorten(token)}; allowed: whole numbers from 0")
    return int(value)
