"""The bulk solver: ADMM on positions, one factor for all variants of a take, batched over variants.

The splitting z_e = p_child - p_parent puts the exact bone length (and the girdle's rigidity) on z, where it is a
projection onto a sphere; what is left for p is the quadratic energy, whose matrix never changes.  A forward-kinematics
projection ends it, so that bones are exact whatever the iteration left.  The energy need not fall on the way: callers
look at the residual and hand bad variants to `descent`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.factor import Factor, factorise, solve
from pasdedeux.augmentation.source import NUM_POINTS
from pasdedeux.augmentation.terms import AXIS_GROUP, GIRDLE_PAIRS, Problem, Targets, right_hand_side
from pasdedeux.errors import InputError
from pasdedeux.kinematics import place_bones
from pasdedeux.skeletons import BODY22

__all__ = ["BulkResult", "BulkSettings", "BulkSolver", "project_to_bones"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]

_BONES = np.array(
    [[parent + offset, child + offset] for offset in (0, BODY22.num_joints) for parent, child in BODY22.bones]
)
_EDGES = np.ascontiguousarray(np.concatenate([_BONES, GIRDLE_PAIRS]))
_NUM_BONES = len(_BONES)


@dataclass(frozen=True)
class BulkSettings:
    """Settings of the iteration.

    Args:
        max_iterations: Most iterations.
        tolerance_m: A batch is done when no bone of a frame is further than this from its length (root mean square).
        penalty: ADMM penalty on bone vectors, in units of the Laplacian weight.
        contact_penalty: What an edge's penalty gains per unit of contact weight at its ends; with one penalty for all
            edges the iteration swings wherever contacts are dense.
        relaxation: Over-relaxation, 1 (none) to 1.8.
        is_single_precision: Iterate in 32-bit floats; targets and the final projection stay in 64.

    Raises:
        InputError: A value that is not allowed.
    """

    max_iterations: int = 32
    tolerance_m: float = 2e-4
    penalty: float = 8.0
    contact_penalty: float = 0.3
    relaxation: float = 1.4
    is_single_precision: bool = False

    def __post_init__(self) -> None:
        """Check the settings."""
        if self.max_iterations < 1 or not self.tolerance_m > 0 or not self.penalty > 0 or not 1 <= self.relaxation < 2:
            raise InputError(
                f"bulk solver: {self.max_iterations} iterations, tolerance {self.tolerance_m:g} m, penalty "
                f"{self.penalty:g}, relaxation {self.relaxation:g}; allowed are >= 1, > 0, > 0, and 1 to below 2"
            )


@dataclass(frozen=True)
class BulkResult:
    """What the bulk solver gives.

    Args:
        positions: Positions with exact bones (variant, T, 44, 3), metres.
        residual_m: Root mean square bone error before the final projection (variant,), metres.
        num_iterations: Iterations done.
    """

    positions: Array
    residual_m: Array
    num_iterations: int


class BulkSolver:
    """The factor of a take, ready for any number of batches of variants."""

    def __init__(self, problem: Problem, settings: BulkSettings | None = None) -> None:
        self.problem = problem
        self.settings = settings or BulkSettings()
        dtype = np.float32 if self.settings.is_single_precision else np.float64
        penalties = _penalties(problem, self.settings)
        matrix = problem.matrix + _penalty_matrix(penalties)
        self._factors: list[Factor] = [
            factorise(matrix[group], problem.lag1[group], problem.lag2[group]).astype(dtype) for group in (0, 1)
        ]
        self._penalties: AnyFloat = penalties.astype(dtype)
        self._dtype = dtype

    def solve(self, targets: Targets) -> BulkResult:
        """Solve a batch of variants."""
        problem, settings, dtype = self.problem, self.settings, self._dtype
        frames, count = problem.num_frames, targets.num_variants
        blocks = self._factors[0].num_blocks
        linear: AnyFloat = _padded(right_hand_side(problem, targets), blocks).astype(dtype)
        reference: AnyFloat = _padded(np.transpose(targets.reference, (3, 1, 2, 0)), blocks).astype(dtype)
        lengths = np.empty((frames, len(_EDGES), count), dtype)
        lengths[:, :_NUM_BONES] = targets.lengths_m[:, _BONES[:, 1]].T
        lengths[:, _NUM_BONES:] = np.transpose(targets.girdle_m, (1, 2, 0))
        stiffness = np.full(len(_EDGES), -1.0)
        stiffness[_NUM_BONES:] = problem.weights.girdle
        shape = (3, 2 * blocks, NUM_POINTS, count)
        solution = np.zeros_like(linear)
        offsets, linear, reference = solution.reshape(shape), linear.reshape(shape), reference.reshape(shape)
        dual = np.zeros((3, frames, len(_EDGES), count), dtype)
        aim = np.empty_like(dual)
        squared = np.zeros((frames, count))
        penalties = self._penalties
        _project_edges(offsets, reference, dual, aim, lengths, _EDGES, stiffness, penalties, 1.0, True, squared)
        num_iterations, relaxation = 0, settings.relaxation
        while num_iterations < settings.max_iterations:
            num_iterations += 1
            _assemble(linear, reference, aim, _EDGES, penalties, offsets)
            for axis, group in enumerate(AXIS_GROUP):
                solve(self._factors[group], solution[axis])
            _project_edges(
                offsets, reference, dual, aim, lengths, _EDGES, stiffness, penalties, relaxation, False, squared
            )
            if np.sqrt(squared.max() / _NUM_BONES) < settings.tolerance_m:
                break
        residual = np.sqrt(squared.mean(axis=0) / _NUM_BONES)
        points = reference[:, :frames].astype(np.float64) + offsets[:, :frames]
        positions = project_to_bones(np.transpose(points, (3, 1, 2, 0)), targets.lengths_m)
        return BulkResult(positions=positions, residual_m=residual, num_iterations=num_iterations)


def project_to_bones(points: Array, lengths_m: Array) -> Array:
    """Give the points (variant, T, 44, 3) with their bone directions and exactly these lengths (variant, 44).

    The pelvis stays; a bone without direction takes none, which only a bone of length zero has.
    """
    half = BODY22.num_joints
    positions = np.empty(points.shape)
    for offset in (0, half):
        person = points[:, :, offset : offset + half]
        directions = np.zeros(person.shape)
        for parent, child in BODY22.bones:
            vector = person[:, :, child] - person[:, :, parent]
            norm = np.linalg.norm(vector, axis=-1, keepdims=True)
            directions[:, :, child] = vector / np.where(norm > 0, norm, 1.0)
        positions[:, :, offset : offset + half] = place_bones(
            BODY22, person[:, :, BODY22.root], directions, lengths_m[:, None, offset : offset + half]
        )
    return positions


def _penalties(problem: Problem, settings: BulkSettings) -> Array:
    """Give the penalty of each edge (T, edge): as stiff as what pulls at its ends, or the iteration swings there."""
    contact = np.concatenate([problem.contact.sum(axis=2), problem.contact.sum(axis=1)], axis=1)
    stiffness = contact[:, _EDGES[:, 0]] + contact[:, _EDGES[:, 1]]
    return np.asarray(settings.penalty * problem.weights.laplacian + settings.contact_penalty * stiffness)


def _penalty_matrix(penalties: Array) -> Array:
    matrix = np.zeros((len(penalties), NUM_POINTS, NUM_POINTS))
    for (parent, child), penalty in zip(_EDGES, penalties.T, strict=True):
        matrix[:, parent, parent] += penalty
        matrix[:, child, child] += penalty
        matrix[:, parent, child] -= penalty
        matrix[:, child, parent] -= penalty
    return matrix


def _padded(values: Array, blocks: int) -> Array:
    """Lay (3, T, 44, variant) out as (3, block, 88, variant), a last odd frame followed by zeros."""
    padded = np.zeros((3, 2 * blocks, NUM_POINTS, values.shape[-1]))
    padded[:, : values.shape[1]] = values
    return padded.reshape(3, blocks, 2 * NUM_POINTS, values.shape[-1])


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})
def _project_edges(
    offsets: AnyFloat,
    reference: AnyFloat,
    dual: AnyFloat,
    aim: AnyFloat,
    lengths: AnyFloat,
    edges: npt.NDArray[np.int64],
    stiffness: AnyFloat,
    penalties: AnyFloat,
    relaxation: float,
    is_first: bool,
    squared: AnyFloat,
) -> None:
    """Project edge vectors onto their spheres, update the duals, leave z - u in `aim`, sum squared bone errors."""
    frames, num_edges, count = lengths.shape
    squared[:] = 0.0
    for t in range(frames):
        for e in range(num_edges):
            parent, child = edges[e, 0], edges[e, 1]
            k, penalty = stiffness[e], penalties[t, e]
            for v in range(count):
                x = (
                    offsets[0, t, child, v]
                    - offsets[0, t, parent, v]
                    + reference[0, t, child, v]
                    - reference[0, t, parent, v]
                )
                y = (
                    offsets[1, t, child, v]
                    - offsets[1, t, parent, v]
                    + reference[1, t, child, v]
                    - reference[1, t, parent, v]
                )
                z = (
                    offsets[2, t, child, v]
                    - offsets[2, t, parent, v]
                    + reference[2, t, child, v]
                    - reference[2, t, parent, v]
                )
                length = lengths[t, e, v]
                if k < 0.0:
                    miss = np.sqrt(x * x + y * y + z * z) - length
                    squared[t, v] += miss * miss
                ux, uy, uz = dual[0, t, e, v], dual[1, t, e, v], dual[2, t, e, v]
                if not is_first:
                    # The last z is aim + u; over-relaxation mixes it in.
                    x = relaxation * x + (1.0 - relaxation) * (aim[0, t, e, v] + ux)
                    y = relaxation * y + (1.0 - relaxation) * (aim[1, t, e, v] + uy)
                    z = relaxation * z + (1.0 - relaxation) * (aim[2, t, e, v] + uz)
                x, y, z = x + ux, y + uy, z + uz
                norm = np.sqrt(x * x + y * y + z * z) + 1e-12
                wanted = length if k < 0.0 else (penalty * norm + k * length) / (penalty + k)
                scale = wanted / norm
                ux, uy, uz = x * (1.0 - scale), y * (1.0 - scale), z * (1.0 - scale)
                dual[0, t, e, v], dual[1, t, e, v], dual[2, t, e, v] = ux, uy, uz
                aim[0, t, e, v] = x * scale - ux
                aim[1, t, e, v] = y * scale - uy
                aim[2, t, e, v] = z * scale - uz


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})
def _assemble(
    linear: AnyFloat,
    reference: AnyFloat,
    aim: AnyFloat,
    edges: npt.NDArray[np.int64],
    penalties: AnyFloat,
    rhs: AnyFloat,
) -> None:
    """Give b + penalty S^T (z - u - S r) in `rhs`."""
    frames, num_edges, count = aim.shape[1:]
    rhs[:] = linear
    for axis in range(3):
        for t in range(frames):
            for e in range(num_edges):
                parent, child, penalty = edges[e, 0], edges[e, 1], penalties[t, e]
                for v in range(count):
                    pull = penalty * (aim[axis, t, e, v] - reference[axis, t, child, v] + reference[axis, t, parent, v])
                    rhs[axis, t, child, v] += pull
                    rhs[axis, t, parent, v] -= pull
