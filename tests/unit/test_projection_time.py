"""Choice over time and smoothing of rotations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import angle_between, normalise, slerp, unitquat_from_rotvec
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import centre_and_face
from pasdedeux.projections.search import Neighbours, build_index
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.smoothing import (
    OneEuro,
    bridge_gaps,
    continuous_signs,
    smooth_one_euro,
    smooth_savitzky_golay,
)
from pasdedeux.reconstruction.temporal import (
    TemporalWeights,
    choose_nearest,
    choose_viterbi,
    choose_window,
    viterbi_path,
)
from tests.builders.walkers import walk


def rotations(num_frames: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return unitquat_from_rotvec(np.cumsum(rng.normal(0, 0.05, (num_frames, 3, 3)), axis=0))


def test_viterbi_finds_the_cheapest_of_all_paths() -> None:
    rng = np.random.default_rng(0)
    frames, count = 5, 4
    emission = rng.uniform(0, 0.2, (frames, count))
    emission[2, 1] = np.inf
    continued, pose = rng.normal(0, 0.1, (2, frames, count, 14, 3)).astype(np.float32)
    weight = rng.uniform(0.2, 2.0, frames)

    def cost(path: tuple[int, ...]) -> float:
        total = sum(emission[frame, rank] for frame, rank in enumerate(path))
        for frame in range(frames - 1):
            step = pose[frame + 1, path[frame + 1]] - continued[frame, path[frame]]
            total += weight[frame] * np.linalg.norm(step, axis=-1).mean()
        return float(total)

    best = min(itertools.product(range(count), repeat=frames), key=cost)
    assert viterbi_path(emission, continued, pose, weight).tolist() == list(best)


def toy_search(num_frames: int = 40) -> tuple[Database, Neighbours]:
    poses = centre_and_face(walk(num_frames)).poses_m.astype(np.float32)
    database = Database(poses, np.zeros(num_frames, dtype=bool))
    query = database.project()[:, 3] + np.random.default_rng(0).normal(0, 0.01, (num_frames, 14, 2))
    return database, build_index(database).search(query, num_neighbours=20)


def plain_window(database: Database, neighbours: Neighbours, *, window: int = 4) -> list[int]:
    """The rule of the paper, one candidate and one past frame after the other."""
    starts = set(np.flatnonzero(database.is_sequence_start).tolist())
    chosen: list[np.ndarray] = []
    ranks = []
    for row, yaw in zip(neighbours.row, neighbours.yaw_index, strict=True):
        costs = []
        for at, turn in zip(row, yaw, strict=True):
            distances, weights, before = [], [], int(at)
            for back, past in enumerate(reversed(chosen[-window:]), start=1):
                if before in starts:
                    break
                before -= 1
                bones = bone_rotations(database.turned(before, turn))
                distances.append(np.sqrt(np.sum((0.5 * angle_between(bones, past)) ** 2)))
                weights.append(1.0 / back)
            if not weights and chosen:
                bones = bone_rotations(database.turned(before, turn))
                distances, weights = [np.sqrt(np.sum((0.5 * angle_between(bones, chosen[-1])) ** 2))], [1.0]
            costs.append(np.average(distances, weights=weights) if weights else 0.0)
        ranks.append(int(np.argmin(costs)))
        chosen.append(bone_rotations(database.turned(row[ranks[-1]], yaw[ranks[-1]])))
    return ranks


def test_the_window_rule_agrees_with_its_plain_form() -> None:
    motions = [walk(12, seed=seed) for seed in range(3)]
    poses = np.concatenate([centre_and_face(motion).poses_m for motion in motions])
    database = Database(poses, np.tile(np.arange(12) == 0, 3))
    query = database.project(0, 12)[:, 3] + np.random.default_rng(1).normal(0, 0.02, (12, 14, 2))
    neighbours = build_index(database).search(query, num_neighbours=8)
    assert choose_window(database, neighbours).tolist() == plain_window(database, neighbours)


def test_choices_follow_a_motion_of_the_database() -> None:
    database, neighbours = toy_search()
    frames = np.arange(40)
    for ranks in (
        choose_nearest(neighbours),
        choose_window(database, neighbours),
        choose_viterbi(database, neighbours, rate_hz=24.0),
    ):
        assert np.abs(neighbours.row[frames, ranks] - frames).mean() < 3
    viterbi = choose_viterbi(database, neighbours, rate_hz=24.0)
    assert (np.diff(neighbours.row[frames, viterbi]) == 1).mean() > 0.8


def test_viterbi_without_weight_is_nearest_and_frames_without_candidates_stay_empty() -> None:
    database, neighbours = toy_search()
    projection, distance = neighbours.projection.copy(), neighbours.distance_m.copy()
    projection[[0, 7, 8]] = -1
    distance[[0, 7, 8]] = np.inf
    holes = Neighbours(projection, distance, neighbours.num_yaws)
    free = choose_viterbi(database, holes, rate_hz=24.0, weights=TemporalWeights(pose=0.0))
    np.testing.assert_array_equal(free, choose_nearest(holes))
    for ranks in (free, choose_window(database, holes), choose_viterbi(database, holes, rate_hz=60.0)):
        assert np.flatnonzero(ranks < 0).tolist() == [0, 7, 8]


def test_nothing_seen_anywhere_chooses_nothing() -> None:
    database, _ = toy_search(5)
    empty = Neighbours(np.full((5, 20), -1), np.full((5, 20), np.inf), 30)
    assert (choose_viterbi(database, empty, rate_hz=24.0) == -1).all()
    assert (choose_window(database, empty) == -1).all()


def test_signs_are_made_continuous_without_changing_rotations() -> None:
    unitquat = rotations(50)
    flipped = unitquat * np.random.default_rng(1).choice([-1.0, 1.0], (50, 3, 1))
    smooth = continuous_signs(flipped)
    assert (np.sum(smooth[1:] * smooth[:-1], axis=-1) > 0).all()
    np.testing.assert_allclose(np.abs(np.sum(smooth * unitquat, axis=-1)), 1.0)


def test_smoothing_does_not_depend_on_quaternion_signs() -> None:
    unitquat = rotations(60)
    flipped = unitquat * np.random.default_rng(1).choice([-1.0, 1.0], (60, 3, 1))
    for smooth in (smooth_savitzky_golay, lambda q: smooth_one_euro(q, rate_hz=24.0)):
        assert angle_between(smooth(unitquat), smooth(flipped)).max() < 1e-6


def test_a_steady_turn_passes_savitzky_golay_unchanged_and_noise_shrinks() -> None:
    turn = unitquat_from_rotvec(np.linspace(0, 1.0, 60)[:, None, None] * np.array([[0.0, 1.0, 0.0]]))
    assert angle_between(smooth_savitzky_golay(turn), turn).max() < 1e-4
    noisy = slerp(
        turn, normalise(turn + np.random.default_rng(0).normal(0, 0.05, turn.shape)), np.ones(turn.shape[:-1])
    )
    for smooth in (smooth_savitzky_golay(noisy), smooth_one_euro(noisy, rate_hz=24.0)):
        assert angle_between(smooth, turn)[5:].mean() < 0.75 * angle_between(noisy, turn)[5:].mean()


def test_the_one_euro_filter_looks_at_no_later_frame() -> None:
    unitquat = rotations(40)
    whole = smooth_one_euro(unitquat, rate_hz=24.0)
    np.testing.assert_allclose(smooth_one_euro(unitquat[:25], rate_hz=24.0), whole[:25])
    with pytest.raises(InputError, match="cut-offs"):
        OneEuro(min_cutoff_hz=0.0)


@pytest.mark.parametrize("num_frames", [0, 1, 2, 3, 4, 5])
def test_short_motions_are_smoothed_without_complaint(num_frames: int) -> None:
    unitquat = rotations(num_frames)
    assert smooth_savitzky_golay(unitquat).shape == unitquat.shape
    assert smooth_one_euro(unitquat, rate_hz=24.0).shape == unitquat.shape


def test_gaps_are_bridged_on_the_short_arc_and_ends_are_held() -> None:
    unitquat = rotations(10)
    known = np.array([0, 0, 1, 0, 0, 0, 1, 1, 0, 0], dtype=bool)
    broken = np.where(known[:, None, None], unitquat, np.array([1.0, 0, 0, 0]))
    bridged = bridge_gaps(broken, known)
    np.testing.assert_array_equal(bridged[known], unitquat[known])
    assert angle_between(bridged[4], slerp(unitquat[2], unitquat[6], np.full(3, 0.5))).max() < 1e-7
    assert angle_between(bridged[[0, 1]], unitquat[[2, 2]]).max() < 1e-7
    assert angle_between(bridged[[8, 9]], unitquat[[7, 7]]).max() < 1e-7
    with pytest.raises(InputError, match="nothing was seen"):
        bridge_gaps(unitquat, np.zeros(10, dtype=bool))
