"""Fit bone scales to a body given by a file, a table or positions; report what does not fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.asf_amc import read_asf
from pasdedeux.formats.rigs.own_skeleton import OwnSkeleton, body_map, standing
from pasdedeux.formats.rigs.target_body import BodyFit, TargetBody, body_of_skeleton, fit_body, read_body
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.kinematics import bone_directions, bone_lengths, place_bones
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import LAYOUTS
from tests.builders.body_models import npz
from tests.builders.own_sources import write_walk
from tests.builders.source_samples import FIGURE_REST_M, figure_motion

REST = np.array([FIGURE_REST_M[joint] for joint in BODY22.joint_names])
LENGTHS = bone_lengths(BODY22, REST)
SMPL = [name.replace("_toe", "_foot") for name in BODY22.joint_names]


def figure() -> OwnSkeleton:
    motion = figure_motion()
    return OwnSkeleton(motion, body_map(LAYOUTS["body22"], BODY22, motion.rest_offsets_m))


def fitted(target: TargetBody) -> BodyFit:
    """Return the scales of the figure's bones that make it this body."""
    return fit_body(target, figure(), LENGTHS, layout="body22", who="A")


def body_with(scales: np.ndarray) -> np.ndarray:
    tee = standing(figure()).rest_body22_m
    return place_bones(BODY22, np.zeros(3), bone_directions(BODY22, tee), LENGTHS * scales)


@given(seed=st.integers(0, 1000))
def test_positions_of_a_body_give_its_bones_back_whatever_its_pose(seed: int) -> None:
    scales = np.random.default_rng(seed).uniform(0.7, 1.3, BODY22.num_joints)
    directions = bone_directions(BODY22, REST + np.random.default_rng(seed).normal(0.0, 0.02, REST.shape))
    posed = place_bones(BODY22, np.ones(3), directions, LENGTHS * scales)
    fit = fitted(read_body("smpl.npz", npz(positions_m=posed, joint_names=SMPL)))
    np.testing.assert_allclose(fit.bone_scale[1:], scales[1:], rtol=1e-9)
    assert fit.num_guessed == 0


def test_a_body_of_an_asf_file_has_its_bones(tmp_path: Path) -> None:
    write_walk(tmp_path)
    asf = read_asf((tmp_path / "90.asf").read_bytes())
    rest = SourceMotion.at_rest(asf.skeleton, asf.rest_offsets).to_motion(
        metres_per_unit=asf.metres_per_unit, rate_hz=1.0
    )
    rigged = OwnSkeleton(rest, body_map(LAYOUTS["cmu_asf"], rest.skeleton, rest.rest_offsets_m))
    body = body_of_skeleton("90.asf", rigged, "cmu_asf")
    fit = fitted(body)
    # 0.42 m from knee to ankle, 0.28 m from shoulder to elbow: what the file was written with.
    for joint, length_m in (("left_ankle", 0.42), ("right_elbow", 0.28)):
        at = BODY22.index(joint)
        assert fit.bone_scale[at] * LENGTHS[at] == pytest.approx(length_m, rel=1e-3)
    # The spines of both layouts have their joints at other places: it is scaled as a whole.
    assert np.ptp(fit.bone_scale[BODY22.indices(["spine1", "spine2", "spine3", "neck"])]) < 0.05
    again = fit_body(body, rigged, bone_lengths(BODY22, rigged.rest_body22_m), layout="cmu_asf", who="A")
    np.testing.assert_allclose(again.bone_scale[1:], 1.0, atol=1e-6)


def test_a_table_says_some_distances_and_the_rest_follows_the_body() -> None:
    scales = np.full(BODY22.num_joints, 1.1)
    long = BODY22.indices(["left_knee", "left_ankle", "right_knee", "right_ankle"])
    scales[long] = 1.25
    body = body_with(scales)
    pairs = [("left_hip", "left_ankle"), ("left_shoulder", "right_shoulder"), ("left_shoulder", "left_wrist")]
    lines = [f"{a},{b},{np.linalg.norm(body[BODY22.index(a)] - body[BODY22.index(b)]):.6f}" for a, b in pairs]
    fit = fitted(read_body("me.csv", "\n".join(["from,to,distance_m", *lines]).encode()))
    np.testing.assert_allclose(fit.bone_scale[long], 1.25, atol=0.01)
    np.testing.assert_allclose(fit.bone_scale[BODY22.indices(["right_elbow", "left_wrist"])], 1.1, atol=0.01)
    assert max(map(abs, fit.misfit_m.values())) < 1e-3
    assert fit.num_guessed > 0


def test_what_does_not_fit_together_is_said_as_misfit() -> None:
    thigh, shank, leg = (BODY22.index("left_hip"), BODY22.index("left_knee"), BODY22.index("left_ankle"))
    fit = fitted(TargetBody("odd.csv", {(thigh, shank): 0.4, (shank, leg): 0.4, (thigh, leg): 0.9}))
    assert max(map(abs, fit.misfit_m.values())) == pytest.approx(0.1 / 3, rel=0.05)


def test_json_with_a_joint_a_line_is_read_like_an_npz() -> None:
    body = body_with(np.full(BODY22.num_joints, 0.9))
    named = json.dumps(dict(zip(SMPL, body.tolist(), strict=True))).encode()
    first, second = read_body("a.json", named), read_body("a.npz", npz(positions_m=body[None], joint_names=SMPL))
    assert first.distances_m == pytest.approx(second.distances_m)


WITHOUT = [name for name in SMPL if name != "left_wrist"]


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (
            npz(positions_m=np.delete(REST, BODY22.index("left_wrist"), 0), joint_names=WITHOUT),
            "body: joint 'left_wrist' is missing; needed are left_hip, ",
        ),
        (
            npz(positions_m=100.0 * REST, joint_names=SMPL),
            r"body: the distance from '.*' to '.*' \(in metres\?\) is .*; allowed: 0.01 to 2.5",
        ),
        (npz(positions_m=REST * np.nan, joint_names=SMPL), "body: the position of 'pelvis' .* is not finite"),
        (npz(positions_m=REST), r"body: array 'joint_names' of texts, shape \(22\), is needed, found none"),
        (npz(joint_names=SMPL), r"body: array 'positions_m' of numbers, shape \(any, any, 3\), is needed, found none"),
        (b'{"pelvis": [0, 1]}', "body: array 'positions_m' of numbers"),
        (b"{", "body: this body is not valid JSON: line 1"),
        (b"from,to,distance_m\nleft_hip,left_paw,0.4", "body: line 2: joint 'left_paw' is not known; known: pelvis"),
        (b"from,to,distance_m\nleft_hip,left_knee,forty", "body: line 2: distance_m: 'forty' is not a number"),
        (
            b"from,to,distance_m\nleft_hip,left_knee,42",
            "body: line 2: the distance from 'left_hip' to 'left_knee' .* is 42; allowed: 0.01 to 2.5",
        ),
        (b"from,to,distance_m\nleft_hip,left_hip,0.4", "body: line 2: a distance of 'left_hip' from itself"),
        (b"from,to,distance_m\n", "body: line 2: the table has no rows"),
        (b"hello", "body: line 1: no body is recognised"),
    ],
)
def test_bad_bodies_are_refused_in_a_sentence(data: bytes, sentence: str) -> None:
    with pytest.raises(FormatError, match=sentence):
        read_body("body", data)


def test_a_giant_is_asked_for_its_unit() -> None:
    giant = TargetBody("giant.csv", {(BODY22.index("left_hip"), BODY22.index("left_knee")): 2.0})
    with pytest.raises(InputError, match=r"giant.csv: this body would be 5 times the size of A; .* is it in metres\?"):
        fitted(giant)
