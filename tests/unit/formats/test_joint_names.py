"""Find a layout by names of joints in any spelling and order, or by geometry where joints have only numbers."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from pasdedeux.errors import FormatError
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv
from pasdedeux.formats.poses2d.annotation_npz import read_annotation_npz
from pasdedeux.formats.poses2d.coco import read_coco
from pasdedeux.formats.poses2d.cvat import read_cvat
from pasdedeux.formats.poses2d.own_layout import read_layout
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, LAYOUTS_OF_COUNT, layout_of_names
from tests.builders.body_models import npz
from tests.builders.own_sources import film_duet
from tests.builders.source_samples import person_px

_OPENPOSE_BODY = "RShoulder RElbow RWrist LShoulder LElbow LWrist"
_OPENPOSE_25B = (
    "Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle RAnkle"
)
NAMES = {
    "coco17": " ".join(KEYPOINT_LAYOUTS["coco17"].keypoint_names).replace("_", "-"),
    "coco18": f"Nose Neck {_OPENPOSE_BODY} RHip RKnee RAnkle LHip LKnee LAnkle REye LEye REar LEar",
    "body25": f"Nose Neck {_OPENPOSE_BODY} MidHip RHip RKnee RAnkle LHip LKnee LAnkle REye LEye REar LEar "
    "LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel",
    "body25b": f"{_OPENPOSE_25B} UpperNeck HeadTop LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel",
    "halpe26": f"{_OPENPOSE_25B} Head Neck Hip LBigToe RBigToe LSmallToe RSmallToe LHeel RHeel",
    "mediapipe33": " ".join(KEYPOINT_LAYOUTS["mediapipe33"].keypoint_names).replace("big_toe", "foot_index").upper(),
    "crowdpose14": "left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_hip right_hip "
    "left_knee right_knee left_ankle right_ankle top_head neck",
    "lsp14": "R_Ankle R_Knee R_Hip L_Hip L_Knee L_Ankle R_Wrist R_Elbow R_Shoulder L_Shoulder L_Elbow L_Wrist Neck "
    "Head_top",
    "mpi15": "Head Neck RSho RElb RWri LSho LElb LWri RHip RKnee RAnk LHip LKnee LAnk Chest",
    "jhmdb15": "neck belly face right_shoulder left_shoulder right_hip left_hip right_elbow left_elbow right_knee "
    "left_knee right_wrist left_wrist right_ankle left_ankle",
    "posetrack17": "nose head_bottom head_top left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow "
    "left_wrist right_wrist left_hip right_hip left_knee right_knee left_ankle right_ankle",
    "mpii16": "RAnkle RKnee RHip LHip LKnee LAnkle Pelvis Thorax Neck Head RWrist RElbow RShoulder LShoulder LElbow "
    "LWrist",
    "h36m17": "root RHip RKnee RFoot LHip LKnee LFoot Spine Thorax Neck/Nose Head LShoulder LElbow LWrist RShoulder "
    "RElbow RWrist",
    "h36m17 as lifters write it": "root rhip rkne rank lhip lkne lank belly neck nose head lsho lelb lwri rsho relb "
    "rwri",
    "op14": " ".join(".".join(reversed(name.split("_"))).title() for name in KEYPOINT_LAYOUTS["op14"].keypoint_names),
    "pair17": " ".join(KEYPOINT_LAYOUTS["pair17"].keypoint_names).replace("left_", "L.").replace("right_", "R."),
}
"""Names as data sets and tools write them, in the order of the layout."""


def as_coco(names: list[str], tables: np.ndarray) -> AnnotatedFrames:
    people = [
        {
            "image_id": frame,
            "category_id": 3,
            "keypoints": np.concatenate([px, np.full((len(px), 1), 2)], 1).ravel().tolist(),
        }
        for frame, px in enumerate(tables)
    ]
    categories = [{"id": 1, "name": "dog"}, {"id": 3, "name": "person", "keypoints": names}]
    images = [{"id": frame, "file_name": f"frame_{frame}.jpg"} for frame in range(len(tables))]
    return read_coco(json.dumps({"images": images, "annotations": people, "categories": categories}), "s")


def as_cvat(names: list[str], tables: np.ndarray) -> AnnotatedFrames:
    skeletons = "".join(
        f'<skeleton frame="{frame}" keyframe="1">'
        + "".join(f'<points label="{name}" points="{x},{y}"/>' for name, (x, y) in zip(names, px, strict=True))
        + "</skeleton>"
        for frame, px in enumerate(tables.tolist())
    )
    return read_cvat(f'<annotations><track id="0">{skeletons}</track></annotations>', "s")


def as_csv(names: list[str], tables: np.ndarray) -> AnnotatedFrames:
    rows = [f"{at},{name},{x},{y}" for at, px in enumerate(tables) for name, (x, y) in zip(names, px, strict=True)]
    return read_annotation_csv("\n".join(["frame,joint,x,y", *rows]), "s")


def as_npz(names: list[str], tables: np.ndarray) -> AnnotatedFrames:
    frames, people, confidence = np.arange(len(tables)), np.zeros(len(tables), int), np.ones(tables.shape[:2])
    data = npz(joint_names=names, frame=frames, person=people, keypoints_px=tables, confidence=confidence)
    return read_annotation_npz(data, "s")


READERS: dict[str, Callable[[list[str], np.ndarray], AnnotatedFrames]] = {
    "coco": as_coco,
    "cvat": as_cvat,
    "csv": as_csv,
    "npz": as_npz,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("case", NAMES)
def test_joints_go_where_their_names_say_in_any_spelling_and_order(case: str, reader: str) -> None:
    layout = KEYPOINT_LAYOUTS[case.split()[0]]
    names, tables = NAMES[case].split(), np.stack([person_px(layout.name, seed) for seed in range(3)])
    order = np.random.default_rng(0).permutation(len(names))
    expected = {skeleton: layout.derive(skeleton, tables, np.ones(tables.shape[:2])) for skeleton in ("pair17", "op14")}
    for chosen in (np.arange(len(names)), order):
        found = READERS[reader]([names[at] for at in chosen], tables[:, chosen])
        if chosen is not order:
            assert found.layout == layout.name
        for skeleton, joints in expected.items():
            given = KEYPOINT_LAYOUTS[found.layout].derive(skeleton, found.keypoints_px, found.confidence)
            limbs = slice(5, None) if skeleton == "pair17" else slice(2, None)
            np.testing.assert_allclose(given.positions[:, limbs], joints.positions[:, limbs], atol=1e-9)


PARTS = ("Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle")
AMBIGUOUS = [layout.name for layouts in LAYOUTS_OF_COUNT.values() if len(layouts) > 1 for layout in layouts]
"""Layouts whose number of keypoints another layout has as well."""


def test_some_joints_are_read_and_names_that_no_layout_has_are_said_or_refused() -> None:
    names = ["head", *(f"{side} {part}" for side in ("Left", "Right") for part in PARTS)]
    tables = np.stack([person_px("op14", 1)[[0, 5, 6, 7, 11, 12, 13, 2, 3, 4, 8, 9, 10]]] * 2)
    for read in READERS.values():
        found = read(names, tables)
        assert (found.layout, found.remarks) == ("op14", ())
        assert (found.confidence > 0).sum() == 26
    more, wider = [*names, "hat", "tail"], np.concatenate([tables, tables[:, :2]], axis=1)
    for reader in ("coco", "npz"):
        assert READERS[reader](more, wider).remarks == ("joints left out that 'op14' lacks: 'hat', 'tail'",)
    for reader in ("cvat", "csv"):
        with pytest.raises(FormatError, match="the layout is unclear: no layout has 'hat', 'tail', and 'op14' has the"):
            READERS[reader](more, wider)
    with pytest.raises(FormatError, match="the layout is unclear: 0 of the joints 'a1x', 'b2y' are known; state it"):
        as_csv(["a1x", "b2y"], tables[:, :2])


def test_categories_have_their_own_order() -> None:
    names = [*KEYPOINT_LAYOUTS["coco17"].keypoint_names]
    px = person_px("coco17")
    rows = np.concatenate([px, np.full((17, 1), 2)], axis=1)
    categories = [{"id": 7, "keypoints": names[::-1]}, {"id": 2, "keypoints": names}]
    people = [
        {"image_id": 0, "category_id": number, "track_id": number, "keypoints": rows[::step].ravel().tolist()}
        for number, step in ((2, 1), (7, -1))
    ]
    found = read_coco(json.dumps({"images": [{"id": 0}], "annotations": people, "categories": categories}), "s")
    np.testing.assert_allclose(found.keypoints_px, np.stack([px, px]))


@pytest.mark.parametrize("layout", AMBIGUOUS)
def test_numbers_alone_are_told_apart_by_the_body(layout: str) -> None:
    rng = np.random.default_rng(1)
    tables = np.stack([person_px(layout, seed) for seed in range(20)]) * 2.0
    tables += rng.normal(0.0, 4.0, tables.shape)
    tables[rng.random(tables.shape[:2]) < 0.1] = 0.0
    count = tables.shape[1]
    for numbers in (map(str, range(count)), (f"point-{at}" for at in range(1, count + 1))):
        assert as_coco(list(numbers), tables).layout == layout


@pytest.mark.parametrize("layout", AMBIGUOUS)
@pytest.mark.parametrize("duet", ["hug", "lift"])
def test_numbers_alone_of_people_who_move_are_told_apart(duet: str, layout: str) -> None:
    film = film_duet(duet, duration_s=1.0, rate_hz=10.0)
    tables = np.nan_to_num(np.concatenate(film.keypoints_px("coco17" if layout == "pair17" else layout)))
    found = as_coco([str(at) for at in range(tables.shape[1])], tables)
    assert found.layout == ("coco17" if layout == "pair17" else layout)


def test_few_numbers_that_fit_several_layouts_are_refused_where_none_is_usual() -> None:
    numbers = [str(at) for at in range(14)]
    with pytest.raises(FormatError, match=r"14 keypoints without names may be 'crowdpose14' or .*: say which"):
        as_coco(numbers, np.stack([person_px("lsp14")]))
    assert as_coco([str(at) for at in range(17)], np.stack([person_px("coco17")])).layout == "coco17"


def test_every_layout_is_found_by_its_own_names() -> None:
    for layout in KEYPOINT_LAYOUTS.values():
        assert layout_of_names(layout.keypoint_names) is layout


def test_a_layout_of_ones_own_takes_names_where_they_are_its_own_and_else_the_order() -> None:
    theirs = ["head", "l_paw", "r_paw", "waist"]
    text = (
        f'keypoints = {theirs}\n[joints]\nhead = "head"\nleft_wrist = "l_paw"\nright_wrist = "r_paw"\npelvis = "waist"'
    )
    layout, px = read_layout(text), np.array([[[5.0, 1.0], [9.0, 4.0], [1.0, 4.0], [5.0, 8.0]]])
    joints = [PAIR17.index(name) for name in ("head", "left_wrist", "right_wrist", "pelvis")]
    for names, order in (
        (theirs, [0, 1, 2, 3]),
        (["Waist", "R Paw", "L-Paw", "Head"], [3, 2, 1, 0]),
        (["a", "b", "c", "d"], [0, 1, 2, 3]),
    ):
        text = "\n".join(f"0,{name},{x},{y}" for name, (x, y) in zip(names, px[0][order], strict=True))
        found = read_annotation_csv(f"frame,joint,x,y\n{text}\n", layout=layout)
        np.testing.assert_array_equal(found.keypoints_px[0, joints], px[0])
