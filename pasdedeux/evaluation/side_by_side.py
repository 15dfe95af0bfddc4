"""A reconstruction beside what it was made from, as a short clip: the image, then 3D from front and side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.drawing import PERSON_COLOURS, TRUTH_COLOUR
from pasdedeux.evaluation.overlay import overlay_clip
from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons import OP14

__all__ = ["side_by_side_clip", "turn_to_camera"]

Array = npt.NDArray[np.float64]

_PANEL_PX = 240
_PEOPLE_SHARE = 0.78
"""Part of a panel's height or width that people take."""
_MIN_DISTANCE_M = 0.5
_TITLES = ("image", "3D, camera's view", "3D, from its side")


def side_by_side_clip(
    keypoints_px: Array, found_m: Array, *, rate_hz: float, truth_m: Array | None = None, max_frames: int = 60
) -> bytes:
    """Draw people as given (left), what was found as the camera sees it (middle) and from its side (right).

    Each person has a colour; the truth is grey, behind.  The middle of all people stays in the middle of each panel,
    so their places to each other show.

    Args:
        keypoints_px: The tracks (frame, person, 14, 2), pixels, y down; NaN where not seen.
        found_m: The reconstruction (frame, person, 14, 3), camera axes, metres; NaN where a person is not there.
        rate_hz: Frames per second.
        truth_m: The true motion (frame, person, 14, 3), camera axes, where it is known.
        max_frames: Longer tracks are cut.

    Returns:
        An animated WebP.
    """
    keypoints, found = keypoints_px[:max_frames], found_m[:max_frames]
    views = [((0, 1), [1.0, -1.0]), ((2, 1), [-1.0, -1.0])]
    solid = [found] if truth_m is None else [truth_m[:max_frames], found]
    images = [[_about_hips(motion)[..., axes] * signs for motion in solid] for axes, signs in views]
    most = _PEOPLE_SHARE * _PANEL_PX
    per_metre = most / max(_extent(image[-1]) for image in images)
    # Hips are not half way up: what stands about them would run out of the panel.
    height = images[0][-1][..., 1].reshape(len(found), -1)
    down = -0.5 * float(np.nanmedian(np.nanmax(height, axis=1) + np.nanmin(height, axis=1)))
    figures = [_panel((keypoints - _middle_of(keypoints)) * (most / max(_extent(keypoints), 1.0)), 0)]
    colours = list(_colours(keypoints.shape[1]))
    for number, image in enumerate(images, start=1):
        figures += [_panel((points + np.array([0.0, down])) * per_metre, number) for points in image]
        colours += [TRUTH_COLOUR] * found.shape[1] * (len(solid) - 1) + _colours(found.shape[1])
    return overlay_clip(
        OP14,
        np.concatenate(figures, axis=1),
        image_size_px=(3 * _PANEL_PX, _PANEL_PX),
        rate_hz=rate_hz,
        colours=colours,
        titles=_TITLES,
        max_width_px=3 * _PANEL_PX,
    )


def turn_to_camera(motion_m: Array, place_m: Array) -> Array:
    """Turn a motion in camera axes so that it is seen along the ray to where people are, as their image shows them.

    A camera sees somebody at the edge of its image from another side than somebody in the middle.

    Args:
        motion_m: What is turned (frame, person, 14, 3), camera axes, metres.
        place_m: People in their place (frame, person, 14, 3), the camera at the origin; frames in which their middle
            is nearer than half a metre, as without a known place, are left as they are.
    """
    places = place_m.reshape(len(place_m), -1, 3)
    is_there = np.isfinite(places).all(axis=-1, keepdims=True)
    middle = np.where(is_there, places, 0.0).sum(axis=1) / np.maximum(is_there.sum(axis=1), 1)
    distance = np.linalg.norm(middle, axis=-1, keepdims=True)
    to_camera = np.where(distance > _MIN_DISTANCE_M, -middle / np.maximum(distance, 1e-9), [0.0, 0.0, 1.0])
    turn = swing_between(to_camera, np.broadcast_to([0.0, 0.0, 1.0], to_camera.shape))
    return np.asarray(rotate(turn[:, None, None], motion_m))


def _colours(num_people: int) -> list[str]:
    return [PERSON_COLOURS[person % len(PERSON_COLOURS)] for person in range(num_people)]


def _extent(points: Array) -> float:
    """Return the greater of height and width that all people of a frame take, its median over the frames."""
    flat = points.reshape(len(points), -1, points.shape[-1])
    flat = flat[np.asarray(np.isfinite(flat).all(axis=-1)).any(axis=1)]
    if not len(flat):
        return 1.0
    return float(np.median((np.nanmax(flat, axis=1) - np.nanmin(flat, axis=1)).max(axis=-1)))


def _middle_of(seen: Array) -> Array:
    """Return the middle of all seen joints (frame, 1, 1, 2); frames that show nobody have the frame's before."""
    middle = np.zeros((len(seen), 1, 1, 2))
    for frame, points in enumerate(seen):
        known = points[np.isfinite(points).all(axis=-1)]
        box = 0.5 * (known.min(axis=0) + known.max(axis=0)) if len(known) else middle[max(frame - 1, 0), 0, 0]
        middle[frame, 0, 0] = box
    return middle


def _about_hips(positions_m: Array) -> Array:
    """Return positions (frame, person, 14, 3) about the mean mid-hip of the people who are there."""
    hips = mid_hip(positions_m)
    is_there = np.isfinite(hips).all(axis=-1, keepdims=True)
    total = np.where(is_there, hips, 0.0).sum(axis=1, keepdims=True)
    return np.asarray(positions_m - (total / np.maximum(is_there.sum(axis=1, keepdims=True), 1))[:, :, None])


def _panel(points: Array, number: int) -> Array:
    return np.asarray(points + np.array([number + 0.5, 0.5]) * _PANEL_PX)
