"""Find the motion of a hand-held camera from the background or from keypoints, and subtract it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.interpolate import interp1d

from pasdedeux.film.annotating import annotate_shot
from pasdedeux.film.camera import LOST, CameraFollower
from pasdedeux.film.shots import at_constant_rate
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.reconstruction.moving_camera import moving_camera_doubt, share_alike, subtract_motion
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tests.builders.rendered_film import Bodies, Film, duet_bodies, hand_held, render, rows_of

COUNT = 31
MOVES = {"still": {}, "shaken": {"shake_px": 40.0}, "panned": {"pan_rad": 0.3}, "zoomed": {"zoom": 1.3}}


@cache
def bodies() -> Bodies:
    return duet_bodies("waltz", seconds=1.1, frames=slice(COUNT))


@cache
def filmed(kind: str = "still", *, turn_rad: float = 0.0) -> tuple[Film, AnnotatedFrames]:
    """Return film of a camera that moves so, and its people tracked between key frames; neither may be changed."""
    film = render(bodies(), yaw_rad=0.2, turn_rad=turn_rad, moves=hand_held(COUNT, **MOVES[kind]), blur=1, seed=3)
    return film, annotated(film, rows_of(film, [0, 10, 20, 30]))


def annotated(film: Film, keys: AnnotatedFrames) -> AnnotatedFrames:
    return annotate_shot(keys, iter(film.images), 0, COUNT, is_key=True).frames


def distances_px(film: Film, frames: AnnotatedFrames) -> np.ndarray:
    """Return the distance of every joint (frame, person, joint) from the truth."""
    px = np.full(film.px.shape, np.nan)
    px[frames.frame, frames.person_id] = frames.keypoints_px
    return np.linalg.norm(px - film.px, axis=-1)


def tracks_of_px(px: np.ndarray) -> list[Track]:
    """Return tracks of pair17 keypoints (frame, person, 17, 2)."""
    lens = Lens(800.0, (320.0, 240.0))
    tracks = []
    for person in range(px.shape[1]):
        joints = KEYPOINT_LAYOUTS[PAIR17.name].derive("op14", px[:, person], np.ones(px[:, person].shape[:-1]))
        tracks.append(Track(joints.positions, joints.confidence, 30.0, lens, person))
    return tracks


@pytest.mark.parametrize("kind", ["shaken", "panned", "zoomed"])
def test_people_are_where_a_still_camera_would_see_them(kind: str) -> None:
    film, frames = filmed(kind)
    motion = frames.camera_motion["film"]
    middle = np.median(hand_held(COUNT, **MOVES[kind]), axis=0)
    still = render(bodies(), yaw_rad=0.2, turn_rad=0.0, moves=np.tile(middle, (COUNT, 1)), blur=0, seed=3)
    steady = motion.steady_px(np.arange(COUNT), film.px)
    # Which direction of the camera is the typical one is left open: a similarity of all frames.
    points, wanted = (px.reshape(-1, 2) @ [1.0, 1j] for px in (steady, still.px))
    known = np.stack([points, np.ones(len(points))], axis=-1)
    off = np.abs(known @ np.linalg.lstsq(known, wanted)[0] - wanted)
    # Pan and tilt are rotations, which a similarity of all frames cannot undo where the lens is assumed.
    assert off.mean() < 0.012 * film.height_px
    np.testing.assert_allclose(motion.image_px(np.arange(COUNT), steady), film.px)
    assert share_alike(tracks_of_px(steady)) < 0.1
    assert "the camera moves" in motion.in_words()


def test_a_still_camera_moves_nothing() -> None:
    _, frames = filmed()
    assert not frames.camera_motion
    assert not frames.doubts
    px = tracks_of_px(np.zeros((5, 1, 17, 2)))
    assert subtract_motion(px, None) == (px, False)


def test_between_key_frames_joints_are_as_well_tracked_before_a_shaken_camera() -> None:
    errors_px = {}
    for kind in ("still", "shaken"):
        film, frames = filmed(kind)
        errors_px[kind] = np.nanmean(distances_px(film, frames)[film.is_visible])
    assert errors_px["shaken"] < 1.1 * errors_px["still"]


def test_joints_that_flow_cannot_follow_go_along_with_the_others() -> None:
    film = render(bodies(), yaw_rad=0.2, turn_rad=0.0, moves=hand_held(COUNT, shake_px=60.0), blur=1, seed=3)
    given = rows_of(film, [0, 15, 30])
    wrist = PAIR17.index("right_wrist")
    given.confidence[:, wrist] = 0.4  # known, but not seen: nothing to be tracked
    followed = distances_px(film, annotated(film, given))[:, :, wrist]
    linear = interp1d([0, 15, 30], film.px[[0, 15, 30]], axis=0)(np.arange(COUNT))
    interpolated = np.linalg.norm(linear - film.px, axis=-1)[:, :, wrist]
    assert np.nanmean(followed) < 0.6 * np.nanmean(interpolated)


def test_keypoints_alone_tell_that_the_camera_moves() -> None:
    for kind, is_moved in (("still", False), ("shaken", True), ("panned", True)):
        doubt = moving_camera_doubt(tracks_of_px(filmed(kind)[0].px))
        assert bool(doubt) == is_moved, kind
        assert not is_moved or "everybody moves alike in" in doubt


def test_the_background_behind_a_camera_that_goes_round_people_is_not_taken_for_a_pan() -> None:
    film, frames = filmed(turn_rad=0.4)
    tracks, is_subtracted = subtract_motion(tracks_of_px(film.px), frames.camera_motion["film"])
    assert not is_subtracted
    np.testing.assert_array_equal(tracks[0].keypoints_px, tracks_of_px(film.px)[0].keypoints_px)


def test_a_camera_that_sees_no_background_is_not_known() -> None:
    grey = np.random.default_rng(0).integers(0, 255, (20, 120, 160), dtype=np.uint8)
    follower = CameraFollower(np.full((20, 0, 2, 2), np.nan))
    for image in grey:
        follower.add(image)
    assert follower.motion(0) == (None, True)
    assert "not known" in LOST


def test_shadows_on_a_plain_backdrop_are_not_taken_for_motion_of_the_camera() -> None:
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    backdrop = 60.0 + 0.1 * x + 6.0 * np.kron(rng.uniform(size=(30, 40)), np.ones((8, 8)))
    backdrop = cv2.GaussianBlur(backdrop, (0, 0), 4.0)
    follower = CameraFollower(np.full((40, 1, 2, 2), np.nan))
    for at in range(40):
        away = np.hypot((x - 160.0 - 1.5 * at) / 90.0, (y - 120.0 + at) / 70.0)
        shaded = backdrop * (1.0 - 0.25 / (1.0 + np.exp(12.0 * (away - 1.0))))
        follower.add((shaded + rng.normal(0.0, 0.6, shaded.shape)).round().astype(np.uint8))
    assert follower.motion(0)[0] is None


def test_the_motion_of_film_of_a_variable_rate_is_placed_with_its_keypoints() -> None:
    matrices = np.tile(np.eye(3), (30, 1, 1))
    matrices[:, 0, 2] = np.arange(30.0) * 2
    time_s = np.cumsum(np.r_[0.0, np.where(np.arange(29) % 3 == 0, 0.08, 0.04)])
    points = np.repeat(-matrices[:, None, :2, 2], 17, axis=1) + 100.0
    frames = AnnotatedFrames(
        "coco17", ("s",) * 30, np.arange(7, 37), np.zeros(30, dtype=int), points, np.ones((30, 17)), rate_hz=25.0
    )
    frames = replace(frames, camera_motion={"s": CameraMotion(7, matrices, (640, 480))})
    placed = at_constant_rate(frames, 7, time_s, 25.0)
    steady = placed.camera_motion["s"].steady_px(placed.frame, placed.keypoints_px)
    np.testing.assert_allclose(steady, 100.0)
