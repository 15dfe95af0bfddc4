"""Live clean-up stills planted feet as poses leave, keeps floor and bones, and changes no pose that has left."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.reconstruction.cleanup import bend_leg
from pasdedeux.reconstruction.errors import foot_slide_m, jitter_m, root_centred_error_m
from pasdedeux.reconstruction.live.cleanup import LiveCleanUp, LiveFloor
from pasdedeux.skeletons import OP14
from tests.builders.crowds import duet_couple

RATE_HZ = 30.0
ANKLES = OP14.indices(["left_ankle", "right_ankle"])


@pytest.fixture(scope="module")
def dancer() -> np.ndarray:
    return duet_couple("waltz", duration_s=8.0)[:, 0]


@pytest.fixture(scope="module")
def gliding(dancer: np.ndarray) -> np.ndarray:
    """Return the same poses on a path with the smooth errors, above all in depth, that one camera makes."""
    rng = np.random.default_rng(0)
    window = np.hanning(25)
    noise = rng.normal(0, 1, (3, len(dancer) + 24))
    error = np.stack([np.convolve(axis, window / window.sum(), "valid") for axis in noise], axis=-1)
    return np.asarray(dancer + (error * np.array([0.03, 0.03, 0.2]))[:, None])


def cleaned(motion: np.ndarray) -> np.ndarray:
    clean_up = LiveCleanUp(RATE_HZ)
    return np.stack([clean_up.step(frame, pose) for frame, pose in enumerate(motion)])


def test_standing_feet_slide_less_and_error_and_jitter_hardly_rise(dancer: np.ndarray, gliding: np.ndarray) -> None:
    found = cleaned(gliding)
    before, after = (foot_slide_m(motion, dancer, rate_hz=RATE_HZ) for motion in (gliding, found))
    assert after < 0.4 * before
    assert root_centred_error_m(found, dancer).mean() < root_centred_error_m(gliding, dancer).mean() + 0.01
    assert jitter_m(found) < jitter_m(gliding) + 0.002


def test_bones_keep_their_length_and_ankles_do_not_sink(gliding: np.ndarray) -> None:
    sunk = gliding.copy()
    sunk[100:103, :, 1] -= 0.03
    found = cleaned(sunk)
    np.testing.assert_allclose(bone_lengths(OP14, found), bone_lengths(OP14, sunk), atol=1e-9)
    lowest = sunk[50:100, ANKLES, 1].min()
    assert sunk[100:103, ANKLES, 1].min() < lowest - 0.01
    assert found[100:103, ANKLES, 1].min() >= lowest - 1e-9


def test_a_pose_that_left_does_not_depend_on_what_comes_later(gliding: np.ndarray) -> None:
    changed = gliding.copy()
    changed[120:] += 1.0
    np.testing.assert_array_equal(cleaned(gliding)[:120], cleaned(changed)[:120])


def test_a_released_foot_returns_to_where_it_is_seen(dancer: np.ndarray) -> None:
    clean_up = LiveCleanUp(RATE_HZ)
    still = np.repeat(dancer[:1], 20, axis=0)
    moved = still + np.array([0.0, 0.0, 0.1]) * np.linspace(0, 1, 20)[:, None, None]
    for frame, pose in enumerate(moved):
        clean_up.step(frame, pose)
    assert clean_up.is_planted.any()
    flying = dancer[0] + np.array([0.0, 0.5, 0.1])
    for frame in range(20, 420):
        found = clean_up.step(frame, flying + np.array([0.05 * (frame - 20), 0.5, 0.0]))
    assert not clean_up.is_planted.any()
    np.testing.assert_allclose(found, flying + np.array([0.05 * 399, 0.5, 0.0]), atol=1e-2)


def test_a_person_held_up_stands_on_nothing_though_the_feet_hang_still(dancer: np.ndarray) -> None:
    holder = np.repeat(dancer[:1], 120, axis=0)
    held = holder + np.array([0.4, 0.5, 0.0])
    floor = LiveFloor(RATE_HZ)
    both = [LiveCleanUp(RATE_HZ, floor=floor, person=person) for person in (0, 1)]
    alone = LiveCleanUp(RATE_HZ)
    for frame in range(120):
        found = [clean_up.step(frame, motion[frame]) for clean_up, motion in zip(both, (holder, held), strict=True)]
        alone.step(frame, held[frame])
        np.testing.assert_allclose(found[1], held[frame], atol=1e-9)
    assert both[0].is_planted.any()
    assert not both[1].is_planted.any()
    assert alone.is_planted.any()  # nobody else is there to say where the floor is
    floor.forget(0)
    for frame in range(120, 240):
        both[1].step(frame, held[frame - 120])
    assert both[1].is_planted.any()


def test_a_leg_bends_as_offline(dancer: np.ndarray) -> None:
    # A floor above the ankles lifts both of them to it, and nothing else is done.
    clean_up = LiveCleanUp(1e5)  # at this rate everything is too fast to be planted
    raised = dancer[0] + np.array([0.0, 0.05, 0.0])
    for frame in range(40):
        clean_up.step(frame, raised + np.array([1e-3 * (frame % 2), 0.0, 0.0]))
    found = clean_up.step(40, dancer[0])
    floor = raised[ANKLES, 1].min()
    for side in ("left", "right"):
        hip, knee, ankle = OP14.indices([f"{side}_{joint}" for joint in ("hip", "knee", "ankle")])
        target = dancer[0, ankle].copy()
        target[1] = max(target[1], floor)
        expected = bend_leg(
            dancer[:1, hip], dancer[:1, knee], dancer[:1, ankle], target[None], fallback=np.array([[0.0, 0.0, 1.0]])
        )
        np.testing.assert_allclose(found[[knee, ankle]], np.concatenate(expected), atol=1e-9)
