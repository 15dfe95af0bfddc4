"""Inner loops of the bulk solver, variants innermost.

No fast-math: fused or reordered operations would round differently in the vector body of a loop and in its rest, and so
make a variant depend on its place in the batch.

The iteration's state (3, T, R, variant) holds in each frame n rows x, a row v = z + u for each edge and one for each
pair of near bones; `aim` (3, T, R - n, variant) holds z - u.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

__all__ = [
    "add_stencils",
    "advance",
    "assemble",
    "assemble_pairs",
    "compare",
    "fade_over_time",
    "mean_change",
    "mix",
    "project",
]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]
Indices = npt.NDArray[np.int64]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance(
    offsets: AnyFloat,
    reference: AnyFloat,
    edges: Indices,
    points: Indices,
    shares: AnyFloat,
    relaxation: AnyFloat,
    aim: AnyFloat,
    state: AnyFloat,
    change: AnyFloat,
) -> None:
    """Take x from `offsets` and move v by `change` (3, T, R - n, variant), relaxation (s - z), s what x gives.

    `reference` holds the edge vectors of r.
    """
    frames, num_edges, count = reference.shape[1:]
    num_pairs = points.shape[1]
    num_points = state.shape[2] - num_edges - num_pairs
    relax = relaxation[0]
    half = relax / (relax + relax)
    for axis in range(3):
        for t in range(frames):
            for i in range(num_points):
                one, other = offsets[axis, t, i], state[axis, t, i]
                for n in range(count):
                    other[n] = one[n]
            for e in range(num_edges):
                child, parent = offsets[axis, t, edges[e, 1]], offsets[axis, t, edges[e, 0]]
                given, aims = reference[axis, t, e], aim[axis, t, e]
                v, moved = state[axis, t, num_points + e], change[axis, t, e]
                for n in range(count):
                    moved[n] = relax * (((child[n] - parent[n]) + given[n]) - half * (v[n] + aims[n]))
                for n in range(count):
                    v[n] += moved[n]
            for e in range(num_pairs):
                a, b = offsets[axis, t, points[t, e, 0]], offsets[axis, t, points[t, e, 1]]
                c, d = offsets[axis, t, points[t, e, 2]], offsets[axis, t, points[t, e, 3]]
                sa, sb, sc, sd = shares[t, e, 0], shares[t, e, 1], shares[t, e, 2], shares[t, e, 3]
                aims, moved = aim[axis, t, num_edges + e], change[axis, t, num_edges + e]
                v = state[axis, t, num_points + num_edges + e]
                for n in range(count):
                    moved[n] = (sa * a[n] + sb * b[n]) + (sc * c[n] + sd * d[n])
                for n in range(count):
                    moved[n] = relax * (moved[n] - half * (v[n] + aims[n]))
                for n in range(count):
                    v[n] += moved[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project(
    state: AnyFloat,
    lengths: AnyFloat,
    limits: AnyFloat,
    normals: AnyFloat,
    num_bones: int,
    girdle: AnyFloat,
    penalties: AnyFloat,
    share: AnyFloat,
    aim: AnyFloat,
) -> None:
    """Leave z - u = 2 z - v in `aim`: bones go to their spheres, girdle pairs towards theirs, near bones out."""
    frames, num_edges, count = lengths.shape
    num_pairs = limits.shape[1]
    num_points = state.shape[2] - num_edges - num_pairs
    tiny = lengths.dtype.type(1e-12)
    one = share[0] / share[0]
    two, zero, inverse = one + one, one - one, one / (share[0] + one)
    scale = np.empty(count, lengths.dtype)
    for t in range(frames):
        for e in range(num_edges):
            x, y, z = state[0, t, num_points + e], state[1, t, num_points + e], state[2, t, num_points + e]
            wanted = lengths[t, e]
            for n in range(count):
                scale[n] = np.sqrt((x[n] * x[n] + y[n] * y[n]) + z[n] * z[n]) + tiny
            if e < num_bones:
                for n in range(count):
                    scale[n] = two * wanted[n] / scale[n] - one
            else:
                penalty = penalties[t, e]
                pulled = one / (penalty + girdle[0])
                for n in range(count):
                    scale[n] = two * ((penalty * scale[n] + girdle[0] * wanted[n]) * pulled / scale[n]) - one
            for axis in range(3):
                v, aims = state[axis, t, num_points + e], aim[axis, t, e]
                for n in range(count):
                    aims[n] = v[n] * scale[n]
        for e in range(num_pairs):
            row, limit = num_points + num_edges + e, limits[t, e]
            x, y, z = state[0, t, row], state[1, t, row], state[2, t, row]
            a, b, c = normals[t, e, 0], normals[t, e, 1], normals[t, e, 2]
            for n in range(count):
                scale[n] = limit[n] - ((a * x[n] + b * y[n]) + c * z[n])
            for n in range(count):
                scale[n] = two * (max(scale[n], zero) * inverse)
            for axis in range(3):
                v, aims, normal = state[axis, t, row], aim[axis, t, num_edges + e], normals[t, e, axis]
                for n in range(count):
                    aims[n] = v[n] + normal * scale[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assemble(
    linear: AnyFloat,
    reference: AnyFloat,
    aim: AnyFloat,
    edges: Indices,
    penalties: AnyFloat,
    rhs: AnyFloat,
) -> None:
    """Return b + penalty S^T (z - u - S r) in `rhs`; `reference` holds S r."""
    frames, num_edges, count = reference.shape[1:]
    rhs[:] = linear
    pull = np.empty(count, aim.dtype)
    for axis in range(3):
        for t in range(frames):
            for e in range(num_edges):
                penalty = penalties[t, e]
                aims, given = aim[axis, t, e], reference[axis, t, e]
                child, parent = rhs[axis, t, edges[e, 1]], rhs[axis, t, edges[e, 0]]
                for n in range(count):
                    pull[n] = penalty * (aims[n] - given[n])
                for n in range(count):
                    child[n] += pull[n]
                for n in range(count):
                    parent[n] -= pull[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assemble_pairs(
    aim: AnyFloat, first: int, points: Indices, shares: AnyFloat, penalties: AnyFloat, rhs: AnyFloat
) -> None:
    """Add penalty B^T a to `rhs` for the rows of `aim` from `first` on: z - u of near bones, aims of contacts."""
    frames, num_pairs, size = points.shape
    count = aim.shape[3]
    for axis in range(3):
        for t in range(frames):
            for e in range(num_pairs):
                penalty = penalties[t, e]
                if penalty <= 0:
                    continue
                aims = aim[axis, t, first + e]
                for k in range(size):
                    factor, pulled = penalty * shares[t, e, k], rhs[axis, t, points[t, e, k]]
                    for n in range(count):
                        pulled[n] += factor * aims[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def compare(changes: AnyFloat, slot: int, used: int, change: AnyFloat, products: AnyFloat, pulls: AnyFloat) -> None:
    """Leave inner products over a frame's rows in `products` (m, T, variant) and `pulls` (m, T, variant).

    Of the differences of changes (m, 3, T, rows, variant), `used` of them: with the one in `slot`, and with `change`.
    """
    _, frames, rows, count = change.shape
    products[:] = 0
    pulls[:] = 0
    for t in range(frames):
        for axis in range(3):
            for row in range(rows):
                newest, now = changes[slot, axis, t, row], change[axis, t, row]
                for i in range(used):
                    other, product, pull = changes[i, axis, t, row], products[i, t], pulls[i, t]
                    for n in range(count):
                        product[n] += other[n] * newest[n]
                    for n in range(count):
                        pull[n] += other[n] * now[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mix(gram: Array, pulls: Array, used: int, ridge: float, moves: AnyFloat, shares: AnyFloat, state: AnyFloat) -> None:
    """Take away from the state what its last moves (m, 3, T, R, variant) explain of the change (Anderson 1965).

    In each frame the shares of the moves solve the ridged least squares with matrix `gram` (m, m, T, variant) and
    right-hand side `pulls` (m, T, variant); `shares` (m, variant) is space to work in.
    """
    _, frames, rows, count = state.shape
    lower, x = np.empty((used, used)), np.empty(used)
    for t in range(frames):
        for n in range(count):
            trace = 1e-30
            for i in range(used):
                trace += gram[i, i, t, n]
            for i in range(used):
                for j in range(i + 1):
                    value = gram[i, j, t, n]
                    if i == j:
                        value += ridge * trace
                    for k in range(j):
                        value -= lower[i, k] * lower[j, k]
                    lower[i, j] = np.sqrt(max(value, 1e-30)) if i == j else value / lower[j, j]
            for i in range(used):
                value = pulls[i, t, n]
                for k in range(i):
                    value -= lower[i, k] * x[k]
                x[i] = value / lower[i, i]
            for i in range(used - 1, -1, -1):
                value = x[i]
                for k in range(i + 1, used):
                    value -= lower[k, i] * x[k]
                x[i] = value / lower[i, i]
            for i in range(used):
                shares[i, n] = x[i]
        for axis in range(3):
            for row in range(rows):
                v = state[axis, t, row]
                for i in range(used):
                    moved, share = moves[i, axis, t, row], shares[i]
                    for n in range(count):
                        v[n] -= share[n] * moved[n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mean_change(change: AnyFloat, num_rows: int) -> Array:
    """Return the mean over frames of the root mean square of the first rows of `change` (3, T, rows, variant)."""
    _, frames, _, count = change.shape
    total, part = np.zeros(count), np.zeros(count, change.dtype)
    for t in range(frames):
        part[:] = 0
        for axis in range(3):
            for row in range(num_rows):
                moved = change[axis, t, row]
                for n in range(count):
                    part[n] += moved[n] * moved[n]
        for n in range(count):
            total[n] += np.sqrt(part[n] / num_rows) / frames
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_stencils(points: Indices, shares: Array, weights: Array, matrix: Array) -> None:
    """Add sum w B^T B to `matrix` (T, n, n)."""
    frames, num_pairs, size = points.shape
    for t in range(frames):
        for e in range(num_pairs):
            for i in range(size):
                for j in range(size):
                    matrix[t, points[t, e, i], points[t, e, j]] += weights[t, e] * shares[t, e, i] * shares[t, e, j]
