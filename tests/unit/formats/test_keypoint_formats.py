"""Read formats of 2D poses: values, missing keypoints, layouts that are told apart or refused, and round trips."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, check_anatomy
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv, write_annotation_csv
from pasdedeux.formats.poses2d.annotation_npz import read_annotation_npz
from pasdedeux.formats.poses2d.coco import read_coco
from pasdedeux.formats.poses2d.detections import Footage
from pasdedeux.formats.poses2d.openpose import OPENPOSE
from pasdedeux.formats.poses2d.points import read_landmarks
from pasdedeux.formats.registry import ANNOTATION_FORMATS, read_annotations, recognise_format
from pasdedeux.skeletons.layouts import FEET4, KEYPOINT_LAYOUTS
from tests.builders.source_samples import (
    coco_text,
    csv_text,
    landmark_texts,
    openpose_text,
    people_of,
    person_px,
    result_texts,
    write_annotation_npz,
)


def rows_of(layout: str, keypoints: np.ndarray) -> AnnotatedFrames:
    count = len(keypoints)
    return AnnotatedFrames(
        layout=layout,
        sequence_id=("s",) * count,
        frame=np.arange(count),
        person_id=np.zeros(count, int),
        keypoints_px=keypoints,
        confidence=np.isfinite(keypoints).all(-1) * 0.9,
    )


def openpose_files(*texts: str) -> dict[str, bytes]:
    return {f"w_{frame}_keypoints.json": text.encode() for frame, text in enumerate(texts)}


def read_openpose_frame(text: str) -> AnnotatedFrames:
    return OPENPOSE.read(openpose_files(text), sequence_id="s")


@pytest.mark.parametrize(
    ("layout", "count"), [("coco18", 18), ("body25", 25), ("halpe26", 26), ("mediapipe33", 33), ("coco17", 17)]
)
def test_openpose_layouts_are_told_from_the_number_of_values(layout: str, count: int) -> None:
    frame = read_openpose_frame(openpose_text(layout, people=2))
    assert frame.layout == layout
    assert frame.keypoints_px.shape == (2, count, 2)
    assert frame.person_id.tolist() == [0, 1]


def test_what_is_at_the_origin_or_has_no_confidence_is_missing() -> None:
    content = json.loads(openpose_text("coco18", missing=(3,)))
    numbers = content["people"][0]["pose_keypoints_2d"]
    numbers[3 * 4 + 2], numbers[3 * 5 : 3 * 5 + 2] = 0.0, [0.0, 0.0]
    frame = read_openpose_frame(json.dumps(content))
    assert np.isnan(frame.keypoints_px[0, [3, 4, 5]]).all()
    assert (frame.confidence[0, [3, 4, 5]] == 0).all()
    assert np.isfinite(frame.keypoints_px[0, [0, 1, 2]]).all()


def test_an_openpose_frame_without_people_is_a_frame() -> None:
    nobody = '{"version": 1.3, "people": []}'
    with pytest.raises(InputError, match="nobody was detected"):
        read_openpose_frame(nobody)
    found = OPENPOSE.read(openpose_files(nobody, openpose_text("coco18")), sequence_id="s")
    assert found.frame.tolist() == [1]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"people": [{"pose_keypoints_2d": [1, 2, 3]}]}', r"3 values .*; allowed: 42 .*, 54 \(coco18\)"),
        ('{"people": [{"pose_keypoints_2d": "x"}]}', "no list 'pose_keypoints_2d'"),
        ('{"people": 1}', "no list 'people'"),
        ('{"people": [', "line 1"),
        ('{"people": [{"pose_keypoints_2d": [Infinity]}]}', "not a finite number"),
    ],
)
def test_a_fault_of_an_openpose_file_is_named(text: str, sentence: str) -> None:
    with pytest.raises(FormatError, match=sentence):
        read_openpose_frame(text)


def test_a_layout_other_than_the_files_is_refused() -> None:
    kind, files = ANNOTATION_FORMATS["openpose"], openpose_files(openpose_text("coco18"))
    assert read_annotations(kind, files, source_id="s", layout="coco18").layout == "coco18"
    renamed = replace(KEYPOINT_LAYOUTS["coco18"], name="mine")  # its joints are put in our own order
    assert read_annotations(kind, files, source_id="s", layout=renamed).layout == "pair17"
    with pytest.raises(InputError, match="the layout 'body25' is asked for, but the files have 18 keypoints"):
        read_annotations(kind, files, source_id="s", layout="body25")
    with pytest.raises(FormatError, match=r"w_0_.*: person 0 has 18 keypoints and w_1_.* has 25: a source has one"):
        kind.read(openpose_files(openpose_text("coco18"), openpose_text("body25")), sequence_id="s")


def test_the_last_file_may_be_cut_off_and_costs_its_frame() -> None:
    kind, texts = ANNOTATION_FORMATS["openpose"], [openpose_text("coco18", seed=seed) for seed in range(3)]
    found = kind.read(openpose_files(*texts[:2], texts[2][:90]), sequence_id="s")
    assert (found.frame.tolist(), found.skipped) == ([0, 1], ("w_2_keypoints.json",))
    with pytest.raises(FormatError, match=r"w_1_keypoints.json: .*on_unreadable"):
        kind.read(openpose_files(texts[0], texts[1][:90], texts[2]), sequence_id="s")
    with pytest.raises(FormatError, match=r"w_0_keypoints.json"):
        kind.read(openpose_files(texts[0][:90]), sequence_id="s")


def shares(layout: str = "coco18", shift: tuple[float, float] = (0.0, 0.0), scale: float = 1.0) -> dict[str, bytes]:
    """Return OpenPose files whose coordinates are shares of an image of 400 x 320, shifted and scaled."""
    files = []
    for seed in range(6):
        content = json.loads(openpose_text(layout, seed=seed))
        values = np.array(content["people"][0]["pose_keypoints_2d"]).reshape(-1, 3)
        values[:, :2] = scale * (values[:, :2] / (400.0, 320.0) - shift)
        content["people"][0]["pose_keypoints_2d"] = values.reshape(-1).tolist()
        files.append(json.dumps(content))
    return openpose_files(*files)


def test_shares_of_the_image_become_pixels_where_its_size_is_known_and_are_refused_elsewhere() -> None:
    kind = ANNOTATION_FORMATS["openpose"]
    with pytest.raises(InputError, match=r"shares of the image.*image_size_px"):
        read_annotations(kind, shares(), source_id="s")
    found = read_annotations(kind, shares(), source_id="s", stated=Footage((400, 320)))
    np.testing.assert_allclose(found.keypoints_px[3], person_px("coco18", seed=3), atol=0.01)
    assert found.remarks == ("coordinates from 0 to 1 across an image of 400 x 320",)
    centred = read_annotations(kind, shares(shift=(0.5, 0.5), scale=2.0), source_id="s", stated=Footage((400, 320)))
    np.testing.assert_allclose(centred.keypoints_px[3], person_px("coco18", seed=3), atol=0.01)
    assert centred.remarks == ("coordinates from -1 to 1 across an image of 400 x 320",)
    for hips_at_origin in (shares(shift=(0.25, 0.594)), shares(shift=(0.25, 0.594), scale=1.5)):
        with pytest.raises(InputError, match="world landmarks"):
            read_annotations(kind, hips_at_origin, source_id="s", stated=Footage((400, 320)))


@pytest.mark.parametrize("layout", KEYPOINT_LAYOUTS)
def test_noise_missing_joints_and_junk_do_not_make_people_of_another_layout(layout: str) -> None:
    """Anatomy is checked by medians, so noise of a detector does not matter."""
    rng = np.random.default_rng(7)
    for noise_px, missing, junk in ((0.0, 0.0, 0), (5.0, 0.1, 0), (5.0, 0.1, 3), (8.0, 0.3, 1)):
        px = np.stack([person_px(layout, seed) for seed in range(40)])
        px += rng.normal(0.0, noise_px, px.shape)
        px[rng.random(px.shape[:2]) < missing] = np.nan
        for row in px:
            spoilt = junk * len(row) // 17
            row[rng.choice(len(row), spoilt, replace=False)] = rng.uniform(0.0, 1500.0, (spoilt, 2))
        check_anatomy(rows_of(layout, px))


def test_coco18_padded_to_25_keypoints_is_noticed_and_the_right_order_named_also_of_faceless_people() -> None:
    px = np.full((10, 25, 2), np.nan)
    px[:, :18] = np.stack([person_px("coco18", seed) for seed in range(10)])
    with pytest.raises(InputError, match=r"do not look like people in the layout 'body25'.*order of 'coco18' fits"):
        check_anatomy(rows_of("body25", px))
    px[:, 14:18] = np.nan
    with pytest.raises(InputError, match=r"the mid-hip lies .* of a body from the middle of the hips.*'coco18' fits"):
        check_anatomy(rows_of("body25", px))


def test_a_real_walk_is_read_as_coco18(data_dir: Path) -> None:
    files = sorted((data_dir / "openpose_coco18_walk").glob("*.json"))
    walk = OPENPOSE.read({path.name: path.read_bytes() for path in files}, sequence_id="walk")
    assert walk.layout == "coco18"
    assert walk.num_rows == 453
    assert int((walk.confidence[:, :14] > 0).all(axis=1).sum()) == 310
    check_anatomy(walk)
    padded = np.full((walk.num_rows, 25, 2), np.nan)
    padded[:, :18] = walk.keypoints_px
    with pytest.raises(InputError, match="order of 'coco18' fits"):
        check_anatomy(rows_of("body25", padded))
    with pytest.raises(InputError, match="do not look like people"):
        check_anatomy(rows_of("coco17", walk.keypoints_px[:, :17]))


def test_coco_visibility_becomes_confidence_and_zero_is_missing() -> None:
    names = KEYPOINT_LAYOUTS["coco17"].keypoint_names
    found = read_coco(coco_text(num_frames=3, people=2), sequence_id="clip")
    assert found.num_rows == 6
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2]
    assert found.person_id.tolist() == [0, 1] * 3
    assert found.image_size_px == {"clip": (640, 480)}
    assert np.isnan(found.keypoints_px[:, names.index("right_wrist")]).all()
    assert (found.confidence[:, names.index("left_wrist")] == 0.5).all()
    assert (found.confidence[:, names.index("nose")] == 1.0).all()


def test_coco_tracks_and_videos_are_kept() -> None:
    content = json.loads(coco_text(num_frames=2, people=2))
    for index, annotation in enumerate(content["annotations"]):
        annotation["track_id"] = 7 + index % 2
    for image in content["images"]:
        image |= {"video_id": "a/b", "frame_id": 5 + image["id"]}
    found = read_coco(json.dumps(content), sequence_id="clip")
    assert set(found.sequence_id) == {"clip.a_b"}
    assert found.frame.tolist() == [15, 15, 16, 16]
    assert found.person_id.tolist() == [7, 8, 7, 8]


@pytest.mark.parametrize("tool", result_texts())
def test_results_of_every_tool_are_the_same_people(tool: str) -> None:
    found = read_coco(result_texts()[tool], sequence_id="r")
    assert (found.layout, set(found.sequence_id)) == ("coco17", {"r"})
    assert found.frame.tolist() == sorted(2 * list(range(6)))
    assert found.has_identities == (tool == "alphapose")
    assert found.person_id.tolist() == ([1, 2] if tool == "alphapose" else [0, 1]) * 6
    for row, (_, _, table) in enumerate(people_of(6, 2)):
        np.testing.assert_array_equal(found.confidence[row], table[:, 2])
        np.testing.assert_array_equal(found.keypoints_px[row], np.where(table[:, 2:] > 0, table[:, :2], np.nan))


@pytest.mark.parametrize("form", landmark_texts())
def test_landmarks_of_every_form_are_the_same_person(form: str) -> None:
    text = landmark_texts()[form].encode()
    kind = recognise_format(text)
    assert kind is ANNOTATION_FORMATS["points"]
    found = read_annotations(kind, {"m": text}, source_id="m", stated=Footage((400, 400)))
    assert (found.layout, found.rate_hz) == ("mediapipe33", 25.0 if form == "frames" else None)
    assert found.frame.tolist() == list(range(6))
    for row, (_, _, table) in enumerate(people_of(6, 1, "mediapipe33")):
        np.testing.assert_allclose(found.keypoints_px[row], np.where(table[:, 2:] > 0, table[:, :2], np.nan))
        np.testing.assert_allclose(found.confidence[row], table[:, 2])


def test_landmarks_of_several_people_are_all_read_and_state_the_image() -> None:
    content = json.loads(landmark_texts(people=2)["people"])
    text = json.dumps({"video": {"frame_rate": 50.0, "image_width": 400, "image_height": 400}, "frames": content})
    found = read_landmarks(text, sequence_id="m")
    assert found.person_id.tolist() == [0, 1] * 6
    assert (found.rate_hz, found.image_size_px, found.has_identities) == (50.0, {"m": (400, 400)}, False)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            '[{"pose_world_landmarks": [[{"x": 0.1, "y": 0.2}]]}]',
            "frame 0: no landmarks of the image are there, only of the",
        ),
        ('[{"frame": -1, "landmarks": []}]', "frame 0: its number is -1"),
        (
            '[{"landmarks": {"nose": {"x": 1, "y": 2}, "left_nose": {"x": 1, "y": 2}, "a": {"x": 1, "y": 2}}}]',
            "left_nose",
        ),
        ("frame,landmark_id,x,y\n0,0,1\n", "line 2: 3 values where 4 are needed"),
        ("frame,landmark_id,x,y\n0,33,1,2\n", "line 2: '33' is no landmark"),
        ("frame,landmark_id,x,y\nzero,3,1,2\n", "line 2: frame: 'zero' is not a number"),
        ('{"fps": "fast", "landmarks": []}', "'fps' is fast"),
    ],
)
def test_a_fault_of_a_file_of_landmarks_is_named(text: str, says: str) -> None:
    with pytest.raises(FormatError, match=says):
        read_landmarks(text, sequence_id="m")


def test_whole_body_results_are_read_without_face_and_hands() -> None:
    for count, layout in ((133, "coco23"), (136, "halpe26")):
        values = np.zeros((count, 3))
        body = person_px(layout)
        values[: len(body)] = np.concatenate([body, np.ones((len(body), 1))], axis=1)
        found = read_coco(json.dumps([{"image_id": 0, "keypoints": values.reshape(-1).tolist()}]), sequence_id="r")
        assert found.layout == layout
        np.testing.assert_array_equal(found.keypoints_px[0], body)


def test_unknown_numbers_of_keypoints_are_named_with_the_layouts_there_are() -> None:
    with pytest.raises(FormatError, match=r"annotation 0 has 21 keypoints; known numbers of .*: 14 \(crowdpose14 or "):
        read_coco(json.dumps([{"image_id": 0, "keypoints": [1.0] * 63}]), sequence_id="r")


def test_a_coco_file_of_two_layouts_is_refused() -> None:
    content = json.loads(coco_text())
    del content["annotations"][4]["keypoints"][-3:]
    with pytest.raises(FormatError, match="annotation 4 has 16 keypoints and annotation 0 has 17: a source has one la"):
        read_coco(json.dumps(content), sequence_id="r")


def test_results_without_anybody_are_refused() -> None:
    for text in ("[]", '[{"frame_id": 0, "instances": []}]', '{"images": [], "annotations": []}'):
        with pytest.raises(InputError, match="nobody"):
            read_coco(text, sequence_id="r")


def test_results_of_one_number_for_two_people_are_numbered_by_their_order() -> None:
    text = result_texts()["alphapose"].replace('"idx": [2.0]', '"idx": [1.0]', 1)
    found = read_coco(text, sequence_id="r")
    assert found.person_id.tolist() == [0, 1] * 6
    assert not found.has_identities


def test_images_of_several_sizes_have_none_and_videos_their_own() -> None:
    content = json.loads(coco_text(num_frames=4))
    for index, image in enumerate(content["images"]):
        image |= {"video_id": index // 2, "width": (640, 640, 320, 1280)[index]}
    found = read_coco(json.dumps(content), sequence_id="c")
    assert found.image_size_px == {"c.0": (640, 480)}
    assert set(found.sequence_id) == {"c.0", "c.1"}


def test_videos_of_names_that_look_alike_stay_two() -> None:
    content = json.loads(coco_text(num_frames=6))
    for index, image in enumerate(content["images"]):
        image["file_name"] = f"{('c/1', 'c_1')[index // 3]}/{index % 3:04d}.jpg"
    found = read_coco(json.dumps(content), sequence_id="v")
    assert sorted(set(found.sequence_id)) == ["v.c_1", "v.c_1_2"]
    assert set(found.frame.tolist()) == {0, 1, 2}


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"image_id": 10', '"image_id": 99', "its 'image_id' is not among the images"),
        ('"id": 11', '"id": 10', "appears twice"),
        (", 2.0, ", ", 3.0, ", "a visibility is none of 0, 1, 2"),
        ('"annotations"', '"things"', "no list 'annotations'"),
    ],
)
def test_a_fault_of_a_coco_file_is_named(old: str, new: str, sentence: str) -> None:
    text = coco_text()
    assert old in text
    with pytest.raises(FormatError, match=sentence):
        read_coco(text.replace(old, new, 1), sequence_id="s")


def test_our_csv_says_layout_size_and_rate_or_has_them_told() -> None:
    found = read_annotation_csv(csv_text())
    assert (found.layout, found.rate_hz, found.num_rows) == ("pair17", 25.0, 3)
    assert found.image_size_px == {"sequence": (640, 480)}
    bare = "\n".join(line for line in csv_text().split("\n") if not line.startswith("#"))
    assert read_annotation_csv(bare).layout == "pair17"
    assert read_annotation_csv(f"{bare}9,0,pelvis,,,\n").confidence[-1].sum() == 0
    with pytest.raises(FormatError, match="the layout is unclear"):
        read_annotation_csv("frame,person,joint,x,y\n0,0,left_knee,1,2\n")
    assert read_annotation_csv("frame,person,joint,x,y\n0,0,left_knee,1,2\n", layout="coco17").layout == "coco17"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("0,0,pelvis,", "0,0,pelvic,", "joint 'pelvic' is not in the layout 'pair17'"),
        ("0,0,pelvis,", "0,0,spine,", "line 6: 'spine' twice for person 0 in frame 0"),
        ("0,0,pelvis,", "x,0,pelvis,", "line 5: frame: 'x' is not a whole number"),
        ("0,0,pelvis,", "0,0,pelvis,1,", "line 5: 7 values where 6 are needed"),
        ("joint,x,y", "joint,x,z", "line 4: column 'z' is unknown"),
        ("frame,person", "frame,score", "line 4: column 'score' is unknown"),
        ("# rate_hz: 25", "# rate_hz: -1", "line 3: the frame rate is -1"),
        ("# image_size: 640x480", "# image_size: big", "line 2: image width"),
    ],
)
def test_a_fault_of_our_csv_is_named_with_its_line(old: str, new: str, sentence: str) -> None:
    text = csv_text()
    assert old in text
    with pytest.raises(FormatError, match=sentence):
        read_annotation_csv(text.replace(old, new, 1))


def test_our_formats_round_trip_with_missing_keypoints_and_people() -> None:
    px = np.stack([person_px("body25", seed) for seed in range(4)]).round(2)
    px[1, 3] = np.nan
    px[2] = np.nan
    frame, person_id = np.array([1, 0, 4, 4]), np.array([0, 0, 1, 0])
    frames = replace(rows_of("body25", px), sequence_id=("b", "b", "a", "a"), frame=frame, person_id=person_id)
    frames = replace(frames, image_size_px={"a": (320, 240), "b": (320, 240)}, rate_hz=29.97)
    assert frames.sequence_id == ("a", "a", "b", "b")
    shown = frames.rows(frames.confidence.any(axis=1))
    kinds = np.where(shown.frame == 0, KeypointStatus.ANNOTATED, KeypointStatus.TRACKED)[:, None]
    shown = replace(shown, status=np.where(shown.confidence > 0, kinds, KeypointStatus.MISSING))
    for given, again in (
        (frames, read_annotation_npz(write_annotation_npz(frames))),
        (shown, read_annotation_csv(write_annotation_csv(shown))),
    ):
        assert (again.layout, again.image_size_px, again.rate_hz) == ("body25", frames.image_size_px, 29.97)
        for name in ("sequence_id", "frame", "person_id", "keypoints_px", "confidence", "status"):
            np.testing.assert_array_equal(getattr(again, name), getattr(given, name))


def test_the_same_person_twice_in_a_frame_is_refused() -> None:
    with pytest.raises(FormatError, match="person 0 appears twice"):
        replace(rows_of("coco17", np.zeros((2, 17, 2))), frame=np.zeros(2, int))


@pytest.mark.parametrize("layout", KEYPOINT_LAYOUTS)
def test_feet_are_given_where_a_layout_has_them(layout: str) -> None:
    names = KEYPOINT_LAYOUTS[layout].keypoint_names
    px = person_px(layout)
    feet = KEYPOINT_LAYOUTS[layout].derive("feet4", px, np.ones(len(px)))
    assert feet.positions.shape == (len(FEET4), 2)
    assert ((feet.confidence > 0) == ("left_heel" in names)).all()
    if "left_heel" in names:
        heel, tip = (px[names.index(f"left_{name}")] for name in ("heel", "big_toe"))
        np.testing.assert_array_equal(feet.positions[FEET4.index("left_heel")], heel)
        ball = feet.positions[FEET4.index("left_toe")]
        np.testing.assert_allclose(np.linalg.norm(ball - heel) + np.linalg.norm(tip - ball), np.linalg.norm(tip - heel))
