"""Write and read COCO and CVAT: annotation tools lose nothing; bad XML is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.errors import FormatError
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv
from pasdedeux.formats.poses2d.coco import read_coco, write_coco
from pasdedeux.formats.poses2d.cvat import read_cvat, write_cvat
from pasdedeux.formats.poses2d.own_layout import read_layout
from pasdedeux.skeletons import PAIR17
from tests.builders.source_samples import person_px


def two_people(layout: str = "coco17") -> AnnotatedFrames:
    """Return two people over ten frames, every third annotated, with hidden and missing keypoints."""
    rng = np.random.default_rng(4)
    frame, person = np.repeat(np.arange(10), 2), np.tile([0, 3], 10)
    px = np.stack([person_px(layout, seed=int(at)) + 40 * who for at, who in zip(frame, person, strict=True)]).round(2)
    confidence = rng.choice([0.0, 0.5, 1.0], size=px.shape[:2], p=[0.2, 0.2, 0.6])
    status = np.where(frame[:, None] % 3 == 0, KeypointStatus.ANNOTATED, KeypointStatus.INTERPOLATED)
    return AnnotatedFrames(
        layout,
        ("clip",) * 20,
        frame,
        person,
        px,
        confidence,
        image_size_px={"clip": (640, 480)},
        rate_hz=25.0,
        status=np.broadcast_to(status, confidence.shape),
    )


def assert_same(found: AnnotatedFrames, expected: AnnotatedFrames) -> None:
    for name in ("layout", "sequence_id", "image_size_px", "has_identities"):
        assert getattr(found, name) == getattr(expected, name)
    for name in ("frame", "person_id", "keypoints_px", "confidence", "status"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("layout", ["coco17", "pair17", "body25"])
def test_cvat_gives_back_places_key_frames_what_is_hidden_and_who_is_who(layout: str) -> None:
    frames = two_people(layout)
    assert_same(read_cvat(write_cvat(frames), "clip"), frames)


@pytest.mark.parametrize("layout", ["coco17", "pair17", "body25"])
def test_coco_gives_back_all_of_it_with_confidences_and_rate(layout: str) -> None:
    frames = two_people(layout)
    rng = np.random.default_rng(0)
    shares = rng.uniform(0.3, 1.0, frames.confidence.shape)
    frames = replace(frames, confidence=np.round(frames.confidence * shares, 4))
    found = read_coco(write_coco(frames), "clip")
    assert_same(found, frames)
    assert found.rate_hz == 25.0


def test_a_keypoint_that_a_tool_deletes_is_missing_though_our_score_of_it_stays() -> None:
    content = json.loads(write_coco(two_people()))
    person = content["annotations"][0]
    seen = person["keypoints"][2::3].index(2)
    person["keypoints"][3 * seen + 2] = 0
    assert read_coco(json.dumps(content), "clip").confidence[0, seen] == 0.0


def test_what_an_annotation_tool_writes_of_coco_has_no_status_and_its_visibilities() -> None:
    text = write_coco(replace(two_people(), status=None)).replace("keypoint_scores", "other")
    found = read_coco(text, "clip")
    assert found.status is None
    np.testing.assert_array_equal(found.confidence, two_people().confidence)


def test_only_key_frames_of_a_cvat_track_are_given_by_a_person() -> None:
    assert sorted(set(read_cvat(write_cvat(two_people())).given().frame.tolist())) == [0, 3, 6, 9]


IMAGES = """<?xml version="1.0" encoding="utf-8"?>
<annotations><version>1.1</version>
<image id="0" name="shot/frame_0012.png" width="640" height="480">
  <skeleton label="person" group_id="GROUP1">
    <points label="Left Wrist" outside="0" occluded="1" points="10.0,20.5"></points>
    <points label="right-wrist" outside="1" occluded="0" points="0.0,0.0"></points>
    <points label="pelvis" outside="0" occluded="0" points="50.0,60.0"></points>
  </skeleton>
  <skeleton label="person" group_id="GROUP2"><points label="pelvis" outside="0" points="90,60"/></skeleton>
</image>
</annotations>
"""


@pytest.mark.parametrize(("groups", "people"), [(("1", "2"), [1, 2]), (("0", "0"), [0, 1])])
def test_cvat_for_images_has_people_by_group_or_by_order(groups: tuple[str, str], people: list[int]) -> None:
    text = IMAGES.replace("GROUP1", groups[0]).replace("GROUP2", groups[1])
    found = read_cvat(text, "clip", layout="pair17")
    assert (found.frame.tolist(), found.person_id.tolist()) == ([12, 12], people)
    assert found.has_identities == (groups[0] != "0")
    names = ["left_wrist", "right_wrist", "pelvis"]
    at = [PAIR17.index(name) for name in names]
    assert found.confidence[0, at].tolist() == [0.5, 0.0, 1.0]
    assert found.image_size_px == {"clip": (640, 480)}


BOMB = """<?xml version="1.0"?>
<!DOCTYPE lolz [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>
<annotations><track id="0">&b;</track></annotations>
"""
FILE = """<?xml version="1.0"?>
<!DOCTYPE x [<!ENTITY f SYSTEM "file:///etc/hostname">]>
<annotations>&f;</annotations>
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "line 2: this CVAT file declares a document type or entities"),
        (FILE, "line 2: this CVAT file declares a document type or entities"),
        ("<annotations><track></annotations>", "line 1: this CVAT file is not valid XML"),
        ("<svg></svg>", "begins with <svg>"),
        ("<annotations></annotations>", "holds no skeletons"),
        (write_cvat(two_people()).replace('label="nose"', 'label="tail"'), "layout is unclear|fit none"),
        (write_cvat(two_people()).replace('frame="4"', 'frame="-4"'), "frame is -4; allowed: 0 to"),
        (write_cvat(two_people()).replace('frame="4"', 'frame="3"'), "frame 3: person 0 appears twice"),
        (IMAGES.replace("50.0,60.0", "50.0"), "frame 12: 'pelvis' has no place x,y"),
    ],
)
def test_bad_cvat_files_are_refused_with_the_place(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_cvat(text.replace("GROUP", ""), "clip")


SBU = """
keypoints = ["head", "neck", "torso", "left shoulder", "left elbow", "left hand", "right shoulder", "right elbow",
  "right hand", "left hip", "left knee", "left foot", "right hip", "right knee", "right foot"]

[joints]
head = "head"
neck = "neck"
chest = { neck = 0.5, torso = 0.5 }
left_shoulder = "left shoulder"
right_wrist = "right hand"
left_hip = "left hip"
right_hip = "right hip"
pelvis = { "left hip" = 0.5, "right hip" = 0.5 }
"""


def test_a_layout_of_ones_own_maps_names_and_its_other_joints_are_missing() -> None:
    layout = read_layout(SBU)
    rows = [f"4,1,{name},{10 * at},{20 * at},tracked" for at, name in enumerate(layout.keypoint_names)]
    found = read_annotation_csv("\n".join(["frame,person,joint,x,y,status", *rows]), "clip", layout)
    assert (found.layout, found.confidence.sum()) == ("pair17", 8)
    at = {name: found.keypoints_px[0, PAIR17.index(name)].tolist() for name in PAIR17.joint_names}
    assert at["right_wrist"] == [80, 160]
    assert at["chest"] == [15, 30]
    assert at["pelvis"] == [105, 210]
    assert np.isnan(at["spine"]).all()
    assert np.isnan(at["left_wrist"]).all()
    assert set(found.status[0].tolist()) == {KeypointStatus.MISSING, KeypointStatus.TRACKED}


def test_a_layout_of_ones_own_reads_files_of_its_number_of_keypoints_also_where_another_layout_has_as_many() -> None:
    names = [f"k{at}" for at in range(17)]
    layout = read_layout(f'keypoints = {json.dumps(names)}\n[joints]\nneck = "k5"\n')
    found = read_coco(write_coco(two_people()), "clip", layout)
    expected = two_people()
    np.testing.assert_array_equal(found.confidence[:, PAIR17.index("neck")], expected.confidence[:, 5])
    assert (found.confidence > 0).sum() == (expected.confidence[:, 5] > 0).sum()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[joints]", "[joins]"), "a layout has keypoints and joints, found keypoints, joins"),
        (('neck = "neck"', 'nck = "neck"'), "joint 'nck' is none of ours: pelvis, spine, chest"),
        (('neck = "neck"', 'neck = "nek"'), "joint 'neck': keypoint 'nek' is not among"),
        (("torso = 0.5", "torso = 0.6"), r"joint 'chest': its weights sum to 1\.1, not 1"),
        (("torso = 0.5", "torso = nan"), "joint 'chest': its weights sum to nan, not 1"),
        (('"head", "neck"', '"head", "head"'), "keypoint 'head' is there twice"),
        (('"head"\nneck', "head\nneck"), "not valid TOML"),
    ],
)
def test_a_bad_layout_is_refused(change: tuple[str, str], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_layout(SBU.replace(*change, 1))
