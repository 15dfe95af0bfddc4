"""A built-in duet as several cameras see it: unknown lenses and places, clocks that differ, noise of a detector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.kinematics.rotations import rotvec_from_unitquat, unitquat_from_rotmat
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, mid_hip, retarget_proportions
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.annotated import database_of_takes
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.sequence import SearchedDatabase
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import BODY22
from tests.builders.rendered_film import duet_bodies

SIZE_PX = (960, 540)
RATE_HZ = 30.0
STEPS = 4
"""The truth has so many moments a frame, so that clocks may differ by parts of one."""


@dataclass(frozen=True)
class FilmedCamera:
    """A camera, its clock and its tracks.

    Args:
        camera: As it truly is.
        ahead_s: What its clock shows when that of the truth shows 0.
        tracks: What is known of it.
    """

    camera: PinholeCamera
    ahead_s: float
    tracks: list[Track]


@lru_cache(maxsize=2)
def duet_m(name: str, seconds: float = 4.0) -> np.ndarray:
    """Return op14 positions (moment, person=2, 14, 3) of a built-in duet, at `STEPS` moments a frame."""
    bodies = duet_bodies(name, seconds=seconds, rate_hz=STEPS * RATE_HZ)
    return op14_from_working(bodies.body22_m, BODY22)


def see(
    truth_m: np.ndarray,
    yaws_deg: tuple[float, ...],
    *,
    num_frames: int = 60,
    late: tuple[int, ...] = (0, 37, -22),
    lenses: tuple[float, ...] = (1.0, 0.85, 1.15),
    noise_px: float = 2.0,
    rate_hz: float = RATE_HZ,
    seed: int = 0,
) -> list[FilmedCamera]:
    """Return what cameras at some yaws see of a truth (moment, person, 14, 3), each from another moment on.

    The second camera has other numbers for the people.
    """
    rng, seen = np.random.default_rng(seed), []
    centre = mid_hip(truth_m).mean(axis=(0, 1))
    for number, (yaw_deg, longer) in enumerate(zip(yaws_deg, lenses, strict=False)):
        camera = look_at_camera(
            centre,
            distance_m=4.5,
            yaw_rad=float(np.deg2rad(yaw_deg)),
            pitch_rad=0.12,
            focal_px=790.0 * longer,
            image_size_px=SIZE_PX,
        )
        first = 60 + late[number]
        shown = truth_m[first : first + STEPS * num_frames : STEPS]
        px = camera.project(shown).px + rng.normal(0.0, noise_px, (*shown.shape[:-1], 2))
        ids = (5, 3) if number == 1 else (0, 1)
        order = ids if number != 1 else ids[::-1]
        lens = Lens.assumed(*SIZE_PX, px)
        tracks = [Track(px[:, at], np.ones((*px.shape[:1], 14)), rate_hz, lens, name) for at, name in enumerate(order)]
        seen.append(FilmedCamera(camera, -late[number] / (STEPS * rate_hz), tracks))
    return seen


def database_of_duets(*names: str) -> SearchedDatabase:
    """Return a database of built-in duets."""
    known = np.concatenate([duet_m(name)[:: 4 * STEPS] for name in names])
    poses = centre_and_face(retarget_proportions(known.reshape(-1, 14, 3))).poses_m.astype(np.float32)
    is_real = np.ones(len(poses), dtype=bool)
    return database_of_takes(Database(poses, is_real), centre_pairs(known), np.deg2rad([0.0, 10.0, 20.0]).tolist())


def errors_m(
    people: tuple[ReconstructedTrack, ...], truth_m: np.ndarray, seen: FilmedCamera, *, has_best_scale: bool = False
) -> tuple[float, float]:
    """Return the mean error of joints about the mid-hip, and of the vector from one mid-hip to the other.

    `has_best_scale`: after everything is scaled by the one factor that fits the truth best.
    """
    poses, trues, roots, true_roots = [], [], [], []
    for number, person in enumerate(people):
        first = 60 - round(seen.ahead_s * STEPS * person.track.rate_hz)
        true = truth_m[first + STEPS * person.track.frames, number] @ seen.camera.camera_from_world_rotmat.T
        poses.append(person.positions_m - mid_hip(person.positions_m)[:, None])
        trues.append(true - mid_hip(true)[:, None])
        roots.append(person.root_m)
        true_roots.append(mid_hip(true))
    scale, apart, true_apart = 1.0, roots[1] - roots[0], true_roots[1] - true_roots[0]
    if has_best_scale:
        placed, known = (np.concatenate([np.ravel(a), np.ravel(b)]) for a, b in ((poses, apart), (trues, true_apart)))
        scale = float(placed @ known / (placed @ placed))
    off = [root_centred_error_m(scale * pose, true).mean() for pose, true in zip(poses, trues, strict=True)]
    return float(np.mean(off)), float(np.linalg.norm(scale * apart - true_apart, axis=-1).mean())


def known_lens(seen: FilmedCamera) -> FilmedCamera:
    """Return the same with the lens known."""
    x, y = seen.camera.principal_point_px
    lens = Lens(seen.camera.focal_px, (float(x), float(y)), is_known=True)
    return replace(seen, tracks=[replace(track, lens=lens) for track in seen.tracks])


def calibrated(
    camera: PinholeCamera,
    name: str = "cam",
    *,
    scale: float = 1.0,
    distortions: tuple[float, ...] = (),
    unit: float = 1.0,
) -> str:
    """Return the table of a camera in a file of a calibration, for images larger by a scale."""
    rotmat = np.diag([1.0, -1.0, -1.0]) @ camera.camera_from_world_rotmat
    (cx, cy), focal = camera.principal_point_px, scale * camera.focal_px
    cx, cy = (scale * (at + 0.5) - 0.5 for at in (cx, cy))
    rotvec = rotvec_from_unitquat(unitquat_from_rotmat(rotmat))
    return f"""[{name}]
name = "{name}"
size = [ {scale * camera.image_size_px[0]}, {scale * camera.image_size_px[1]},]
matrix = [ [ {focal}, 0.0, {cx},], [ 0.0, {focal}, {cy},], [ 0.0, 0.0, 1.0,],]
distortions = {list(distortions or (0.0,) * 5)}
rotation = {rotvec.tolist()}
translation = {(-unit * rotmat @ camera.position_m).tolist()}
"""
