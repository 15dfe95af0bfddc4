"""Clean-up stills planted feet, keeps the floor and the bones, and leaves poses nearly as they were."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.cleanup import bend_leg, clean_up
from pasdedeux.reconstruction.errors import jitter_m, root_centred_error_m
from pasdedeux.skeletons import OP14
from tests.builders.crowds import duet_couple

ANKLES = OP14.indices(["left_ankle", "right_ankle"])


@pytest.fixture(scope="module")
def dancer() -> np.ndarray:
    return duet_couple("waltz", duration_s=8.0)[:, 0]


def gliding(true: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return the same poses on a path with the smooth errors, above all in depth, that one camera makes."""
    rng = np.random.default_rng(seed)
    window = np.hanning(25)
    error = np.stack([np.convolve(rng.normal(0, 1, len(true) + 24), window / window.sum(), "valid") for _ in range(3)])
    return np.asarray(true + (error.T * np.array([0.06, 0.06, 0.2]))[:, None])


def planted_step(positions: np.ndarray, is_planted: np.ndarray) -> float:
    stays = is_planted[1:] & is_planted[:-1]
    return float(np.linalg.norm(np.diff(positions[:, ANKLES], axis=0), axis=-1)[stays].mean())


def test_planted_feet_stand_still_and_the_error_does_not_rise(dancer: np.ndarray) -> None:
    seen = gliding(dancer)
    found = clean_up(seen, rate_hz=30.0)
    assert found.is_planted.mean() > 0.3
    assert planted_step(found.positions_m, found.is_planted) < 0.1 * planted_step(seen, found.is_planted)
    before, after = (root_centred_error_m(motion, dancer).mean() for motion in (seen, found.positions_m))
    assert after < before + 0.005
    assert jitter_m(found.positions_m) < jitter_m(dancer) + 0.002
    # The feet show how the body moved, so its path comes nearer to the truth.
    off = [np.diff(mid_hip(motion) - mid_hip(dancer), axis=0) for motion in (seen, found.positions_m)]
    assert np.abs(off[1]).mean() < 0.7 * np.abs(off[0]).mean()


def test_bones_keep_their_length_and_nobody_sinks_into_the_floor(dancer: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    seen = gliding(dancer) + rng.normal(0, 0.004, dancer.shape)
    found = clean_up(seen, rate_hz=30.0)
    lengths = bone_lengths(OP14, found.positions_m)
    np.testing.assert_allclose(lengths, np.broadcast_to(np.median(bone_lengths(OP14, seen), axis=0), lengths.shape))
    assert found.positions_m[:, ANKLES, 1].min() > found.floor_m - 1e-6


def test_a_motion_that_is_right_stays_as_it_is(dancer: np.ndarray) -> None:
    found = clean_up(dancer, rate_hz=30.0)
    assert root_centred_error_m(found.positions_m, dancer).mean() < 0.005
    assert np.abs(found.shift_m).max() < 0.03


def test_feet_that_seem_to_creep_for_seconds_do_not_take_the_body_along(dancer: np.ndarray) -> None:
    # Errors of poses last: legs are 6 cm too far back, then too far forward, under a body that is in place.
    seen, legs = dancer.copy(), [joint for leg in OP14.legs for joint in leg[1:]]
    seen[:, legs, 2] += 0.06 * np.sin(2.0 * np.pi * np.arange(len(seen)) / 150.0)[:, None]
    off = mid_hip(clean_up(seen, rate_hz=30.0).positions_m) - mid_hip(dancer)
    assert np.hypot(off[:, 0], off[:, 2]).mean() < 0.015


def test_without_contact_the_path_is_unchanged(dancer: np.ndarray) -> None:
    flying = dancer + np.linspace(0, 30.0, len(dancer))[:, None, None]
    found = clean_up(flying, rate_hz=30.0)
    assert not found.is_planted.any()
    np.testing.assert_array_equal(found.shift_m, 0.0)


def lift() -> np.ndarray:
    """Return the lift (frame, person, 14, 3): B is up from 3.2 to 6.8 s."""
    return duet_couple("lift", duration_s=10.0)


def test_a_person_held_up_stays_up_and_where_the_partner_holds_them() -> None:
    true = lift()
    seen = np.stack([gliding(true[:, person], seed=person) for person in (0, 1)], axis=1)
    found = clean_up(seen, rate_hz=30.0)
    up = slice(96, 204)
    assert not found.is_planted[up, 1].any()
    assert found.is_planted[up, 0].any(axis=-1).mean() > 0.7
    above = (found.positions_m - true)[up, 1][:, ANKLES, 1] - found.floor_m + 0.07
    assert np.abs(above).mean() < 0.06
    place, before = (np.diff(mid_hip(motion), axis=1)[:, 0] for motion in (found.positions_m, seen))
    # The path of one is corrected with that of the other.
    assert np.abs(place - before)[up].max() < 0.03
    assert np.abs(found.shift_m[up, 1]).max() > 0.05


def test_people_apart_are_cleaned_up_as_if_each_were_alone(dancer: np.ndarray) -> None:
    seen = [gliding(dancer, seed) + np.array([4.0 * seed, 0.0, 0.0]) for seed in (0, 1)]
    together = clean_up(np.stack(seen, axis=1), rate_hz=30.0)
    for person, motion in enumerate(seen):
        alone = clean_up(motion, rate_hz=30.0)
        np.testing.assert_array_equal(together.is_planted[:, person], alone.is_planted)
        np.testing.assert_allclose(together.shift_m[:, person, [0, 2]], alone.shift_m[:, [0, 2]], atol=1e-9)


def test_a_person_who_comes_later_counts_only_then(dancer: np.ndarray) -> None:
    seen = np.stack([dancer, dancer + np.array([1.5, -0.4, 0.0])], axis=1)
    there = np.ones((len(dancer), 2), dtype=bool)
    there[:, 1] = False
    found, alone = clean_up(seen, rate_hz=30.0, is_present=there), clean_up(dancer, rate_hz=30.0)
    assert not found.is_planted[:, 1].any()
    assert found.floor_m == alone.floor_m
    np.testing.assert_allclose(found.positions_m[:, 0], alone.positions_m, atol=1e-9)


def test_legs_reach_their_target_or_as_far_as_they_go() -> None:
    rng = np.random.default_rng(2)
    hip = rng.normal(0, 0.1, (50, 3))
    knee = hip + np.array([0.0, -0.4, 0.1]) + rng.normal(0, 0.03, (50, 3))
    ankle = knee + np.array([0.0, -0.4, -0.1]) + rng.normal(0, 0.03, (50, 3))
    forward = np.broadcast_to(np.array([0.0, 0.0, 1.0]), hip.shape)
    target = ankle + rng.normal(0, 0.03, ankle.shape)
    target[:5] = hip[:5] + np.array([0.0, -3.0, 0.0])
    new_knee, new_ankle = bend_leg(hip, knee, ankle, target, fallback=forward)
    for parent, child, new_parent, new_child in ((hip, knee, hip, new_knee), (knee, ankle, new_knee, new_ankle)):
        np.testing.assert_allclose(
            np.linalg.norm(new_child - new_parent, axis=-1), np.linalg.norm(child - parent, axis=-1)
        )
    reach = np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    near = np.linalg.norm(target - hip, axis=-1) < reach - 1e-5
    assert near.sum() > 20
    np.testing.assert_allclose(new_ankle[near], target[near], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(new_ankle[:5] - hip[:5], axis=-1), reach[:5], rtol=1e-5)
    same_knee, same_ankle = bend_leg(hip, knee, ankle, ankle, fallback=forward)
    np.testing.assert_allclose(same_ankle, ankle, atol=1e-5)
    assert np.abs(same_knee - knee).max() < 0.01


def test_short_motions_and_bad_input_have_defined_answers(dancer: np.ndarray) -> None:
    for count in (1, 2, 3):
        assert clean_up(dancer[:count], rate_hz=30.0).positions_m.shape == (count, 14, 3)
    with pytest.raises(InputError, match="shape"):
        clean_up(dancer[:, :5], rate_hz=30.0)
    with pytest.raises(InputError, match="finite"):
        clean_up(np.full((4, 14, 3), np.nan), rate_hz=30.0)
