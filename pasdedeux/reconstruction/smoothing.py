"""Smoothing of rotations over time: 1-euro for live use, Savitzky-Golay offline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import conjugate, multiply, normalise, rotvec_from_unitquat, slerp

__all__ = ["OneEuro", "bridge_gaps", "continuous_signs", "one_euro_share", "smooth_one_euro", "smooth_savitzky_golay"]

Array = npt.NDArray[np.float64]


def continuous_signs(unitquat: Array) -> Array:
    """Return the same rotations (frame, *batch, 4) with signs chosen so that neighbours lie on the same half-sphere."""
    dots = np.sum(unitquat[1:] * unitquat[:-1], axis=-1)
    flips = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    signs = np.concatenate([np.ones((1, *dots.shape[1:])), flips]) if len(unitquat) else np.ones(unitquat.shape[:-1])
    return np.asarray(unitquat * signs[..., None])


def smooth_savitzky_golay(unitquat: Array, *, num_frames: int = 9, order: int = 2) -> Array:
    """Smooth rotations (frame, *batch, 4) offline: polynomial fits over a window, by component, back on the sphere.

    Fitting components and normalising is exact to second order in the angle turned within the window.  The window
    shrinks for short motions; with fewer frames than `order` + 2 nothing is smoothed.

    Raises:
        InputError: An even or too short window.
    """
    if num_frames % 2 == 0 or num_frames <= order:
        raise InputError(f"the smoothing window is {num_frames} frames; it must be odd and more than {order}")
    length = min(num_frames, len(unitquat) - (len(unitquat) + 1) % 2)
    if length < order + 2:
        return np.array(unitquat)
    from scipy.signal import savgol_filter  # here: 0.3 s that planning does not need

    return normalise(savgol_filter(continuous_signs(unitquat), length, order, axis=0, mode="interp"))


@dataclass(frozen=True)
class OneEuro:
    """Parameters of the 1-euro filter (Casiez, Roussel and Vogel 2012).

    Args:
        min_cutoff_hz: Cut-off at rest; lower is smoother.
        beta: Growth of the cut-off with speed, Hz per rad/s; higher lags less.
        derivative_cutoff_hz: Cut-off of the speed estimate.
    """

    min_cutoff_hz: float = 1.5
    beta: float = 0.5
    derivative_cutoff_hz: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values without meaning."""
        if not (self.min_cutoff_hz > 0 and self.derivative_cutoff_hz > 0 and self.beta >= 0):
            raise InputError(f"1-euro filter: cut-offs must be positive and beta not negative, found {self}")


def smooth_one_euro(unitquat: Array, *, rate_hz: float, parameters: OneEuro | None = None) -> Array:
    """Smooth rotations (frame, *batch, 4) as they arrive: each result uses this frame and earlier ones only.

    The filter of Casiez, Roussel and Vogel (2012, algorithm 1) on the sphere: the difference to the last result is the
    rotation vector on the short arc, its low-passed value per second is the velocity (0 at first), the length of that
    raises the cut-off, and the low-pass of the rotation is a step along the arc.  About one fixed axis it is the filter
    of the angle.
    """
    parameters = parameters or OneEuro()
    smoothed = np.array(unitquat, dtype=np.float64)
    if len(smoothed) == 0:
        return smoothed
    velocity = np.zeros((*smoothed.shape[1:-1], 3))
    derivative_share = one_euro_share(np.asarray(parameters.derivative_cutoff_hz), rate_hz)
    for frame in range(1, len(smoothed)):
        step = rotvec_from_unitquat(multiply(unitquat[frame], conjugate(smoothed[frame - 1])))
        velocity = velocity + derivative_share * (step * rate_hz - velocity)
        speed = np.linalg.norm(velocity, axis=-1)
        share = one_euro_share(parameters.min_cutoff_hz + parameters.beta * speed, rate_hz)
        smoothed[frame] = slerp(smoothed[frame - 1], unitquat[frame], share)
    return smoothed


def one_euro_share(cutoff_hz: Array | float, rate_hz: float) -> Array:
    """Return the weight of a new sample in a first-order low-pass (Casiez, Roussel and Vogel 2012, algorithm 1)."""
    return np.asarray(1.0 / (1.0 + rate_hz / (2.0 * np.pi * np.asarray(cutoff_hz))))


def bridge_gaps(unitquat: Array, is_known: npt.NDArray[np.bool_]) -> Array:
    """Fill frames that are not known on the short arc between their neighbours; the ends repeat the nearest known one.

    Args:
        unitquat: Rotations (frame, *batch, 4); unknown frames may hold anything.
        is_known: (frame,).

    Raises:
        InputError: No frame is known.
    """
    known = np.flatnonzero(is_known)
    if len(known) == 0:
        raise InputError("nothing was seen in any frame; there is no motion to bridge")
    frames = np.arange(len(unitquat))
    after = np.searchsorted(known, frames)
    right = known[np.minimum(after, len(known) - 1)]
    left = known[np.maximum(np.where(is_known, after, after - 1), 0)]
    left = np.minimum(left, right)
    span = np.maximum(right - left, 1)
    fraction = np.clip((frames - left) / span, 0.0, 1.0)
    shape = (len(frames),) + (1,) * (unitquat.ndim - 2)
    bridged = slerp(unitquat[left], unitquat[right], np.broadcast_to(fraction.reshape(shape), unitquat.shape[:-1]))
    return np.where(np.reshape(is_known, (*shape, 1)), unitquat, bridged)
