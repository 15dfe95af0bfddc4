"""Expected errors, doubts and verdicts of a reconstruction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.people.decisions import Decision, decide
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction import people
from pasdedeux.reconstruction.ambiguity import doubt_of_camera, may_lie
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.lying import ON_BELLY, is_on_floor
from pasdedeux.reconstruction.matching import Method, Searcher
from pasdedeux.reconstruction.people import SequenceOptions, reconstruct_people
from pasdedeux.reconstruction.pitch import PitchEstimate, choose_pitch
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.reliability import (
    PlaceReliability,
    Reliability,
    camera_doubt,
    judge_person,
    judge_tracks,
    left_out_misfit_m,
)
from pasdedeux.reconstruction.scene import SceneEstimate
from pasdedeux.reconstruction.tracks import Lens, Track, broken_doubts
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level
from tests.builders.walkers import database_of, random_poses, walk

LENS = Lens(1400.0, (960.0, 540.0))
NAMES = np.repeat(np.arange(4).astype(str), 96).astype(object)
"""Of the motion of each row of the database."""


def searcher_over(num_walks: int) -> Searcher:
    walks = [walk(96, seed=seed) for seed in range(num_walks)]
    return Searcher.of(database_of(walks, num_yaws=30, rate_hz=24.0, camera=DatabaseCamera()))


def seen(world: np.ndarray, *, hidden: float = 0.0, middle: np.ndarray | None = None) -> Track:
    """Film a motion from five metres, level."""
    centre = world.mean(axis=(0, 1)) if middle is None else middle
    depth = 5.0 - (world[..., 2] - centre[2])
    px = np.stack(
        [960 + 1400 * (world[..., 0] - centre[0]) / depth, 540 - 1400 * (world[..., 1] - centre[1]) / depth], -1
    )
    is_hidden = np.random.default_rng(3).random(px.shape[:2]) < hidden
    return Track(np.where(is_hidden[..., None], np.nan, px), np.where(is_hidden, 0.0, 0.9), 24.0, LENS)


def camera_before(
    world: np.ndarray, pitch_rad: float, *, yaw_rad: float = 0.3, distance_m: float = 5.0
) -> PinholeCamera:
    """Return a camera that looks at the middle of a motion."""
    middle = mid_hip(world).reshape(-1, 3).mean(axis=0)
    return look_at_camera(middle, distance_m=distance_m, yaw_rad=yaw_rad, pitch_rad=pitch_rad, focal_px=1400.0)


def seen_by(camera: PinholeCamera, world: np.ndarray, *, is_known: bool = False) -> Track:
    return Track(camera.project(world).px, np.ones(world.shape[:2]), 24.0, replace(LENS, is_known=is_known))


def couple_seen() -> list[Track]:
    """Return the tracks of two people who walk beside each other."""
    both = np.stack([walk(48, seed=2), walk(48, seed=2) + np.array([1.0, 0.0, 0.0])], axis=1)
    middle = both.mean(axis=(0, 1, 2))
    return [replace(seen(both[:, person], middle=middle), person_id=person, partner_id=1 - person) for person in (0, 1)]


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    return searcher_over(4)


def test_motion_that_the_database_lacks_is_reported_and_has_larger_errors(searcher: Searcher) -> None:
    left_out = left_out_misfit_m(searcher.database, searcher.index, NAMES)
    known, foreign = walk(48, seed=2), np.repeat(random_poses(np.random.default_rng(4), 6), 8, axis=0)
    errors_m, judged = [], []
    for world in (known, foreign):
        track = reconstruct_track(searcher, seen(world), Method.FIT)
        errors_m.append(root_centred_error_m(track.positions_m, world).mean())
        judged.append(judge_person(track, left_out))
    assert errors_m[0] < errors_m[1]
    assert judged[0].expected_error_m < judged[1].expected_error_m
    assert [reliability.is_lacking for reliability in judged] == [False, True]
    assert judged[0].verdict.level is Level.PASS
    assert "the database lacks this motion" in judged[1].verdict.reason
    far = replace(judged[0], left_out_m=judged[0].misfit_m / 1.6).verdict
    assert far.level is Level.FAIL
    assert "what would help: takes of such motion in the database, it is farthest at " in far.reason


def test_joints_not_seen_are_a_warning_with_their_share(searcher: Searcher) -> None:
    judged = judge_person(reconstruct_track(searcher, seen(walk(48, seed=2), hidden=0.5), Method.FIT))
    assert judged.share_seen == pytest.approx(0.5, abs=0.05)
    assert judged.verdict.level is Level.WARN
    assert "% of the joints are seen" in judged.verdict.reason


def test_the_left_out_misfit_is_that_of_a_search_without_the_own_motion(searcher: Searcher) -> None:
    found = left_out_misfit_m(searcher.database, searcher.index, NAMES)
    rng = np.random.default_rng(1)
    rows, yaws = evenly_spread(searcher.database.num_rows, 128), rng.uniform(0.0, 30, 128)
    plain = []
    for row, yaw in zip(rows, yaws, strict=True):
        projections = searcher.database.project()[NAMES[row] != NAMES].reshape(-1, 14, 2)
        query = searcher.database.camera.project(searcher.database.turned(row, yaw))
        plain.append(np.linalg.norm(projections - query, axis=-1).mean(axis=-1).min())
    assert 0.5 * np.percentile(plain, 95) < found < 1.2 * np.percentile(plain, 95)
    assert found == left_out_misfit_m(searcher.database, searcher.index, NAMES)
    alone = searcher_over(1)
    assert np.isnan(left_out_misfit_m(alone.database, alone.index, NAMES[:96]))


def test_a_pitch_at_the_edge_of_what_was_tried_or_badly_known_is_a_doubt() -> None:
    pitches = np.deg2rad([0.0, 20.0, 45.0])
    well, badly = np.deg2rad([2.0, 7.0])
    (doubt,) = camera_doubt(pitches, PitchEstimate(pitches[2], well))
    assert "45 +- 2.0 degrees, at the edge of what was tried" in doubt
    assert camera_doubt(pitches, PitchEstimate(pitches[1], badly)) == ("camera pitch 20 +- 7.0 degrees",)
    for index in (0, 1):
        assert camera_doubt(pitches, PitchEstimate(pitches[index], well)) == ()
    assert camera_doubt([0.8], PitchEstimate(0.8)) == ()
    below = np.deg2rad([-10.0, 0.0, 20.0])
    assert "-10 +- 2.0 degrees, at the edge" in camera_doubt(below, PitchEstimate(below[0], well))[0]
    assert camera_doubt(below, PitchEstimate(0.5 * below[0], well)) == ()
    good = Reliability(0.05, 0.01, 0.05, 1.0, 0.0)
    assert good.verdict.level is Level.PASS
    assert replace(good, doubts=(doubt,)).verdict.level is Level.WARN


def test_a_guessed_pitch_is_a_doubt_that_says_how_to_state_it() -> None:
    (doubt,) = camera_doubt([0.0, 0.5], PitchEstimate(0.3, 0.2, is_guess=True))
    assert doubt.startswith("nobody is seen standing")
    assert "--pitch" in doubt


def lasting(first: int, last: int, person_id: int, *, x_px: float = 0.0, size: float = 1.0) -> Track:
    track = seen(walk(last - first + 1, seed=2))
    middle = np.array([960.0, 540.0])
    px = (track.keypoints_px - middle) * size + middle + [x_px, 0.0]
    return replace(track, keypoints_px=px, person_id=person_id, first_frame=first)


def test_a_track_that_ends_where_another_begins_is_reported_with_the_row_that_joins_them() -> None:
    tracks = [lasting(0, 40, 0), lasting(0, 90, 1, x_px=700.0), lasting(45, 90, 2)]
    doubts = broken_doubts("clip", tracks)
    assert sorted(doubts) == [0, 2]
    assert "0 ends where 2 begins: the same person?" in doubts[0]
    row = doubts[0].rsplit(": ", 1)[1]
    frame = np.concatenate([track.frames for track in tracks])
    person = np.repeat([0, 1, 2], [len(track.frames) for track in tracks])
    assert set(decide("clip", frame, person, [Decision.from_words(row)])) == {0, 1}


def test_few_frames_and_a_stature_against_the_height_of_the_camera_are_doubts(searcher: Searcher) -> None:
    # The camera is as high as the middle of the walker, 0.8 m.
    for length, statures_m, height_m in ((5, {}, None), (48, {0: 1.7}, 1.6)):
        options = SequenceOptions(statures_m=statures_m)
        found = reconstruct_people(searcher, [seen(walk(length, seed=2))], options, camera_height_m=height_m)
        (judged,) = judge_tracks(found).verdicts.values()
        assert judged.level is Level.WARN
        assert ("0.2 s are too short" if length == 5 else "person 0 of 1.70 m would be") in judged.reason


def test_statures_that_contradict_each_other_are_doubts_of_people_and_place(searcher: Searcher) -> None:
    tracks = couple_seen()
    for stated, says in (
        ({0: 1.7, 1: 1.7}, ""),
        ({0: 1.7, 1: 1.1}, "by person 1 of 1.10 m: one of both statures is wrong"),
        ({0: 2.5}, "person 1 would be 2.5"),
    ):
        found = reconstruct_people(searcher, tracks, SequenceOptions(statures_m=stated))
        quality = judge_tracks(found)
        judged = quality.verdicts
        assert found.has_stature == (not says)
        assert set(judged) == {"person 0", "person 1", "place of 0 and 1"}
        unstated = judge_tracks(replace(found, has_stature=False))
        for known, unknown in ((quality.people[0], unstated.people[0]), (quality.places[0, 1], unstated.places[0, 1])):
            assert found.has_stature == (known.expected_error_m < 0.9 * unknown.expected_error_m)
        assert bool(says) == (judged["person 0"].level is not Level.PASS)
        assert all(says in verdict.reason for verdict in judged.values())


def test_the_place_of_a_partner_who_is_farther_away_than_the_other_is_less_well_known(searcher: Searcher) -> None:
    near, far = couple_seen()
    # The second track is longer; only frames of both count.
    found = reconstruct_people(searcher, [near, replace(far, first_frame=5)])
    *before, last = found.methods
    near, far = last.people
    expected = []
    for away_m in (0.0, 1.0, 2.0):
        moved = replace(far, root_m=far.root_m * [1.0, 1.0, 0.0] + [0.0, 0.0, near.root_m[:, 2].mean() - away_m])
        people = (replace(near, root_m=near.root_m * [1, 1, 0] + [0, 0, near.root_m[:, 2].mean()]), moved)
        judged = judge_tracks(replace(found, methods=(*before, replace(last, people=people))))
        expected.append(judged.places[0, 1].expected_error_m)
    assert found.scene is not None
    stated_m = found.scene.place_deviation_m[0, 1]
    weight = np.log(expected[1] / expected[0]) / np.log(np.hypot(stated_m, 0.3) / stated_m)
    assert 0.5 < weight < 1.2
    assert expected[2] / expected[0] == pytest.approx((np.hypot(stated_m, 0.6) / stated_m) ** weight)


@pytest.mark.parametrize(("height_m", "stature_m"), [(6.0, None), (0.8, 1.7), (0.8, 2.4)])
def test_a_height_that_makes_giants_is_a_doubt(searcher: Searcher, height_m: float, stature_m: float | None) -> None:
    stated = {} if stature_m is None else {0: stature_m}
    track = seen(walk(48, seed=2))
    found = reconstruct_people(searcher, [track], SequenceOptions(statures_m=stated), camera_height_m=height_m)
    assert bool(found.doubts) == ((height_m, stature_m) != (0.8, 1.7))
    assert found.scene is not None
    if stature_m is None:
        assert "that height is wrong, or the pitch" in found.doubts[0]
        assert found.scene.sizes[0] == pytest.approx(1.0, abs=0.25)


def test_a_height_does_not_size_a_person_without_feet_below_the_camera(searcher: Searcher) -> None:
    track = seen(walk(48, seed=2))
    above = replace(track, keypoints_px=track.keypoints_px - [0.0, 400.0])
    found = reconstruct_people(searcher, [above], SequenceOptions(statures_m={0: 1.3}), camera_height_m=1.5)
    assert found.doubts == ()


@pytest.mark.parametrize("kind", ["overhead", "lying", "five frames"])
def test_without_evidence_of_the_camera_the_place_fails_and_nobody_passes(searcher: Searcher, kind: str) -> None:
    worlds = np.stack([walk(48, seed=2), walk(48, seed=3) + np.array([1.2, 0.0, 0.3])], axis=1)
    if kind == "lying":
        worlds = worlds @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    camera = camera_before(worlds, np.deg2rad({"overhead": 85.0, "lying": 20.0, "five frames": 10.0}[kind]))
    shown = worlds[: 5 if kind == "five frames" else None]
    tracks = [replace(seen_by(camera, shown[:, person]), person_id=person, partner_id=1 - person) for person in (0, 1)]
    pitches = [0.0, 0.25, 0.5]
    pitch = choose_pitch([searcher.pitched(tried) for tried in pitches], tracks)
    found = reconstruct_people(searcher.pitched(pitch.pitch_rad), tracks, pitch=pitch)
    quality = judge_tracks(found, pitches_rad=pitches)
    judged = quality.verdicts
    assert judged["place of 0 and 1"].level is Level.FAIL
    is_laid = kind != "five frames"
    assert ("person 1 is not seen upright" in judged["place of 0 and 1"].reason) == is_laid
    assert quality.people[0].evidence[-1] == is_laid
    says = "0.2 s are too short" if kind == "five frames" else "nobody is seen standing"
    for verdict in judged.values():
        assert verdict.level is not Level.PASS
        assert says in verdict.reason


@pytest.mark.parametrize(("kind", "says"), [("stands", ""), ("lies", "person 0 may lie, feet to the steep camera")])
def test_an_image_with_a_second_reading_fails_and_names_it(searcher: Searcher, kind: str, says: str) -> None:
    world = walk(48, seed=2, turn_rad=0.0)
    if kind == "lies":
        world = world @ ON_BELLY.T
    # A person on the belly has the head towards +Z, so the camera is at the feet.
    pitch = PitchEstimate(np.deg2rad(40.0), 0.03)
    track = seen_by(camera_before(world, pitch.pitch_rad, yaw_rad=np.pi if kind == "lies" else 0.3), world)
    assert not is_on_floor(track)
    found = reconstruct_people(searcher.pitched(pitch.pitch_rad), [track], pitch=pitch)
    (judged,) = judge_tracks(found).verdicts.values()
    assert bool(says) == (judged.level is Level.FAIL)
    assert says in judged.reason


@pytest.mark.parametrize(
    ("ratios", "is_doubt"),
    [
        ([1.05] * 4, True),
        ([1.05, 1.05, 1.05, 2.5], False),
        ([1.05, 2.5, 1.05, 1.05], False),
        ([2.5] * 4, False),
        ([4.0, 4.0, 4.0, 0.3], True),
        ([1.3] * 4, False),
    ],
)
def test_standing_on_one_leg_is_no_doubt_and_lying_down_late_is(ratios: list[float], is_doubt: bool) -> None:
    upright = 0.02 + 0.01 * np.random.default_rng(1).random(20)
    assert may_lie(upright * np.repeat(ratios, 5), upright, frames_per_s=5.0) == is_doubt
    assert not may_lie(np.zeros(0), np.zeros(0), frames_per_s=5.0)


def test_a_camera_that_looks_up_from_below_the_floor_is_found_and_reported(searcher: Searcher) -> None:
    world = walk(48, seed=2)
    camera = camera_before(world, np.deg2rad(-28.0))
    track = seen_by(camera, world, is_known=True)
    tried = np.deg2rad([-30.0, 0.0, 20.0]).tolist()
    pitch = choose_pitch([searcher.pitched(pitch_rad) for pitch_rad in tried], [track])
    found = reconstruct_people(searcher.pitched(pitch.pitch_rad), [track], pitch=pitch)
    assert found.scene is not None
    assert np.rad2deg(found.pitch.pitch_rad) == pytest.approx(-28.0, abs=4.0)
    assert found.scene.camera_height_m == pytest.approx(camera.position_m[1], abs=0.5)
    (judged,) = judge_tracks(found, pitches_rad=tried).verdicts.values()
    assert judged.level is Level.WARN
    assert "m below the floor, as before a stage" in judged.reason
    stated = reconstruct_people(searcher.pitched(0.0), [track], pitch=pitch, camera_height_m=1.0)
    assert stated.scene is not None
    assert stated.scene.camera_height_m > 0.0
    # A stature does not contradict a camera below the floor, and is not used if its person is not reconstructed.
    unseen = replace(track, confidence=np.zeros((48, 14)), person_id=1)
    for name, is_used in ((0, True), (1, False)):
        tall = reconstruct_people(
            searcher.pitched(pitch.pitch_rad), [track, unseen], SequenceOptions(statures_m={name: 1.8}), pitch=pitch
        )
        assert set(tall.skipped) == {1}
        assert tall.doubts[0].endswith("state its height (--height, in a study camera_height_m)")
        assert tall.has_stature is is_used


def test_searches_under_two_pitches_are_compared_by_the_people_that_both_have(searcher: Searcher) -> None:
    tracks = [replace(seen(walk(24, seed=2)), person_id=name) for name in (0, 1)]
    both = reconstruct_people(searcher, tracks)
    last = both.methods[-1]
    farther = replace(last.people[0], score_m=1.1 * last.people[0].score_m)
    alone = replace(both, methods=(replace(last, people=(farther,)),))
    assert people._is_nearer(both, alone)
    assert not people._is_nearer(alone, both)
    assert not people._is_nearer(replace(both, methods=()), both)


def test_poses_are_searched_again_at_a_nearer_pitch(searcher: Searcher, monkeypatch: pytest.MonkeyPatch) -> None:
    world = walk(96, seed=7)
    right, wrong = (PitchEstimate(np.deg2rad(pitch_deg), np.deg2rad(15.0)) for pitch_deg in (20.0, 0.0))
    camera = camera_before(world, right.pitch_rad, distance_m=4.0)
    track = seen_by(camera, world, is_known=True)
    truth = (world - camera.position_m) @ camera.camera_from_world_rotmat.T

    def error_m(pitch: PitchEstimate, least_rad: float) -> float:
        monkeypatch.setattr(people, "_OTHER_PITCH_RAD", least_rad)
        found = reconstruct_people(searcher.pitched(pitch.pitch_rad), [track], pitch=pitch)
        return float(root_centred_error_m(found.methods[-1].people[0].positions_m, truth).mean())

    assert error_m(wrong, people._OTHER_PITCH_RAD) < 0.6 * error_m(wrong, np.inf)
    once = error_m(right, np.inf)
    monkeypatch.setattr(people, "_PITCHES_RAD", (0.0, 0.01))
    assert error_m(right, 0.1) == once, "0.01 is farther from the image"


def test_an_implausible_camera_is_a_doubt_if_it_was_not_stated() -> None:
    good = SceneEstimate(0.1, 0.02, 0.0, 1.5, 1.2, np.ones(1), (), {})
    low, wide = replace(good, camera_height_m=0.3), replace(good, lens_factor=0.3)
    below = replace(good, camera_height_m=-1.5)
    known = {"is_lens_known": False, "is_height_given": False}
    assert doubt_of_camera(good, **known) == ""
    assert doubt_of_camera(below, **known) == ""
    assert "implausible camera: 0.30 m above the floor" in doubt_of_camera(low, **known)
    assert doubt_of_camera(low, is_lens_known=False, is_height_given=True) == ""
    assert "focal length 0.30 of the assumed one" in doubt_of_camera(wide, **known)
    assert "1.50 m below the floor" in doubt_of_camera(replace(wide, camera_height_m=-1.5), **known)
    assert doubt_of_camera(wide, is_lens_known=True, is_height_given=False) == ""


def test_a_pitch_at_the_edge_raises_the_expected_error(searcher: Searcher) -> None:
    found = reconstruct_people(searcher, [seen(walk(48, seed=2))], pitch=PitchEstimate(0.1, 0.02))
    expected = [
        judge_tracks(found, pitches_rad=tried).people[0].expected_error_m for tried in ([-1.0, 1.0], [-1.0, -0.9])
    ]
    assert expected[1] > 1.15 * expected[0]
    of_one = judge_tracks(found, pitches_rad=[0.1]).people[0]
    assert of_one.expected_error_m == expected[0]


def test_people_below_the_middle_of_the_image_leave_the_pitch_as_well_known_as_others(searcher: Searcher) -> None:
    """Images give the pitch of the rays to people, which is larger than that of the camera."""
    found = []
    for below_rad in (0.0, 0.25):
        track = seen(walk(48, seed=2))
        px = track.keypoints_px + np.array([0.0, 1400.0 * np.tan(below_rad)])
        track = replace(track, keypoints_px=px, lens=replace(LENS, is_known=True))
        pitch = PitchEstimate(below_rad, 0.03)
        reconstructed = reconstruct_people(searcher.pitched(below_rad), [track], pitch=pitch)
        assert reconstructed.pitch.pitch_rad == pytest.approx(0.0, abs=0.06)
        found.append(reconstructed.pitch.deviation_rad)
    assert found[1] < 1.5 * found[0]


def test_a_badly_known_place_warns_then_fails_and_says_what_would_help() -> None:
    assert [PlaceReliability(error).verdict.level for error in (0.1, 0.25, 0.6)] == [Level.PASS, Level.WARN, Level.FAIL]
    assert (
        "25 cm (9 to 51); what would help: a stature (--stature, in a study statures_m)"
        in PlaceReliability(0.25).verdict.reason
    )


def test_large_expected_errors_and_hardly_anything_seen_fail() -> None:
    good = Reliability(0.05, 0.01, 0.05, 1.0, 0.0)
    assert replace(good, expected_error_m=0.12).verdict.level is Level.WARN
    far = replace(good, expected_error_m=0.3, farthest_s=2.5).verdict
    assert far.level is Level.FAIL
    assert "what would help: takes of such motion in the database, it is farthest at 2.5 s" in far.reason
    assert replace(good, share_seen=0.2).verdict.level is Level.FAIL
    lacking = replace(good, misfit_m=0.06)
    assert replace(lacking, is_unproven=False).verdict.level is Level.WARN
    assert replace(lacking, is_unproven=True).verdict.level is Level.FAIL
    assert replace(good, share_bridged=0.5).verdict.level is Level.WARN
    assert replace(good, expected_error_m=float("nan"), left_out_m=float("nan")).verdict.level is Level.PASS
