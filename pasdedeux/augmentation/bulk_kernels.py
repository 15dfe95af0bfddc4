"""Inner loops of the bulk solver, variants innermost.

No fast-math: fused or reordered operations would round differently in the vector body of a loop and in its rest, and so
make a variant depend on its place in the batch.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["add_stencils", "assemble", "assemble_pairs", "project_edges", "project_near"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]
Indices = npt.NDArray[np.int64]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_edges(
    offsets: AnyFloat,
    reference: AnyFloat,
    dual: AnyFloat,
    aim: AnyFloat,
    lengths: AnyFloat,
    edges: Indices,
    num_bones: int,
    girdle: AnyFloat,
    penalties: AnyFloat,
    constants: AnyFloat,
    is_first: bool,
    squared: AnyFloat,
) -> None:
    """Project edge vectors onto their spheres, update the duals, leave z - u in `aim`, sum squared bone errors.

    `reference` holds the edge vectors of r.  Loops run over all edges and variants of a frame and touch few arrays
    each: only so the compiler makes vector code of them.
    """
    frames, num_edges, count = lengths.shape
    squared[:] = 0.0
    relaxation = constants[0]
    one = relaxation / relaxation
    keep, tiny = one - relaxation, lengths.dtype.type(1e-12)
    size = num_edges * count
    vector, scale = np.empty((3, size), lengths.dtype), np.empty(size, lengths.dtype)
    for t in range(frames):
        wanted = lengths[t].reshape(size)
        for axis in range(3):
            along, given = vector[axis], reference[axis, t].reshape(size)
            for e in range(num_edges):
                child, parent, start = offsets[axis, t, edges[e, 1]], offsets[axis, t, edges[e, 0]], e * count
                for v in range(count):
                    along[start + v] = (child[v] - parent[v]) + given[start + v]
        x, y, z = vector[0], vector[1], vector[2]
        for i in range(num_bones * count):
            miss = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]) - wanted[i]
            scale[i] = miss * miss
        for e in range(num_bones):
            for v in range(count):
                squared[t, v] += scale[e * count + v]
        for axis in range(3):
            along, last, aims = vector[axis], dual[axis, t].reshape(size), aim[axis, t].reshape(size)
            if is_first:
                for i in range(size):
                    along[i] += last[i]
            else:
                # The last z is aim + u; over-relaxation mixes it in.
                for i in range(size):
                    along[i] = (relaxation * along[i] + keep * (aims[i] + last[i])) + last[i]
        for i in range(size):
            scale[i] = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i]) + tiny
        for e in range(num_bones, num_edges):
            penalty = penalties[t, e]
            inverse = one / (penalty + girdle[0])
            for i in range(e * count, (e + 1) * count):
                scale[i] = (penalty * scale[i] + girdle[0] * wanted[i]) * inverse / scale[i]
        for i in range(num_bones * count):
            scale[i] = wanted[i] / scale[i]
        for axis in range(3):
            along, last, aims = vector[axis], dual[axis, t].reshape(size), aim[axis, t].reshape(size)
            for i in range(size):
                left = along[i] - along[i] * scale[i]
                last[i] = left
                aims[i] = along[i] * scale[i] - left


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
    frames, num_edges, count = aim.shape[1:]
    rhs[:] = linear
    pull = np.empty(count, aim.dtype)
    for axis in range(3):
        for t in range(frames):
            for e in range(num_edges):
                penalty = penalties[t, e]
                aims, given = aim[axis, t, e], reference[axis, t, e]
                child, parent = rhs[axis, t, edges[e, 1]], rhs[axis, t, edges[e, 0]]
                for v in range(count):
                    pull[v] = penalty * (aims[v] - given[v])
                for v in range(count):
                    child[v] += pull[v]
                for v in range(count):
                    parent[v] -= pull[v]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project_near(
    offsets: AnyFloat,
    dual: AnyFloat,
    aim: AnyFloat,
    limits: AnyFloat,
    points: Indices,
    shares: AnyFloat,
    normals: AnyFloat,
    penalties: AnyFloat,
    constants: AnyFloat,
    is_first: bool,
) -> None:
    """Pull the vectors between near bones towards their half-spaces, whose weight is the penalty over `share`."""
    frames, num_pairs, count = limits.shape
    relaxation, share = constants[0], constants[1]
    one = relaxation / relaxation
    keep, inverse = one - relaxation, one / (share + one)
    reach = np.zeros(count, limits.dtype)
    for t in range(frames):
        for e in range(num_pairs):
            if penalties[t, e] <= 0:
                continue
            a, b, c, d = points[t, e, 0], points[t, e, 1], points[t, e, 2], points[t, e, 3]
            sa, sb, sc, sd = shares[t, e, 0], shares[t, e, 1], shares[t, e, 2], shares[t, e, 3]
            reach[:] = 0
            for axis in range(3):
                n = normals[t, e, axis]
                for v in range(count):
                    x = sa * offsets[axis, t, a, v] + sb * offsets[axis, t, b, v]
                    x += sc * offsets[axis, t, c, v] + sd * offsets[axis, t, d, v]
                    u = dual[axis, t, e, v]
                    if not is_first:
                        x = relaxation * x + keep * (aim[axis, t, e, v] + u)
                    x += u
                    aim[axis, t, e, v] = x
                    reach[v] += n * x
            for axis in range(3):
                n = normals[t, e, axis]
                for v in range(count):
                    pull = n * max(limits[t, e, v] - reach[v], limits[t, e, v] - limits[t, e, v]) * inverse
                    # z = x + u + pull, and what is left of x + u is the new dual.
                    dual[axis, t, e, v] = -pull
                    aim[axis, t, e, v] += pull + pull


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assemble_pairs(
    aim: AnyFloat,
    points: Indices,
    shares: AnyFloat,
    penalties: AnyFloat,
    rhs: AnyFloat,
) -> None:
    """Add penalty B^T a to `rhs` for aims a (3, T, M, variant): z - u of near bones, D u less r's vector of spans."""
    frames, num_pairs, count = aim.shape[1:]
    for axis in range(3):
        for t in range(frames):
            for e in range(num_pairs):
                penalty = penalties[t, e]
                if penalty <= 0:
                    continue
                for k in range(points.shape[2]):
                    point, factor = points[t, e, k], penalty * shares[t, e, k]
                    for v in range(count):
                        rhs[axis, t, point, v] += factor * aim[axis, t, e, v]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_stencils(points: Indices, shares: Array, weights: Array, matrix: Array) -> None:
    """Add sum w B^T B to `matrix` (T, 44, 44)."""
    frames, num_pairs, size = points.shape
    for t in range(frames):
        for e in range(num_pairs):
            for i in range(size):
                for j in range(size):
                    matrix[t, points[t, e, i], points[t, e, j]] += weights[t, e] * shares[t, e, i] * shares[t, e, j]
