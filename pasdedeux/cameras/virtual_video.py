"""Virtual video: takes seen by pinhole cameras from drawn views, with pixel noise and hidden joints.

The experiment of Yin et al. (2018, section 6): 3D pairs are seen from random views and become 2D annotations whose
ground truth is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError

PERSON_HEIGHT_PX = 600.0
"""Height of a person in the image for which noise in pixels is stated."""

PERSON_HEIGHT_M = 1.7
"""Height of the person that sets the focal length."""


_JUNK_CONFIDENCE = (0.05, 0.2)
_MIN_DEPTH_M = 1.0
"""Smallest depth of a joint before a camera."""
_MIN_PITCH_RAD, _MAX_PITCH_RAD = float(np.deg2rad(-15.0)), float(np.deg2rad(60.0))
_WALK_M_S = 1.3
"""Comfortable walking speed (Bohannon 1997)."""
_MAX_TURN_RAD, _MAX_AWAY_M = np.pi / 6.0, 0.6
"""A passer-by crosses the image within 30 degrees and within 0.6 m of the middle of the pair."""


@dataclass(frozen=True)
class VirtualView:
    """A virtual camera, and the numbers from which it was made."""

    camera: PinholeCamera
    distance_m: float
    yaw_rad: float
    pitch_rad: float


@dataclass(frozen=True)
class Annotated:
    """Pixels (*batch, joint, 2), NaN where hidden, and confidences (*batch, joint): 1 where seen, 0 where hidden."""

    px: Array
    confidence: Array


def sample_views(
    rng: np.random.Generator,
    count: int,
    *,
    pitch_mean_rad: float = float(np.deg2rad(10.0)),
    pitch_deviation_rad: float = float(np.deg2rad(10.0)),
) -> tuple[Array, Array]:
    """Draw azimuths about +Y (0 on +Z) and elevations (count,), radians, of views.

    Azimuths are uniform; elevations are normal, folded back at the ends of -15 to 60 degrees.

    By default they are about eye level or slightly above, as people film people.  An infinite deviation draws
    directions uniformly on the band of the sphere between the two ends.
    """
    yaw = rng.uniform(-np.pi, np.pi, size=count)
    if np.isinf(pitch_deviation_rad):
        return yaw, np.arcsin(rng.uniform(np.sin(_MIN_PITCH_RAD), np.sin(_MAX_PITCH_RAD), size=count))
    span = _MAX_PITCH_RAD - _MIN_PITCH_RAD
    folded = np.mod(rng.normal(pitch_mean_rad, pitch_deviation_rad, size=count) - _MIN_PITCH_RAD, 2 * span)
    return yaw, _MIN_PITCH_RAD + np.minimum(folded, 2 * span - folded)


def look_at_camera(
    target_m: Array,
    *,
    distance_m: float,
    yaw_rad: float,
    pitch_rad: float,
    focal_px: float,
    image_size_px: tuple[int, int] = (1920, 1080),
) -> PinholeCamera:
    """Return the upright camera that looks at `target_m` (3,) from a distance; the target is at the image's centre.

    At yaw 0 and pitch 0 the camera stands on +Z of the target and looks along -Z; yaw turns it towards +X, a positive
    pitch lifts it.  The image's up is continuous up to straight above (pitch 90 degrees).
    """
    direction = _towards(yaw_rad, pitch_rad)
    right = np.array([np.cos(yaw_rad), 0.0, -np.sin(yaw_rad)])
    return PinholeCamera(
        focal_px=focal_px,
        principal_point_px=np.array(image_size_px) / 2.0,
        camera_from_world_rotmat=np.stack([right, np.cross(direction, right), direction]),
        position_m=np.asarray(target_m) + distance_m * direction,
        image_size_px=image_size_px,
    )


def _towards(yaw_rad: float, pitch_rad: float) -> Array:
    """Return the world direction (3,) from the scene towards a camera."""
    level = np.cos(pitch_rad)
    return np.array([level * np.sin(yaw_rad), np.sin(pitch_rad), level * np.cos(yaw_rad)])


def frame_take(positions: Array, roots: Array, *, distance_m: float, yaw_rad: float, pitch_rad: float) -> VirtualView:
    """Return a camera that looks at the mean root and sees a person of 1.7 m about 600 px tall.

    Its image is the smallest of at least 1280 x 720 in steps of 16 that holds every joint with a margin of 5 % of the
    person's height.

    Args:
        positions: Every joint of every person and frame to be seen, (*batch, 3), metres.
        roots: Roots of the people, (*batch, 3), metres; the camera looks at their mean.
        distance_m: Wanted distance from the camera to the mean root; grown where a joint would come nearer than
            1 m to the image plane.  The focal length grows with it, so people keep their size.
        yaw_rad: Azimuth of the camera.
        pitch_rad: Elevation of the camera.
    """
    points = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=-1)]
    centres = np.asarray(roots, dtype=np.float64).reshape(-1, 3)
    centres = centres[np.isfinite(centres).all(axis=-1)]
    if len(points) == 0 or len(centres) == 0:
        raise InputError("virtual video: the take has no finite positions to look at")
    target = centres.mean(axis=0)
    towards = float(((points - target) @ _towards(yaw_rad, pitch_rad)).max())
    distance = max(distance_m, towards + _MIN_DEPTH_M)
    focal = PERSON_HEIGHT_PX * distance / PERSON_HEIGHT_M

    def camera(size: tuple[int, int]) -> PinholeCamera:
        return look_at_camera(
            target, distance_m=distance, yaw_rad=yaw_rad, pitch_rad=pitch_rad, focal_px=focal, image_size_px=size
        )

    reach = np.abs(camera((2, 2)).project(points).px - 1.0).max(axis=0) + 0.05 * PERSON_HEIGHT_PX
    width, height = np.maximum(np.ceil(2.0 * reach / 16.0).astype(int) * 16, [1280, 720])
    return VirtualView(camera((int(width), int(height))), distance, yaw_rad, pitch_rad)


def annotate_pixels(rng: np.random.Generator, px: Array, *, noise_px: float = 0.0, occlusion: float = 0.0) -> Annotated:
    """Make annotations of exact pixels: normal noise on every coordinate, and joints hidden at random.

    Args:
        rng: Random generator.
        px: Exact pixels, (*batch, joint, 2); NaN stays missing.
        noise_px: Standard deviation of the noise.
        occlusion: Share of the joints that are hidden, each on its own, from 0 to 1.
    """
    exact = np.asarray(px, dtype=np.float64)
    # Always make both draws, so that the noise of a joint does not depend on the occlusion.
    noise = rng.standard_normal(exact.shape) * noise_px
    is_hidden = rng.random(exact.shape[:-1]) < occlusion
    seen = np.where(is_hidden[..., None], np.nan, exact + noise)
    is_seen = np.asarray(np.isfinite(seen).all(axis=-1))
    return Annotated(px=np.where(is_seen[..., None], seen, np.nan), confidence=is_seen.astype(np.float64))


def add_junk(rng: np.random.Generator, seen: Annotated, count: int, image_size_px: tuple[int, int]) -> Annotated:
    """Move `count` joints of each person in every frame anywhere in the image, with a confidence below 0.2.

    Detectors do so with joints that they do not find.  Unseen people stay unseen.
    """
    chosen = np.argsort(rng.random(seen.confidence.shape), axis=-1) < count
    chosen &= (seen.confidence > 0).any(axis=-1, keepdims=True)
    places = rng.random(seen.px.shape) * np.array(image_size_px, dtype=np.float64)
    confidence = rng.uniform(*_JUNK_CONFIDENCE, size=seen.confidence.shape)
    return Annotated(
        px=np.where(chosen[..., None], places, seen.px), confidence=np.where(chosen, confidence, seen.confidence)
    )


def passer_by(
    rng: np.random.Generator, person: Array, centre: Array, *, towards_camera: Array, rate_hz: float
) -> Array:
    """Return a person who walks through a take across the image, with the motion of `person` reversed in time.

    Args:
        rng: Draws the direction, and the distance of the path from the middle of the pair.
        person: Joints (frame, joint, 3), moved so that their mean follows the path; time is reversed so that the two
            do not move alike.
        centre: Middle (3,) of the pair.
        towards_camera: Direction (3,) from there to the camera.
        rate_hz: Frames per second.
    """
    moved = person[::-1].copy()
    turn = rng.uniform(-_MAX_TURN_RAD, _MAX_TURN_RAD) + (np.pi if rng.random() < 0.5 else 0.0)
    depth = np.array([towards_camera[0], 0.0, towards_camera[2]])
    depth = depth / max(float(np.linalg.norm(depth)), 1e-9)
    across = np.array([depth[2], 0.0, -depth[0]])
    along = np.cos(turn) * across + np.sin(turn) * depth
    time_s = (np.arange(len(person)) - 0.5 * (len(person) - 1)) / rate_hz
    path = centre + rng.uniform(-_MAX_AWAY_M, _MAX_AWAY_M) * depth + _WALK_M_S * time_s[:, None] * along
    shift = path - moved.mean(axis=1)
    shift[:, 1] = 0.0
    return np.asarray(moved + shift[:, None])
