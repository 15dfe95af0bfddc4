"""Read the files of tools in use: each holds the same one or two people, with their frames and numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from itertools import chain
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus
from pasdedeux.formats.poses2d.coco import read_coco
from pasdedeux.formats.poses2d.detections import Footage
from pasdedeux.formats.registry import ANNOTATION_FORMATS, read_annotations, recognise_format
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tests.builders.source_samples import coco_text, people_of, yolo_text

FRAMES = 6
NAMES = KEYPOINT_LAYOUTS["coco17"].keypoint_names
SIZE_PX = (640, 480)
COCO = ANNOTATION_FORMATS["coco"]


def listed(people: int = 2, layout: str = "coco17") -> list[tuple[int, int, np.ndarray]]:
    return list(people_of(FRAMES, people, layout))


def wide(people: int, name_of: Callable[[int, str], str], layout: str = "coco17") -> list[str]:
    """Return a table with a row for each frame and people beside each other."""
    names = KEYPOINT_LAYOUTS[layout].keypoint_names
    rows = [
        ["frame", *(f"{name_of(person, name)}_{axis}" for person in range(people) for name in names for axis in "xyc")]
    ]
    for frame in range(FRAMES):
        tables = [table for at, _, table in listed(people, layout) if at == frame]
        rows.append([str(frame), *(f"{value:.3f}" for table in tables for value in table.ravel())])
    return [",".join(row) for row in rows]


def long(people: int, columns: str, row: str) -> str:
    """Return a table with a row for each keypoint."""
    values = [
        (f, p, "AB"[p], NAMES[k], *xyc, k + 1) for f, p, table in listed(people) for k, xyc in enumerate(table.tolist())
    ]
    return "\n".join([columns, *(row.format(*value) for value in values)])


def deeplabcut(people: int, index: Callable[[int], list[str]]) -> list[str]:
    lead, parts = [""] * (len(index(0)) - 1), [(who, name) for who in range(people) for name in NAMES]
    rows = [["scorer", *lead, *["net"] * 3 * len(parts)]]
    rows += [["individuals", *lead, *(f"dancer {'AB'[who]}" for who, _ in parts for _ in "xyl")]] if people > 1 else []
    rows += [["bodyparts", *lead, *(name for _, name in parts for _ in "xyl")]]
    rows += [["coords", *lead, *["x", "y", "likelihood"] * len(parts)]]
    for frame in range(FRAMES):
        tables = [table for at, _, table in listed(people) if at == frame]
        rows.append([*index(frame), *(f"{value:.3f}" if value else "" for table in tables for value in table.ravel())])
    return [",".join(row) for row in rows]


def coco_of(change: Callable[[dict[str, Any], int, int], dict[str, Any]], images: list[dict[str, Any]]) -> str:
    people = [
        change({"image_id": frame, "keypoints": table.ravel().tolist(), "category_id": 1}, frame, person)
        for frame, person, table in listed()
    ]
    return json.dumps({"images": images, "annotations": people, "categories": [{"id": 1, "keypoints": NAMES}]})


IMAGES = [{"id": frame, "file_name": f"frame_{frame:06d}.PNG"} for frame in range(FRAMES)]
POSETRACK = [10_003_420_000 + frame for frame in range(FRAMES)]
POSETRACK_IMAGES = [
    {"id": at, "frame_id": at, "vid_id": "000342", "file_name": f"val/000342_mpii/{frame:06d}.jpg"}
    for frame, at in enumerate(POSETRACK)
]
POSETRACK_PEOPLE = [
    {"image_id": POSETRACK[frame], "track_id": person, "keypoints": table.ravel().tolist()}
    for frame, person, table in listed()
]
BOXES = [{"image_id": 0, "bbox": [1, 2, 3, 4]}, {"image_id": 3, "keypoints": None}]
BY_FRAME = [[table.tolist() for at, _, table in listed() if at == frame] for frame in range(FRAMES)]
BY_NAME: dict[str, dict[str, dict[str, list[float]]]] = {}
for _frame, _person, _table in listed():
    BY_NAME.setdefault(str(_frame), {})[str(_person)] = dict(zip(NAMES, _table.tolist(), strict=True))
ALONE = [table.tolist() for _, _, table in listed(1)]
NAMED = [
    [
        {"name": name, "x": x, "y": y, "score": sure}
        for name, (x, y, sure) in reversed(list(zip(NAMES, table, strict=True)))
    ]
    for table in ALONE
]
ONE, TWO = wide(1, lambda person, name: name), wide(2, lambda person, name: f"p{person + 1}_{name}")
ONE_AXIS_FIRST = [re.sub(r"(\w+)_([xyc])\b", r"\2_\1", ONE[0]), *ONE[1:]]

TEXTS = {
    "COCO with confidences as v": coco_of(lambda row, frame, person: row | {"track_id": person}, IMAGES),
    "COCO with names of people": coco_of(lambda row, frame, person: row | {"track_id": "AB"[person]}, IMAGES),
    "COCO of CVAT": coco_of(
        lambda row, frame, person: row | {"attributes": {"track_id": person, "keyframe": frame % 3 == 0}}, IMAGES
    ),
    "COCO with null": coco_of(
        lambda row, frame, person: row | {"keypoints": [value or None for value in row["keypoints"]]}, IMAGES
    ),
    "COCO of PoseTrack": json.dumps({"images": POSETRACK_IMAGES, "annotations": POSETRACK_PEOPLE}),
    "results of PoseTrack": json.dumps(POSETRACK_PEOPLE),
    "results with boxes alone": json.dumps(
        BOXES + [{"image_id": frame, "keypoints": table.tolist()} for frame, _, table in listed()]
    ),
    "lists of lists": json.dumps(BY_FRAME),
    "lists of lists of one person": json.dumps(ALONE),
    "lists by frame": json.dumps({str(frame): people for frame, people in enumerate(BY_FRAME)}),
    "lists by image": json.dumps({f"img ({frame}).jpg": people for frame, people in enumerate(BY_FRAME)}),
    "flat lists": json.dumps([[[*chain(*table)] for table in people] for people in BY_FRAME]),
    "wide table with axes first, one person": "\n".join(ONE_AXIS_FIRST),
    "our rows by number of joint": long(2, "frame,person,joint,x,y,confidence", "{0}.0,{1}.0,{7},{4},{5},{6}"),
    "people by number in frames by number": json.dumps(BY_NAME),
    "people by name in frames by image": json.dumps(
        {f"img ({f}).jpg": {"AB"[int(p)]: joints for p, joints in people.items()} for f, people in BY_NAME.items()}
    ),
    "people by name in a list of frames": json.dumps(
        [{"AB"[int(p)]: joints for p, joints in people.items()} for people in BY_NAME.values()]
    ),
    "frames by number in people by number": json.dumps(
        {f"person_{p}": {f: BY_NAME[f][p] for f in BY_NAME} for p in "01"}
    ),
    "frames by image in people by number": json.dumps(
        {f"dancer {p}": {f"frame_{f}.jpg": BY_NAME[f][p] for f in BY_NAME} for p in "01"}
    ),
    "frames in order in people by number": json.dumps(
        {f"Dancer{p}": [[*BY_NAME[f][p].values()] for f in BY_NAME] for p in "01"}
    ),
    "lists of named joints by frame": json.dumps({f"frame_{f}": [*people.values()] for f, people in BY_NAME.items()}),
    "AlphaPose's lists in OpenPose's words": json.dumps(
        {
            f"{f}.jpg": {
                "version": "AlphaPose v0.3",
                "people": [{"pose_keypoints_2d": [*chain(*table)]} for table in people],
            }
            for f, people in enumerate(BY_FRAME)
        }
    ),
    "AlphaPose's lists of bodies": json.dumps(
        {
            f"{f}.jpg": {"bodies": [{"joints": [*chain(*table)]} for table in people]}
            for f, people in enumerate(BY_FRAME)
        }
    ),
    "rows with a frame and an image": long(
        2, "image,frame,person,keypoint,x,y,score", "film_{0}_12.jpg,{0},{1},{3},{4},{5},{6}"
    ),
    "rows with an image in place of a frame": long(
        2, "file_name,person,keypoint,x,y,score", "clip/frame_{0:04d}.png,{1},{3},{4},{5},{6}"
    ),
    "rows with an image as frame": long(2, "frame,person,keypoint,x,y,score", "{0}.jpg,{1},{3},{4},{5},{6}"),
    "our rows with an image": long(2, "image,frame,person,joint,x,y,confidence", "a_{0}.jpg,{0},{1},{3},{4},{5},{6}"),
    "points with names, one person": json.dumps([{"frame": f, "keypoints": points} for f, points in enumerate(NAMED)]),
    "wide table, one person": "\n".join(ONE),
    "wide table in camel case, one person": "\n".join(wide(1, lambda person, name: name.title().replace("_", ""))),
    "wide table of two people": "\n".join(TWO),
    "wide table with semicolons, one person": "\n".join(ONE).replace(",", ";").replace(".", ","),
    "wide table with tabs, one person": "\n".join(ONE).replace(",", "\t"),
    "rows by name with a person": long(2, "Frame,Person,Keypoint,X,Y,Score", "{0},{1},{3},{4},{5},{6}"),
    "rows by name without a person": long(2, "Frame,Bodypart,X,Y,Likelihood", "{0},{3},{4},{5},{6}"),
    "our rows with names of people": long(2, "frame;person;joint;x;y;confidence", "{0};{2};{3};{4};{5};{6}"),
    "DeepLabCut, one person": "\n".join(deeplabcut(1, lambda frame: [str(frame)])),
    "DeepLabCut of two people": "\n".join(deeplabcut(2, lambda frame: [str(frame)])),
    "DeepLabCut of images, one person": "\n".join(deeplabcut(1, lambda at: ["labels", "film", f"img{at:04d}.png"])),
}
ORDERED = ("null", "boxes", "lists", "one person", "without a person")
"""Kinds whose people have no numbers."""


def check(found: AnnotatedFrames, people: int, *, is_numbered: bool, has_scores: bool = True) -> None:
    assert (found.layout, found.has_identities) == ("coco17", is_numbered)
    frames, persons, tables = zip(*listed(people), strict=True)
    assert found.frame.tolist() == [*frames]
    if is_numbered:
        assert found.person_id.tolist() == [*persons]
    px, confidence = np.split(np.stack(tables), [2], axis=-1)
    np.testing.assert_allclose(found.keypoints_px, np.where(confidence > 0, px, np.nan), atol=2e-3)
    if has_scores:
        np.testing.assert_allclose(found.confidence, confidence[..., 0], atol=1e-3)


@pytest.mark.parametrize("kind", TEXTS)
def test_files_of_every_tool_are_recognised_and_are_the_same_people(kind: str) -> None:
    text, people = TEXTS[kind], 1 if "one person" in kind else 2
    is_numbered = not any(word in kind for word in ORDERED)
    for data in (text.encode(encoding) for encoding in ("utf-8", "utf-8-sig", "utf-16")):
        found = read_annotations(recognise_format(data), {"a": data}, source_id="s")
        numbers = found.person_id - found.person_id.min()
        check(found, people, is_numbered=is_numbered)
        assert set(found.sequence_id) == {"s.000342" if kind == "COCO of PoseTrack" else "s"}
        assert numbers.max() == people - 1


def test_the_order_that_is_assumed_of_17_numbers_is_said_where_nothing_tells_another() -> None:
    """PoseTrack 2018 has ends of heads where COCO has eyes."""
    data = json.dumps(POSETRACK_PEOPLE).encode()
    said = "keypoints without names taken as 'coco17', not 'posetrack17' (layout)"
    assert read_annotations(COCO, {"a": data}, source_id="s").remarks == (said,)
    stated = read_annotations(COCO, {"a": data}, source_id="s", layout="posetrack17")
    assert (stated.layout, stated.remarks) == ("posetrack17", ())
    named = TEXTS["COCO with confidences as v"].encode()
    assert read_annotations(COCO, {"a": named}, source_id="s").remarks == ()


def test_what_is_no_key_frame_of_cvat_is_interpolated() -> None:
    found = read_coco(TEXTS["COCO of CVAT"], "s")
    for frame, row, sure in zip(found.frame, found.status, found.confidence, strict=True):
        expected = KeypointStatus.ANNOTATED if frame % 3 == 0 else KeypointStatus.INTERPOLATED
        assert set(row[sure > 0].tolist()) == {expected}


@pytest.mark.parametrize("has_scores", [True, False])
@pytest.mark.parametrize("tail", ["", " 0.870000", " 0.870000 3"])
@pytest.mark.parametrize("name", ["clip_{}.txt", "image ({}).txt"])
def test_a_folder_of_yolo_is_read(has_scores: bool, tail: str, name: str) -> None:
    files = {
        name.format(frame): yolo_text(seed=frame, has_scores=has_scores, tail=tail).encode() for frame in range(FRAMES)
    }
    kind = recognise_format(next(iter(files.values())))
    assert kind is ANNOTATION_FORMATS["yolo"]
    found = read_annotations(kind, files, source_id="s", stated=Footage(SIZE_PX))
    check(found, 2, is_numbered=False, has_scores=has_scores)
    with pytest.raises(InputError, match="image_size_px"):
        read_annotations(kind, files, source_id="s")


def test_visibilities_are_judged_by_the_file_and_not_by_the_person() -> None:
    """Somebody who is always hidden has only 1s, which mean the same as the 1s of others."""
    content = json.loads(coco_text(num_frames=3, people=2))
    for person in content["annotations"][::2]:
        person["keypoints"][2::3] = [min(1.0, v) for v in person["keypoints"][2::3]]
    found = read_coco(json.dumps(content), "s")
    assert {*found.confidence[::2].ravel().tolist()} == {0.0, 0.5}
    assert {*found.confidence[1::2].ravel().tolist()} == {0.0, 0.5, 1.0}
    for person in content["annotations"]:
        person["keypoints"][2::3] = [min(1.0, v) for v in person["keypoints"][2::3]]
    assert {*read_coco(json.dumps(content), "s").confidence.ravel().tolist()} == {0.0, 1.0}


@pytest.mark.parametrize("count", [17, 25])
def test_the_first_landmarks_of_mediapipe_are_no_other_detectors(count: int) -> None:
    rows = listed(1, "mediapipe33")
    by_row = [
        "Frame,LandmarkID,X,Y",
        *(f"{f},{k},{x},{y}" for f, _, t in rows for k, (x, y, _) in enumerate(t[:count])),
    ]
    wide_rows = [
        ",".join(f"x{k},y{k},v{k}" for k in range(count)),
        *(",".join(map(str, t[:count].ravel())) for _, _, t in rows),
    ]
    lists = json.dumps(
        [{"landmarks": [{"x": x, "y": y, "visibility": v} for x, y, v in t[:count].tolist()]} for _, _, t in rows]
    )
    for text in ("\n".join(by_row), "\n".join(wide_rows), lists):
        data = text.encode()
        found = read_annotations(recognise_format(data), {"a": data}, source_id="s")
        assert found.layout == "mediapipe33"
        tables = np.stack([table[:count] for _, _, table in rows])
        px = np.where(tables[..., 2:] > 0, tables[..., :2], np.nan)
        np.testing.assert_allclose(found.keypoints_px[:, :count], px)
        assert np.isnan(found.keypoints_px[:, count:]).all()


@pytest.mark.parametrize("layout", ["coco17", "coco18", "body25", "body25b", "h36m17"])
def test_points_of_other_detectors_by_number_are_theirs(layout: str) -> None:
    tables = [t.tolist() for _, _, t in listed(1, layout)]
    data = json.dumps([{"landmarks": [{"x": x, "y": y} for x, y, _ in table]} for table in tables]).encode()
    found = read_annotations(recognise_format(data), {"a": data}, source_id="s")
    assert found.layout == layout


def scaled_coco(scale: float, size_px: tuple[int, int] | None, *, left_px: float = 0.0) -> dict[str, bytes]:
    """Return the people in COCO, moved to the left and scaled, in images that state this size or none."""
    stated = {} if size_px is None else {"width": size_px[0], "height": size_px[1]}
    people = [
        {"image_id": f, "track_id": p, "keypoints": ((t - (left_px, 0, 0)) * (scale, scale, 1)).ravel().tolist()}
        for f, p, t in listed()
    ]
    images = [{"id": frame} | stated for frame in range(FRAMES)]
    return {"a": json.dumps({"images": images, "annotations": people}).encode()}


def test_keypoints_of_another_size_are_scaled_where_the_file_states_it_and_refused_elsewhere() -> None:
    stated = scaled_coco(2.0, (1280, 960))
    found = read_annotations(COCO, stated, source_id="s", stated=Footage(SIZE_PX))
    check(found, 2, is_numbered=True)
    assert found.image_size_px == {"s": SIZE_PX}
    assert "keypoints of images of 1280 x 960 scaled to 640 x 480" in found.remarks
    with pytest.raises(InputError, match="images of 1280 x 960, but the film has 640 x 360 pixels, which is another"):
        read_annotations(COCO, stated, source_id="s", stated=Footage((640, 360)))
    outside = r"\d\d% of the keypoints of 's' lie outside the image: they reach 902 x 608, and the image is 640 x 480"
    for files, size_px in ((scaled_coco(2.0, None), SIZE_PX), (scaled_coco(2.0, SIZE_PX), None)):
        with pytest.raises(InputError, match=outside):
            read_annotations(COCO, files, source_id="s", stated=Footage(size_px))


@pytest.mark.parametrize(
    ("scale", "num_outside", "doubt"),
    [
        (1.0, 0, ""),
        (1.0, 10, r"\d% of the keypoints of 's' lie outside the image: they reach \d+ x \d+, and .* is 640 x 480"),
        (1.6, 0, "lie outside the image"),
        (0.5, 0, r"'s' lie in a quarter of the image: they reach \d+ x \d+, and the image is 640 x 480"),
        (0.1, 0, r"'s' lie in a quarter of the image: .* is 640 x 480: is it another size"),
    ],
)
def test_keypoints_that_seem_to_be_of_another_size_are_doubted(scale: float, num_outside: int, doubt: str) -> None:
    """Keypoints of which some per cent lie outside, or all in a quarter of the image, may be right."""
    seen = np.concatenate([table[table[:, 2] > 0, 0] for _, _, table in listed()])
    left_px = np.percentile(seen, num_outside) + 0.06 * 640 if num_outside else 0.0
    found = read_annotations(COCO, scaled_coco(scale, SIZE_PX, left_px=left_px), source_id="s")
    assert len(found.doubts) == bool(doubt)
    assert re.search(doubt, " ".join(found.doubts))


def test_an_offset_moves_frames_that_a_tool_counts_from_1() -> None:
    data = "\n".join(ONE).encode()
    found = read_annotations(ANNOTATION_FORMATS["points"], {"a": data}, source_id="s", frame_offset=7)
    assert found.frame.tolist() == [at + 7 for at in range(FRAMES)]
    with pytest.raises(InputError, match=r"frame 0 would be -1 \(frame_offset\)"):
        read_annotations(ANNOTATION_FORMATS["points"], {"a": data}, source_id="s", frame_offset=-1)
