"""The energy of one variant as terms of a fit, and the solver with guaranteed descent; bones are exact.

The terms use the sums of `terms` for a take, as the bulk solver does, so each formula is written once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import weights
from pasdedeux.augmentation.contacts import ContactTerm
from pasdedeux.augmentation.problem import AXIS_GROUP, MeshProblem, Targets, girdle_pairs
from pasdedeux.augmentation.terms import right_hand_side
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitResult, FitSettings, fit_bones
from pasdedeux.fitting.terms import DistanceTerm, HalfSpaceTerm, QuadraticTerm, Term
from pasdedeux.skeletons import BODY22


def laplacian_residual(problem: MeshProblem, targets: Targets, offsets: Array) -> Array:
    """Return L x - L_c (s q - r) (variant, T, n, 3), metres, of offsets x = p - r (variant, T, n, 3)."""
    kept = np.matmul(problem.mesh.laplacian[None], offsets)
    return np.asarray(kept - np.matmul(problem.mesh.cross_laplacian[None], targets.difference))


def fit_terms(problem: MeshProblem, targets: Targets, variant: int) -> list[Term]:
    """State the energy of one variant as terms of a fit."""
    single = targets.select([variant])
    groups = list(AXIS_GROUP)
    direction, contacts = problem.contact_direction, problem.contacts
    missed = single.contact_m[0] - contacts.vectors(single.reference[0])
    kept = (direction * problem.contact_weights)[..., None] * missed
    quadratic = QuadraticTerm(
        origin_m=single.reference[0],
        matrix=problem.free_matrix,
        lag1=problem.lag1[groups],
        lag2=problem.lag2[groups],
        linear=right_hand_side(problem, single)[0] + contacts.spread(kept, problem.source.num_points),
        constant=_constant(problem, single) + float((kept * missed).sum()),
    )
    girdle = DistanceTerm(
        pairs=girdle_pairs(problem.source.num_people),
        lengths_m=single.girdle_m[0],
        weights=np.array(weights.GIRDLE),
    )
    near = problem.clearance
    clearance = HalfSpaceTerm(
        origin_m=single.reference[0],
        points=near.points,
        shares=near.shares,
        normals=near.normals,
        limits_m=single.clearance_m[0],
        weights=near.weights,
    )
    lengths = np.linalg.norm(single.contact_m[0], axis=-1)
    return [quadratic, girdle, clearance, ContactTerm(contacts, (1.0 - direction) * problem.contact_weights, lengths)]


def _constant(problem: MeshProblem, single: Targets) -> float:
    """Return the energy of the quadratic terms at x = 0, which depends on their targets alone."""
    difference = single.difference[0]
    parts = (
        weights.LAPLACIAN * laplacian_residual(problem, single, np.zeros((1, *difference.shape))) ** 2,
        problem.floor * single.height[0] ** 2,
        problem.stance[..., None] * np.diff(difference, axis=0)[..., [0, 2]] ** 2,
        (problem.anchor - weights.REFERENCE)[:, None] * difference**2,
    )
    return float(sum(part.sum() for part in parts))


def descend(
    targets: Targets,
    variant: int,
    terms: Sequence[Term],
    start: Array | None = None,
    settings: FitSettings | None = None,
) -> FitResult:
    """Minimise the terms of one variant, from `start` (T, n, 3) or from plain forward kinematics."""
    forest = BoneForest((BODY22,) * targets.bone_scale.shape[1], targets.lengths_m[variant])
    return fit_bones(forest, forest.state_of(targets.reference[variant] if start is None else start), terms, settings)
