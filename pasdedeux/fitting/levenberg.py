"""Levenberg-Marquardt on bone directions: bone lengths exact at every step, energy never rises.

Points are linear in each bone's vector and every bone moves on its own sphere, so the exact curvature is the
Gauss-Newton one plus a diagonal: bone b adds -l_b u_b . G_b, G_b the gradient summed over the points it carries (the
pull of the motion along the bone).  Its positive part is kept, which speeds up the last steps and cannot spoil descent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers, plain
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.fitting.blocks import NotPositiveDefinite, solve_blocks
from pasdedeux.fitting.bones import BoneForest, BoneState, tangents_of
from pasdedeux.fitting.terms import AXES, Normal, Term, total_energy

SMALLEST_CURVATURE = 1e-9
"""Added to the diagonal so that a bone of length zero, which moves nothing, has a step of zero."""


FIRST_DAMPING, SMALLEST_DAMPING = 1e-4, 1e-12
"""As shares of the diagonal."""
LARGEST_DAMPING = 1e8
"""A fit ends when the damping exceeds this."""


@dataclass(frozen=True)
class FitSettings:
    """When to stop.

    Args:
        max_iterations: Largest number of accepted or refused steps.
        tolerance: Stop when a step lowers the energy by less than this share.
    """

    max_iterations: int = 30
    tolerance: float = 1e-6


@dataclass(frozen=True)
class FitResult:
    """The fitted motion and its energies.

    Args:
        positions_m: (T, N, 3), metres.
        state: Roots and directions.
        energies: Energy at the start and after every accepted step; never rises.
        num_iterations: Steps tried.
    """

    positions_m: Array
    state: BoneState
    energies: tuple[float, ...]
    num_iterations: int


def fit_bones(
    forest: BoneForest, start: BoneState, terms: Sequence[Term], settings: FitSettings | None = None
) -> FitResult:
    """Minimise the terms over roots and bone directions of a whole clip.

    Args:
        forest: Skeletons and their lengths.
        start: First guess.
        terms: Terms; together they should determine every unknown (a weak `PointTerm` does).
        settings: When to stop.
    """
    settings = settings or FitSettings()
    state = start
    positions = forest.positions(state)
    energy = total_energy(terms, positions)
    if not np.isfinite(energy):
        raise InputError("the energy of the first guess is not finite: positions, targets and weights must be")
    constant = Normal.zeros(*positions.shape[:2])
    for term in terms:
        if term.is_quadratic:
            term.add_curvature(positions, constant)
    carried = _carry(forest, constant)
    del constant
    energies = [energy]
    damping, is_converged, iteration = FIRST_DAMPING, False, 0
    is_fresh = False
    while iteration < settings.max_iterations and not is_converged:
        if not is_fresh:
            normal = Normal.zeros(0, positions.shape[1])
            normal.gradient = np.zeros(positions.shape)
            for term in terms:
                term.add_gradient(positions, normal)
                if not term.is_quadratic:
                    term.add_curvature(positions, normal)
            tangents = tangents_of(state.directions)
            diagonal, below, gradient = _reduce(forest, state, tangents, carried, normal)
            is_fresh = True
        iteration += 1
        try:
            step = -solve_blocks(_damped(diagonal, damping), below, gradient)
            moved = forest.retract(state, tangents, step)
            moved_positions = forest.positions(moved)
            moved_energy = total_energy(terms, moved_positions)
        except NotPositiveDefinite:
            moved_energy = np.inf
        if moved_energy <= energy:
            is_converged = energy - moved_energy <= settings.tolerance * energy
            state, positions, energy = moved, moved_positions, moved_energy
            energies.append(energy)
            damping, is_fresh = max(damping * 0.1, SMALLEST_DAMPING), False
        else:
            damping *= 10.0
            is_converged = damping > LARGEST_DAMPING
    return FitResult(positions_m=positions, state=state, energies=tuple(energies), num_iterations=iteration)


def _damped(diagonal: Array, damping: float) -> Array:
    blocks = np.array(diagonal)
    entries = np.einsum("tii->ti", blocks)  # a view
    entries *= 1.0 + damping
    entries += SMALLEST_CURVATURE
    return blocks


def _carry(forest: BoneForest, normal: Normal) -> tuple[Array, Array, Array]:
    """Sum curvature over the points that bones carry: C K C' within frames (3, T, N, N), C l between (3, T - lag, N).

    Between frames, K is a diagonal l, and C l C' has an entry only if one bone carries the other: the sum of l over the
    points that the further bone carries.
    """
    carries = forest.topology.carries
    within = carries @ normal.matrix @ carries.T
    return np.ascontiguousarray(within), normal.lag1 @ carries.T, normal.lag2 @ carries.T


def _reduce(
    forest: BoneForest, state: BoneState, tangents: Array, carried: tuple[Array, Array, Array], normal: Normal
) -> tuple[Array, Array, Array]:
    """Return the normal equations in the unknowns of the step: blocks as `solve_blocks` takes them, and gradient."""
    frames, points = state.directions.shape[:2]
    shape = forest.topology
    carries, starts, n = shape.carries, shape.starts, int(shape.starts[-1])
    basis = np.zeros((frames, points, AXES, 3))
    basis[..., :2] = tangents * forest.lengths_m[:, None, None]
    basis[:, shape.roots] = np.eye(3)
    summed = carries @ normal.gradient
    full = np.einsum("tga,tgak->tgk", summed, basis)
    gradient = full[:, shape.unknown_points, shape.unknown_columns]
    bending = np.maximum(-(summed * state.directions).sum(axis=-1) * forest.lengths_m, 0.0)
    bending[:, shape.roots] = 0.0

    diagonal = np.zeros((frames, n, n))
    below = np.zeros((frames, 2, n, n))
    _reduce_within(carried[0], basis, bending, starts, diagonal)
    for lag in (1, 2):
        if frames > lag:
            _reduce_between(carried[lag], basis, shape.related, shape.further, starts, lag, below)
    for points, shares, weights, unit in normal.stencils:
        _add_stencils(plain(points), plain(shares), plain(weights), plain(unit), carries, basis, starts, diagonal)
    return diagonal, below, gradient


@compiled()
def _reduce_within(carried: Array, basis: Array, bending: Array, starts: Integers, diagonal: Array) -> None:
    _, frames, points, _ = carried.shape
    for t in range(frames):
        for g in range(points):
            for h in range(g + 1):
                a, b, c = carried[0, t, g, h], carried[1, t, g, h], carried[2, t, g, h]
                if a == 0.0 and b == 0.0 and c == 0.0:
                    continue
                for i in range(starts[g + 1] - starts[g]):
                    x, y, z = a * basis[t, g, 0, i], b * basis[t, g, 1, i], c * basis[t, g, 2, i]
                    for j in range(starts[h + 1] - starts[h]):
                        value = x * basis[t, h, 0, j] + y * basis[t, h, 1, j] + z * basis[t, h, 2, j]
                        diagonal[t, starts[g] + i, starts[h] + j] = value
                        diagonal[t, starts[h] + j, starts[g] + i] = value
            for i in range(starts[g], starts[g + 1]):
                diagonal[t, i, i] += bending[t, g]


@compiled()
def _add_stencils(
    points: Integers,
    shares: Array,
    weights: Array,
    units: Array,
    carries: Array,
    basis: Array,
    starts: Integers,
    diagonal: Array,
) -> None:
    """Add sum w r' r; r has the derivatives of a combination of points along its unit vector, mostly zero."""
    frames, count, size = points.shape
    num_bones = len(carries)
    row, used = np.empty(starts[-1]), np.empty(starts[-1], np.int64)
    for t in range(frames):
        for e in range(count):
            weight = weights[t, e]
            if weight == 0.0:
                continue
            num_used = 0
            for g in range(num_bones):
                moved = 0.0
                for k in range(size):
                    moved += shares[t, e, k] * carries[g, points[t, e, k]]
                if moved == 0.0:
                    continue
                for i in range(starts[g + 1] - starts[g]):
                    along = 0.0
                    for axis in range(3):
                        along += units[t, e, axis] * basis[t, g, axis, i]
                    row[num_used], used[num_used] = moved * along, starts[g] + i
                    num_used += 1
            for i in range(num_used):
                value = weight * row[i]
                for j in range(num_used):
                    diagonal[t, used[i], used[j]] += value * row[j]


@compiled()
def _reduce_between(
    summed: Array, basis: Array, related: Integers, further: Integers, starts: Integers, lag: int, below: Array
) -> None:
    frames = summed.shape[1]
    for t in range(frames):
        for row in range(len(related)):
            g, h, carried = related[row, 0], related[row, 1], further[row]
            a, b, c = summed[0, t, carried], summed[1, t, carried], summed[2, t, carried]
            for i in range(starts[g + 1] - starts[g]):
                x = a * basis[t + lag, g, 0, i]
                y = b * basis[t + lag, g, 1, i]
                z = c * basis[t + lag, g, 2, i]
                for j in range(starts[h + 1] - starts[h]):
                    below[t, lag - 1, starts[g] + i, starts[h] + j] = (
                        x * basis[t, h, 0, j] + y * basis[t, h, 1, j] + z * basis[t, h, 2, j]
                    )
