"""The bulk solver: ADMM on positions, one factor for all variants of a take, batched over variants.

The splitting z_e = p_child - p_parent puts the exact bone length (and the girdle's rigidity) on z, where it is a
projection onto a sphere; what is left for p is the quadratic energy, whose matrix never changes.

What is left of the error after a few iterations is smooth in time and takes hundreds more to go.  So most of the work
is done at 10 frames a second (`coarse`), where an iteration costs little, with Anderson acceleration (Anderson 1965;
Zhang et al. 2019 for ADMM), whose least squares look a second or two around: what holds a variant up in one place does
not wait for another.  A few iterations at all frames end it, and a forward-kinematics projection makes bones exact.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.bulk_kernels import (
    add_stencils,
    advance,
    assemble,
    assemble_pairs,
    compare,
    fade_over_time,
    mean_change,
    mix,
    project,
)
from pasdedeux.augmentation.coarse import Thinning, interpolate, thin_out
from pasdedeux.augmentation.contacts import aim_contacts
from pasdedeux.augmentation.factor import Factor, factorise, solve
from pasdedeux.augmentation.problem import AXIS_GROUP, Problem, Targets, girdle_pairs
from pasdedeux.augmentation.source import points_of
from pasdedeux.augmentation.terms import build_targets, right_hand_side
from pasdedeux.kinematics import bone_directions, place_bones
from pasdedeux.skeletons import BODY22

__all__ = ["BulkResult", "BulkSolver", "project_to_bones"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]

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
_COARSE_HZ = 10.0
"""Rate at which most of the work is done."""
_FEWEST_COARSE = 8
"""Takes of fewer frames than this at that rate are not thinned out."""
_MEMORY = 8
"""Moves that Anderson acceleration looks back on."""
_REACH_S = 2.0
"""How far its least squares look around: a frame counts by 1/e less for every such time."""
_RIDGE = 1e-7
"""Ridge of the least squares, as a share of the trace."""
_FIRST_MIX = 5
"""Iterations before the first acceleration."""


@dataclass(frozen=True)
class _End:
    """When a variant has settled; means over frames, of edges and of joints.

    Args:
        checked_every: Iterations after which that is asked.
        change_m: It has when edges change by less than this in an iteration, metres.
        stalled_m: It also has when they change by less than this,
        moved_m: and joints moved by less than this since it was asked last: somewhere bones swing between touching and
            not, which moves nothing else.
    """

    checked_every: int
    change_m: float
    stalled_m: float
    moved_m: float


_COARSE_END = _End(10, 1e-5, 1e-4, 1e-4)
_FINE_END = _End(8, 5e-5, 1e-4, 1e-4)
_MOST_FINE = 48
"""Most iterations at all frames, which see what is faster than the coarse rate shows."""
_GAP_PER_COARSE_CHANGE, _GAP_PER_FINE_CHANGE = 100.0, 10.0
"""Mean joint distance from the optimum over the last change of the edges at either rate."""


@dataclass(frozen=True)
class BulkResult:
    """What the bulk solver gives.

    Args:
        positions: Positions with exact bones (variant, T, n, 3), metres.
        estimated_gap_m: Estimate of the mean joint distance from the optimum (variant,), metres.
        num_iterations: Iterations at the coarse rate (variant,).
    """

    positions: Array
    estimated_gap_m: Array
    num_iterations: npt.NDArray[np.int64]


@dataclass(frozen=True)
class _Iteration:
    """Arrays of the iteration, variants last; `state` and `aim` as in `bulk_kernels`."""

    offsets: AnyFloat
    linear: AnyFloat
    reference: AnyFloat
    lengths: AnyFloat
    limits: AnyFloat
    between: AnyFloat
    kept: AnyFloat
    contact_aim: AnyFloat
    state: AnyFloat
    aim: AnyFloat
    change: AnyFloat

    def select(self, variants: npt.NDArray[np.intp]) -> _Iteration:
        """Return what belongs to some of the variants."""
        return _Iteration(**{f.name: np.ascontiguousarray(getattr(self, f.name)[..., variants]) for f in fields(self)})


class _Level:
    """A problem with its factor, at which variants are iterated."""

    def __init__(self, problem: Problem, dtype: type[np.floating]) -> None:
        self.problem, self.dtype = problem, dtype
        self.edges, self.num_bones = _edges(problem.source.num_people)
        self.num_points, self.num_edges = problem.source.num_points, len(self.edges)
        penalties = _edge_penalties(problem, self.edges)
        near = problem.clearance
        near_penalties = _CLEARANCE_PENALTY * near.weights
        stencils = np.zeros(problem.matrix.shape[1:])
        edges = np.tile(self.edges, (len(penalties), 1, 1))
        add_stencils(edges, np.tile([1.0, -1.0], (*penalties.shape, 1)), penalties, stencils)
        add_stencils(near.points, near.shares, near_penalties, stencils)
        matrix = problem.matrix + stencils
        self._factors: list[Factor] = [
            factorise(matrix[group], problem.lag1[group], problem.lag2[group]).astype(dtype) for group in (0, 1)
        ]
        self._penalties, self._near_penalties = self._narrow(penalties), self._narrow(near_penalties)
        self._shares, self._normals = self._narrow(near.shares), self._narrow(near.normals)
        self._relaxation, self._share = self._narrow([_RELAXATION]), self._narrow([_CLEARANCE_PENALTY])
        self._girdle = self._narrow([problem.weights.girdle])
        self._contact_shares = self._narrow(problem.contacts.shares)
        self._contact_weights = self._narrow(problem.contact_weights)
        self._direction = self._narrow(problem.contact_direction)

    def _narrow(self, values: npt.ArrayLike) -> AnyFloat:
        """Return values in the precision of the iteration."""
        return np.ascontiguousarray(values, dtype=self.dtype)

    def begin(self, targets: Targets, start: AnyFloat | None = None) -> _Iteration:
        """Return where the iteration starts.

        Args:
            targets: What the variants are to reach.
            start: x and v of the edges (3, T, n + edge, variant); plain forward kinematics where not given.
        """
        problem, dtype = self.problem, self.dtype
        frames, count = problem.num_frames, targets.num_variants
        near = problem.clearance
        shape = (3, 2 * self._factors[0].num_blocks, self.num_points, count)
        linear: AnyFloat = np.zeros(shape, dtype)
        for variant in range(count):
            # One by one: BLAS sums in another order for another number of columns.
            linear[:, :frames, :, variant] = right_hand_side(problem, targets.select([variant]))[..., 0]
        edges = targets.reference[:, :, self.edges[:, 1]] - targets.reference[:, :, self.edges[:, 0]]
        lengths = np.empty((frames, self.num_edges, count), dtype)
        lengths[:, : self.num_bones] = targets.lengths_m[:, self.edges[: self.num_bones, 1]].T
        lengths[:, self.num_bones :] = np.transpose(targets.girdle_m, (1, 2, 0))
        rows = self.num_edges + near.weights.shape[1]
        between = self._narrow(np.transpose(problem.contacts.vectors(targets.reference), (3, 1, 2, 0)))
        kept = self._narrow(np.transpose(targets.contact_m, (3, 1, 2, 0)))
        begun = _Iteration(
            offsets=np.zeros(shape, dtype),
            linear=linear,
            reference=self._narrow(np.transpose(edges, (3, 1, 2, 0))),
            lengths=lengths,
            limits=self._narrow(np.transpose(targets.clearance_m, (1, 2, 0))),
            between=between,
            kept=kept,
            contact_aim=kept - between,
            state=np.zeros((3, frames, self.num_points + rows, count), dtype),
            aim=np.zeros((3, frames, rows, count), dtype),
            change=np.zeros((3, frames, rows, count), dtype),
        )
        if start is None:
            begun.state[:, :, self.num_points : self.num_points + self.num_edges] = begun.reference
        else:
            begun.state[:, :, : self.num_points + self.num_edges] = start
            self._lean_on_near(begun)
            self._aim_contacts(begun)
        self._project(begun)
        return begun

    def iterate(self, now: _Iteration) -> None:
        """Do one iteration; `project` or `accelerate` must follow."""
        contacts, near = self.problem.contacts, self.problem.clearance
        count = now.lengths.shape[-1]
        assemble(now.linear, now.reference, now.aim, self.edges, self._penalties, now.offsets)
        assemble_pairs(now.aim, self.num_edges, near.points, self._shares, self._near_penalties, now.offsets)
        assemble_pairs(now.contact_aim, 0, contacts.points, self._contact_shares, self._contact_weights, now.offsets)
        for group, axes in enumerate(_AXES):
            solve(self._factors[group], now.offsets.reshape(3, -1, 2 * self.num_points, count), axes)
        advance(
            now.offsets,
            now.reference,
            self.edges,
            near.points,
            self._shares,
            self._relaxation,
            now.aim,
            now.state,
            now.change,
        )

    def settle(self, now: _Iteration) -> None:
        """Make the aims of the next iteration from the state."""
        self._project(now)
        self._aim_contacts(now)

    def _project(self, now: _Iteration) -> None:
        project(
            now.state,
            now.lengths,
            now.limits,
            self._normals,
            self.num_bones,
            self._girdle,
            self._penalties,
            self._share,
            now.aim,
        )

    def _aim_contacts(self, now: _Iteration) -> None:
        aim_contacts(
            now.state,
            now.between,
            self.problem.contacts.points,
            self._contact_shares,
            now.kept,
            self._contact_weights,
            self._direction,
            now.contact_aim,
        )

    def _lean_on_near(self, now: _Iteration) -> None:
        """Give near bones the v they have when their vectors stay where x puts them: its dual is the pull they feel."""
        near = self.problem.clearance
        frames = np.arange(len(near.weights))[:, None, None]
        x = now.state[:, frames, near.points]
        vectors = (self._shares[None, ..., None] * x).sum(axis=3)
        reach = (np.moveaxis(self._normals, -1, 0)[..., None] * vectors).sum(axis=0)
        pull = np.maximum(now.limits - reach, 0.0) / self._share[0]
        now.state[:, :, self.num_points + self.num_edges :] = (
            vectors - np.moveaxis(self._normals, -1, 0)[..., None] * pull
        )


class _Acceleration:
    """Anderson acceleration of one iteration: the moves it looks back on and their inner products."""

    def __init__(self, now: _Iteration, rate_hz: float) -> None:
        frames, count = now.lengths.shape[0], now.lengths.shape[-1]
        self._keep = float(np.exp(-1.0 / (_REACH_S * rate_hz)))
        self._moves = np.zeros((_MEMORY, *now.state.shape), now.state.dtype)
        self._changes = np.zeros((_MEMORY, *now.change.shape), now.state.dtype)
        self._gram = np.zeros((_MEMORY, _MEMORY, frames, count))
        self._shares = np.zeros((_MEMORY, count), now.state.dtype)
        self._last_state: AnyFloat | None = None
        self._last_change: AnyFloat | None = None
        self._made = 0

    def select(self, variants: npt.NDArray[np.intp]) -> None:
        """Go on with some of the variants."""
        for name in ("_moves", "_changes", "_gram", "_shares", "_last_state", "_last_change"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[..., variants]))

    def mix(self, now: _Iteration) -> None:
        """Take what the last moves explain of this change out of the state."""
        if self._last_state is None or self._last_change is None:
            self._last_state, self._last_change = np.array(now.state), np.array(now.change)
            return
        slot = self._made % _MEMORY
        self._made += 1
        used = min(self._made, _MEMORY)
        np.subtract(now.state, self._last_state, out=self._moves[slot])
        np.subtract(now.change, self._last_change, out=self._changes[slot])
        self._last_state[...], self._last_change[...] = now.state, now.change
        products = np.empty((2, _MEMORY, *self._gram.shape[2:]), now.state.dtype)
        compare(self._changes, slot, used, now.change, products[0], products[1])
        summed = products.astype(np.float64)
        for part in summed:
            fade_over_time(part, self._keep)
        self._gram[slot] = summed[0]
        self._gram[:, slot] = summed[0]
        mix(self._gram, summed[1], used, _RIDGE, self._moves, self._shares, now.state)


class BulkSolver:
    """The factors of a take, ready for any number of batches of variants.

    Args:
        problem: What the variants share.
        dtype: Precision of the iteration; targets and the final projection stay in 64 bits.
    """

    def __init__(self, problem: Problem, *, dtype: type[np.floating] = np.float32) -> None:
        self.problem = problem
        rate = problem.source.rate_hz
        stride = max(round(rate / _COARSE_HZ), 1)
        if problem.num_frames < _FEWEST_COARSE * stride:
            stride = 1
        self._thinning: Thinning | None = thin_out(problem, stride) if stride > 1 else None
        self._coarse = _Level(self._thinning.problem if self._thinning else problem, dtype)
        self._fine = _Level(problem, dtype)

    def solve(self, targets: Targets) -> BulkResult:
        """Solve a batch of variants; what a variant gets does not depend on the others, to the last bit."""
        level = self._coarse
        now = level.begin(targets if self._thinning is None else build_targets(level.problem, targets.bone_scale))
        most = self.problem.settings.num_iterations
        ended, change_m, iterations = _settle(level, now, _COARSE_END, most, is_accelerated=True)
        estimate = _GAP_PER_COARSE_CHANGE * change_m
        if self._thinning is not None:
            now = self._fine.begin(targets, interpolate(self._thinning, ended))
            ended, change_m, _ = _settle(self._fine, now, _FINE_END, min(most, _MOST_FINE), is_accelerated=False)
            estimate += _GAP_PER_FINE_CHANGE * change_m
        points = targets.reference + np.transpose(ended[:, :, : self._fine.num_points], (3, 1, 2, 0))
        positions = project_to_bones(points, targets.lengths_m)
        return BulkResult(positions=positions, estimated_gap_m=estimate, num_iterations=iterations)


def _settle(
    level: _Level, now: _Iteration, end: _End, most: int, *, is_accelerated: bool
) -> tuple[AnyFloat, Array, npt.NDArray[np.int64]]:
    """Iterate until every variant hardly changes, `most` times at most; those that have ended leave the batch.

    Returns:
        x and v of the edges (3, T, n + edge, variant), how far edges still change at the last iteration (variant,),
        metres, and its number (variant,).
    """
    count, num_points = now.lengths.shape[-1], level.num_points
    num_rows = num_points + level.num_edges
    ended = np.zeros((3, level.problem.num_frames, num_rows, count), level.dtype)
    change_m, iterations = np.zeros(count), np.zeros(count, np.int64)
    left, before = np.arange(count), np.array(now.state[:, :, :num_points])
    acceleration = _Acceleration(now, level.problem.source.rate_hz) if is_accelerated else None
    for iteration in range(1, most + 1):
        level.iterate(now)
        if acceleration is not None and iteration > _FIRST_MIX:
            acceleration.mix(now)
        level.settle(now)
        is_last = iteration == most
        if iteration % end.checked_every and not is_last:
            continue
        change, moved = _edge_change(now), _moved(now.state, before)
        before = np.array(now.state[:, :, :num_points])
        is_done = (change <= end.change_m) | ((change <= end.stalled_m) & (moved <= end.moved_m)) | is_last
        if not is_done.any():
            continue
        done, kept = np.flatnonzero(is_done), np.flatnonzero(~is_done)
        ended[..., left[done]] = now.state[:, :, :num_rows, done]
        change_m[left[done]], iterations[left[done]] = change[done], iteration
        if not len(kept):
            break
        left, now, before = left[kept], now.select(kept), np.ascontiguousarray(before[..., kept])
        if acceleration is not None:
            acceleration.select(kept)
    return ended, change_m, iterations


def _edge_change(now: _Iteration) -> Array:
    """Return how far the edges' v moved in the last iteration (variant,), metres.

    It is the mean of each frame's root mean square, as a few frames may swing for ever.
    """
    return mean_change(now.change, now.lengths.shape[1])


def _moved(state: AnyFloat, before: AnyFloat) -> Array:
    """Return how far joints moved since (variant,), metres, likewise."""
    return mean_change(state[:, :, : before.shape[2]] - before, before.shape[2])


def project_to_bones(points: Array, lengths_m: Array) -> Array:
    """Return the points (variant, T, n, 3) with their bone directions and exactly these lengths (variant, n).

    The pelvis stays; a bone without direction takes none, which only a bone of length zero has.
    """
    people = points.reshape(*points.shape[:2], -1, BODY22.num_joints, 3)
    lengths = lengths_m.reshape(len(lengths_m), 1, -1, BODY22.num_joints)
    return points_of(place_bones(BODY22, people[..., BODY22.root, :], bone_directions(BODY22, people), lengths))


@lru_cache(maxsize=8)
def _edges(num_people: int) -> tuple[npt.NDArray[np.int64], int]:
    """Return everybody's bones, then girdle pairs (edge, 2), and how many bones there are."""
    bones = np.concatenate([np.array(BODY22.bones) + person * BODY22.num_joints for person in range(num_people)])
    return np.ascontiguousarray(np.concatenate([bones, girdle_pairs(num_people)])), len(bones)


def _edge_penalties(problem: Problem, edges: npt.NDArray[np.int64]) -> Array:
    """Return the penalty of each edge (T, edge): as stiff as what pulls at its ends, or the iteration swings there."""
    contact = np.zeros((problem.num_frames, problem.source.num_points))
    pull = problem.contact_weights[..., None] * np.abs(problem.contacts.shares)
    np.add.at(contact, (np.arange(len(contact))[:, None, None], problem.contacts.points), pull)
    stiffness = contact[:, edges[:, 0]] + contact[:, edges[:, 1]]
    return np.asarray(_PENALTY * problem.weights.laplacian + _CONTACT_PENALTY * stiffness)
