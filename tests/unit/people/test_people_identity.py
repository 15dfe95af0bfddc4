"""Follow people through crossings, absences and doubled detections, in any order of rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pasdedeux.people.identity import FollowedRows, body_size_px, follow_people, identity_switches
from pasdedeux.people.identity_kernels import match_costs, predict_joints, update_joints
from tests.builders.crowds import SALSA_TAKES, duet_couple, salsa_couple
from tests.builders.filmed_people import Detections, film, joined
from tests.builders.walkers import walk


def follow(seen: Detections) -> FollowedRows:
    return follow_people(seen.frame, seen.keypoints_px, seen.confidence, rate_hz=seen.rate_hz)


def switches(seen: Detections, found: FollowedRows) -> int:
    return identity_switches(seen.true_id, found.track_id, seen.frame)


def crossing(num_frames: int = 90) -> np.ndarray:
    """Return two walkers who cross, one behind the other in the image."""
    couple = np.stack([walk(num_frames, seed=person, rate_hz=30.0, turn_rad=0.0) for person in range(2)], axis=1)
    displacement_m = np.linspace(-1.2, 1.2, num_frames)[:, None]
    couple[:, 0, :, 0] += displacement_m
    couple[:, 1, :, 0] -= displacement_m
    couple[:, 1, :, 2] -= 0.4
    return couple


@pytest.mark.parametrize("noise_px", [0.0, 5.0])
@pytest.mark.parametrize("name", ["waltz", "hug", "judo", "push_hands"])
def test_duets_are_followed_without_a_switch(name: str, noise_px: float) -> None:
    couple = duet_couple(name, duration_s=6.0)
    for view in range(3):
        seen = film(np.random.default_rng([view, 7]), couple, noise_px=noise_px)
        found = follow(seen)
        assert switches(seen, found) == 0
        assert set(found.track_id.tolist()) == {0, 1}


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.0, 5.0])
def test_the_salsa_takes_are_followed_without_a_switch(data_dir: Path, noise_px: float) -> None:
    for take in SALSA_TAKES:
        seen = film(np.random.default_rng([int(take), 0]), salsa_couple(data_dir, take), noise_px=noise_px)
        assert switches(seen, follow(seen)) == 0, take


def test_the_order_of_people_and_rows_does_not_matter() -> None:
    seen = film(np.random.default_rng(3), crossing(), noise_px=5.0)
    found = follow(seen)
    shuffled = np.random.default_rng(4).permutation(len(seen.frame))
    again = follow(seen.rows(shuffled))
    pairs = zip(found.track_id[shuffled].tolist(), again.track_id.tolist(), strict=True)
    assert len(set(pairs)) == len(set(found.track_id.tolist())) == 2


def test_a_person_hidden_while_passing_behind_comes_back_as_the_same() -> None:
    couple = crossing()
    for yaw_rad in (0.0, 0.3, -0.3):
        seen = film(np.random.default_rng(5), couple, noise_px=3.0, yaw_rad=yaw_rad)
        hidden = (seen.true_id == 1) & (seen.frame > 35) & (seen.frame < 55)
        kept = seen.rows(~hidden)
        found = follow(kept)
        assert switches(kept, found) == 0
        assert set(found.track_id.tolist()) == {0, 1}


def test_gaps_in_the_frame_numbers_are_time_that_passed() -> None:
    seen = film(np.random.default_rng(6), crossing(), noise_px=2.0)
    kept = seen.rows((seen.frame % 3 == 0) & ~((seen.frame > 30) & (seen.frame < 42)))
    assert switches(kept, follow(kept)) == 0


def test_people_may_come_and_go() -> None:
    seen = film(np.random.default_rng(8), crossing(), noise_px=2.0, yaw_rad=0.1)
    kept = seen.rows((seen.true_id == 0) | (seen.frame >= 40))
    found = follow(kept)
    assert switches(kept, found) == 0
    assert (found.track_id[kept.frame < 40] == 0).all()
    assert kept.frame[found.track_id == 1].min() == 40


def test_a_person_who_is_back_after_too_long_is_a_new_one() -> None:
    seen = film(np.random.default_rng(9), crossing(150), yaw_rad=0.0)
    alone = seen.rows((seen.true_id == 0) & ((seen.frame < 40) | (seen.frame > 100)))
    assert sorted(set(follow(alone).track_id.tolist())) == [0, 1]


def test_a_doubled_person_is_merged_into_one() -> None:
    seen = film(np.random.default_rng(10), crossing(), yaw_rad=0.2)
    doubled = np.flatnonzero((seen.true_id == 0) & (seen.frame > 20) & (seen.frame < 26))
    noise_px = np.random.default_rng(11).normal(0, 3.0, (len(doubled), 14, 2))
    second = seen.rows(doubled)
    both = joined(seen, replace(second, keypoints_px=second.keypoints_px + noise_px))
    found = follow(both)
    assert found.num_merged == len(doubled)
    assert switches(both, found) == 0
    assert set(found.track_id.tolist()) == {-1, 0, 1}
    used = found.track_id >= 0
    assert len({(f, t) for f, t in zip(both.frame[used], found.track_id[used], strict=True)}) == used.sum()


def test_short_ghosts_and_scraps_are_dropped() -> None:
    seen = film(np.random.default_rng(12), crossing(), yaw_rad=0.0)
    ghost = seen.rows(np.flatnonzero(seen.true_id == 0)[30:34])
    ghost = replace(ghost, keypoints_px=ghost.keypoints_px + np.array([700.0, -300.0]), true_id=np.full(4, 9))
    scrap = seen.rows(np.flatnonzero(seen.true_id == 0)[50:60])
    scrap = replace(scrap, confidence=scrap.confidence * (np.arange(14) < 2), true_id=np.full(10, 8))
    everyone = joined(seen, ghost, scrap)
    found = follow(everyone)
    assert (found.track_id[everyone.true_id >= 8] == -1).all()
    assert found.num_ghosts == 14
    assert switches(everyone, found) == 0


@pytest.mark.parametrize("confidence", [0.1, 0.2])
def test_junk_joints_of_low_confidence_split_nobody(confidence: float) -> None:
    couple = duet_couple("waltz", duration_s=5.0)
    for people in (couple[:, :1], couple):
        seen = film(np.random.default_rng(1), people, noise_px=5.0)
        rng = np.random.default_rng(2)
        junk = np.argsort(rng.random(seen.confidence.shape), axis=1) < 3
        places = rng.random(seen.keypoints_px.shape) * [1920.0, 1080.0]
        spoilt = replace(
            seen,
            keypoints_px=np.where(junk[..., None], places, seen.keypoints_px),
            confidence=np.where(junk, confidence, 0.9),
        )
        found = follow(spoilt)
        assert set(found.track_id.tolist()) == set(range(people.shape[1]))
        assert switches(spoilt, found) == 0


def test_no_detection_gives_no_track() -> None:
    empty = follow_people(np.zeros(0, np.int64), np.zeros((0, 14, 2)), np.zeros((0, 14)), rate_hz=30.0)
    assert len(empty.track_id) == 0
    blind = follow_people(np.arange(3), np.full((3, 14, 2), np.nan), np.ones((3, 14)), rate_hz=30.0)
    assert blind.track_id.tolist() == [-1, -1, -1]
    assert np.isnan(body_size_px(np.zeros((14, 2)), np.zeros(14)))


def test_costs_and_updates_of_one_person_are_what_their_formulas_say() -> None:
    rng = np.random.default_rng(8)
    place, speed = rng.normal(0, 100, (14, 2)), rng.normal(0, 30, (14, 2))
    known, trust = rng.uniform(size=14) < 0.8, rng.uniform(size=(3, 14)).clip(0.2) - 0.2
    seen = trust > 0
    points = place + rng.normal(0, 200, (3, 14, 2))
    body = np.median(speed[known], axis=0)
    predicted = place + 0.1 * body + 0.05 * (speed - body)
    np.testing.assert_allclose(predict_joints(place, speed, known, 0.1, 0.05), predicted)
    size = np.array([300.0, 330.0, 200.0])
    cost = match_costs(predicted, known, 310.0, points, trust, size)
    for at in range(3):
        both = seen[at] & known
        apart = np.minimum(np.linalg.norm(points[at] - predicted, axis=-1) / 310.0, 0.75)
        distance = np.average(apart[both], weights=trust[at, both])
        is_new = seen[at] & ~known
        expected = distance + 0.2 * abs(np.log(size[at] / 310.0)) + 0.05 * is_new.sum() / seen[at].sum()
        assert cost[at] == pytest.approx(expected)
    new_place, new_speed, new_known = place.copy(), speed.copy(), known.copy()
    update_joints(new_place, new_speed, new_known, predicted, points[0], trust[0], 0.04, 0.8)
    off = np.where((seen[0] & known)[:, None], trust[0][:, None] * (points[0] - predicted), 0.0)
    np.testing.assert_allclose(new_place, np.where((seen[0] & ~known)[:, None], points[0], predicted + 0.7 * off))
    np.testing.assert_allclose(new_speed, speed * np.where(seen[0], 1.0, 0.8)[:, None] + 0.25 / 0.04 * off)
    np.testing.assert_array_equal(new_known, known | seen[0])
