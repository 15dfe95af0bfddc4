"""Clips of motions at 10 Hz, each in the frame of its pair, as the classifier and the predictor see them."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.skeletons import BODY22

CLIP_HZ = 10.0
CLIP_FRAMES = 20
"""Frames of a clip that the classifier sees."""
HISTORY, HORIZON = 20, 10
"""Frames given to the predictor, and frames that it predicts."""
_STRIDE = 5
"""A clip begins every half second."""


def in_pair_frame(motion_m: Array, frame: int) -> Array:
    """Return motions (*batch, T, 2, 22, 3) about the middle of both pelvises in a frame, A facing B along x."""
    pelvises = motion_m[..., frame, :, BODY22.root, :]
    middle = pelvises.mean(axis=-2)
    across = pelvises[..., 1, :] - pelvises[..., 0, :]
    yaw = np.arctan2(across[..., 2], across[..., 0])
    cos, sin = (turn[..., None, None, None] for turn in (np.cos(yaw), np.sin(yaw)))
    moved = motion_m - (middle * [1.0, 0.0, 1.0])[..., None, None, None, :]
    x, y, z = (moved[..., axis] for axis in range(3))
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=-1)


def cut_clips(
    motion_m: Array, rate_hz: float, *, num_frames: int = CLIP_FRAMES, frame: int | None = None, is_held: bool = True
) -> Array:
    """Cut a motion (T, 2, 22, 3), metres, into clips (n, num_frames, 2, 22, 3) at 10 Hz, each in its pair's frame.

    Between frames of the motion, positions are interpolated.

    Args:
        motion_m: The motion.
        rate_hz: Its frames per second.
        num_frames: Frames of a clip.
        frame: Frame of the clip that defines its pair's frame; by default the middle one.
        is_held: Hold the last pose of a shorter motion; otherwise it has no clip (n = 0).
    """
    times = np.arange(0.0, (len(motion_m) - 1) / rate_hz + 1e-9, 1.0 / CLIP_HZ) * rate_hz
    below = np.minimum(times.astype(int), max(len(motion_m) - 2, 0))
    share = (times - below)[:, None, None, None]
    above = np.minimum(below + 1, len(motion_m) - 1)
    slow = (1.0 - share) * motion_m[below] + share * motion_m[above]
    if is_held:
        slow = np.concatenate([slow, np.repeat(slow[-1:], max(num_frames - len(slow), 0), axis=0)])
    starts = np.arange(0, max(len(slow) - num_frames + 1, 0), _STRIDE)
    return in_pair_frame(slow[starts[:, None] + np.arange(num_frames)], num_frames // 2 if frame is None else frame)


def exchange_people(clips: Array) -> Array:
    """Return clips (n, T, 2, 22, 3), metres, with A and B exchanged, in the frame of the pair."""
    return in_pair_frame(clips[:, :, ::-1], clips.shape[1] // 2)


def joint_errors(predicted: Array, true: Array) -> tuple[Array, Array]:
    """Return JME and AME (n, T), centimetres, of motions (n, T, 2, 22, 3), metres (Guo et al. 2022).

    JME is the mean distance of joints in the frame of the pair.  AME is the same after each person's pose is aligned
    with the true one by the best rigid motion (Kabsch 1976), so it measures poses alone, not places.
    """
    jme = np.linalg.norm(predicted - true, axis=-1).mean(axis=(-2, -1))
    first, other = (motion - motion.mean(axis=-2, keepdims=True) for motion in (predicted, true))
    left, _, right = np.linalg.svd(np.swapaxes(first, -1, -2) @ other)
    sign = np.sign(np.linalg.det(left @ right))
    left[..., :, -1] *= sign[..., None]
    ame = np.linalg.norm(first @ (left @ right) - other, axis=-1).mean(axis=(-2, -1))
    return 100.0 * jme, 100.0 * ame
