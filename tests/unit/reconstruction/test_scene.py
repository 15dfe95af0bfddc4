"""Camera, sizes and places of all people are estimated together from floor, contacts and sizes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction import scene as estimate
from pasdedeux.reconstruction.couples import PairDepth
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.scene import SceneEstimate, estimate_scene
from pasdedeux.reconstruction.scene_solver import Solution
from pasdedeux.reconstruction.terms.floor import FloorTerm
from pasdedeux.reconstruction.terms.placed import PlacedPeople, SeenPeople, SeenPerson
from pasdedeux.reconstruction.terms.term import SceneTerm
from pasdedeux.skeletons import OP14
from tests.builders.crowds import duet_couple
from tests.builders.walkers import reconstruction

STRIDE = 2
"""Of the frames every second one is looked at: it tells the same in half the time."""
RATE_HZ = 30.0 / STRIDE
LIFTED = slice(round(3.5 * RATE_HZ), round(6.5 * RATE_HZ))
"""Frames of the built-in lift in which one is off the floor."""
ANKLES = OP14.indices(["left_ankle", "right_ankle"])
PITCH_RAD, DISTANCE_M, HEAD_M = 0.26, 4.0, 0.11


@cache
def seen_and_true(
    name: str, *, is_upside_down: bool = False, pitch_rad: float = PITCH_RAD
) -> tuple[list[ReconstructedTrack], np.ndarray, float]:
    """Return a duet as a camera sees it, with true poses and wrong distances, the truth, and the camera's height."""
    world = duet_couple(name, duration_s=8.0, rate_hz=STRIDE * RATE_HZ)
    if is_upside_down:
        middle = mid_hip(world[:, 1])[:, None]
        world[:, 1] = middle + (world[:, 1] - middle) * [-1.0, -1.0, 1.0] + [1.0, 0.0, 0.0]
        world[:, 1, :, 1] += HEAD_M - world[:, 1, :, 1].min(axis=1)[:, None]
    camera = look_at_camera(
        mid_hip(world).mean(axis=(0, 1)), distance_m=DISTANCE_M, yaw_rad=1.1, pitch_rad=pitch_rad, focal_px=1400.0
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
        found = reconstruction(positions[::STRIDE], rate_hz=RATE_HZ, person_id=person)
        track = replace(found.track, lens=replace(found.track.lens, is_known=True))
        people.append(replace(found, track=track))
    return people, truth[::STRIDE], float(camera.position_m[1])


def solved(people: list[ReconstructedTrack], guess_deg: float = 18.0, **known: Any) -> tuple[SceneEstimate, np.ndarray]:
    guess = PitchEstimate(np.deg2rad(guess_deg), np.deg2rad(5.0))
    scene = estimate_scene(people, guess, **known)
    return scene, np.stack([scene.placed(n, person).positions_m for n, person in enumerate(people)], axis=1)


@cache
def solved_duet(name: str) -> tuple[SceneEstimate, np.ndarray]:
    return solved(seen_and_true(name)[0])


def place_error(found: np.ndarray, truth: np.ndarray) -> float:
    between = [np.diff(mid_hip(motion), axis=1)[:, 0] for motion in (found, truth)]
    return float(np.median(np.linalg.norm(between[0] - between[1], axis=-1)))


def lifted(people: list[ReconstructedTrack]) -> list[ReconstructedTrack]:
    """Return the part of a lift in which one is off the floor."""
    return [
        reconstruction(person.positions_m[LIFTED], rate_hz=RATE_HZ, person_id=number)
        for number, person in enumerate(people)
    ]


@cache
def terms_at(carried: tuple[int, int] | None) -> tuple[list[SceneTerm], SeenPeople, np.ndarray, float]:
    """Return the terms of a lift, its people, unknowns near the first guess, and the side of the floor."""
    # The second camera is below the floor, and its pitch is stated.
    pitch_rad, deviation_rad, side = (0.3, 0.09, 1.0) if carried is None else (-0.45, 0.0, -1.0)
    tracks, _, _ = seen_and_true("lift", pitch_rad=pitch_rad)
    frames, rng = np.arange(len(tracks[0].root_m)), np.random.default_rng(1)
    said = PairDepth((0, 1), frames, rng.normal(0.0, 0.2, len(frames)), np.where(frames % 5, 0.1, np.inf))
    seen = SeenPeople(tuple(map(SeenPerson, tracks)))
    known = estimate.KnownScene(seen, PitchEstimate(pitch_rad, deviation_rad), [said], {}, None)
    assert known.sides()[0] == side
    terms, start = known.terms(carried), next(known.starts())
    return terms, seen, start + rng.normal(0.0, 0.03, len(start)), side


@pytest.mark.parametrize("carried", [None, (0, 1)])
def test_the_jacobian_of_each_term_is_that_of_finite_differences(carried: tuple[int, int] | None) -> None:
    terms, seen, x, side = terms_at(carried)
    rng = np.random.default_rng(2)
    moved = 1e-6 * rng.normal(0.0, 1.0, (8, len(x)))
    moved[:, seen.starts[0] :] *= rng.random(len(x) - seen.starts[0]) < 0.1
    for term in terms:
        jacobian = term.jacobian(PlacedPeople(seen, x, side))
        for step in moved:
            before, after = (term.residual(PlacedPeople(seen, x + sign * step, side)) for sign in (-1, 1))
            change = (jacobian.slopes * step[jacobian.columns]).sum(axis=1)
            np.testing.assert_allclose(0.5e6 * (after - before), 1e6 * change, rtol=1e-4, atol=1e-3, err_msg=str(term))


@pytest.mark.parametrize("name", ["lift", "hug", "waltz"])
def test_one_floor_and_sizes_of_people_put_both_in_their_place_to_each_other(name: str) -> None:
    people, truth, _ = seen_and_true(name)
    thought = np.stack([person.positions_m for person in people], axis=1)
    scene, found = solved_duet(name)
    assert place_error(thought, truth) > 0.2
    assert place_error(found, truth) < min(0.12, 2.0 * scene.place_deviation_m[0, 1])
    assert np.rad2deg(abs(scene.pitch_rad - PITCH_RAD)) < 6.0
    assert 0.1 < np.rad2deg(scene.pitch_deviation_rad) < 5.0
    # Poses are kept, with one size for each person.
    for number, person in enumerate(people):
        before, after = (p - mid_hip(p)[:, None] for p in (person.positions_m, found[:, number]))
        np.testing.assert_allclose(
            np.linalg.norm(after, axis=-1), scene.sizes[number] * np.linalg.norm(before, axis=-1), atol=1e-9
        )


def test_a_hand_in_front_of_a_person_farther_away_makes_no_place_well_known() -> None:
    world = duet_couple("hug", duration_s=6.0, rate_hz=RATE_HZ)
    middle = mid_hip(world).mean(axis=(0, 1))
    camera = look_at_camera(middle, distance_m=6.0, yaw_rad=2.0, pitch_rad=0.0, focal_px=1400.0)
    truth = (world - camera.position_m) @ camera.camera_from_world_rotmat.T
    for behind_m in (0.0, 1.5):
        truth[:, 1, :, 2] -= behind_m
        # The lens is not known, and 20 % longer than the assumed one.
        seen = truth - (1.0 - 1.0 / 1.2) * mid_hip(truth)[:, :, None]
        people = [reconstruction(seen[:, n], rate_hz=RATE_HZ, person_id=n) for n in (0, 1)]
        scene, found = solved(people, 0.0)
        assert place_error(found, truth) < 2.0 * scene.place_deviation_m[0, 1]
    # Apparent sizes set them apart, the hands draw them together, and both are possible.
    assert place_error(found, truth) > 1.0


def test_a_person_held_up_is_not_put_on_the_floor() -> None:
    scene, found = solved_duet("lift")
    up = np.array([0.0, np.cos(scene.pitch_rad), np.sin(scene.pitch_rad)])
    height = (found[:, :, ANKLES] @ up).min(axis=2) + scene.camera_height_m
    assert np.median(height[LIFTED, 1] - height[LIFTED, 0]) == pytest.approx(0.36, abs=0.12)
    assert np.abs(height[:, 0] - 0.07).max() < 0.12


def test_a_person_carried_all_the_time_is_held_to_the_carrier(monkeypatch: pytest.MonkeyPatch) -> None:
    people, truth, _ = seen_and_true("lift")
    carried = lifted(people)
    found, placed = solved(carried)
    up = np.array([0.0, np.cos(found.pitch_rad), np.sin(found.pitch_rad)])
    height = (placed[:, :, ANKLES] @ up).min(axis=2) + found.camera_height_m
    assert np.median(height[:, 1] - height[:, 0]) == pytest.approx(0.36, abs=0.1)
    assert place_error(placed, truth[LIFTED]) < 0.04
    monkeypatch.setattr(estimate, "_HELD_SHARE", 1.0)
    assert place_error(solved(carried)[1], truth[LIFTED]) > 0.05


def test_of_two_candidates_the_one_who_explains_more_is_carried(monkeypatch: pytest.MonkeyPatch) -> None:
    people, _, _ = seen_and_true("lift")
    carried = lifted(people)
    right, _ = solved(carried)
    costs, solve = {None: 40.0, 0: 20.0, 1: 10.0}, estimate.solve_scene

    def costing(terms: list[SceneTerm], *given: Any, **how: Any) -> Solution:
        off_floor = [term.person for term in terms if isinstance(term, FloorTerm) and term.is_carried]
        return replace(solve(terms, *given, **how), cost=costs[off_floor[0] if off_floor else None])

    monkeypatch.setattr(estimate, "solve_scene", costing)
    found, _ = solved(carried)
    assert found.camera_height_m == right.camera_height_m


def test_the_lowest_part_bears_a_person_without_a_foot_on_the_floor() -> None:
    people, truth, _ = seen_and_true("waltz", is_upside_down=True)
    _, found = solved(people)
    thought = np.stack([person.positions_m for person in people], axis=1)
    assert place_error(thought, truth) > 0.2
    assert place_error(found, truth) < 0.16


def test_a_known_height_of_the_camera_and_known_statures_give_sizes() -> None:
    people, truth, height_m = seen_and_true("waltz")
    scene, _ = solved(people, camera_height_m=height_m)
    assert scene.camera_height_m == pytest.approx(height_m, rel=0.03)
    _, found = solved(people, statures_m={0: 1.82, 1: 1.65})
    shins = (np.diff(motion[:, 0, OP14.legs[0][1:]], axis=1) for motion in (found, truth))
    length_m, true_length_m = (np.linalg.norm(shin, axis=-1).mean() for shin in shins)
    assert length_m / true_length_m == pytest.approx(1.0, abs=0.04)


def test_a_camera_that_looks_up_from_below_the_floor_is_found_there() -> None:
    people, truth, height_m = seen_and_true("waltz", pitch_rad=-0.45)
    assert height_m < -0.5
    # The second pitch puts the feet below the camera; a pitch one deviation off puts them above it.
    for guess_deg in (-24.0, -10.0):
        scene, found = solved(people, guess_deg)
        assert scene.camera_height_m == pytest.approx(height_m, abs=0.2)
        assert np.rad2deg(abs(scene.pitch_rad + 0.45)) < 3.0
        assert place_error(found, truth) < 0.06


def test_one_person_and_short_tracks_have_defined_answers() -> None:
    people, _, _ = seen_and_true("waltz")
    for count in (1, 2, 3, 40):
        cut = reconstruction(people[0].positions_m[:count], rate_hz=RATE_HZ, first_frame=5)
        scene, placed = solved([cut])
        assert placed.shape == (count, 1, 14, 3)
        assert np.isfinite(placed).all()
        assert np.isfinite(scene.pitch_deviation_rad)
