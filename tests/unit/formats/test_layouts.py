"""Derive working skeletons by layouts: sides are kept, and bones keep their lengths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.positions_as_motion import motion_from_positions
from pasdedeux.formats.rigs.working_poses import check_layout, derive_working_poses
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, LAYOUTS, find_layout
from tests.builders.own_sources import real_motions
from tests.builders.source_samples import figure_motion, person_px


def test_an_unknown_table_or_joint_is_refused() -> None:
    with pytest.raises(InputError, match="has no table for 'body99'"):
        LAYOUTS["body22"].joint_map("body99")
    with pytest.raises(InputError, match="layout 'cmu_asf': joint 'head_end' is not in skeleton 'body22'; known"):
        derive_working_poses(figure_motion(), LAYOUTS["cmu_asf"].with_tables({"pair17": {"head": "root"}}))


def test_body22_maps_to_itself() -> None:
    motion = figure_motion()
    positions, unitquat = motion.world()
    poses = derive_working_poses(motion, LAYOUTS["body22"])
    np.testing.assert_allclose(poses.body22_m, positions, atol=1e-12)
    np.testing.assert_allclose(poses.body22_world_unitquat, unitquat, atol=1e-12)
    np.testing.assert_allclose(poses.pair17_m[:, PAIR17.index("left_wrist")], positions[:, BODY22.index("left_wrist")])
    hips = positions[:, BODY22.indices(["left_hip", "right_hip"])].mean(axis=1)
    np.testing.assert_allclose(poses.pair17_m[:, PAIR17.index("pelvis")], hips, atol=1e-12)


def test_the_nose_of_op14_lies_in_front_of_the_head_and_turns_with_it() -> None:
    motion = figure_motion()
    poses = derive_working_poses(motion, LAYOUTS["body22"])
    _, unitquat = motion.world()
    nose = poses.op14_m[:, OP14.index("head")] - poses.body22_m[:, BODY22.index("head")]
    x, y, z, w = np.moveaxis(unitquat[:, BODY22.index("head")], -1, 0)
    forward = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)
    cosine = (nose * forward).sum(-1) / np.linalg.norm(nose, axis=-1)
    assert (cosine > 0.9).all()


def test_a_mapping_that_puts_two_joints_on_one_place_is_refused() -> None:
    layout = LAYOUTS["body22"].with_tables({"body22": {"left_elbow": "left_shoulder"}})
    with pytest.raises(InputError, match="from 'left_shoulder' to 'left_elbow' of 'body22'"):
        check_layout(figure_motion(), layout)


@pytest.mark.slow
def test_real_files_become_people(data_dir: Path) -> None:
    for name, motion in real_motions(data_dir).items():
        layout = find_layout(motion.skeleton, motion.rest_offsets_m)
        assert layout.name == name
        check_layout(motion, layout)
        poses = derive_working_poses(motion, layout)
        lengths = bone_lengths(BODY22, poses.body22_m)
        spread = (lengths.max(axis=0) - lengths.min(axis=0)) / np.maximum(lengths.mean(axis=0), 1e-9)
        # Only the neck of ASF spans two joints; every other bone keeps its length.
        assert spread.max() < (0.06 if name == "cmu_asf" else 1e-6), name
        left, right = (poses.body22_m[:, BODY22.index(f"{side}_hip")] for side in ("left", "right"))
        forward = np.cross(left - right, [0.0, 1.0, 0.0])
        # The nose is in front of the middle of the shoulders, toes in front of the ankles, left hand on the left.
        middle = poses.op14_m[:, OP14.index("neck")]
        nose = ((poses.op14_m[:, OP14.index("head")] - middle) * forward).sum(-1)
        assert (nose > 0).mean() > 0.8, name
        for side in ("left", "right"):
            ankle, toe = (poses.body22_m[:, BODY22.index(f"{side}_{joint}")] for joint in ("ankle", "toe"))
            assert (((toe - ankle) * forward).sum(-1) > 0).mean() > 0.8, (name, side)
        wrists = poses.body22_m[:, BODY22.index("left_wrist")] - poses.body22_m[:, BODY22.index("right_wrist")]
        assert ((wrists * (left - right)).sum(-1) > 0).mean() > 0.6, name
        assert 0.2 < np.median(poses.body22_m[:, BODY22.index("head"), 1] - poses.body22_m[:, 0, 1]) < 0.85, name


def test_positions_without_rotations_become_a_motion_of_swings() -> None:
    positions, _ = figure_motion().world()
    motion = motion_from_positions(BODY22, positions, 30.0)
    again, _ = motion.world()
    # Joints with several children fit their bones only in the mean, everything else exactly.
    assert np.abs(again - positions).max() < 0.02
    positions[3, 4] = np.nan
    with pytest.raises(InputError, match="frame 3: the position of 'neck' is not finite"):
        motion_from_positions(BODY22, positions, 30.0)


@pytest.mark.parametrize("name", ["coco18", "body25", "coco17"])
def test_keypoints_become_joints_on_their_own_side(name: str) -> None:
    layout = KEYPOINT_LAYOUTS[name]
    px = person_px(name)[None]
    pair17 = layout.derive("pair17", px, np.full(px.shape[:2], 0.7))
    op14 = layout.derive("op14", px, np.full(px.shape[:2], 0.7))
    for skeleton, found in ((PAIR17, pair17), (OP14, op14)):
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
            left, right = (found.positions[0, skeleton.index(f"{side}_{part}"), 0] for side in ("left", "right"))
            assert left > right, part  # someone who faces the camera has the left side on the image's right
            given = px[0, layout.keypoint_names.index(f"left_{part}")]
            np.testing.assert_array_equal(found.positions[0, skeleton.index(f"left_{part}")], given)
    heights = pair17.positions[0, PAIR17.indices(["head", "neck", "chest", "spine", "pelvis"]), 1]
    assert (np.diff(heights) > 0).all()  # y points down
    np.testing.assert_allclose(pair17.confidence, 0.7)


def test_a_missing_source_makes_a_missing_joint_with_confidence_zero() -> None:
    layout = KEYPOINT_LAYOUTS["coco18"]
    px, confidence = person_px("coco18")[None], np.linspace(0.3, 0.9, 18)[None].copy()
    hip = layout.keypoint_names.index("left_hip")
    px[0, hip] = np.nan
    found = layout.derive("pair17", px, confidence)
    for joint in ("left_hip", "pelvis", "spine", "chest"):
        assert np.isnan(found.positions[0, PAIR17.index(joint)]).all()
        assert found.confidence[0, PAIR17.index(joint)] == 0
    neck = layout.keypoint_names.index("neck")
    assert found.confidence[0, PAIR17.index("neck")] == confidence[0, neck]
    both = [layout.keypoint_names.index(name) for name in ("left_ear", "right_ear")]
    assert found.confidence[0, PAIR17.index("head")] == confidence[0, both].min()


def test_a_head_without_both_ears_is_the_nose_and_body25_has_a_second_way_to_the_pelvis() -> None:
    layout = KEYPOINT_LAYOUTS["body25"]
    px, confidence = person_px("body25")[None], np.full((1, 25), 0.5)
    confidence[0, layout.keypoint_names.index("left_ear")] = 0
    confidence[0, layout.keypoint_names.index("right_hip")] = 0
    found = layout.derive("pair17", px, confidence)
    np.testing.assert_array_equal(found.positions[0, PAIR17.index("head")], px[0, layout.keypoint_names.index("nose")])
    np.testing.assert_array_equal(
        found.positions[0, PAIR17.index("pelvis")], px[0, layout.keypoint_names.index("mid_hip")]
    )
