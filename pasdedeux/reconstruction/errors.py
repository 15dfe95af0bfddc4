"""Errors of a reconstructed motion against ground truth (Yiannakides et al. 2019, section 6.2)."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import rotmat_from_unitquat
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.skeletons import OP14

_STANDING_M = 0.05
"""An ankle within this height of its lowest true position may count as standing."""
_STILL_M_S = 0.2
"""A true ankle slower than this may count as standing."""


def _centred(positions_m: Array) -> Array:
    if positions_m.shape[-2:] != (OP14.num_joints, 3):
        raise InputError(f"op14 positions have shape {positions_m.shape}, expected (..., {OP14.num_joints}, 3)")
    return np.asarray(positions_m - mid_hip(positions_m)[..., None, :])


def _without_root_rotation(centred_m: Array) -> Array:
    rotmat = rotmat_from_unitquat(bone_rotations(centred_m)[..., OP14.root, :])
    return np.asarray(np.einsum("...ji,...nj->...ni", rotmat, centred_m))


def root_centred_error_m(found_m: Array, true_m: Array) -> Array:
    """Return the mean joint distance (*batch,) of op14 poses (*batch, 14, 3): mid-hips aligned, root rotation kept."""
    return np.asarray(np.linalg.norm(_centred(found_m) - _centred(true_m), axis=-1).mean(axis=-1))


def root_removed_error_m(found_m: Array, true_m: Array) -> Array:
    """Return the same with the rotation of the root removed too, as Yiannakides et al. (2019, section 6.2) do.

    The root's rotation is the frame of the body: up from mid-hip to neck, left from hips and shoulders.
    """
    centred, true = _without_root_rotation(_centred(found_m)), _without_root_rotation(_centred(true_m))
    return np.asarray(np.linalg.norm(centred - true, axis=-1).mean(axis=-1))


def scale_free_error_m(found_m: Array, true_m: Array) -> Array:
    """Return the root-centred error (frame,) after the best scale for the whole track, in metres of the truth.

    One camera does not show how large a person is, so this error excludes the size of the body.
    """
    made, true = _centred(found_m), _centred(true_m)
    power = float(np.sum(made**2))
    scale = float(np.sum(made * true)) / power if power > 0 else 1.0
    return np.asarray(np.linalg.norm(scale * made - true, axis=-1).mean(axis=-1))


def jitter_m(positions_m: Array) -> float:
    """Return the mean length of the second difference of joints (frame, joint, 3) over time; 0 below three frames."""
    if len(positions_m) < 3:
        return 0.0
    second = positions_m[2:] - 2.0 * positions_m[1:-1] + positions_m[:-2]
    return float(np.linalg.norm(second, axis=-1).mean())


def foot_slide_m(found_m: Array, true_m: Array, *, rate_hz: float) -> float:
    """Return the mean horizontal displacement of standing ankles per frame; 0 if they never stand.

    It is taken over the frames in which the true ankles stand, so that all methods are compared over the same frames.

    Args:
        found_m: op14 positions (frame, 14, 3), upright axes, with the root's motion; NaN frames do not count.
        true_m: The true ones.
        rate_hz: Frames per second.
    """
    ankles = OP14.indices(["left_ankle", "right_ankle"])
    made, true = found_m[:, ankles], true_m[:, ankles]
    if len(true) < 2:
        return 0.0
    is_low = true[..., 1] < true[..., 1].min(axis=0) + _STANDING_M
    is_still = np.linalg.norm(np.diff(true, axis=0), axis=-1) * rate_hz < _STILL_M_S
    displacement = np.linalg.norm(np.diff(made, axis=0)[..., [0, 2]], axis=-1)
    stands = is_low[1:] & is_low[:-1] & is_still & np.isfinite(displacement)
    return float(displacement[stands].mean()) if stands.any() else 0.0
