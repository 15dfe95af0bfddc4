"""Choice over time and smoothing of rotations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import angle_between, normalise, slerp, unitquat_from_rotvec
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import centre_and_face, mid_hip
from pasdedeux.projections.search import Neighbours, build_index
from pasdedeux.reconstruction import temporal
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.smoothing import OneEuro, OneEuroFilter, bridge_gaps, smooth_savitzky_golay
from pasdedeux.reconstruction.temporal import (
    POSE_WEIGHT,
    FixedLagViterbi,
    choose_nearest,
    choose_viterbi,
    choose_window,
)
from tests.builders.walkers import walk


def rotations(num_frames: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return unitquat_from_rotvec(np.cumsum(rng.normal(0, 0.05, (num_frames, 3, 3)), axis=0))


@pytest.mark.parametrize("seed", range(12))
def test_viterbi_finds_the_cheapest_of_all_paths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, rate_hz = 3, 40.0
    frames = np.cumsum([0, *rng.choice([1, 2, 9], 4)])
    starts = np.arange(60) % 12 == 0
    database = Database(centre_and_face(walk(60)).poses_m.astype(np.float32), starts)
    row, yaw = rng.integers(0, 60, (5, count)), rng.uniform(0, 30, (5, count))
    emission = rng.uniform(0, 0.1, (5, count))
    emission[2, 1] = np.inf
    pose, following = database.turned(row, yaw), database.turned(database.successors()[row], yaw)

    def cost(path: tuple[int, ...]) -> float:
        total = sum(emission[at, rank] for at, rank in enumerate(path))
        for at in range(4):
            gap, before = frames[at + 1] - frames[at], (at, path[at])
            share = min(gap * database.rate_hz / rate_hz, 1.0)
            step = pose[at + 1, path[at + 1]] - pose[before] - share * (following[before] - pose[before])
            total += POSE_WEIGHT / np.sqrt(gap) * np.linalg.norm(step, axis=-1).mean()
        return float(total)

    best = min(itertools.product(range(count), repeat=5), key=cost)
    viterbi = FixedLagViterbi(database, rate_hz=rate_hz, lag=100)
    for at in range(5):  # one after the other, as live
        assert viterbi.push(frames[[at]], row[[at]], yaw[[at]], emission[[at]]) == []
    assert viterbi.decide_until(frames[-1]) == list(best)


def smooth_live(unitquat: np.ndarray) -> np.ndarray:
    """Every frame as the 1-euro filter gives it."""
    live = OneEuroFilter(OneEuro(), 24.0)
    return np.array([live.step(frame, turns) for frame, turns in enumerate(unitquat)]).reshape(unitquat.shape)


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
    # Poses face, and are seen from, several directions: only then does the direction of turning matter.
    poses = np.concatenate([motion - mid_hip(motion)[:, None] for motion in motions])
    database = Database(poses, np.tile(np.arange(12) == 0, 3))
    yaw = 3 * np.arange(12) % 30
    query = database.project(0, 12)[np.arange(12), yaw] + np.random.default_rng(1).normal(0, 0.02, (12, 14, 2))
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


def test_viterbi_without_weight_is_nearest_and_empty_frames_stay_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    database, neighbours = toy_search()
    projection, distance = neighbours.projection.copy(), neighbours.distance_m.copy()
    projection[[0, 7, 8]] = -1
    distance[[0, 7, 8]] = np.inf
    holes = Neighbours(projection, distance, neighbours.num_yaws)
    with monkeypatch.context() as changed:
        changed.setattr(temporal, "POSE_WEIGHT", 0.0)
        free = choose_viterbi(database, holes, rate_hz=24.0)
    np.testing.assert_array_equal(free, choose_nearest(holes))
    for ranks in (free, choose_window(database, holes), choose_viterbi(database, holes, rate_hz=60.0)):
        assert np.flatnonzero(ranks < 0).tolist() == [0, 7, 8]


def test_nothing_seen_anywhere_chooses_nothing() -> None:
    database, _ = toy_search(5)
    empty = Neighbours(np.full((5, 20), -1), np.full((5, 20), np.inf), 30)
    assert (choose_viterbi(database, empty, rate_hz=24.0) == -1).all()
    assert (choose_window(database, empty) == -1).all()


def test_smoothing_does_not_depend_on_quaternion_signs() -> None:
    unitquat = rotations(60)
    flipped = unitquat * np.random.default_rng(1).choice([-1.0, 1.0], (60, 3, 1))
    for smooth in (smooth_savitzky_golay, smooth_live):
        assert angle_between(smooth(unitquat), smooth(flipped)).max() < 1e-6


def test_smoothing_makes_signs_continuous_without_changing_rotations() -> None:
    turn = unitquat_from_rotvec(np.linspace(0, 1.0, 60)[:, None, None] * np.eye(3))
    flipped = turn * np.random.default_rng(1).choice([-1.0, 1.0], (60, 3, 1))
    assert (np.sum(flipped[1:] * flipped[:-1], axis=-1) < 0).any(axis=0).all()
    smooth = smooth_savitzky_golay(flipped)
    assert (np.sum(smooth[1:] * smooth[:-1], axis=-1) > 0.99).all()
    assert angle_between(smooth, turn).max() < 1e-4


def test_a_steady_turn_passes_savitzky_golay_unchanged_and_noise_shrinks() -> None:
    turn = unitquat_from_rotvec(np.linspace(0, 1.0, 60)[:, None, None] * np.array([[0.0, 1.0, 0.0]]))
    assert angle_between(smooth_savitzky_golay(turn), turn).max() < 1e-4
    noisy = normalise(turn + np.random.default_rng(0).normal(0, 0.05, turn.shape))
    for smooth in (smooth_savitzky_golay(noisy), smooth_live(noisy)):
        assert angle_between(smooth, turn)[5:].mean() < 0.75 * angle_between(noisy, turn)[5:].mean()


def test_the_one_euro_filter_of_points_lags_more_at_a_lower_cutoff() -> None:
    slow, fast = (OneEuroFilter(OneEuro(min_cutoff_hz=cutoff_hz), 24.0) for cutoff_hz in (0.5, 5.0))
    for frame in range(6):
        step = np.full((1, 3), 1.0 if frame else 0.0)
        low, high = slow.step(frame, step), fast.step(frame, step)
    assert 0.1 < low.min() < high.min() < 1.0


@pytest.mark.parametrize("num_frames", [0, 1, 2, 3, 4, 5])
def test_short_motions_are_smoothed_without_complaint(num_frames: int) -> None:
    unitquat = rotations(num_frames)
    assert smooth_savitzky_golay(unitquat).shape == unitquat.shape


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
