"""Moving people for the page's player: contacts as lines, and reconstructions over their image and their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.evaluation.pictures import pack_player, people_panel, shown_frames, times_shown
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.views.cameras import SeenBy
from pasdedeux.skeletons import OP14

MAX_LINKS = 10
"""Contacts drawn in a frame, at most."""
_MIN_DISTANCE_M = 0.5


def links_of(contacts: Contacts, positions_m: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the points of held contacts (frame, n, 2, 3), the first ten of each frame; NaN without a contact.

    Args:
        contacts: The contacts.
        positions_m: The people (frame, person, joint, 3), metres, of these contacts or in another motion.
    """
    held = contacts.is_held
    ends = contacts.ends(positions_m.reshape(len(positions_m), -1, 3))
    ends[~held] = np.nan
    first = np.argsort(~held, axis=1, kind="stable")[:, : min(MAX_LINKS, int(held.sum(axis=1).max(initial=0)))]
    return np.asarray(np.take_along_axis(ends, first[:, :, None, None], axis=1))


def reconstruction_player(
    found_m: Array, *, rate_hz: float, keypoints_px: Array | None = None, truth_m: Array | None = None
) -> bytes:
    """Show reconstructed people over the ground truth, beside their image.

    The middle of all people stays in the centre, so their relative places are visible.

    Args:
        found_m: The reconstruction (frame, person, 14, 3), y up, metres; NaN where a person is not there.
        rate_hz: Frames per second.
        keypoints_px: The image (frame, person, 14, 2), pixels, y down; NaN where not seen.
        truth_m: The true motion (frame, person, 14, 3), the same axes, where it is known.
    """
    frames, shown_hz = shown_frames(len(found_m), rate_hz)
    shown = about_hips(found_m[frames])
    panels, labels = [], []
    if keypoints_px is not None:
        (image,) = _about_middle(keypoints_px[frames], _height(shown))
        panels.append(replace(people_panel("image", OP14, image), is_flat=True))
    truth = None if truth_m is None else about_hips(truth_m[frames])
    if truth is not None:
        for frame, error in zip(frames, 100.0 * np.linalg.norm(shown - truth, axis=-1), strict=True):
            known = error[np.isfinite(error)]
            labels.append(f"{frame / rate_hz:.1f} s" + (f", {known.mean():.1f} cm" if len(known) else ""))
    title = "reconstruction" if truth is None else "reconstruction, ground truth in grey"
    panels.append(people_panel(title, OP14, shown, truth_m=truth))
    return pack_player(panels, rate_hz=shown_hz, labels=labels, has_floor=False)


def seen_player(found_m: Array, cameras: Sequence[SeenBy], *, rate_hz: float) -> bytes:
    """Show reconstructed people over the keypoints of each camera, and in the room.

    Args:
        found_m: The reconstruction (frame, person, 14, 3), upright, floor at y = 0, metres; NaN where nobody is there.
        cameras: The cameras, with keypoints of the same frames.
        rate_hz: Frames per second.
    """
    frames, shown_hz = shown_frames(len(found_m), rate_hz)
    shown = found_m[frames] - np.nanmean(found_m[frames], axis=(0, 1, 2)) * [1.0, 0.0, 1.0]
    panels = []
    for seen in cameras:
        image, over = _about_middle(seen.keypoints_px[frames], _height(shown), seen.camera.project(found_m[frames]).px)
        title = "over its 2D poses (grey)" if len(cameras) == 1 else f"{seen.name}: over its 2D poses (grey)"
        direction = seen.camera.camera_from_world_rotmat[2]
        view_rad = float(np.arctan2(-direction[0], direction[2])), float(np.arcsin(np.clip(direction[1], -1.0, 1.0)))
        view = (seen.name, *view_rad) if len(cameras) > 1 else None
        panels.append(replace(people_panel(title, OP14, over, truth_m=image), is_flat=True, view=view))
    panels.append(people_panel("reconstruction", OP14, shown))
    return pack_player(panels, rate_hz=shown_hz, labels=times_shown(frames, len(found_m), rate_hz))


def _about_middle(seen_px: Array, height: float, *others_px: Array) -> list[Array]:
    """Return people of an image (frame, person, joint, 2), and others over them, centred, y up, z = 0."""
    seen = seen_px * [1.0, -1.0]
    middle = np.stack([_middle(points.reshape(-1, 2)) for points in seen])[:, None, None]
    size = height / max(_height(seen), 1e-9)
    return [np.insert((points * [1.0, -1.0] - middle) * size, 2, 0.0, -1) for points in (seen_px, *others_px)]


def about_hips(positions_m: Array) -> Array:
    """Return positions (frame, person, 14, 3) about the mean mid-hip of the people present."""
    return np.asarray(positions_m - _mean_there(mid_hip(positions_m))[:, None, None])


def _mean_there(points: Array) -> Array:
    """Return the mean (frame, 3) of the known points (frame, n, 3); the origin without any."""
    is_there = np.isfinite(points).all(axis=-1, keepdims=True)
    return np.asarray(np.where(is_there, points, 0.0).sum(axis=1) / np.maximum(is_there.sum(axis=1), 1))


def turn_to_camera(motion_m: Array, place_m: Array) -> Array:
    """Turn a motion in camera axes so that it is seen along the ray to the people, as in their image.

    A camera sees a person at the edge of its image from another side than one in the middle.

    Args:
        motion_m: Motion to turn (frame, person, 14, 3), camera axes, metres.
        place_m: People in their place (frame, person, 14, 3), the camera at the origin; frames in which their middle
            is nearer than half a metre, as without a known place, are left as they are.
    """
    middle = _mean_there(merge_axes(place_m, 1, -1))
    distance = np.linalg.norm(middle, axis=-1, keepdims=True)
    to_camera = np.where(distance > _MIN_DISTANCE_M, -middle / np.maximum(distance, 1e-9), [0.0, 0.0, 1.0])
    turn = swing_between(to_camera, np.broadcast_to([0.0, 0.0, 1.0], to_camera.shape))
    return np.asarray(rotate(turn[:, None, None], motion_m))


def _height(points: Array) -> float:
    """Return the height that all people of a frame take, its median over the frames with anybody; 1 without any."""
    height = merge_axes(points[..., 1], 1)
    known = [row[np.isfinite(row)] for row in height if np.isfinite(row).any()]
    return float(np.median([np.ptp(row) for row in known])) if known else 1.0


def _middle(points: Array) -> Array:
    """Return the median (2,) of the known points (n, 2)."""
    known = points[np.isfinite(points).all(axis=-1)]
    return np.median(known, axis=0) if len(known) else np.zeros(2)
