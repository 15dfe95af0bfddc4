"""Check skinned bodies: closed surfaces near the capsules that follow the joints."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pasdedeux.bodies import Body, body_of, standing_motion
from pasdedeux.bodies.shape import Cones, cones_of
from pasdedeux.bodies.surface import _SMOOTH_M, _packed, surface_field
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility.capsules import radius_per_height, standing_m
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton
from tests.builders.moving_pairs import swaying_pair

STATURES_M = (0.9, 1.75, 2.2)
CHAIN = Skeleton("tail", ("a", "b", "c"), (-1, 0, 1))


def standing_body(skeleton: Skeleton, stature_m: float) -> Body:
    """Return the body of somebody in a T-pose."""
    return body_of(skeleton, stature_m * standing_m(skeleton), stature_m * radius_per_height(skeleton))


def cones_in(skeleton: Skeleton, stature_m: float) -> Cones:
    rest, radii = stature_m * standing_m(skeleton), stature_m * radius_per_height(skeleton)
    return cones_of(skeleton, rest, radii)


def distance_to_cone(point: np.ndarray, ends: np.ndarray, radii: np.ndarray) -> float:
    """Return the distance to a round cone, as that to the nearest of many balls."""
    shares = np.linspace(0.0, 1.0, 2001)[:, None]
    balls = ends[0] + shares * (ends[1] - ends[0])
    return float((np.linalg.norm(point - balls, axis=-1) - (radii[0] + shares[:, 0] * (radii[1] - radii[0]))).min())


def field(points: np.ndarray, cones: Cones) -> np.ndarray:
    return np.asarray(surface_field(points, _packed(cones), cones.is_beside, _SMOOTH_M))


@pytest.mark.parametrize("skeleton", [BODY22, PAIR17, OP14], ids=lambda skeleton: skeleton.name)
@pytest.mark.parametrize("stature_m", STATURES_M)
def test_a_body_is_one_closed_surface_that_looks_outwards(skeleton: Skeleton, stature_m: float) -> None:
    body = standing_body(skeleton, stature_m)
    assert 2500 < len(body.vertices_m) < 6000
    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges), "an edge is crossed once in each direction"
    assert {*map(tuple, edges)} == {*map(tuple, edges[:, ::-1])}, "the surface has no rim"
    assert np.unique(body.faces).tolist() == list(range(len(body.vertices_m)))
    corners = body.vertices_m[body.faces]
    volume = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert 0.006 < volume / stature_m**3 < 0.02  # a man of 70 kg and 1.75 m: 0.013
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ni,ni->n", across, body.normals[body.faces[:, 0]]) > -1e-6).mean() > 0.995


@pytest.mark.parametrize("stature_m", STATURES_M)
def test_the_surface_lies_within_a_centimetre_of_the_capsules(stature_m: float) -> None:
    body, cones = standing_body(BODY22, stature_m), cones_in(BODY22, stature_m)
    rest, radii = stature_m * standing_m(BODY22), stature_m * radius_per_height(BODY22)
    bones = [(rest[[parent, child]], np.full(2, radii[child])) for parent, child in BODY22.bones]
    capsules = Cones(
        np.array([ends for ends, _ in bones]),
        np.array([both for _, both in bones]),
        np.array([parent for parent, _ in BODY22.bones]),
        np.eye(len(bones), dtype=bool),
    )
    beside = field(body.vertices_m, capsules)
    assert beside.min() > -0.01
    parts, single = (cones.ends_m, cones.radii_m, cones.joints), np.ones((1, 1), dtype=bool)
    alone = [Cones(*(part[[at]] for part in parts), single) for at in range(len(cones.joints))]
    by_cone = np.stack([field(body.vertices_m, cone) for cone in alone], axis=1)
    is_bone = np.array([any(np.allclose(ends, bone) for bone, _ in bones) for ends in cones.ends_m])
    is_covered = is_bone[by_cone.argmin(axis=1)]
    assert 0.4 < is_covered.mean() < 0.9, "head, hands, heels and flanks lie outside"
    assert beside[is_covered].max() < 0.01
    directions = normalise(np.random.default_rng(0).normal(size=(len(bones), 200, 3)))
    axes = capsules.ends_m[:, 0, None] + np.linspace(0, 1, 200)[:, None] * np.diff(capsules.ends_m, axis=1)
    outside = axes + capsules.radii_m[:, :1, None] * directions
    assert field(outside.reshape(-1, 3), cones).max() < 0.01, "no capsule comes out of the body"


@pytest.mark.parametrize("length_m", [0.1, 1.0])
def test_the_field_is_the_smooth_union_of_cones_that_meet(length_m: float) -> None:
    rng = np.random.default_rng(3)
    num = 6
    is_beside = rng.random((num, num)) < 0.4
    cones = Cones(
        rng.normal(0.0, length_m, (num, 2, 3)),
        rng.uniform(0.05, 0.3, (num, 2)),
        np.zeros(num, dtype=np.int64),
        is_beside | is_beside.T | np.eye(num, dtype=bool),
    )
    points = rng.normal(size=(200, 3))
    away = np.array(
        [[distance_to_cone(point, *cone) for cone in zip(cones.ends_m, cones.radii_m, strict=True)] for point in points]
    )
    least = away.min(axis=1)
    blended = [
        distance - _SMOOTH_M * np.log(np.exp((least[:, None] - away[:, beside]) / _SMOOTH_M).sum(axis=1))
        for distance, beside in zip(away.T, cones.is_beside, strict=True)
    ]
    is_close = np.abs(least) < 1.0
    np.testing.assert_allclose(field(points, cones)[is_close], np.min(blended, axis=0)[is_close], atol=1e-5)


def test_a_body_that_moves_as_a_whole_keeps_its_shape_and_up_to_four_joints_move_a_vertex() -> None:
    body = standing_body(BODY22, 1.75)
    assert (body.weights > 0).sum(axis=1).max() <= 4
    np.testing.assert_allclose(body.weights.sum(axis=1), 1.0)
    joints, weights = body.strongest()
    np.testing.assert_allclose(np.take_along_axis(body.weights, joints, axis=1)[weights > 0], weights[weights > 0])
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    turn, shift = Rotation.from_euler("xyz", [0.3, -1.2, 2.0]), np.array([1.0, 2.0, 3.0])
    moved = body.posed(np.tile(turn.as_quat(), (22, 1)), turn.apply(body.rest_m) + shift)
    np.testing.assert_allclose(moved, turn.apply(body.vertices_m) + shift, atol=1e-12)


def test_a_joint_moves_what_lies_beyond_it_and_nothing_else() -> None:
    body = standing_body(BODY22, 1.75)
    elbow = BODY22.index("left_elbow")
    below = [elbow, BODY22.index("left_wrist")]
    turn = Rotation.from_euler("y", -1.0)
    positions, rotations = body.rest_m.copy(), np.tile([0.0, 0.0, 0.0, 1.0], (22, 1))
    positions[below] = body.rest_m[elbow] + turn.apply(body.rest_m[below] - body.rest_m[elbow])
    rotations[below] = turn.as_quat()
    moved = body.posed(rotations, positions)
    beyond = body.vertices_m[:, 0] - body.rest_m[elbow, 0]
    np.testing.assert_allclose(moved[beyond < -0.1], body.vertices_m[beyond < -0.1], atol=1e-12)
    carried = body.rest_m[elbow] + turn.apply(body.vertices_m - body.rest_m[elbow])
    np.testing.assert_allclose(moved[beyond > 0.1], carried[beyond > 0.1], atol=1e-12)


def test_positions_alone_rest_in_a_t_pose_and_move_as_they_are() -> None:
    positions = swaying_pair()[:, 0]
    motion = standing_motion(BODY22, positions, 30.0)
    rest = motion.rest_positions_m()
    arm = rest[BODY22.index("left_wrist")] - rest[BODY22.index("left_shoulder")]
    assert arm[0] > 0.99 * np.linalg.norm(arm)
    world = motion.world()[0]
    for limb in BODY22.limbs:
        for start, end in pairwise(limb):
            bone, expected = (places[:, end] - places[:, start] for places in (world, positions))
            np.testing.assert_allclose(bone, expected, atol=1e-6)


def test_a_tree_of_unknown_joints_has_capsules_alone() -> None:
    body = body_of(CHAIN, np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([0.0, 0.1, 0.05]))
    assert body.vertices_m[:, 0].min() == pytest.approx(-0.1, abs=0.01)
    assert body.vertices_m[:, 0].max() == pytest.approx(1.05, abs=0.01)


def test_a_joint_that_lies_far_off_does_not_fill_the_memory() -> None:
    far_m = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0], [200.0, 300.0, 100.0]])
    body = body_of(CHAIN, far_m, np.array([0.0, 4.0, 4.0]))
    assert 0 < len(body.vertices_m) < 20_000
