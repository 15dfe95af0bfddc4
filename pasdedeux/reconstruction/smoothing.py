"""Smoothing of rotations over time: 1-euro for live use, Savitzky-Golay offline."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array, Flags
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotation_kernels import (
    conjugate,
    length,
    multiply,
    put_row,
    put_unitquat,
    rotvec_from_unitquat,
    row_of,
    scale,
    subtract,
    unitquat_from_rotvec,
    unitquat_of,
    weighted_sum,
)
from pasdedeux.kinematics.rotations import continuous_signs, normalise, slerp
from pasdedeux.settings import Settings


def smooth_savitzky_golay(unitquat: Array, *, num_frames: int = 9, order: int = 2) -> Array:
    """Smooth rotations (frame, *batch, 4) offline: fit polynomials to each component over a window, then normalise.

    Fitting components and normalising is exact to second order in the angle turned within the window.  The window
    shrinks for short motions; with fewer frames than `order` + 2 nothing is smoothed.
    """
    window = min(num_frames, len(unitquat) - (len(unitquat) + 1) % 2)
    if window < order + 2:
        return np.array(unitquat)
    from scipy.signal import savgol_filter  # here: 0.3 s that planning does not need

    return normalise(savgol_filter(continuous_signs(unitquat), window, order, axis=0, mode="interp"))


class OneEuro(Settings):
    """Parameters of the 1-euro filter (Casiez, Roussel and Vogel 2012)."""

    min_cutoff_hz: float = Field(1.5, gt=0, description="Cut-off at rest; lower is smoother")
    beta: float = Field(0.5, ge=0, description="Growth of the cut-off with speed, Hz per rad/s; higher lags less")
    derivative_cutoff_hz: float = Field(1.0, gt=0, description="Cut-off of the speed estimate")


class OneEuroFilter:
    """The 1-euro filter (Casiez, Roussel and Vogel 2012, algorithm 1), one frame at a time; a gap lowers its rate.

    For rotations, the difference from the last result is the rotation vector on the short arc.  Its low-passed value
    per second is the velocity (0 at first), whose length raises the cut-off; the rotation then takes a step along the
    arc.  About one fixed axis, this is the filter of the angle.
    """

    def __init__(self, parameters: OneEuro, rate_hz: float) -> None:
        self._parameters = parameters
        self._rate_hz = rate_hz
        self._frame = 0
        self._value: Array | None = None
        self._velocity: Array = np.zeros(0)

    def step(self, frame: int, value: Array) -> Array:
        """Return the smoothed rotations (n, 4) or points (n, 3) of this frame."""
        if self._value is None:
            self._value, self._velocity = np.array(value, dtype=np.float64), np.zeros((len(value), 3))
        else:
            options = self._parameters
            rate = self._rate_hz / max(frame - self._frame, 1)
            self._value, self._velocity = _filter(
                self._value,
                self._velocity,
                value,
                rate,
                options.min_cutoff_hz,
                options.beta,
                options.derivative_cutoff_hz,
            )
        self._frame = frame
        return self._value


@compiled()
def _filter(
    value: Array, velocity: Array, new: Array, rate: float, min_cutoff: float, beta: float, derivative_cutoff: float
) -> tuple[Array, Array]:
    """Return the next smoothed rotations (n, 4) or points (n, 3), and velocities (n, 3), rad/s or m/s."""
    smooth, pace = np.empty(value.shape), np.empty(velocity.shape)
    derivative_share = 1.0 / (1.0 + rate / (2.0 * np.pi * derivative_cutoff))
    for at in range(value.shape[0]):
        if value.shape[1] == 4:
            old = unitquat_of(value, at)
            moved = rotvec_from_unitquat(multiply(unitquat_of(new, at), conjugate(old)))
        else:
            moved = subtract(row_of(new, at), row_of(value, at))
        for part in range(3):
            pace[at, part] = velocity[at, part] + derivative_share * (moved[part] * rate - velocity[at, part])
        cutoff = min_cutoff + beta * length(row_of(pace, at))
        moved = scale(1.0 / (1.0 + rate / (2.0 * np.pi * cutoff)), moved)
        if value.shape[1] == 4:
            put_unitquat(smooth, at, multiply(unitquat_from_rotvec(moved), old))
        else:
            put_row(smooth, at, weighted_sum(1.0, row_of(value, at), 1.0, moved))
    return smooth, pace


def bridge_gaps(unitquat: Array, is_known: Flags) -> Array:
    """Interpolate unknown frames on the short arc between known ones; at the ends, repeat the nearest known frame.

    Args:
        unitquat: Rotations (frame, *batch, 4); unknown frames may hold anything.
        is_known: (frame,).
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
