"""Find faults of detectors by continuity: repair wrong labels, mask wrong places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.people.faults import RepairedCrowd, repair_faults, track_size_px
from pasdedeux.skeletons import OP14
from tests.builders.crowds import SALSA_TAKES, duet_couple, salsa_couple
from tests.builders.filmed_people import KINDS, Faulty, JointCounts, count_joints, film, inject, people_of

MIN_RECALL = {"stolen": 0.6, "merged": 0.6}
"""A limb found on the partner is not noticed where the partner's limb is near."""


def filmed(name: str, noise_px: float) -> tuple[np.ndarray, np.ndarray]:
    couple = duet_couple(name, duration_s=5.0)
    return people_of(film(np.random.default_rng([len(name), 1]), couple, noise_px=noise_px))


def repaired(faulty: Faulty) -> RepairedCrowd:
    return repair_faults(faulty.keypoints_px, faulty.confidence, rate_hz=30.0)


@pytest.mark.parametrize("noise_px", [0.0, 5.0])
@pytest.mark.parametrize("name", ["waltz", "judo"])
def test_clean_keypoints_are_left_alone(name: str, noise_px: float) -> None:
    points, confidence = filmed(name, noise_px)
    found = repair_faults(points, confidence, rate_hz=30.0)
    touched = found.is_touched
    assert touched.mean() < 0.002
    np.testing.assert_array_equal(found.keypoints_px[~touched], points[~touched])


@pytest.mark.parametrize("name", ["waltz", "judo", "push_hands"])
def test_labels_stay_where_only_noise_makes_joints_jump(name: str) -> None:
    points, confidence = filmed(name, 8.0)
    found = repair_faults(points, confidence, rate_hz=30.0)
    assert not (found.is_touched & ~found.is_masked).any()


@pytest.mark.parametrize("kind", KINDS)
def test_injected_faults_are_found_and_little_else(kind: str) -> None:
    total = JointCounts()
    for name in ("waltz", "push_hands"):
        points, confidence = filmed(name, 3.0)
        faulty = inject(np.random.default_rng(len(kind)), points, confidence, kind)
        total += count_joints(faulty, points, repaired(faulty))
    assert total.wrong > 20
    assert total.shares["share_of_wrong_joints_found"] > MIN_RECALL.get(kind, 0.95)
    assert total.shares["share_of_changed_joints_that_were_wrong"] > 0.8
    if kind not in MIN_RECALL:
        assert total.shares["share_of_wrong_joints_put_right"] > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_injected_faults_are_found_in_salsa(data_dir: Path, kind: str) -> None:
    total = JointCounts()
    for take in SALSA_TAKES[::4]:
        seen = film(np.random.default_rng([int(take), 1]), salsa_couple(data_dir, take), noise_px=5.0)
        points, confidence = people_of(seen)
        faulty = inject(np.random.default_rng(int(take)), points, confidence, kind)
        total += count_joints(faulty, points, repaired(faulty))
    assert total.shares["share_of_wrong_joints_found"] > MIN_RECALL.get(kind, 0.95)
    assert total.shares["share_of_changed_joints_that_were_wrong"] > 0.65


def test_missing_joints_stay_missing_and_are_no_fault() -> None:
    points, confidence = filmed("waltz", 2.0)
    hidden = np.random.default_rng(0).random(confidence.shape) < 0.3
    points[hidden], confidence[hidden] = np.nan, 0.0
    found = repair_faults(points, confidence, rate_hz=30.0)
    assert found.is_touched.mean() < 0.01
    assert (found.confidence[hidden] == 0).all()


def test_a_swap_for_one_frame_at_either_end_is_put_right() -> None:
    points, confidence = filmed("push_hands", 0.0)
    mirror = np.array(OP14.mirror)
    for frame in (1, -1):
        wrong = points.copy()
        wrong[0, frame] = wrong[0, frame, mirror]
        np.testing.assert_array_equal(repair_faults(wrong, confidence, rate_hz=30.0).keypoints_px, points)


def test_who_comes_later_is_repaired_and_nobody_is_made_up_before() -> None:
    points, confidence = filmed("waltz", 0.0)
    points[1, :60], confidence[1, :60] = np.nan, 0.0
    wrong = points.copy()
    wrong[0, 30] = wrong[0, 30, np.array(OP14.mirror)]
    found = repair_faults(wrong, confidence, rate_hz=30.0)
    np.testing.assert_array_equal(found.keypoints_px[0, 30], points[0, 30])
    assert (found.confidence[1, :60] == 0.0).all()
    assert (found.source_joint[0, 30] != np.arange(14)).sum() >= 8


def test_junk_of_low_confidence_is_masked_and_labels_stay() -> None:
    points, confidence = filmed("waltz", 5.0)
    rng = np.random.default_rng(4)
    junk = np.argsort(rng.random(confidence.shape), axis=-1) < 2
    spoilt = np.where(junk[..., None], rng.random(points.shape) * [1920.0, 1080.0], points)
    found = repair_faults(spoilt, np.where(junk, 0.1, 0.9), rate_hz=30.0)
    is_far = junk & (np.linalg.norm(spoilt - points, axis=-1) > 60.0)
    assert found.is_masked[is_far].mean() > 0.99
    assert found.is_touched[~junk].mean() < 0.01


def test_too_few_frames_or_joints_are_left_as_they_are() -> None:
    short = repair_faults(np.zeros((1, 2, 14, 2)), np.ones((1, 2, 14)), rate_hz=30.0)
    assert not short.is_masked.any()
    blind = repair_faults(np.full((2, 9, 14, 2), np.nan), np.zeros((2, 9, 14)), rate_hz=30.0)
    assert not blind.is_touched.any()


def test_the_size_of_a_person_is_the_median_over_the_frames_that_show_the_body_and_1_where_none_does() -> None:
    points, _ = filmed("waltz", 0.0)
    size = track_size_px(points[:, 0])
    assert size[0] > 50.0
    np.testing.assert_array_equal(size, np.full(len(points), size[0]))
    np.testing.assert_allclose(track_size_px(3.0 * points[:, 0]), 3.0 * size)
    np.testing.assert_array_equal(track_size_px(np.full((4, 14, 2), np.nan)), np.ones(4))
