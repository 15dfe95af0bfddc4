"""The bulk solver: ADMM on positions, one factor for all variants of a take, batched over variants.

The splitting z_e = p_child - p_parent puts the exact bone length (and the girdle's rigidity) on z, where it is a
projection onto a sphere; for p the quadratic energy remains, whose matrix never changes.

The error that remains after a few iterations is smooth in time and needs hundreds more to vanish.  So most of the work
is done at 10 frames a second (`coarse`), where an iteration costs little, with Anderson acceleration (Anderson 1965;
Zhang et al. 2019 for ADMM), whose least squares look a second or two around: slow convergence in one place does not
delay another.  A few iterations at all frames end it, and a forward-kinematics projection makes bones exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags, Integers, plain
from pasdedeux.augmentation.bulk_kernels import (
    Batch,
    BonePairs,
    Form,
    Memory,
    add_stencils,
    advance,
    fade_over_time,
    mean_change,
    mix_moves,
    pull_to_targets,
    remember,
)
from pasdedeux.augmentation.coarse import Thinning, interpolate_thinned, thin_out
from pasdedeux.augmentation.exact_bones import project_to_bones
from pasdedeux.augmentation.factor import Factor, factorise, solve_factored
from pasdedeux.augmentation.problem import AXIS_GROUP, MeshProblem, Targets, girdle_pairs
from pasdedeux.augmentation.terms import build_targets, right_hand_side
from pasdedeux.augmentation.weights import GIRDLE, LAPLACIAN
from pasdedeux.skeletons import BODY22

AnyFloat = npt.NDArray[np.floating]

_AXES = tuple(np.flatnonzero(np.array(AXIS_GROUP) == group) for group in (0, 1))


_PENALTY = 8.0
"""ADMM penalty on bone vectors, in units of the Laplacian weight."""
_CONTACT_PENALTY = 0.15
"""Increase of an edge's penalty per unit of contact weight at its ends; with the same penalty for all edges the
iteration oscillates wherever contacts are dense."""
_CLEARANCE_PENALTY = 0.12
"""Penalty of near bones per unit of their weight."""
_RELAXATION = 1.4
"""Over-relaxation, 1 (none) to 1.8."""
_MOST_ITERATIONS = 300
"""Iterations at most; settled variants end sooner."""
_COARSE_HZ = 10.0
"""Rate at which most of the work is done."""
_FEWEST_COARSE = 8
"""Takes with fewer frames than this at that rate are solved at all frames."""
_MEMORY = 6
"""Number of previous moves that Anderson acceleration uses."""
_REACH_S = 2.0
"""Time constant of its least squares: the weight of a frame falls by a factor of e for every such time."""
_RIDGE = 1e-7
"""Ridge of the least squares, as a share of the trace."""
_FIRST_MIX = 5
"""Iterations before the first acceleration."""
_SMALL_SCALE = 0.7
"""Scales below this are reached in two steps, the second starting at twice the change of the first."""
_COMPARED_EVERY = 2
"""Of so many frames one enters the least squares, whose solution is used for all of them."""
_WORTH_LEAVING = 0.75
"""Finished variants leave the batch once at most this share of it remains, because leaving costs copies."""
_TINY_M = 1e-9
"""Added to lengths used as divisors, metres."""


@dataclass(frozen=True)
class _Settled:
    """Criteria of convergence of a variant; means over frames, of edges and of joints.

    Args:
        checked_every: Iterations between checks.
        change_m: It has when edges change by less than this in an iteration, metres.
        stalled_m: It also has when they change by less than this,
        moved_m: and joints moved by less than this since the last check: some bones oscillate between touching and not,
            which moves nothing else.
    """

    checked_every: int
    change_m: float
    stalled_m: float
    moved_m: float


_COARSE_END = _Settled(10, 1e-5, 1e-4, 1e-4)
_FINE_END = _Settled(4, 2e-5, 3e-5, 3e-5)
_MOST_FINE = 24
"""Most iterations at all frames, for motion faster than the coarse rate shows."""
_GAP_PER_COARSE_CHANGE, _GAP_PER_FINE_CHANGE = 250.0, 2.0
"""Mean joint distance from the optimum over the last change of the edges at either rate, so that the sum is an upper
bound: of 42 variants over seven takes it was too small for none, typically 2 to 3 mm where the gap is 0.2 to 0.8."""


@dataclass(frozen=True)
class BulkResult:
    """Result of the bulk solver.

    Args:
        positions: Positions with exact bones (variant, T, n, 3), metres.
        estimated_gap_m: Estimate of the mean joint distance from the optimum (variant,), metres.
        num_iterations: Iterations at the coarse rate (variant,).
    """

    positions: Array
    estimated_gap_m: Array
    num_iterations: Integers


class _Factored:
    """A problem with its factor, on which variants are iterated."""

    def __init__(self, problem: MeshProblem, dtype: type[np.floating]) -> None:
        self.problem, self.dtype = problem, dtype
        self.edges, self.num_bones = _edges(problem.source.num_people)
        self.num_points, self.num_edges = problem.source.num_points, len(self.edges)
        penalties = _edge_penalties(problem, self.edges)
        near = problem.clearance
        stencils = np.zeros(problem.matrix.shape[1:])
        edges = np.tile(self.edges, (len(penalties), 1, 1))
        add_stencils(edges, np.tile([1.0, -1.0], (*penalties.shape, 1)), penalties, stencils)
        add_stencils(near.points, near.shares, _CLEARANCE_PENALTY * near.weights, stencils)
        matrix = problem.matrix + stencils
        self._factors: list[Factor] = [
            factorise(matrix[group], problem.lag1[group], problem.lag2[group]).astype(dtype) for group in (0, 1)
        ]
        self._near, self._contacts = near.weights > 0, problem.contact_weights > 0
        pairs = [
            self._pairs(self._near, near.points, near.shares, _CLEARANCE_PENALTY * near.weights, near.normals),
            self._pairs(self._contacts, problem.contacts.points, problem.contacts.shares, problem.contact_weights),
        ]
        self.form = Form(
            first=np.arange(problem.num_frames + 1) * self.num_edges + pairs[0].first + pairs[1].first,
            edges=self.edges,
            num_bones=self.num_bones,
            penalties=self._narrow(penalties),
            near=pairs[0],
            contacts=pairs[1],
            directions=self._narrow(problem.contact_direction[self._contacts]),
            constants=self._narrow([_RELAXATION, _CLEARANCE_PENALTY, GIRDLE, _TINY_M]),
        )

    def _narrow(self, values: npt.ArrayLike) -> AnyFloat:
        """Return values in the precision of the iteration."""
        return np.ascontiguousarray(values, dtype=self.dtype)

    def _pairs(
        self, is_used: Flags, points: Integers, shares: Array, weights: Array, normals: Array | None = None
    ) -> BonePairs:
        """Return the pairs of each frame (T, M) without empty places."""
        return BonePairs(
            first=np.concatenate([[0], np.cumsum(is_used.sum(axis=1))]),
            points=points[is_used],
            shares=self._narrow(shares[is_used]),
            weights=self._narrow(weights[is_used]),
            normals=self._narrow(np.zeros((0, 3)) if normals is None else normals[is_used]),
        )

    def begin(self, targets: Targets, start: tuple[AnyFloat, AnyFloat] | None = None) -> Batch:
        """Return where the iteration starts.

        Args:
            targets: Targets of the variants.
            start: x (T, point, 3, variant) and v of the edges (T, edge, 3, variant) less r's; plain forward kinematics
                where not given.
        """
        problem, dtype, form = self.problem, self.dtype, self.form
        frames, count = problem.num_frames, targets.num_variants
        linear = np.zeros((2 * self._factors[0].num_blocks, self.num_points, 3, count), dtype)
        linear[:frames] = np.moveaxis(right_hand_side(problem, targets), 0, -1)
        lengths = np.empty((frames, self.num_edges, count), dtype)
        lengths[:, : self.num_bones] = targets.lengths_m[:, self.edges[: self.num_bones, 1]].T
        lengths[:, self.num_bones :] = np.transpose(targets.girdle_m, (1, 2, 0))
        edges = targets.reference[:, :, self.edges[:, 1]] - targets.reference[:, :, self.edges[:, 0]]
        rows = (int(form.first[-1]), 3, count)
        begun = Batch(
            linear=linear,
            reference=self._last(edges),
            lengths=lengths,
            limits=self._last(targets.clearance_m[:, self._near]),
            between=self._last(problem.contacts.vectors(targets.reference)[:, self._contacts]),
            kept=self._last(targets.contact_m[:, self._contacts]),
            offsets=np.zeros_like(linear),
            state=np.zeros(rows, dtype),
            aim=np.zeros(rows, dtype),
            change=np.zeros(rows, dtype),
        )
        self._start_pairs(begun, None if start is None else start[0])
        if start is not None:
            begun.state[self._edge_rows] = start[1]
        pull_to_targets(form, begun)
        return begun

    def _start_pairs(self, begun: Batch, x: AnyFloat | None) -> None:
        """Leave the state of pairs of bones at x; where that is not given, contacts begin with the source's vectors."""
        near, contacts = self.form.near, self.form.contacts
        frame = np.repeat(np.arange(len(contacts.first) - 1), np.diff(contacts.first))
        rows = np.arange(len(frame)) + self.num_edges * (frame + 1) + near.first[frame + 1]
        if x is None:
            begun.state[rows] = begun.kept - begun.between
            return
        begun.state[rows] = _pair_vectors(contacts, frame, x)
        # Near bones get the v of an unchanged x: their dual is then the force on them.
        frame = np.repeat(np.arange(len(near.first) - 1), np.diff(near.first))
        rows = np.arange(len(frame)) + self.num_edges * (frame + 1) + contacts.first[frame]
        vectors = _pair_vectors(near, frame, x)
        reach = (near.normals[..., None] * vectors).sum(axis=1)
        away = np.maximum(begun.limits - reach, 0.0) / self.form.constants[1]
        begun.state[rows] = vectors - near.normals[..., None] * away[:, None]

    def _last(self, values: Array) -> AnyFloat:
        """Return values with variants last, in the precision of the iteration."""
        return self._narrow(np.moveaxis(values, 0, -1))

    @property
    def _edge_rows(self) -> Integers:
        """Rows of the edges (T, edge)."""
        return np.asarray(self.form.first[:-1, None] + np.arange(self.num_edges))

    def iterate(self, now: Batch) -> None:
        """Solve for x and move v; `pull_to_targets` must follow."""
        blocks = now.offsets.reshape(-1, 2 * self.num_points, *now.offsets.shape[2:])
        for group, axes in enumerate(_AXES):
            solve_factored(self._factors[group], blocks, axes)
        advance(self.form, now)

    def moved(self, now: Batch, before: AnyFloat) -> Array:
        """Return how far joints moved since (variant,), metres, as `edges_moved`."""
        difference = (now.offsets[: len(before)] - before).reshape(-1, 3, before.shape[-1])
        return mean_change(difference, np.arange(self.problem.num_frames + 1) * self.num_points, self.num_points)

    def edges_moved(self, now: Batch) -> Array:
        """Return how far the edges' v moved in the last iteration (variant,), metres.

        It is the mean of each frame's root mean square, because a few frames may oscillate for ever.
        """
        return mean_change(now.change, self.form.first, self.num_edges)

    def ended(self, now: Batch, variants: npt.NDArray[np.intp]) -> tuple[AnyFloat, AnyFloat]:
        """Return x (T, point, 3, variant) and v of the edges (T, edge, 3, variant) of some of the variants."""
        return now.offsets[: self.problem.num_frames][..., variants], now.state[self._edge_rows][..., variants]


def _pair_vectors(pairs: BonePairs, frame: Integers, x: AnyFloat) -> AnyFloat:
    """Return the vector of each pair (pair, 3, variant) of x (T, point, 3, variant)."""
    parts = [pairs.shares[:, corner, None, None] * x[frame, pairs.points[:, corner]] for corner in range(4)]
    return (parts[0] + parts[1]) + (parts[2] + parts[3])


class _Acceleration:
    """Anderson acceleration of one iteration: previous moves and their inner products."""

    def __init__(self, form: Form, now: Batch, rate_hz: float) -> None:
        self._form = form
        self._keep = float(np.exp(-_COMPARED_EVERY / (_REACH_S * rate_hz)))
        size, count, dtype = (_MEMORY, *now.state.shape), now.state.shape[-1], now.state.dtype
        compared = -(-(len(form.first) - 1) // _COMPARED_EVERY)
        self._memory = Memory(
            last_state=np.zeros_like(now.state),
            last_change=np.zeros_like(now.change),
            moves=np.zeros(size, dtype),
            changes=np.zeros(size, dtype),
            products=np.zeros((2, _MEMORY, compared, count), dtype),
        )
        self._gram = np.zeros((_MEMORY, _MEMORY, compared, count))
        self._made = -1

    def select(self, variants: npt.NDArray[np.intp]) -> None:
        """Go on with some of the variants."""
        self._memory, self._gram = Memory(*_select(self._memory, variants)), plain(self._gram[..., variants])

    def mix(self, now: Batch) -> None:
        """Subtract from the state the part of this change that the last moves explain."""
        memory, slot = self._memory, self._made % _MEMORY
        self._made += 1
        if self._made == 0:
            memory.last_state[...], memory.last_change[...] = now.state, now.change
            return
        used = min(self._made, _MEMORY)
        remember(self._form, now, memory, slot, used, _COMPARED_EVERY)
        summed = memory.products.astype(np.float64)
        for part in summed:
            fade_over_time(part, self._keep)
        self._gram[slot] = summed[0]
        self._gram[:, slot] = summed[0]
        mix_moves(self._form, self._gram, summed[1], used, _COMPARED_EVERY, _RIDGE, memory.moves, now.state)


def _select(parts: Iterable[AnyFloat], variants: npt.NDArray[np.intp]) -> Iterator[AnyFloat]:
    """Return the part of some of the variants, which are the last axis."""
    return (np.ascontiguousarray(part[..., variants]) for part in parts)


class BulkSolver:
    """The factors of a take, prepared for any number of batches of variants.

    Args:
        problem: The problem shared by the variants.
        dtype: Precision of the iteration; targets and the final projection stay in 64 bits.
    """

    def __init__(self, problem: MeshProblem, *, dtype: type[np.floating] = np.float32) -> None:
        self.problem = problem
        rate = problem.source.rate_hz
        stride = max(round(rate / _COARSE_HZ), 1)
        if problem.num_frames < _FEWEST_COARSE * stride:
            stride = 1
        self._thinning: Thinning | None = thin_out(problem, stride) if stride > 1 else None
        self._coarse = _Factored(self._thinning.problem if self._thinning else problem, dtype)
        self._fine = _Factored(problem, dtype) if self._thinning else self._coarse

    def solve(self, targets: Targets) -> BulkResult:
        """Solve a batch of variants; the result of each does not depend on the others, to the last bit."""
        most = _MOST_ITERATIONS
        ended = self._solve_coarse(targets.bone_scale, most)
        estimate, iterations = _GAP_PER_COARSE_CHANGE * ended.change_m, ended.num_iterations
        if self._thinning is not None:
            start = interpolate_thinned(self._thinning, ended.offsets), interpolate_thinned(self._thinning, ended.edges)
            now = self._fine.begin(targets, start)
            ended = _settle(self._fine, now, _FINE_END, min(most, _MOST_FINE), start[0], is_accelerated=False)
            estimate += _GAP_PER_FINE_CHANGE * ended.change_m
        points = targets.reference + np.moveaxis(ended.offsets, -1, 0)
        positions = project_to_bones(points, targets.lengths_m)
        return BulkResult(positions=positions, estimated_gap_m=estimate, num_iterations=iterations)

    def _solve_coarse(self, bone_scale: Array, most: int) -> _Ended:
        """Return the result of variants at the coarse rate; those with very small bones start half-way."""
        level = self._coarse
        is_far = bone_scale.min(axis=(1, 2)) < _SMALL_SCALE
        near = np.where(is_far.reshape(-1, 1, 1), 0.5 * (1.0 + bone_scale), bone_scale)
        ended = _settle(level, level.begin(build_targets(level.problem, near)), _COARSE_END, most, is_accelerated=True)
        far = np.flatnonzero(is_far)
        if len(far):
            start = 2.0 * ended.offsets[..., far], 2.0 * ended.edges[..., far]
            now = level.begin(build_targets(level.problem, bone_scale[far]), start)
            further = _settle(level, now, _COARSE_END, most, start[0], is_accelerated=True)
            ended.offsets[..., far], ended.edges[..., far] = further.offsets, further.edges
            ended.change_m[far] = further.change_m
            ended.num_iterations[far] += further.num_iterations
        return ended


@dataclass(frozen=True)
class _Ended:
    """Where the iteration ended.

    Args:
        offsets: x (T, point, 3, variant), metres.
        edges: v of the edges less r's (T, edge, 3, variant), metres.
        change_m: Change of edges in the last iteration (variant,), metres.
        num_iterations: Its number (variant,).
    """

    offsets: AnyFloat
    edges: AnyFloat
    change_m: Array
    num_iterations: Integers


def _settle(
    level: _Factored,
    now: Batch,
    end: _Settled,
    most: int,
    start: AnyFloat | None = None,
    *,
    is_accelerated: bool,
) -> _Ended:
    """Iterate until every variant hardly changes, `most` times at most; finished variants leave the batch."""
    frames, count = level.problem.num_frames, now.state.shape[-1]
    ended = _Ended(
        offsets=np.zeros((frames, level.num_points, 3, count), level.dtype),
        edges=np.zeros((frames, level.num_edges, 3, count), level.dtype),
        change_m=np.zeros(count),
        num_iterations=np.zeros(count, np.int64),
    )
    lanes, is_open = np.arange(count), np.ones(count, dtype=bool)
    before = np.zeros((frames, level.num_points, 3, count), level.dtype) if start is None else start
    acceleration = _Acceleration(level.form, now, level.problem.source.rate_hz) if is_accelerated else None
    for iteration in range(1, most + 1):
        level.iterate(now)
        if acceleration is not None and iteration > _FIRST_MIX:
            acceleration.mix(now)
        if iteration % end.checked_every == 0 or iteration == most:
            change, moved = level.edges_moved(now), level.moved(now, before)
            before = np.array(now.offsets[:frames])
            is_done = (change <= end.change_m) | ((change <= end.stalled_m) & (moved <= end.moved_m))
            done = np.flatnonzero(is_open & (is_done | (iteration == most)))
            ended.offsets[..., lanes[done]], ended.edges[..., lanes[done]] = level.ended(now, done)
            ended.change_m[lanes[done]], ended.num_iterations[lanes[done]] = change[done], iteration
            is_open[done] = False
            kept = np.flatnonzero(is_open)
            if not len(kept):
                break
            if len(kept) <= _WORTH_LEAVING * len(lanes):
                now, before = Batch(*_select(now, kept)), before[..., kept]
                lanes, is_open = lanes[kept], is_open[kept]
                if acceleration is not None:
                    acceleration.select(kept)
        pull_to_targets(level.form, now)
    return ended


@lru_cache(maxsize=8)
def _edges(num_people: int) -> tuple[Integers, int]:
    """Return everybody's bones, then girdle pairs (edge, 2), and how many bones there are."""
    bones = np.concatenate([np.array(BODY22.bones) + person * BODY22.num_joints for person in range(num_people)])
    return np.ascontiguousarray(np.concatenate([bones, girdle_pairs(num_people)])), len(bones)


def _edge_penalties(problem: MeshProblem, edges: Integers) -> Array:
    """Return the penalty of each edge (T, edge): the stiffness of the terms at its ends; else iterations oscillate."""
    contact = np.zeros((problem.num_frames, problem.source.num_points))
    at_ends = problem.contact_weights[..., None] * np.abs(problem.contacts.shares)
    np.add.at(contact, (np.arange(len(contact))[:, None, None], problem.contacts.points), at_ends)
    stiffness = contact[:, edges[:, 0]] + contact[:, edges[:, 1]]
    return plain(_PENALTY * LAPLACIAN + _CONTACT_PENALTY * stiffness)
