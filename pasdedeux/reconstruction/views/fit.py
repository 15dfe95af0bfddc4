"""Fit poses with exact bones to the rays of all views at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import ACCELERATION_M_S2, HALF_WEIGHT, BoneVectorTerm
from pasdedeux.fitting.terms import AccelerationTerm, Normal, Term
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.reconstruction.views.calibration import View
from pasdedeux.skeletons import OP14

_BONE_DEVIATION_M = 0.1
"""Standard deviation of a bone by one view alone, where several views see it."""
_MIN_NOISE_M = 0.008
"""Smallest noise assumed of rays."""
_NUM_ROUNDS = 3
_STOP = FitSettings(max_iterations=10, tolerance=1e-3)


@dataclass(frozen=True)
class RayTerm(Term):
    """sum w |(I - d d') (p - c)|^2: each joint on the ray in which a camera sees it.

    Args:
        camera_m: Place of the camera c (3,).
        rays: Unit directions d (T, N, 3); anything where the weight is 0.
        weights: (T, N).
    """

    camera_m: Array
    rays: Array
    weights: Array

    is_quadratic = False  # its axes depend on each other, which only stencils can express

    def _across(self, positions_m: Array) -> Array:
        away = positions_m - self.camera_m
        return np.asarray(away - (away * self.rays).sum(axis=-1, keepdims=True) * self.rays)

    def off_m(self, positions_m: Array) -> Array:
        """Return the distance of each joint from its ray (T, N)."""
        return np.asarray(np.linalg.norm(self._across(positions_m), axis=-1))

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        return float((self.weights * self.off_m(positions_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        normal.gradient += self.weights[..., None] * self._across(positions_m)

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the curvature: one part along each of two directions across the ray."""
        frames, joints = self.weights.shape
        points = np.broadcast_to(np.arange(joints)[:, None], (frames, joints, 1))
        helper = np.where(np.abs(self.rays[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
        first = np.cross(self.rays, helper)
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        for unit in (first, np.cross(self.rays, first)):
            normal.stencils.append((points, np.ones(points.shape), self.weights, unit))


def fit_person(
    views: Sequence[View], person: int, guess_m: Array, lengths_m: Array, rate_hz: float
) -> tuple[Array, float]:
    """Return a person's poses fitted to all views (frame, 14, 3), and the median distance of joints from their rays.

    Args:
        views: Calibrated views.
        person: Number of the person in them.
        guess_m: Poses by one view (frame, 14, 3), axes of the first camera; they decide where rays do not.
        lengths_m: Bone lengths (14,), kept exactly.
        rate_hz: Frames per second.
    """
    forest = BoneForest((OP14,), lengths_m)
    guess_lengths = np.median(bone_lengths(OP14, guess_m), axis=0)
    scale = lengths_m / np.where(guess_lengths > 0, guess_lengths, 1.0)
    parents = np.array(OP14.parents)
    vectors = (guess_m - guess_m[:, np.where(parents < 0, 0, parents)]) * scale[:, None]
    smooth = AccelerationTerm(np.array((rate_hz**2 / ACCELERATION_M_S2) ** 2))
    bones = BoneVectorTerm(OP14, vectors, np.array(1.0 / _BONE_DEVIATION_M**2))
    rays = []
    for view in views:
        is_seen = view.confidence[:, person] > 0
        ray = np.where(is_seen[..., None], view.rays[:, person], [0.0, 0.0, -1.0])
        rays.append(RayTerm(view.position_m, ray, np.where(is_seen, view.confidence[:, person], 0.0)))
    noise, robust = _MIN_NOISE_M, [np.ones(term.weights.shape) for term in rays]
    state = forest.state_of(guess_m)
    for _ in range(_NUM_ROUNDS):
        terms = [
            RayTerm(term.camera_m, term.rays, term.weights * share / noise**2)
            for term, share in zip(rays, robust, strict=True)
        ]
        result = fit_bones(forest, state, [*terms, smooth, bones], _STOP)
        state = result.state
        off = [np.where(term.weights > 0, term.off_m(result.positions_m), np.nan) for term in rays]
        # The median of a Rayleigh distribution is 1.1774 deviations.
        noise = max(_MIN_NOISE_M, float(np.nanmedian(np.stack(off))) / 1.1774)
        robust = [1.0 / (1.0 + (np.nan_to_num(off_m) / (HALF_WEIGHT * noise)) ** 2) for off_m in off]
    return result.positions_m, float(np.nanmedian(np.stack(off)))
