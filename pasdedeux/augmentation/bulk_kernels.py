"""Inner loops of the bulk solver, variants innermost.

Loops read and write few arrays, because LLVM checks each two of them for aliasing before it vectorises.
No fast-math: fused or reordered operations would round differently in the vector body of a loop and in its rest, and so
make a variant depend on its place in the batch.

An iteration's arrays of rows (row, 3, variant) hold for each frame, one frame after the other, a row for each edge, for
each pair of near bones and for each contact: in `state` v = z + u of the first two, the vector by x of the third; in
`aim` z - u.  All are of x = p - r: an edge's vector is its row and that of r.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers
from pasdedeux.compiled import compiled, inner_kernel

AnyFloat = npt.NDArray[np.floating]


class BonePairs(NamedTuple):
    """Pairs of bones, those of frame t from `first[t]` to `first[t + 1]`.

    Args:
        first: (T + 1,).
        points: Ends of both bones (pair, 4).
        shares: What the ends contribute to the pair's vector (pair, 4).
        weights: Penalty of near bones, weight of contacts (pair,).
        normals: Directions out of each other (pair, 3); of near bones.
    """

    first: Integers
    points: Integers
    shares: AnyFloat
    weights: AnyFloat
    normals: AnyFloat


class Form(NamedTuple):
    """Data shared by the variants of a take.

    Args:
        first: First row of each frame (T + 1,).
        edges: Points at both ends of each edge (edge, 2), bones first.
        num_bones: How many edges are bones.
        penalties: ADMM penalty of each edge (T, edge).
        near: Bones that may not come deeper into each other.
        contacts: Points that keep their distance.
        directions: Share k of each contact that keeps its direction (pair,).
        constants: Relaxation, penalty of near bones per weight, weight of the girdle, what divisors are kept above.
    """

    first: Integers
    edges: Integers
    num_bones: int
    penalties: AnyFloat
    near: BonePairs
    contacts: BonePairs
    directions: AnyFloat
    constants: AnyFloat


class Batch(NamedTuple):
    """Arrays of some variants, which come last.

    Args:
        linear: b of the normal equations (frame, point, 3, variant), frames filled up to whole blocks.
        reference: Vectors of r's edges (T, edge, 3, variant), metres.
        lengths: Wanted lengths of the edges (T, edge, variant), metres.
        limits: Least n . B x of near bones (pair, variant), metres.
        between: r's vectors of the contacts (pair, 3, variant), metres.
        kept: The source's, stretched to the wanted length (pair, 3, variant), metres.
        offsets: x, or b before it is solved for (frame, point, 3, variant).
        state: See above.
        aim: See above.
        change: What the last iteration moved v by (row, 3, variant).
    """

    linear: AnyFloat
    reference: AnyFloat
    lengths: AnyFloat
    limits: AnyFloat
    between: AnyFloat
    kept: AnyFloat
    offsets: AnyFloat
    state: AnyFloat
    aim: AnyFloat
    change: AnyFloat


class Memory(NamedTuple):
    """The history of Anderson acceleration: m moves, whose changes are kept for some of the frames.

    Args:
        last_state: State after the last iteration, before it was mixed (row, 3, variant).
        last_change: Change of the last iteration (row, 3, variant).
        moves: Differences of states (m, row, 3, variant).
        changes: Differences of changes (m, row, 3, variant).
        products: Inner products of each difference of changes with the newest and with the change itself, over the rows
            of a frame (2, m, T, variant).
    """

    last_state: AnyFloat
    last_change: AnyFloat
    moves: AnyFloat
    changes: AnyFloat
    products: AnyFloat


@compiled()
def pull_to_targets(form: Form, now: Batch) -> None:
    """Leave z - u = 2 z - v in `aim` and b + penalty S^T (z - u - S r) in `offsets`.

    Bones go to their spheres, girdle pairs towards theirs, near bones out of each other, and contacts to
    k v + (1 - k) D u, u where they point now (see `contacts`).
    """
    first, edges, near, contacts = form.first, form.edges, form.near, form.contacts
    frames, num_edges, _, count = now.reference.shape
    state, aim, reference, lengths, limits = now.state, now.aim, now.reference, now.lengths, now.limits
    between, kept = now.between, now.kept
    share, girdle, tiny = form.constants[1], form.constants[2], form.constants[3]
    unit = share / share
    two, zero, inverse = unit + unit, unit - unit, unit / (share + unit)
    scale, other = np.empty(count, state.dtype), np.empty((1, 3, count), state.dtype)
    blocks, num_points, width = len(now.offsets), now.offsets.shape[1], 3 * count
    linear, rhs = now.linear.reshape(blocks, num_points, width), now.offsets.reshape(blocks, num_points, width)
    flat, flat_other = aim.reshape(len(aim), width), other.reshape(1, width)
    rhs[frames:] = zero
    for t in range(frames):
        for i in range(num_points):
            for k in range(width):
                rhs[t, i, k] = linear[t, i, k]
        row = first[t]
        for e in range(num_edges):
            penalty = form.penalties[t, e]
            for n in range(count):
                x, y = state[row, 0, n] + reference[t, e, 0, n], state[row, 1, n] + reference[t, e, 1, n]
                z = state[row, 2, n] + reference[t, e, 2, n]
                scale[n] = np.sqrt((x * x + y * y) + z * z) + tiny
            if e < form.num_bones:
                for n in range(count):
                    scale[n] = two * lengths[t, e, n] / scale[n] - unit
            else:
                pulled = unit / (penalty + girdle)
                for n in range(count):
                    scale[n] = two * ((penalty * scale[n] + girdle * lengths[t, e, n]) * pulled / scale[n]) - unit
            for axis in range(3):
                for n in range(count):
                    given = reference[t, e, axis, n]
                    aim[row, axis, n] = (state[row, axis, n] + given) * scale[n] - given
            parent, child = edges[e, 0], edges[e, 1]
            for k in range(width):
                rhs[t, child, k] += penalty * flat[row, k]
            for k in range(width):
                rhs[t, parent, k] -= penalty * flat[row, k]
            row += 1
        for e in range(near.first[t], near.first[t + 1]):
            a, b, c = near.normals[e, 0], near.normals[e, 1], near.normals[e, 2]
            for n in range(count):
                reach = (a * state[row, 0, n] + b * state[row, 1, n]) + c * state[row, 2, n]
                scale[n] = two * (max(limits[e, n] - reach, zero) * inverse)
            for axis in range(3):
                normal = near.normals[e, axis]
                for n in range(count):
                    aim[row, axis, n] = state[row, axis, n] + normal * scale[n]
            _spread(near, e, flat, row, rhs, t)
            row += 1
        for e in range(contacts.first[t], contacts.first[t + 1]):
            keep, free = form.directions[e], unit - form.directions[e]
            for n in range(count):
                x, y = state[row, 0, n] + between[e, 0, n], state[row, 1, n] + between[e, 1, n]
                z = state[row, 2, n] + between[e, 2, n]
                scale[n] = np.sqrt((x * x + y * y) + z * z) + tiny
            for n in range(count):
                x, y, z = kept[e, 0, n], kept[e, 1, n], kept[e, 2, n]
                scale[n] = free * np.sqrt((x * x + y * y) + z * z) / scale[n]
            for axis in range(3):
                for n in range(count):
                    given = between[e, axis, n]
                    other[0, axis, n] = (keep * kept[e, axis, n] + scale[n] * (state[row, axis, n] + given)) - given
            _spread(contacts, e, flat_other, 0, rhs, t)
            row += 1


@compiled()
def _spread(pairs: BonePairs, e: int, aims: AnyFloat, row: int, rhs: AnyFloat, t: int) -> None:
    """Add weight B^T a to the right-hand side (point, 3 variant) of a frame."""
    for corner in range(4):
        factor, point = pairs.weights[e] * pairs.shares[e, corner], pairs.points[e, corner]
        for k in range(aims.shape[1]):
            rhs[t, point, k] += factor * aims[row, k]


@compiled()
def advance(form: Form, now: Batch) -> None:
    """Move v by `change`, relaxation (s - z), s what x gives."""
    first, edges, near, contacts = form.first, form.edges, form.near, form.contacts
    relax = form.constants[0]
    half = relax / (relax + relax)
    rows, width = len(now.state), 3 * now.state.shape[2]
    offsets = now.offsets.reshape(len(now.offsets), now.offsets.shape[1], width)
    state, aim, change = now.state.reshape(rows, width), now.aim.reshape(rows, width), now.change.reshape(rows, width)
    for t in range(len(first) - 1):
        row = first[t]
        for e in range(len(edges)):
            parent, child = edges[e, 0], edges[e, 1]
            for k in range(width):
                change[row, k] = offsets[t, child, k] - offsets[t, parent, k]
            row += 1
        for e in range(near.first[t], near.first[t + 1]):
            _combine(near, e, offsets, t, change, row)
            row += 1
        for moved in range(first[t], row):
            for k in range(width):
                change[moved, k] = relax * (change[moved, k] - half * (state[moved, k] + aim[moved, k]))
            for k in range(width):
                state[moved, k] += change[moved, k]
        for e in range(contacts.first[t], contacts.first[t + 1]):
            _combine(contacts, e, offsets, t, state, row)
            row += 1


@inner_kernel()
def _combine(pairs: BonePairs, e: int, points: AnyFloat, t: int, vectors: AnyFloat, row: int) -> None:
    """Write a pair's vector, by x of a frame's points, to a row of `vectors`."""
    a, b, c, d = pairs.points[e, 0], pairs.points[e, 1], pairs.points[e, 2], pairs.points[e, 3]
    p, q, r, s = pairs.shares[e, 0], pairs.shares[e, 1], pairs.shares[e, 2], pairs.shares[e, 3]
    for k in range(vectors.shape[1]):
        vectors[row, k] = (p * points[t, a, k] + q * points[t, b, k]) + (r * points[t, c, k] + s * points[t, d, k])


@compiled()
def remember(form: Form, now: Batch, memory: Memory, slot: int, used: int, stride: int) -> None:
    """Put the newest move in `slot`, and compare the changes of every `stride`-th frame."""
    first, contacts = form.first, form.contacts
    size, width = len(memory.moves), now.state.shape[1] * now.state.shape[2]
    count = now.state.shape[2]
    total = len(now.state)
    state, change = now.state.reshape(total, width), now.change.reshape(total, width)
    last_state, last_change = memory.last_state.reshape(total, width), memory.last_change.reshape(total, width)
    moves, changes = memory.moves.reshape(size, total, width), memory.changes.reshape(size, total, width)
    made, pulled = np.empty(width, state.dtype), np.empty(width, state.dtype)
    products = memory.products
    for t in range(len(first) - 1):
        for row in range(first[t], first[t + 1]):
            for k in range(width):
                moves[slot, row, k] = state[row, k] - last_state[row, k]
            for k in range(width):
                last_state[row, k] = state[row, k]
        if t % stride:
            continue
        stop = first[t + 1] - (contacts.first[t + 1] - contacts.first[t])
        for row in range(first[t], stop):
            for k in range(width):
                changes[slot, row, k] = change[row, k] - last_change[row, k]
            for k in range(width):
                last_change[row, k] = change[row, k]
        for i in range(used):
            made[:] = 0
            pulled[:] = 0
            row = first[t]
            while row + 1 < stop:
                for k in range(width):
                    made[k] += (
                        changes[i, row, k] * changes[slot, row, k] + changes[i, row + 1, k] * changes[slot, row + 1, k]
                    )
                for k in range(width):
                    pulled[k] += changes[i, row, k] * change[row, k] + changes[i, row + 1, k] * change[row + 1, k]
                row += 2
            if row < stop:
                for k in range(width):
                    made[k] += changes[i, row, k] * changes[slot, row, k]
                for k in range(width):
                    pulled[k] += changes[i, row, k] * change[row, k]
            for n in range(count):
                products[0, i, t // stride, n] = (made[n] + made[count + n]) + made[2 * count + n]
            for n in range(count):
                products[1, i, t // stride, n] = (pulled[n] + pulled[count + n]) + pulled[2 * count + n]


@compiled()
def fade_over_time(values: Array, keep: float) -> None:
    """Sum values (m, T, variant) over frames in place, those a frame further away by `keep` less."""
    size, frames, count = values.shape
    ahead = np.empty((frames, count))
    for i in range(size):
        ahead[frames - 1] = 0.0
        for t in range(frames - 2, -1, -1):
            for n in range(count):
                ahead[t, n] = keep * (ahead[t + 1, n] + values[i, t + 1, n])
        for t in range(1, frames):
            for n in range(count):
                values[i, t, n] += keep * values[i, t - 1, n]
        for t in range(frames):
            for n in range(count):
                values[i, t, n] += ahead[t, n]


@compiled()
def mix_moves(
    form: Form, gram: Array, pulls: Array, used: int, stride: int, ridge: float, moves: AnyFloat, state: AnyFloat
) -> None:
    """Subtract from the state the part of the change that its last moves (m, row, 3, variant) explain (Anderson 1965).

    In every `stride`-th frame the shares of the moves solve the ridged least squares with matrix `gram`
    (m, m, T, variant) and right-hand side `pulls` (m, T, variant).
    """
    size, total, count = len(moves), len(state), state.shape[2]
    width = 3 * count
    lower, x = np.zeros((size, size, count)), np.zeros((size, count))
    trace, shares = np.empty(count), np.zeros((size, width), state.dtype)
    flat, past = state.reshape(total, width), moves.reshape(size, total, width)
    for t in range(len(form.first) - 1):
        if t % stride == 0:
            _solve_shares(gram[:, :, t // stride], pulls[:, t // stride], used, ridge, lower, trace, x)
            for i in range(used):
                for axis in range(3):
                    for n in range(count):
                        shares[i, axis * count + n] = x[i, n]
        for row in range(form.first[t], form.first[t + 1]):
            i = 0
            while i + 2 < used:
                for k in range(width):
                    flat[row, k] -= (shares[i, k] * past[i, row, k] + shares[i + 1, k] * past[i + 1, row, k]) + (
                        shares[i + 2, k] * past[i + 2, row, k]
                    )
                i += 3
            while i < used:
                for k in range(width):
                    flat[row, k] -= shares[i, k] * past[i, row, k]
                i += 1


@inner_kernel()
def _solve_shares(gram: Array, pulls: Array, used: int, ridge: float, lower: Array, trace: Array, x: Array) -> None:
    """Write the solution of (gram + ridge trace) x = pulls to `x` (m, variant), by Cholesky."""
    count = pulls.shape[1]
    trace[:] = 1e-30
    for i in range(used):
        for n in range(count):
            trace[n] += gram[i, i, n]
    for i in range(used):
        for j in range(i + 1):
            value = lower[i, j]
            for n in range(count):
                value[n] = gram[i, j, n]
            if i == j:
                for n in range(count):
                    value[n] += ridge * trace[n]
            for k in range(j):
                a, b = lower[i, k], lower[j, k]
                for n in range(count):
                    value[n] -= a[n] * b[n]
            if i == j:
                for n in range(count):
                    value[n] = np.sqrt(max(value[n], 1e-30))
            else:
                b = lower[j, j]
                for n in range(count):
                    value[n] /= b[n]
    for i in range(used):
        value = x[i]
        for n in range(count):
            value[n] = pulls[i, n]
        for k in range(i):
            a, b = lower[i, k], x[k]
            for n in range(count):
                value[n] -= a[n] * b[n]
        b = lower[i, i]
        for n in range(count):
            value[n] /= b[n]
    for i in range(used - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, used):
            a, b = lower[k, i], x[k]
            for n in range(count):
                value[n] -= a[n] * b[n]
        b = lower[i, i]
        for n in range(count):
            value[n] /= b[n]


@compiled()
def mean_change(values: AnyFloat, first: Integers, num_rows: int) -> Array:
    """Return the mean over frames of the root mean square of a frame's first rows of `values` (row, 3, variant)."""
    count, frames = values.shape[2], len(first) - 1
    total, part = np.zeros(count), np.zeros(count, values.dtype)
    for t in range(frames):
        part[:] = 0
        for row in range(first[t], first[t] + num_rows):
            for axis in range(3):
                moved = values[row, axis]
                for n in range(count):
                    part[n] += moved[n] * moved[n]
        for n in range(count):
            total[n] += np.sqrt(part[n] / num_rows) / frames
    return total


@compiled()
def add_stencils(points: Integers, shares: Array, weights: Array, matrix: Array) -> None:
    """Add sum w B^T B to `matrix` (T, n, n)."""
    frames, num_pairs, size = points.shape
    for t in range(frames):
        for e in range(num_pairs):
            for i in range(size):
                for j in range(size):
                    matrix[t, points[t, e, i], points[t, e, j]] += weights[t, e] * shares[t, e, i] * shares[t, e, j]
