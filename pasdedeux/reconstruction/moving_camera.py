"""Detect a moving camera from keypoints: all joints move alike in the image, and no foot stands still.

If the motion of a camera is unknown, it is taken for motion of the people, and their feet leave the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.people.identity import body_size_px
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

_STEP_S = 0.2
"""Time between the two frames of a displacement."""
_MIN_SPEED = 0.1
"""Slowest speed of an ankle before a moving camera, body heights per second; noise of 3 px on people of
500 px is 0.06."""
_ALIKE, _MIN_ALIKE = 0.5, 0.6
"""A joint moves like the others if it differs from their median displacement by less than the first, as a part of that
displacement; the second is the share of the joints that must."""
_MAX_SHARE = 0.2
"""Largest share of frames in which everybody moves alike before a still camera: at most 0.06 in 26 clips of two people
and of walkers, and 0.25 or more in the same clips if the camera pans by 29 degrees or shakes by 7 % of a person's
height."""
_MIN_JUDGED_S = 0.5
_ANKLES = OP14.indices(["left_ankle", "right_ankle"])


def share_alike(tracks: Sequence[Track]) -> float:
    """Return the share of frames in which all joints of all people move alike and no ankle is still.

    Only frames that show an ankle count; 0 where less than half a second of them is seen.
    """
    first, last = min(track.first_frame for track in tracks), max(int(track.frames[-1]) for track in tracks)
    px = np.full((last - first + 1, len(tracks), OP14.num_joints, 2), np.nan)
    for person, track in enumerate(tracks):
        seen = np.where((track.confidence > 0)[..., None], track.keypoints_px, np.nan)
        px[track.frames - first, person] = seen
    step = max(1, round(_STEP_S * tracks[0].rate_hz))
    sizes = body_size_px(px, np.isfinite(px[..., 0]).astype(np.float64))
    sizes = sizes[np.isfinite(sizes)]
    if not len(sizes) or len(px) <= step:
        return 0.0
    speed = (px[step:] - px[:-step]) / (float(np.median(sizes)) * step / tracks[0].rate_hz)
    ankles = np.linalg.norm(speed[:, :, _ANKLES], axis=-1).reshape(len(speed), -1)
    judged = np.flatnonzero(np.isfinite(ankles).any(axis=1))
    if len(judged) < _MIN_JUDGED_S * tracks[0].rate_hz:
        return 0.0
    joints = speed[judged].reshape(len(judged), -1, 2)
    common = np.nanmedian(joints, axis=1)
    off = np.linalg.norm(joints - common[:, None], axis=-1)
    is_alike = off < _ALIKE * np.linalg.norm(common, axis=-1)[:, None]
    share = is_alike.sum(axis=1) / np.isfinite(off).sum(axis=1)
    return float(np.mean((share > _MIN_ALIKE) & (np.nanmin(ankles[judged], axis=1) > _MIN_SPEED)))


def subtract_motion(tracks: Sequence[Track], motion: CameraMotion | None) -> tuple[list[Track], bool]:
    """Return tracks in the steady image of a camera that moves, and whether its motion was subtracted.

    It is not subtracted if feet would then slide more: cameras that move around people are not supported.
    """
    if motion is None or not tracks:
        return [*tracks], False
    steady = [replace(track, keypoints_px=motion.steady_px(track.frames, track.keypoints_px)) for track in tracks]
    if share_alike(steady) > max(_MAX_SHARE, share_alike(tracks)):
        return [*tracks], False
    return steady, True


def moving_camera_doubt(tracks: Sequence[Track]) -> str:
    """Return a sentence if the camera seems to move, else an empty text."""
    share = share_alike(tracks)
    if share <= _MAX_SHARE:
        return ""
    return (
        f"everybody moves alike in {share:.0%} of the frames, as before a moving camera, which is taken for motion of "
        "the people; what would help: the film itself (reconstruct FILM, [[ingest.videos]]), whose background tells "
        "how the camera turns, or keypoints of stabilised images"
    )
