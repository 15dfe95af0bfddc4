"""Rigid alignment of point sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array


@dataclass(frozen=True)
class RigidTransform:
    """A proper rigid motion: `rotmat` (*batch, 3, 3), then `translation_m` (*batch, 3)."""

    rotmat: Array
    translation_m: Array

    def apply(self, points: Array) -> Array:
        """Move points (*batch, n, 3)."""
        moved = np.einsum("...ij,...nj->...ni", self.rotmat, points) + self.translation_m[..., None, :]
        return np.asarray(moved)


def best_rotation(source: Array, target: Array) -> Array:
    """Return the proper rotations (*batch, 3, 3) that turn vectors `source` (*batch, n, 3) best onto `target`.

    Least squares without centring (Arun, Huang and Blostein 1987; the determinant is kept at +1, so nothing mirrors).
    """
    covariance = np.einsum("...ni,...nj->...ij", target, source)
    u, _, vt = np.linalg.svd(covariance)
    sign = np.linalg.det(u) * np.linalg.det(vt)
    u[..., :, 2] *= np.where(sign < 0, -1.0, 1.0)[..., None]
    return np.asarray(u @ vt)


def align_rigid(source: Array, target: Array) -> RigidTransform:
    """Return the proper rigid motion that brings points `source` (*batch, n, 3) closest to `target`, without scale."""
    source_mean = source.mean(axis=-2, keepdims=True)
    target_mean = target.mean(axis=-2, keepdims=True)
    rotmat = best_rotation(source - source_mean, target - target_mean)
    translation = target_mean[..., 0, :] - np.einsum("...ij,...j->...i", rotmat, source_mean[..., 0, :])
    return RigidTransform(rotmat=rotmat, translation_m=translation)
