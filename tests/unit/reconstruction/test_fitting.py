"""Terms and solvers of fits of poses with exact bones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.errors import InputError
from pasdedeux.fitting.blocks import NotPositiveDefinite, solve_blocks
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.dragging import pull_joint
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import BoneVectorTerm
from pasdedeux.fitting.terms import (
    AccelerationTerm,
    DistanceTerm,
    HalfSpaceTerm,
    Normal,
    PointTerm,
    QuadraticTerm,
    Term,
)
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.reconstruction.views.fit import RayTerm
from pasdedeux.skeletons import BODY22, Skeleton
from tests.builders.moving_pairs import swaying_pair

CHAIN = Skeleton("chain", ("root", "a", "b", "c", "d"), (-1, 0, 1, 1, 3))
TREE = Skeleton("tree", tuple("abcdefghij"), (-1, 0, 1, 1, 3, 0, 5, 5, 7, 8))


def _chain(generator: np.random.Generator, frames: int) -> tuple[BoneForest, np.ndarray]:
    forest = BoneForest((CHAIN, CHAIN), generator.uniform(0.2, 0.6, 10))
    return forest, generator.normal(size=(frames, 10, 3))


def _terms(generator: np.random.Generator, frames: int) -> list[Term]:
    """Return one of each kind, the quadratic ones first."""
    pairs = np.array([[0, 6], [2, 9]])
    return [
        PointTerm(generator.normal(size=(frames, 10, 3)), generator.uniform(0.1, 2.0, (frames, 10, 3))),
        AccelerationTerm(generator.uniform(0.1, 2.0, (max(frames - 2, 0), 1, 1))),
        BoneVectorTerm(TREE, generator.normal(size=(frames, 10, 3)), generator.uniform(size=(frames, 10, 3))),
        RayTerm(
            generator.normal(size=3),
            normalise(generator.normal(size=(frames, 10, 3))),
            generator.uniform(0.0, 2.0, (frames, 10)),
        ),
        DistanceTerm(pairs, np.full((frames, 2), 0.5), np.array(3.0)),
        HalfSpaceTerm(
            origin_m=generator.normal(size=(frames, 10, 3)),
            points=generator.integers(0, 10, (frames, 6, 4)),
            shares=generator.normal(size=(frames, 6, 4)),
            normals=generator.normal(size=(frames, 6, 3)),
            limits_m=generator.normal(size=(frames, 6)),
            weights=generator.uniform(0.0, 2.0, (frames, 6)),
        ),
    ]


@pytest.mark.parametrize("frames", [1, 2, 3, 7])
def test_block_solve_agrees_with_a_dense_solve(frames: int) -> None:
    generator = np.random.default_rng(frames)
    n = 5
    dense = np.zeros((frames * n, frames * n))
    for t in range(frames):
        stop = min(t + 3, frames)
        rows = generator.normal(size=(30, (stop - t) * n))
        dense[t * n : stop * n, t * n : stop * n] += rows.T @ rows
    diagonal, below = np.zeros((frames, n, n)), np.zeros((frames, 2, n, n))
    for t in range(frames):
        diagonal[t] = dense[t * n : (t + 1) * n, t * n : (t + 1) * n]
        for lag in (1, 2):
            if t + lag < frames:
                below[t, lag - 1] = dense[(t + lag) * n : (t + lag + 1) * n, t * n : (t + 1) * n]
    rhs = generator.normal(size=(frames, n))
    solution = solve_blocks(diagonal, below, rhs)
    np.testing.assert_allclose(solution.ravel(), np.linalg.solve(dense, rhs.ravel()), rtol=1e-8)


def test_block_solve_refuses_a_matrix_that_is_not_positive_definite() -> None:
    with pytest.raises(NotPositiveDefinite, match="frame 0"):
        solve_blocks(-np.eye(3)[None], np.zeros((1, 2, 3, 3)), np.ones((1, 3)))


@pytest.mark.parametrize("index", range(6))
def test_gradients_agree_with_finite_differences(index: int) -> None:
    generator = np.random.default_rng(5)
    frames = 4
    term = _terms(generator, frames)[index]
    positions, direction = generator.normal(size=(2, frames, 10, 3))
    normal = Normal.zeros(frames, 10)
    term.add_gradient(positions, normal)
    step = 1e-5
    slope = (term.energy(positions + step * direction) - term.energy(positions - step * direction)) / (2 * step)
    assert 2.0 * (normal.gradient * direction).sum() == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("index", range(4))
def test_curvature_of_quadratic_terms_is_exact(index: int) -> None:
    generator = np.random.default_rng(6)
    frames = 5
    term = _terms(generator, frames)[index]
    positions, direction = generator.normal(size=(2, frames, 10, 3))
    normal = Normal.zeros(frames, 10)
    term.add_curvature(positions, normal)
    whole = QuadraticTerm(
        np.zeros((frames, 10, 3)), normal.matrix, normal.lag1, normal.lag2, np.zeros((frames, 10, 3))
    ).energy(direction)
    whole += sum((weights * (direction * unit).sum(axis=-1) ** 2).sum() for _, _, weights, unit in normal.stencils)
    second = term.energy(positions + direction) + term.energy(positions - direction) - 2.0 * term.energy(positions)
    assert whole == pytest.approx(0.5 * second, rel=1e-9)


@given(seed=st.integers(0, 2**32 - 1), frames=st.integers(1, 6))
@settings(max_examples=20, deadline=None)
def test_energy_never_rises_and_bones_stay_exact(seed: int, frames: int) -> None:
    generator = np.random.default_rng(seed)
    forest, start = _chain(generator, frames)
    result = fit_bones(forest, forest.state_of(start), _terms(generator, frames), FitSettings(max_iterations=15))
    assert np.all(np.diff(result.energies) <= 0)
    pair = result.positions_m.reshape(frames, 2, 5, 3)
    lengths = np.where(forest.topology.parents < 0, 0.0, forest.lengths_m).reshape(2, 5)
    np.testing.assert_allclose(bone_lengths(CHAIN, pair), np.broadcast_to(lengths, (frames, 2, 5)), atol=1e-12)


def test_seen_joints_bring_back_the_pose_they_were_seen_in() -> None:
    truth = swaying_pair(6)[:, 0]
    lengths = np.median(bone_lengths(BODY22, truth), axis=0)
    forest = BoneForest((BODY22,), lengths)
    generator = np.random.default_rng(0)
    start = forest.state_of(truth + generator.normal(0.0, 0.05, truth.shape))
    stop = FitSettings(max_iterations=50, tolerance=1e-12)
    result = fit_bones(forest, start, [PointTerm(truth, np.array(1.0))], stop)
    np.testing.assert_allclose(result.positions_m, truth, atol=1e-6)


def test_targets_that_are_missing_pull_nothing() -> None:
    truth = swaying_pair(3)[:, 0]
    targets = truth.copy()
    targets[:, 5] = np.nan
    term = PointTerm(targets, np.array(1.0))
    moved = truth.copy()
    moved[:, 5] += 1.0
    assert term.energy(moved) == 0.0


def test_a_bone_of_length_zero_is_carried_along() -> None:
    truth = swaying_pair(3)[:, 0]
    lengths = np.median(bone_lengths(BODY22, truth), axis=0)
    lengths[BODY22.index("head")] = 0.0
    forest = BoneForest((BODY22,), lengths)
    result = fit_bones(forest, forest.state_of(truth), [PointTerm(truth, np.array(1.0))])
    head_m, neck_m = (result.positions_m[:, BODY22.index(joint)] for joint in ("head", "neck"))
    np.testing.assert_array_equal(head_m, neck_m)


def test_a_first_guess_that_is_not_finite_is_refused() -> None:
    forest = BoneForest((CHAIN,), np.ones(5))
    start, term = forest.state_of(np.full((2, 5, 3), np.nan)), PointTerm(np.zeros((2, 5, 3)), np.array(1.0))
    with pytest.raises(InputError, match="not finite"):
        fit_bones(forest, start, [term])


@pytest.mark.parametrize("joint", [CHAIN.root, 2, 4])
def test_a_pulled_joint_goes_where_it_can_bones_keep_their_lengths_and_others_stay(joint: int) -> None:
    people = np.random.default_rng(3).normal(size=(2, 5, 3))
    before = bone_lengths(CHAIN, people)
    for away, misses_at_most in ((0.0, 1e-6), (0.05, 2e-3), (50.0, np.inf)):
        target = people[1, joint] + np.array([away, 0.0, 0.0])
        pulled = pull_joint(CHAIN, people, 1, joint, target)
        np.testing.assert_allclose(bone_lengths(CHAIN, pulled), before, atol=1e-9)
        np.testing.assert_array_equal(pulled[0], people[0])
        assert np.linalg.norm(pulled[1, joint] - target) <= misses_at_most


def test_a_fit_takes_no_more_steps_than_it_may_and_counts_each() -> None:
    generator = np.random.default_rng(1)
    forest, start = _chain(generator, 4)
    terms = _terms(generator, 4)
    for count in (1, 3):
        stopped = fit_bones(forest, forest.state_of(start), terms, FitSettings(max_iterations=count, tolerance=0.0))
        assert stopped.num_iterations == count
