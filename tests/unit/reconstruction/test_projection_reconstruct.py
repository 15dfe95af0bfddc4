"""A track of keypoints becomes the motion it was projected from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec, yaw_rotmat
from pasdedeux.people.video import rate_from_times
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face, mid_hip, retarget_proportions
from pasdedeux.projections.scale import running_median
from pasdedeux.reconstruction import pitch
from pasdedeux.reconstruction.errors import (
    foot_slide_m,
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
    scale_free_error_m,
)
from pasdedeux.reconstruction.lying import ON_BELLY, is_on_floor, with_laid
from pasdedeux.reconstruction.matching import Method, ReconstructionOptions, Searcher, match_track
from pasdedeux.reconstruction.people import SequenceOptions, reconstruct_people
from pasdedeux.reconstruction.pitch import choose_pitch, floor_offset
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.tracks import Lens, Track, tracks_of
from pasdedeux.skeletons import OP14
from tests.builders.walkers import database_of, random_poses, walk

FOCAL_PX = 0.72 * 1920


def make_searcher(pitch_rad: float = 0.0) -> Searcher:
    return Searcher.of(database_of([walk(150, seed=seed) for seed in range(6)], camera=DatabaseCamera(pitch_rad)))


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    return make_searcher()


def film(
    world: np.ndarray, *, yaw: float = 0.4, pitch: float = 0.0, distance_m: float = 4.0
) -> tuple[Track, np.ndarray]:
    """Return the track of a walker seen by a pinhole, and the truth in camera axes."""
    camera: PinholeCamera = look_at_camera(
        mid_hip(world).mean(axis=0), distance_m=distance_m, yaw_rad=yaw, pitch_rad=pitch, focal_px=FOCAL_PX
    )
    px = camera.project(world).px
    track = Track(px, np.ones(px.shape[:2]), 24.0, Lens.assumed(1920, 1080, px))
    return track, (world - camera.position_m) @ camera.camera_from_world_rotmat.T


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.5])
def test_a_new_walk_is_reconstructed_near_the_truth_in_place_and_size(searcher: Searcher, yaw: float) -> None:
    world = walk(80, seed=11)
    track, truth = film(world, yaw=yaw)
    found = {method: reconstruct_track(searcher, track, method) for method in searcher.methods}
    for person in found.values():
        assert root_centred_error_m(person.positions_m, truth).mean() < 0.09
        assert np.linalg.norm(person.root_m - mid_hip(truth), axis=-1).mean() < 0.25
        lengths = bone_lengths(OP14, person.positions_m)
        np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], (80, 14)), atol=1e-9)
        np.testing.assert_allclose(lengths[0].sum(), REFERENCE_LENGTHS_M.sum())
    jitters = {method: jitter_m(person.positions_m - person.root_m[:, None]) for method, person in found.items()}
    assert jitters[Method.VITERBI] < 0.5 * jitters[Method.NEAREST]


def test_a_mirrored_image_gives_a_mirrored_person(searcher: Searcher) -> None:
    world = walk(60, seed=11)
    track, truth = film(world, yaw=0.3)
    swapped = list(OP14.mirror)
    mirrored_px = np.array([1920.0, 0.0]) + track.keypoints_px[:, swapped] * np.array([-1.0, 1.0])
    mirrored = Track(mirrored_px, track.confidence, 24.0, track.lens)
    found = reconstruct_track(searcher, mirrored)
    mirrored_truth = truth[:, swapped] * np.array([-1.0, 1.0, 1.0])
    # The left arm lifts in every walk of the database and the right one here: near, but never the unmirrored truth.
    assert root_centred_error_m(found.positions_m, mirrored_truth).mean() < 0.2
    assert (
        root_centred_error_m(found.positions_m, truth).mean()
        > root_centred_error_m(found.positions_m, mirrored_truth).mean()
    )


def test_the_pitch_of_the_camera_is_found() -> None:
    searchers = [make_searcher(pitch) for pitch in (0.0, 0.35, 0.7)]
    for true_pitch in (0.0, 0.35, 0.7):
        track, truth = film(walk(60, seed=3), pitch=true_pitch)
        chosen = choose_pitch(searchers, [track])
        assert abs(chosen.pitch_rad - true_pitch) < np.deg2rad(3.0)
        assert 0.0 < chosen.deviation_rad < np.deg2rad(5.0)
        found = reconstruct_track(searchers[0].pitched(chosen.pitch_rad), track)
        assert root_centred_error_m(found.positions_m, truth).mean() < 0.09


def test_a_camera_that_looks_up_is_distinguished_from_a_level_one() -> None:
    searchers = [make_searcher(pitch) for pitch in (-0.524, -0.175, 0.0, 0.35)]
    for true_pitch in (-0.48, -0.35, -0.12, 0.0):
        track, _ = film(walk(60, seed=3), pitch=true_pitch)
        assert abs(choose_pitch(searchers, [track]).pitch_rad - true_pitch) < np.deg2rad(3.0)


@pytest.mark.parametrize(("bow_rad", "true_pitch"), [(0.1, 0.35), (0.15, 0.175), (-0.1, 0.35)])
def test_a_flat_floor_gives_the_pitch_where_the_database_leans(
    bow_rad: float, true_pitch: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An upright person looks like one who bows, or leans back, before a camera of another pitch.
    bow = rotmat_from_unitquat(unitquat_from_rotvec(np.array([bow_rad, 0.0, 0.0])))
    poses = np.concatenate([centre_and_face(walk(150, seed=seed)).poses_m @ bow.T for seed in range(4)])
    pitches = (0.0, 0.175, 0.35, 0.525)
    searchers = [
        Searcher.of(Database(poses, np.tile(np.arange(150) == 0, 4), camera=DatabaseCamera(pitch))) for pitch in pitches
    ]
    track, _ = film(walk(120, seed=9, turn_rad=0.0), yaw=0.0, pitch=true_pitch)
    known = replace(track, lens=replace(track.lens, is_known=True))

    def nearest_pitch() -> float:
        chosen = choose_pitch(searchers, [known])
        return min(pitches, key=lambda tried: abs(tried - chosen.pitch_rad))

    assert nearest_pitch() == true_pitch
    monkeypatch.setattr(pitch, "_FLOOR_WEIGHT", 0.0)
    assert nearest_pitch() != true_pitch


def test_level_hips_give_the_pitch_of_a_bowing_person_where_nobody_bows_in_the_database() -> None:
    bow = rotmat_from_unitquat(unitquat_from_rotvec(np.array([0.3, 0.0, 0.0])))
    world = walk(120, seed=9, turn_rad=3.0)
    heading = yaw_rotmat(3.0 * np.arange(120) / 119)
    back = mid_hip(world)[:, None]
    bowed = back + np.einsum("fij,jk,flk,fnl->fni", heading, bow, heading, world - back)
    searchers = [make_searcher(pitch) for pitch in (0.0, 0.175, 0.35, 0.7)]
    track, _ = film(bowed, yaw=1.0, pitch=0.1, distance_m=6.0)
    assert abs(choose_pitch(searchers, [track]).pitch_rad - 0.1) < np.deg2rad(4.0)


def test_a_lying_person_says_little_about_the_pitch_which_alone_is_a_guess_between_level_and_steep() -> None:
    searchers = [make_searcher(pitch) for pitch in (0.0, 0.35, 0.7)]
    standing, _ = film(walk(60, seed=3), pitch=0.35)
    lying, _ = film(walk(60, seed=4) @ yaw_rotmat(0.4)[:, [0, 2, 1]], pitch=0.35)
    alone = choose_pitch(searchers, [lying])
    assert alone.is_guess
    assert 0.0 < alone.pitch_rad < np.deg2rad(30.0)
    assert alone.deviation_rad > np.deg2rad(8.0)
    both, without_lying = choose_pitch(searchers, [standing, lying]), choose_pitch(searchers, [standing])
    assert both.pitch_rad == pytest.approx(without_lying.pitch_rad, abs=np.deg2rad(1.5))
    assert not both.is_guess


def test_a_lying_person_is_found_among_upright_poses_laid_down_and_named_by_their_rows() -> None:
    searcher, world = make_searcher(0.5), walk(48, seed=11, turn_rad=0.0)
    hips = mid_hip(world)[:, None]
    track, truth = film(hips[:1] + (world - hips) @ ON_BELLY.T, yaw=1.1, pitch=0.5)
    (method,) = reconstruct_people(searcher, [track], SequenceOptions(has_clean_up=False)).methods
    upright = reconstruct_track(searcher, track, Method.FIT)
    assert root_centred_error_m(upright.positions_m, truth).mean() > 0.2
    assert root_centred_error_m(method.people[0].positions_m, truth).mean() < 0.07
    assert method.people[0].row.max() < searcher.database.num_rows
    assert not is_on_floor(film(world, yaw=1.1, pitch=0.5)[0])
    assert is_on_floor(track)
    legs = OP14.indices(["left_ankle", "right_ankle"])
    close = np.where(np.isin(np.arange(14), legs), 0.0, track.confidence)
    assert not is_on_floor(replace(track, confidence=close))


def test_poses_are_laid_only_on_a_back_that_bears() -> None:
    stretched = random_poses(np.random.default_rng(0), 1, spread=0.0)
    kneeling = stretched.copy()
    kneeling[:, OP14.indices(["left_ankle", "right_ankle"])] += [0.0, 0.3, -0.3]
    database = Database(np.concatenate([stretched, kneeling]), np.array([True, True]))
    laid = with_laid(Searcher.of(database))
    assert laid.source_row is not None
    assert laid.source_row.tolist() == [0, 1, 0, 1, 0]
    assert laid.pitched(0.2).source_row is laid.source_row
    on_belly, on_back = laid.database.poses_m[3], laid.database.poses_m[4]
    np.testing.assert_allclose(on_belly[:, 1], -kneeling[0, :, 2], atol=1e-6)
    np.testing.assert_allclose(on_back[:, 1], stretched[0, :, 2], atol=1e-6)


@pytest.mark.parametrize(("torso", "shoulders"), [(1.08, 0.75), (0.9, 1.3)])
def test_joints_missing_at_random_do_not_move_the_pitch(torso: float, shoulders: float) -> None:
    # The person has another build than the database; the neck, which anchors the image, is missing as often as others.
    searchers = [make_searcher(pitch) for pitch in (0.175, 0.35, 0.525)]
    build = np.ones(14)
    build[OP14.indices(["left_hip", "right_hip"])] = torso
    build[OP14.indices(["left_shoulder", "right_shoulder", "head"])] = shoulders
    track, _ = film(retarget_proportions(walk(240, seed=3), REFERENCE_LENGTHS_M * build), pitch=0.35)
    whole = choose_pitch(searchers, [track])
    assert abs(whole.pitch_rad - 0.35) < np.deg2rad(5.0)
    for share in (0.1, 0.25):
        is_hidden = np.random.default_rng(1).random(track.confidence.shape) < share
        partly = replace(track, keypoints_px=np.where(is_hidden[..., None], np.nan, track.keypoints_px))
        assert abs(choose_pitch(searchers, [partly]).pitch_rad - whole.pitch_rad) < np.deg2rad(1.25)


@pytest.mark.parametrize("method", [Method.VITERBI, Method.FIT])
def test_missing_joints_cost_little_and_empty_frames_are_bridged_and_marked(searcher: Searcher, method: Method) -> None:
    track, truth = film(walk(80, seed=11))
    hidden = np.random.default_rng(0).uniform(size=(80, 14)) < 0.3
    hidden[30:36] = True
    points = np.where(hidden[..., None], np.nan, track.keypoints_px)
    found = reconstruct_track(searcher, Track(points, ~hidden * 1.0, 24.0, track.lens), method)
    assert found.is_bridged[30:36].all()
    assert (found.num_joints_seen[30:36] == 0).all()
    assert np.isnan(found.score_m[30:36]).all()
    assert (found.row[30:36] == -1).all()
    full = root_centred_error_m(reconstruct_track(searcher, track, method).positions_m, truth).mean()
    assert root_centred_error_m(found.positions_m, truth).mean() < full + 0.04
    assert np.isfinite(found.positions_m).all()


def test_a_track_without_a_person_is_refused_with_the_reason(searcher: Searcher) -> None:
    empty = Track(np.full((5, 14, 2), np.nan), np.ones((5, 14)), 24.0, Lens(1000.0, (500.0, 500.0)))
    with pytest.raises(InputError, match="no frame of the track shows 4 joints"):
        match_track(searcher, empty)
    wrists = np.full((5, 14, 2), np.nan)
    wrists[:, ::4] = 100.0
    with pytest.raises(InputError, match="three bones"):
        match_track(searcher, Track(wrists, np.ones((5, 14)), 24.0, Lens(1000.0, (500.0, 500.0))))


def test_tracks_refuse_impossible_values() -> None:
    lens = Lens(1000.0, (0.0, 0.0))
    with pytest.raises(InputError, match="expected"):
        Track(np.zeros((3, 17, 2)), np.zeros((3, 17)), 24.0, lens)
    with pytest.raises(InputError, match="frame rate"):
        Track(np.zeros((3, 14, 2)), np.zeros((3, 14)), 0.0, lens)
    with pytest.raises(InputError, match="negative"):
        Track(np.zeros((3, 14, 2)), np.full((3, 14), -1.0), 24.0, lens)
    with pytest.raises(ValidationError, match="num_candidates"):
        ReconstructionOptions(num_candidates=0)


def test_the_floor_is_where_the_lowest_ankle_stands_in_upright_axes(searcher: Searcher) -> None:
    track, _ = film(walk(40, seed=2), pitch=0.0)
    found = reconstruct_track(searcher, track)
    camera = DatabaseCamera(0.3)
    moved = found.positions_m - floor_offset([found], camera)
    upright = moved @ camera.camera_from_upright_rotmat
    assert upright[:, OP14.indices(["left_ankle", "right_ankle"]), 1].min() == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(mid_hip(upright[0])[[0, 2]], 0.0, atol=1e-9)


def test_tracks_keep_gaps_and_people_apart() -> None:
    frame = np.array([3, 4, 4, 7])
    person = np.array([0, 0, 5, 0])
    points = np.arange(4 * 28, dtype=float).reshape(4, 14, 2)
    columns = {
        "sequence_id": ["walk"] * 4,
        "frame": frame,
        "person_id": person,
        "partner_id": [None, 5, 0, None],
        "time_s": frame / 25.0,
        "op14_px": points,
        "op14_confidence": np.ones((4, 14)),
        "image_width_px": [640] * 4,
        "image_height_px": [480] * 4,
        "focal_px": [None] * 4,
    }
    tracks = tracks_of(columns, "walk")
    assert [track.person_id for track in tracks] == [0, 5]
    assert tracks[0].frames.tolist() == [3, 4, 5, 6, 7]
    assert tracks[0].rate_hz == pytest.approx(25.0)
    np.testing.assert_allclose(tracks[0].times_s, np.arange(3, 8) / 25.0)
    assert (tracks[0].confidence[[2, 3]] == 0).all()
    np.testing.assert_array_equal(tracks[0].keypoints_px[4], points[3])
    assert (tracks[0].partner_id, tracks[1].partner_id) == (None, 0)
    assert (tracks[0].lens.principal_point_px, tracks[0].lens.is_known) == ((320.0, 240.0), False)
    assert tracks_of(columns, "run") == []
    with pytest.raises(InputError, match="twice"):
        tracks_of(columns | {"person_id": np.zeros(4)}, "walk")
    with pytest.raises(InputError, match="do not grow"):
        rate_from_times(frame, np.zeros(4))


def test_an_unknown_image_size_puts_the_middle_where_the_people_are() -> None:
    points = np.full((2, 14, 2), np.nan)
    points[:, :3] = [[100.0, 50.0], [300.0, 250.0], [200.0, 100.0]]
    lens = Lens.assumed(None, None, points)
    assert lens.principal_point_px == (200.0, 150.0)
    assert lens.focal_px > 0


def test_running_medians_skip_what_is_unknown() -> None:
    values = np.array([np.nan, 1.0, 9.0, 1.0, np.nan, np.nan, np.nan, 4.0])
    np.testing.assert_allclose(running_median(values, 3), [1.0, 5.0, 1.0, 5.0, 1.0, 1.0, 4.0, 4.0])
    with pytest.raises(InputError, match="no finite"):
        running_median(np.full(3, np.nan), 3)


def test_error_measures_ignore_what_they_state() -> None:
    world = walk(30)
    moved = world @ yaw_rotmat(0.8).T + np.array([1.0, 2.0, 3.0])
    assert root_centred_error_m(world + 5.0, world).max() < 1e-12
    assert root_centred_error_m(moved, world).mean() > 0.1
    assert root_removed_error_m(moved, world).max() < 1e-9
    assert scale_free_error_m(1.3 * world, world).max() < 1e-9


def test_jitter_is_the_mean_length_of_second_differences_over_joints_and_frames() -> None:
    pull_m = np.random.default_rng(0).normal(size=(14, 3))
    thrown = 0.5 * np.arange(6.0)[:, None, None] ** 2 * pull_m + np.arange(6.0)[:, None, None]
    assert jitter_m(thrown) == pytest.approx(np.linalg.norm(pull_m, axis=1).mean())
    assert jitter_m(thrown[:2]) == 0.0


def test_feet_slide_where_they_stand_in_the_truth_alone() -> None:
    true = np.zeros((6, 14, 3))
    true[3:, :, 0] = 0.5 * np.arange(1, 4)[:, None]  # three frames of standing, then a run
    slid = true.copy()
    slid[:, :, 2] = 0.1 * np.arange(6)[:, None]
    slid[0, :, 1] = -3.0  # who sinks once is judged in the same frames
    assert foot_slide_m(slid, true, rate_hz=30.0) == pytest.approx(0.1)
    assert foot_slide_m(true, true, rate_hz=30.0) == 0.0
    slid[0] = np.nan
    assert foot_slide_m(slid, true, rate_hz=30.0) == pytest.approx(0.1)
    assert foot_slide_m(slid[:1], true[:1], rate_hz=30.0) == 0.0
