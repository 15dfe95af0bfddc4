"""The bulk solver: ADMM on positions, one factor for all variants of a take, batched over variants.

The splitting z_e = p_child - p_parent puts the exact bone length (and the girdle's rigidity) on z, where it is a
projection onto a sphere; what is left for p is the quadratic energy, whose matrix never changes.  A forward-kinematics
projection ends it, so that bones are exact whatever the iteration left.  The energy need not fall meanwhile: callers
look at the residual and hand bad variants to guaranteed descent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.bulk_kernels import (
    add_stencils,
    assemble,
    assemble_pairs,
    project_edges,
    project_near,
)
from pasdedeux.augmentation.contacts import aim_contacts
from pasdedeux.augmentation.factor import Factor, factorise, solve
from pasdedeux.augmentation.problem import AXIS_GROUP, GIRDLE_PAIRS, Problem, Targets
from pasdedeux.augmentation.source import NUM_POINTS, points_of
from pasdedeux.augmentation.terms import right_hand_side
from pasdedeux.kinematics import bone_directions, place_bones
from pasdedeux.skeletons import BODY22

__all__ = ["BulkResult", "BulkSolver", "project_to_bones"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]

_BONES = np.array(
    [[parent + offset, child + offset] for offset in (0, BODY22.num_joints) for parent, child in BODY22.bones]
)
_EDGES = np.ascontiguousarray(np.concatenate([_BONES, GIRDLE_PAIRS]))
_NUM_BONES = len(_BONES)
_AXES = tuple(np.flatnonzero(np.array(AXIS_GROUP) == group) for group in (0, 1))


_PENALTY = 8.0
"""ADMM penalty on bone vectors, in units of the Laplacian weight."""
_CONTACT_PENALTY = 0.15
"""What an edge's penalty gains per unit of contact weight at its ends; with one penalty for all edges the iteration
swings wherever contacts are dense."""
_CLEARANCE_PENALTY = 0.12
"""Penalty of near bones per unit of their weight."""
_RELAXATION = 1.4
"""Over-relaxation, 1 (none) to 1.8."""


@dataclass(frozen=True)
class BulkResult:
    """What the bulk solver gives.

    Args:
        positions: Positions with exact bones (variant, T, 44, 3), metres.
        residual_m: Root mean square bone error before the final projection (variant,), metres.
    """

    positions: Array
    residual_m: Array


class BulkSolver:
    """The factor of a take, ready for any number of batches of variants.

    The number of iterations is that of the problem's settings, the same for all: stopping each variant at a tolerance
    makes results jump where the count does, and a model that learns how motion changes with scale learns the jumps.

    Args:
        problem: What the variants share.
        dtype: Precision of the iteration; targets and the final projection stay in 64 bits.
    """

    def __init__(self, problem: Problem, *, dtype: type[np.floating] = np.float32) -> None:
        self.problem = problem
        penalties = _penalties(problem)
        near = problem.clearance
        near_penalties = _CLEARANCE_PENALTY * near.weights
        stencils = np.zeros(problem.matrix.shape[1:])
        edges = np.tile(_EDGES, (len(penalties), 1, 1))
        add_stencils(edges, np.tile([1.0, -1.0], (*penalties.shape, 1)), penalties, stencils)
        add_stencils(near.points, near.shares, near_penalties, stencils)
        matrix = problem.matrix + stencils
        self._factors: list[Factor] = [
            factorise(matrix[group], problem.lag1[group], problem.lag2[group]).astype(dtype) for group in (0, 1)
        ]
        self._penalties: AnyFloat = penalties.astype(dtype)
        self._shares: AnyFloat = near.shares.astype(dtype)
        self._normals: AnyFloat = near.normals.astype(dtype)
        self._near_penalties: AnyFloat = near_penalties.astype(dtype)
        self._constants: AnyFloat = np.array([_RELAXATION, _CLEARANCE_PENALTY]).astype(dtype)
        self._contact_shares: AnyFloat = problem.contacts.shares.astype(dtype)
        self._contact_weights: AnyFloat = problem.contact_weights.astype(dtype)
        self._direction: AnyFloat = np.array([problem.weights.contact_direction]).astype(dtype)
        self._girdle: AnyFloat = np.array([problem.weights.girdle]).astype(dtype)
        self._dtype = dtype

    def solve(self, targets: Targets) -> BulkResult:
        """Solve a batch of variants; what a variant gets does not depend on the others, to the last bit."""
        problem, dtype = self.problem, self._dtype
        frames, count = problem.num_frames, targets.num_variants
        blocks, near = self._factors[0].num_blocks, problem.clearance
        shape = (3, 2 * blocks, NUM_POINTS, count)
        linear: AnyFloat = np.zeros(shape, dtype)
        for variant in range(count):
            # One by one: BLAS sums in another order for another number of columns.
            linear[:, :frames, :, variant] = right_hand_side(problem, targets.select([variant]))[..., 0]
        edges = targets.reference[:, :, _EDGES[:, 1]] - targets.reference[:, :, _EDGES[:, 0]]
        lengths = np.empty((frames, len(_EDGES), count), dtype)
        lengths[:, :_NUM_BONES] = targets.lengths_m[:, _BONES[:, 1]].T
        lengths[:, _NUM_BONES:] = np.transpose(targets.girdle_m, (1, 2, 0))
        touching = problem.contacts.points
        between: AnyFloat = np.ascontiguousarray(
            np.transpose(problem.contacts.vectors(targets.reference), (3, 1, 2, 0)), dtype
        )
        kept: AnyFloat = np.ascontiguousarray(np.transpose(targets.contact_m, (3, 1, 2, 0)), dtype)
        contact_aim = kept - between
        state = _Iteration(
            offsets=np.zeros(shape, dtype),
            linear=linear,
            reference=np.ascontiguousarray(np.transpose(edges, (3, 1, 2, 0)), dtype),
            dual=np.zeros((3, frames, len(_EDGES), count), dtype),
            aim=np.zeros((3, frames, len(_EDGES), count), dtype),
            lengths=lengths,
            limits=np.ascontiguousarray(np.transpose(targets.clearance_m, (1, 2, 0)), dtype),
            near_dual=np.zeros((3, *near.weights.shape, count), dtype),
            near_aim=np.zeros((3, *near.weights.shape, count), dtype),
        )
        squared: AnyFloat = np.zeros((frames, count), dtype)
        self._project(state, squared, is_first=True)
        for iteration in range(problem.settings.num_iterations):
            if iteration > 0:
                aim_contacts(
                    *(state.offsets, between, touching, self._contact_shares, kept),
                    *(self._contact_weights, self._direction, contact_aim),
                )
            assemble(state.linear, state.reference, state.aim, _EDGES, self._penalties, state.offsets)
            assemble_pairs(state.near_aim, near.points, self._shares, self._near_penalties, state.offsets)
            assemble_pairs(contact_aim, touching, self._contact_shares, self._contact_weights, state.offsets)
            for group, axes in enumerate(_AXES):
                solve(self._factors[group], state.offsets.reshape(3, blocks, 2 * NUM_POINTS, count), axes)
            self._project(state, squared, is_first=False)
        residual = np.sqrt(np.array([column.mean() for column in squared.T.astype(np.float64)]) / _NUM_BONES)
        points = targets.reference + np.transpose(state.offsets[:, :frames], (3, 1, 2, 0))
        positions = project_to_bones(points, targets.lengths_m)
        return BulkResult(positions=positions, residual_m=residual)

    def _project(self, state: _Iteration, squared: AnyFloat, *, is_first: bool) -> None:
        project_edges(
            state.offsets,
            state.reference,
            state.dual,
            state.aim,
            state.lengths,
            _EDGES,
            _NUM_BONES,
            self._girdle,
            self._penalties,
            self._constants,
            is_first,
            squared,
        )
        project_near(
            state.offsets,
            state.near_dual,
            state.near_aim,
            state.limits,
            self.problem.clearance.points,
            self._shares,
            self._normals,
            self._near_penalties,
            self._constants,
            is_first,
        )


@dataclass(frozen=True)
class _Iteration:
    """Arrays of the iteration, variants last."""

    offsets: AnyFloat
    linear: AnyFloat
    reference: AnyFloat
    dual: AnyFloat
    aim: AnyFloat
    lengths: AnyFloat
    limits: AnyFloat
    near_dual: AnyFloat
    near_aim: AnyFloat


def project_to_bones(points: Array, lengths_m: Array) -> Array:
    """Return the points (variant, T, 44, 3) with their bone directions and exactly these lengths (variant, 44).

    The pelvis stays; a bone without direction takes none, which only a bone of length zero has.
    """
    pairs = points.reshape(*points.shape[:2], 2, BODY22.num_joints, 3)
    lengths = lengths_m.reshape(-1, 1, 2, BODY22.num_joints)
    return points_of(place_bones(BODY22, pairs[..., BODY22.root, :], bone_directions(BODY22, pairs), lengths))


def _penalties(problem: Problem) -> Array:
    """Return the penalty of each edge (T, edge): as stiff as what pulls at its ends, or the iteration swings there."""
    contact = np.zeros((problem.num_frames, NUM_POINTS))
    pull = problem.contact_weights[..., None] * np.abs(problem.contacts.shares)
    np.add.at(contact, (np.arange(len(contact))[:, None, None], problem.contacts.points), pull)
    stiffness = contact[:, _EDGES[:, 0]] + contact[:, _EDGES[:, 1]]
    return np.asarray(_PENALTY * problem.weights.laplacian + _CONTACT_PENALTY * stiffness)
