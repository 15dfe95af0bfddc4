"""Two people are placed to each other by pairs that look like both, and left alone where nothing looks like them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, mid_hip, retarget_proportions
from pasdedeux.reconstruction.matching import Method, Searcher
from pasdedeux.reconstruction.people import ReconstructedPeople, SequenceOptions, reconstruct_people
from pasdedeux.reconstruction.tracks import Lens, Track
from tests.builders.walkers import walk

FRAMES = 96
FOCAL_PX, ASSUMED_FOCAL_PX = 1400.0, 1000.0
SIZES = (1.05, 0.92)


def couple(num_frames: int, *, start_s: float = 0.0) -> np.ndarray:
    """Return two walkers (frame, person, 14, 3) who circle each other 0.8 m apart, face to face."""
    frames = round(start_s * 24.0) + num_frames
    worlds = [walk(frames, seed=3 + person, turn_rad=0.0) for person in (0, 1)]
    angle = 2.2 * np.arange(frames) / 24.0
    people = []
    for world, turn in zip(worlds, (0.0, np.pi), strict=True):
        away = world - (mid_hip(world) * [1.0, 0.0, 1.0])[:, None] - [0.0, 0.0, 0.4]  # they face +Z
        people.append(np.einsum("fij,fnj->fni", yaw_rotmat(angle + turn), away))
    return np.stack(people, axis=1)[-num_frames:]


@cache
def database() -> tuple[Searcher, np.ndarray]:
    pairs = couple(240)
    poses = centre_and_face(retarget_proportions(np.concatenate([pairs[:, 0], pairs[:, 1]]))).poses_m
    searcher = Searcher.of(Database(poses, np.arange(480) % 240 == 0))
    return searcher, centre_pairs(pairs)


@cache
def filmed() -> tuple[list[Track], np.ndarray]:
    """Return tracks of two people of other sizes, by a lens that is not assumed, and the truth in camera axes."""
    world = couple(FRAMES, start_s=1.03) * np.array(SIZES)[:, None, None]
    hips = mid_hip(world)
    world += (mid_hip(couple(FRAMES, start_s=1.03)) - hips)[:, :, None] * [1.0, 0.0, 1.0]
    camera = look_at_camera(hips.mean(axis=(0, 1)), distance_m=4.0, yaw_rad=0.4, pitch_rad=0.0, focal_px=FOCAL_PX)
    px = camera.project(world).px
    lens = Lens(ASSUMED_FOCAL_PX, (960.0, 540.0))
    tracks = [
        Track(px[:, number], np.ones((FRAMES, 14)), 24.0, lens, number, partner_id=1 - number) for number in (0, 1)
    ]
    return tracks, (world - camera.position_m) @ camera.camera_from_world_rotmat.T


def depth_error(found: ReconstructedPeople, truth: np.ndarray) -> float:
    first, second = (person.root_m[:, 2] for person in found.methods[-1].people)
    true = mid_hip(truth[:, 1])[:, 2] - mid_hip(truth[:, 0])[:, 2]
    return float(np.abs(second - first - true).mean())


def reconstructed(tracks: list[Track], pairs: np.ndarray | None, method: Method) -> ReconstructedPeople:
    return reconstruct_people(database()[0], tracks, SequenceOptions([method], has_clean_up=False), pairs_m=pairs)


def test_pairs_find_the_depth_between_two_people() -> None:
    tracks, truth = filmed()
    alone = reconstructed(tracks, None, Method.VITERBI)
    placed = reconstructed(tracks, database()[1], Method.VITERBI)
    assert depth_error(placed, truth) < depth_error(alone, truth)
    assert depth_error(placed, truth) < 0.2
    scene = placed.scene
    assert scene is not None
    # Only relative sizes of people are known; the lens follows from the depths of pairs.
    assert scene.sizes[0] / scene.sizes[1] == pytest.approx(SIZES[0] / SIZES[1], rel=0.1)
    assert scene.lens_factor == pytest.approx(FOCAL_PX / ASSUMED_FOCAL_PX, rel=0.25)
    assert abs(placed.pitch.pitch_rad) < np.deg2rad(4.0)


def test_a_stated_focal_length_is_kept() -> None:
    tracks, truth = filmed()
    known = Lens(FOCAL_PX, (960.0, 540.0), is_known=True)
    stated = [replace(track, lens=known) for track in tracks]
    placed = reconstructed(stated, database()[1], Method.VITERBI)
    assert placed.scene is not None
    assert placed.scene.lens_factor == pytest.approx(1.0, abs=0.05)
    assert depth_error(placed, truth) < 0.2


def test_the_baseline_is_left_where_everybodys_own_size_puts_them() -> None:
    tracks, _ = filmed()
    with_pairs, without = (reconstructed(tracks, pairs, Method.NEAREST) for pairs in (None, database()[1]))
    assert with_pairs.scene is None
    for person, same in zip(with_pairs.methods[-1].people, without.methods[-1].people, strict=True):
        np.testing.assert_array_equal(person.positions_m, same.positions_m)


def test_pairs_that_look_like_nobody_move_people_little() -> None:
    tracks, truth = filmed()
    rng = np.random.default_rng(0)
    strangers = np.stack([walk(60, seed=50 + person, turn_rad=6.0) for person in (0, 1)], axis=1)
    strangers[:, 1] += rng.normal(0.0, 1.0, (60, 1, 3)) * [0.3, 0.6, 1.0]
    alone = reconstructed(tracks, None, Method.VITERBI)
    placed = reconstructed(tracks, centre_pairs(strangers), Method.VITERBI)
    assert depth_error(placed, truth) < depth_error(alone, truth) + 0.1


def test_gaps_and_tracks_that_only_overlap_are_placed_where_both_are_seen() -> None:
    tracks, _ = filmed()
    first, second = tracks
    seen = second.confidence.copy()
    seen[20:30] = 0.0
    late = Track(second.keypoints_px[8:], seen[8:], 24.0, second.lens, 1, 8, 8 / 24.0, 0)
    placed = reconstructed([first, late], database()[1], Method.VITERBI)
    for person, frames in zip(placed.methods[-1].people, (FRAMES, FRAMES - 8), strict=True):
        assert person.positions_m.shape == (frames, 14, 3)
        assert np.isfinite(person.positions_m).all()
