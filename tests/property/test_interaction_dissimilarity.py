"""Test laws of the dissimilarities, and that kernels agree with the plain forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from benchmarks.chains import plain_coverage
from benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.interaction.coverage import coverage_curve, draw_parts
from pasdedeux.interaction.dissimilarity import (
    BETA_M,
    align_plane,
    cartesian_dissimilarity,
    edge_weights,
    interaction_dissimilarity,
    plane_residual,
)
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.kernels import best_turn
from pasdedeux.interaction.nearest import (
    Coverage,
    cartesian_distances,
    image_distances,
    interaction_distances,
    pair_table,
)
from pasdedeux.kinematics import align_rigid
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat

seeds = st.integers(0, 2**31 - 1)


def plane_points(seed: int) -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    first = rng.normal(size=(34, 2)) * 0.4
    return rng, first, first + 0.05 * rng.normal(size=(34, 2))


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_planar_dissimilarity_sees_reflection_and_scale(seed: int) -> None:
    _, first, _ = plane_points(seed)
    assert interaction_dissimilarity(first, first) == pytest.approx(0.0, abs=1e-12)
    assert interaction_dissimilarity(first * [-1.0, 1.0], first) > 0.05
    assert interaction_dissimilarity(first * 1.2, first) > 0.01


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_closed_form_alignment_is_the_best_rotation(seed: int) -> None:
    rng, first, second = plane_points(seed)
    first = first @ turn(rng.uniform(-np.pi, np.pi)).T
    residual = float(plane_residual(first, second))
    assert ((align_plane(first, second) - second) ** 2).sum() == pytest.approx(residual, rel=1e-9)
    centred = first - first.mean(axis=0)
    for angle in np.linspace(-np.pi, np.pi, 60):
        tried = centred @ turn(angle).T - (second - second.mean(axis=0))
        assert (tried**2).sum() >= residual - 1e-12


def hidden(rng: np.random.Generator, points: np.ndarray, share: float) -> np.ndarray:
    """Return points (..., n, d) with a share of them not seen, but for two that always are."""
    is_hidden = rng.random(points.shape[:-1]) < share
    is_hidden[..., :2] = False
    return np.where(is_hidden[..., None], np.nan, points)


def plain_masked(first: np.ndarray, second: np.ndarray) -> float:
    """Return d_I edge by edge over the points that both show; each graph spans all seen points of its pair."""
    both = [k for k in range(len(first)) if np.isfinite(first[k]).all() and np.isfinite(second[k]).all()]
    align = align_plane if first.shape[1] == 2 else lambda moved, fixed: align_rigid(moved, fixed).apply(moved)
    difference = dict(zip(both, align(first[both], second[both]) - second[both], strict=True))
    total = 0.0
    for points in (first, second):
        seen = np.flatnonzero(np.isfinite(points).all(axis=1))
        edges = [(seen[i], seen[j]) for i, j in delaunay_edges(points[seen])]
        shared = [edge for edge in edges if edge[0] in difference and edge[1] in difference]
        weights = [1.0 / max(0.05, float(np.linalg.norm(points[j] - points[i]))) for i, j in shared]
        lengths = [float(np.linalg.norm(difference[j] - difference[i])) for i, j in shared]
        total += sum(w * length for w, length in zip(weights, lengths, strict=True)) / max(sum(weights), 1e-300)
    return total


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([2, 3]), st.floats(0.0, 0.6))
def test_masked_dissimilarity_is_symmetric_rigid_and_the_plain_form(seed: int, dimension: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    complete = 0.4 * rng.normal(size=(2, 34, dimension)) * [[[1.0]], [[1.05]]]
    first, second = hidden(rng, complete, share)
    expected = plain_masked(first, second)
    assert interaction_dissimilarity(first, second) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert interaction_dissimilarity(second, first) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    if dimension == 2:
        images = np.stack([first, second]).reshape(2, 2, 17, 2)
        np.testing.assert_allclose(image_distances(images[:1], images)[0], [0.0, expected], rtol=1e-6, atol=1e-8)
    rotmat = turn(rng.uniform(-np.pi, np.pi)) if dimension == 2 else rotmat_from_unitquat(normalise(rng.normal(size=4)))
    moved = first @ rotmat.T + rng.normal(size=dimension)
    assert interaction_dissimilarity(moved, second) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    # The same shape, other points of it hidden.
    elsewhere = hidden(rng, complete[0], share) @ rotmat.T
    assert interaction_dissimilarity(first, elsewhere) == pytest.approx(0.0, abs=1e-6)
    # Points that are given again count again.
    assert interaction_dissimilarity(*np.where(np.isnan([first, second]), complete, [first, second])) == (
        interaction_dissimilarity(*complete)
    )


def test_a_few_hidden_points_hardly_change_the_dissimilarity_of_pairs() -> None:
    rng = np.random.default_rng(3)
    pairs = random_pairs(rng, 80)[..., :2].reshape(80, 34, 2)
    whole = np.array([interaction_dissimilarity(pairs[k], pairs[k + 1]) for k in range(79)])
    part = np.array([interaction_dissimilarity(pairs[k], hidden(rng, pairs[k + 1], 0.1)) for k in range(79)])
    assert np.corrcoef(whole, part)[0, 1] > 0.97
    assert np.median(part / whole) == pytest.approx(1.0, abs=0.03)


def test_pairs_that_share_hardly_a_point_are_refused() -> None:
    first, second = np.full((2, 34, 2), np.nan)
    first[:17], second[16:] = 1.0, 1.0
    with pytest.raises(InputError, match="seen in both pairs, and there are 1"):
        interaction_dissimilarity(first, second)


def test_equation_8_on_a_case_worked_by_hand() -> None:
    # A triangle against itself with one corner moved away along the axis of symmetry, so no turn is needed.
    first = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, 0.5]])
    second = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, 0.9]])
    total = 0.0
    for points in (first, second):
        lengths = [1.0, np.hypot(0.5, points[2, 1]), np.hypot(0.5, points[2, 1])]
        weights = 1.0 / np.array(lengths)
        total += (weights * [0.0, 0.4, 0.4]).sum() / weights.sum()
    assert interaction_dissimilarity(first, second) == pytest.approx(total, rel=1e-9)


def test_short_edges_stop_gaining_weight_at_beta() -> None:
    first = np.array([[0.0, 0.0], [0.001, 0.0], [1.0, 0.0], [0.5, 1.0]])
    short, long = edge_weights(first, np.array([[0, 1], [0, 2]]))
    assert short / long == pytest.approx(1.0 / BETA_M)


@settings(max_examples=25, deadline=None)
@given(seeds, st.booleans())
def test_fast_rotation_is_the_best_proper_rotation(seed: int, is_mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    fixed = rng.normal(size=(34, 3))
    fixed -= fixed.mean(axis=0)
    rotmat = rotmat_from_unitquat(normalise(rng.normal(size=4)))
    moving = fixed @ rotmat.T + 0.1 * rng.normal(size=(34, 3))
    if is_mirrored:
        moving = moving * [-1.0, 1.0, 1.0]
    moving -= moving.mean(axis=0)
    result = np.empty((3, 3))
    best_turn(moving, fixed, np.empty((4, 4)), np.empty((4, 4)), np.empty(4), result)
    np.testing.assert_allclose(result, align_rigid(moving, fixed).rotmat, atol=1e-9)


@pytest.mark.parametrize("kind", ["flat", "line", "point", "same"])
def test_fast_rotation_takes_degenerate_points(kind: str) -> None:
    rng = np.random.default_rng(1)
    fixed = rng.normal(size=(34, 3))
    fixed *= {"flat": [1, 1, 0], "line": [1, 0, 0], "point": [0, 0, 0], "same": [1, 1, 1]}[kind]
    fixed -= fixed.mean(axis=0)
    moving = fixed @ rotmat_from_unitquat(normalise(rng.normal(size=4))).T
    result = np.empty((3, 3))
    best_turn(moving, fixed, np.empty((4, 4)), np.empty((4, 4)), np.empty(4), result)
    np.testing.assert_allclose(result @ result.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(result) == pytest.approx(1.0)
    np.testing.assert_allclose(moving @ result.T, fixed, atol=1e-7)


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_spatial_dissimilarities_ignore_rigid_motion_of_the_pair(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = random_pairs(rng, 2).reshape(2, 34, 3)
    rotmat = rotmat_from_unitquat(normalise(rng.normal(size=4)))
    moved = first @ rotmat.T + rng.normal(size=3)
    assert interaction_dissimilarity(moved, second) == pytest.approx(interaction_dissimilarity(first, second), rel=1e-6)
    assert cartesian_dissimilarity(moved, second) == pytest.approx(cartesian_dissimilarity(first, second), rel=1e-9)
    # One person moved is another pair.
    apart = first.copy()
    apart[17:] += [0.3, 0.0, 0.0]
    assert cartesian_dissimilarity(apart, first) > 0.05


def test_compiled_minima_agree_with_the_definition() -> None:
    rng = np.random.default_rng(4)
    truth, draws = random_pairs(rng, 5), random_pairs(rng, 9)
    coverage = Coverage(truth)
    coverage.add(pair_table(draws[:4]))
    coverage.add(pair_table(draws[4:]))
    interaction, cartesian = plain_coverage(truth, draws)
    assert coverage.interaction_m.mean() == pytest.approx(interaction, rel=1e-9)
    assert coverage.cartesian_m.mean() == pytest.approx(cartesian, rel=1e-9)


def test_coverage_falls_with_draws_and_is_zero_on_the_truth_itself() -> None:
    rng = np.random.default_rng(6)
    truth = random_pairs(rng, 8)
    draws = np.concatenate([random_pairs(rng, 20), truth])
    curve = coverage_curve(truth, draws, [1, 5, 20, 28, 1000])
    assert list(curve.num_draws) == [1, 5, 20, 28]
    assert (np.diff(curve.interaction_m) <= 0).all()
    assert (np.diff(curve.cartesian_m) <= 0).all()
    assert curve.interaction_m[-1] == pytest.approx(0.0, abs=1e-7)
    assert curve.cartesian_m[-1] == pytest.approx(0.0, abs=1e-7)


@settings(max_examples=20)
@given(st.lists(st.integers(0, 4), min_size=1, max_size=30), st.lists(st.integers(1, 30), min_size=1, max_size=4))
@example([0, 0, 0], [1, 3])
def test_a_draw_that_is_repeated_changes_no_point_of_the_curve(draws: list[int], points: list[int]) -> None:
    rng = np.random.default_rng(3)
    truth, different = rng.normal(0.0, 0.4, (3, 2, 17, 3)), rng.normal(0.0, 0.4, (5, 2, 17, 3))
    points = sorted({min(point, len(draws)) for point in points})
    assert [part.point for part in draw_parts(different[draws], points)] == points
    curve = coverage_curve(truth, different[draws], points)
    for at, point in enumerate(points):
        every = different[sorted(set(draws[:point]))]
        assert curve.interaction_m[at] == pytest.approx(interaction_distances(truth, every).min(axis=1).mean())
        assert curve.cartesian_m[at] == pytest.approx(cartesian_distances(truth, every).min(axis=1).mean())
        assert curve.shape[at] == pytest.approx(coverage_curve(truth, every, [len(every)]).shape[0])


def test_coverage_refuses_nothing_and_nan() -> None:
    pairs = random_pairs(np.random.default_rng(0), 2)
    with pytest.raises(InputError, match="at least one real pair"):
        Coverage(pairs[:0])
    with pytest.raises(InputError, match="no point of the curve"):
        coverage_curve(pairs, pairs, [0, 3])
    broken = pairs.copy()
    broken[1, 0, 0, 0] = np.nan
    with pytest.raises(InputError, match="point set 1"):
        Coverage(pairs).add(pair_table(broken))


@given(seed=st.integers(0, 2**32 - 1), num_joints=st.integers(3, 12))
@settings(max_examples=25, deadline=None)
def test_minima_are_those_of_the_whole_table_of_distances(seed: int, num_joints: int) -> None:
    """The number of joints may be odd or small, and several pairs may be almost equally near."""
    rng = np.random.default_rng(seed)
    truth, pairs = rng.normal(size=(4, 2, num_joints, 3)), rng.normal(size=(9, 2, num_joints, 3))
    pairs[3:6] = truth[1] + 1e-6 * rng.normal(size=(3, 2, num_joints, 3))
    coverage = Coverage(truth)
    for part in (pairs[:0], pairs[:5], pairs[5:]):
        coverage.add(pair_table(part))
    distances = interaction_distances(truth, pairs)
    np.testing.assert_allclose(coverage.interaction_m, distances.min(axis=1), rtol=0, atol=1e-12)
