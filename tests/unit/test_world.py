"""Camera, sizes and places of all people are one estimate: floor, contacts and sizes together tell where people are."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import Reconstruction
from pasdedeux.reconstruction.world import Seen, World, WorldSettings, estimate_world
from pasdedeux.skeletons import OP14
from tests.builders.crowds import duet_couple

RATE_HZ = 30.0
ANKLES = OP14.indices(["left_ankle", "right_ankle"])
PITCH_RAD, DISTANCE_M = 0.26, 4.0


def seen_and_true(name: str) -> tuple[list[Seen], np.ndarray, float]:
    """Return a duet with its own poses as a camera sees it, how far away as a search errs, truth, camera's height."""
    world = duet_couple(name, duration_s=8.0)
    camera = look_at_camera(
        mid_hip(world).mean(axis=(0, 1)), distance_m=DISTANCE_M, yaw_rad=1.1, pitch_rad=PITCH_RAD, focal_px=1400.0
    )
    truth = (world - camera.position_m) @ camera.camera_from_world_rotmat.T
    rng = np.random.default_rng(4)
    window = np.hanning(61) / np.hanning(61).sum()
    people = []
    for person, size in enumerate((1.04, 0.93)):
        # Each person's size is unknown and the apparent one errs by some per cent for a second or two.
        noise = np.convolve(rng.normal(0.0, 0.25, len(truth) + 60), window, "valid")
        root = mid_hip(truth[:, person])
        positions = (root * (size * np.exp(noise))[:, None])[:, None] + (truth[:, person] - root[:, None]) * size
        count = len(truth)
        found = Reconstruction(
            positions_m=positions,
            bone_unitquat=bone_rotations(positions),
            root_m=mid_hip(positions),
            yaw_rad=np.zeros(count),
            score_m=np.full(count, 0.03),
            row=np.zeros(count, dtype=np.int64),
            num_joints_seen=np.full(count, 14),
            is_bridged=np.zeros(count, dtype=bool),
            metres_per_pixel=np.ones(count),
            correction_m=np.zeros(count),
            noise_m=0.0,
        )
        people.append(Seen(0, found, RATE_HZ))
    return people, truth, float(camera.position_m[1])


def solved(people: list[Seen], guess_deg: float = 18.0, **known: float) -> tuple[World, np.ndarray]:
    guess = PitchEstimate(0, np.deg2rad(guess_deg), np.deg2rad(5.0))
    world = estimate_world(people, guess, settings=WorldSettings(lens_deviation=0.02), **known)
    return world, np.stack([world.moved(n, one.found).positions_m for n, one in enumerate(people)], axis=1)


def place_error(found: np.ndarray, truth: np.ndarray) -> float:
    between = [np.diff(mid_hip(one), axis=1)[:, 0] for one in (found, truth)]
    return float(np.median(np.linalg.norm(between[0] - between[1], axis=-1)))


@pytest.mark.parametrize("name", ["lift", "hug", "waltz"])
def test_one_floor_and_sizes_of_people_put_both_in_their_place_to_each_other(name: str) -> None:
    people, truth, _ = seen_and_true(name)
    thought = np.stack([one.found.positions_m for one in people], axis=1)
    world, found = solved(people)
    assert place_error(thought, truth) > 0.2
    assert place_error(found, truth) < 0.12
    assert np.rad2deg(abs(world.pitch_rad - PITCH_RAD)) < 6.0
    assert 0.1 < np.rad2deg(world.pitch_deviation_rad) < 5.0
    # Poses are kept, at one size a person.
    for number, one in enumerate(people):
        before, after = (p - mid_hip(p)[:, None] for p in (one.found.positions_m, found[:, number]))
        np.testing.assert_allclose(
            np.linalg.norm(after, axis=-1), world.sizes[number] * np.linalg.norm(before, axis=-1), atol=1e-9
        )


def test_who_is_held_up_is_not_put_on_the_floor() -> None:
    people, _, _ = seen_and_true("lift")
    world, found = solved(people)
    up = np.array([0.0, np.cos(world.pitch_rad), np.sin(world.pitch_rad)])
    height = (found[:, :, ANKLES] @ up).min(axis=2) + world.camera_height_m
    assert np.median(height[110:200, 1] - height[110:200, 0]) == pytest.approx(0.36, abs=0.12)
    assert np.abs(height[:, 0] - 0.07).max() < 0.12


def test_a_known_height_of_the_camera_and_known_statures_give_sizes() -> None:
    people, truth, height_m = seen_and_true("hug")
    world, _ = solved(people, camera_height_m=height_m)
    assert world.camera_height_m == pytest.approx(height_m, rel=0.03)
    known = [Seen(0, one.found, RATE_HZ, stature) for one, stature in zip(people, (1.82, 1.65), strict=True)]
    _, found = solved(known)
    lengths = [
        np.linalg.norm(np.diff(one[:, OP14.legs[0][1:]], axis=1), axis=-1).mean() for one in (found[:, 0], truth[:, 0])
    ]
    assert lengths[0] / lengths[1] == pytest.approx(1.0, abs=0.04)
    with pytest.raises(InputError, match="height of the camera"):
        solved(people, camera_height_m=0.0)


def test_one_person_and_short_tracks_have_defined_answers() -> None:
    people, _, _ = seen_and_true("waltz")
    for count in (1, 2, 3, 40):
        found = people[0].found
        cut = Reconstruction(
            **{name: value[:count] if np.ndim(value) else value for name, value in vars(found).items()}
        )
        world, placed = solved([Seen(5, cut, RATE_HZ)])
        assert placed.shape == (count, 1, 14, 3)
        assert np.isfinite(placed).all()
        assert np.isfinite(world.pitch_deviation_rad)
