"""The energy of variants, evaluated term by term as it is written."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.clearance import separations
from pasdedeux.augmentation.problem import GIRDLE_PAIRS, Problem, Targets
from pasdedeux.augmentation.spans import span_vectors
from pasdedeux.augmentation.terms import bending_rows
from pasdedeux.skeletons import BODY22

__all__ = ["energy_terms", "laplacian_residual", "total_energy"]

Array = npt.NDArray[np.float64]


def laplacian_residual(problem: Problem, targets: Targets, offsets: Array) -> Array:
    """Return L x - L_c d (variant, T, 44, 3), metres, of offsets x = p - r (variant, T, 44, 3)."""
    kept = np.matmul(problem.mesh.laplacian[None], offsets)
    return np.asarray(kept - np.matmul(problem.mesh.cross_laplacian[None], targets.difference))


def energy_terms(problem: Problem, targets: Targets, offsets: Array) -> dict[str, Array]:
    """Return each term's energy (variant,) for offsets x = p - r (variant, T, 44, 3); see `terms` for the formulas."""
    weights, half = problem.weights, BODY22.num_joints
    apart = offsets - targets.difference
    terms = {
        "laplacian": weights.laplacian * (laplacian_residual(problem, targets, offsets) ** 2).sum(axis=(1, 2, 3)),
        "smoothness": problem.smoothness * (np.diff(offsets, n=2, axis=1) ** 2).sum(axis=(1, 2, 3)),
        "reference": weights.reference * (offsets**2).sum(axis=(1, 2, 3)),
        "floor": (problem.floor * (offsets[..., 1] - targets.height) ** 2).sum(axis=(1, 2)),
        "stance": (problem.stance[..., None] * np.diff(apart, axis=1)[..., [0, 2]] ** 2).sum(axis=(1, 2, 3)),
        "fixed": ((problem.anchor - weights.reference)[:, None] * apart**2).sum(axis=(1, 2, 3)),
    }
    bends = np.einsum("mi,vtia->vtma", bending_rows(problem.source), offsets)
    terms["bending"] = weights.bending * (bends**2).sum(axis=(1, 2, 3))
    frame, first, second = problem.touching
    gaps = apart[:, frame, first] - apart[:, frame, second + half]
    if problem.contact_shift is not None:
        gaps = gaps - problem.contact_shift
    terms["contact"] = (problem.directed[frame, first, second] * (gaps**2).sum(axis=-1)).sum(axis=1)
    positions = targets.reference + offsets
    lengths = np.linalg.norm(span_vectors(problem.spans, positions), axis=-1)
    terms["spans"] = (problem.spans.weights * (lengths - problem.spans.lengths_m) ** 2).sum(axis=(1, 2))
    points = positions[:, :, GIRDLE_PAIRS]
    distance = np.linalg.norm(points[..., 0, :] - points[..., 1, :], axis=-1)
    terms["girdle"] = weights.girdle * ((distance - targets.girdle_m) ** 2).sum(axis=(1, 2))
    short = np.maximum(targets.clearance_m - separations(problem.clearance, offsets), 0.0)
    terms["clearance"] = (problem.clearance.weights * short**2).sum(axis=(1, 2))
    return terms


def total_energy(problem: Problem, targets: Targets, offsets: Array) -> Array:
    """Return the energy (variant,) of offsets x = p - r (variant, T, 44, 3)."""
    return np.asarray(sum(energy_terms(problem, targets, offsets).values()))
