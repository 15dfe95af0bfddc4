"""Cameras that saw reconstructed people, in the frame of the motions, for files and pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.reconstruction.body import soles_m
from pasdedeux.reconstruction.people import ReconstructedPeople
from pasdedeux.skeletons import OP14


@dataclass(frozen=True)
class SeenBy:
    """A camera and its keypoints of the people at the frames of `spanned_frames`.

    Args:
        name: Its name.
        camera: Lens, rotation and place in the frame of the motions: upright, soles at y = 0.
        keypoints_px: Its keypoints (frame, person, 14, 2), pixels; NaN where not seen.
        rate_hz: Its frames per second.
        first_time_s: Time of its frame 0 by the clock of the first camera.
        offset_s: Offset of its clock from that of the first camera.
        angle_rad: Angle at the people between the rays to this camera and to the first one.
    """

    name: str
    camera: PinholeCamera
    keypoints_px: Array
    rate_hz: float
    first_time_s: float
    offset_s: float = 0.0
    angle_rad: float = 0.0

    def off_px(self, upright_m: Array) -> float:
        """Return the median distance of joints (frame, person, 14, 3) from the keypoints, pixels; NaN without any."""
        away = np.linalg.norm(self.camera.project(upright_m).px - self.keypoints_px, axis=-1)
        return float(np.nanmedian(away)) if np.isfinite(away).any() else float("nan")

    def in_words(self, upright_m: Array) -> str:
        """Return in words its distance from the people (frame, person, 14, 3), its lens, clock and agreement."""
        width, focal_px = self.camera.image_size_px[0], self.camera.focal_px
        distance_m = np.linalg.norm(self.camera.position_m - np.nanmean(upright_m, axis=(0, 1, 2)))
        across = np.rad2deg(2.0 * np.arctan(0.5 * width / focal_px))
        offset_s = round(self.offset_s, 2) + 0.0  # no -0.00
        clock = f", its clock {offset_s:+.2f} s, {np.rad2deg(self.angle_rad):.0f} degrees from the first camera"
        return (
            f"camera {self.name}: {distance_m:.1f} m from the people, lens {focal_px:.0f} px ({across:.0f} degrees)"
            f"{clock if self.offset_s or self.angle_rad else ''}; joints are {self.off_px(upright_m):.1f} px (median) "
            "from where it sees them"
        )


def spanned_frames(people: ReconstructedPeople) -> Integers:
    """Return the frames from the first to the last of anybody (frame,)."""
    tracks = [person.track for person in people.methods[-1].people]
    return np.arange(min(track.first_frame for track in tracks), max(int(track.frames[-1]) for track in tracks) + 1)


def upright_m(people: ReconstructedPeople) -> Array:
    """Return the joints at `spanned_frames` (frame, person, 14, 3), upright, soles at y = 0; NaN: not there."""
    motions, frames = people.methods[-1], spanned_frames(people)
    soles = np.array([0.0, soles_m(motions.bodies), 0.0])
    placed_m = np.full((len(frames), len(motions.people), OP14.num_joints, 3), np.nan)
    for number, person in enumerate(motions.people):
        upright = (person.positions_m - motions.origin_m) @ people.camera_from_upright_rotmat
        placed_m[person.track.frames - frames[0], number] = upright + soles
    return placed_m


def seen_alone(people: ReconstructedPeople, name: str = "1") -> SeenBy:
    """Return the camera of people seen by one camera."""
    motions, frames = people.methods[-1], spanned_frames(people)
    track = motions.people[0].track
    keypoints_px = np.full((len(frames), len(motions.people), OP14.num_joints, 2), np.nan)
    for number, person in enumerate(motions.people):
        keypoints_px[person.track.frames - frames[0], number] = person.track.keypoints_px
    first_time_s = track.first_time_s - track.first_frame / track.rate_hz
    return SeenBy(name, people.camera, keypoints_px, track.rate_hz, first_time_s)


def camera_facts(cameras: Sequence[SeenBy], upright_m: Array) -> dict[str, Array]:
    """Return the values of several cameras by name, for files of motion; for one camera nothing, see `camera_...`."""
    if len(cameras) < 2:
        return {}
    return {
        "cameras_name": np.array([seen.name for seen in cameras]),
        "cameras_position_m": np.stack([seen.camera.position_m for seen in cameras]),
        "cameras_from_world_rotmat": np.stack([seen.camera.camera_from_world_rotmat for seen in cameras]),
        "cameras_focal_px": np.array([seen.camera.focal_px for seen in cameras]),
        "cameras_principal_point_px": np.stack([seen.camera.principal_point_px for seen in cameras]),
        "cameras_offset_s": np.array([seen.offset_s for seen in cameras]),
        "cameras_angle_rad": np.array([seen.angle_rad for seen in cameras]),
        "cameras_off_px": np.array([seen.off_px(upright_m) for seen in cameras]),
    }
