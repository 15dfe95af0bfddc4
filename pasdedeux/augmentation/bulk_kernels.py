"""Inner loops of the bulk solver, variants innermost.

No fast-math: fused or reordered operations would round differently in the vector body of a loop and in its rest, and so
make a variant depend on its place in the batch.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["add_stencils", "assemble", "assemble_near", "project_edges", "project_near"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]
Indices = npt.NDArray[np.int64]


@numba.njit(cache=True, nogil=True)
def project_edges(
    offsets: AnyFloat,
    reference: AnyFloat,
    dual: AnyFloat,
    aim: AnyFloat,
    lengths: AnyFloat,
    edges: Indices,
    stiffness: AnyFloat,
    penalties: AnyFloat,
    constants: AnyFloat,
    is_first: bool,
    squared: AnyFloat,
) -> None:
    """Project edge vectors onto their spheres, update the duals, leave z - u in `aim`, sum squared bone errors."""
    frames, num_edges, count = lengths.shape
    squared[:] = 0.0
    relaxation = constants[0]
    one = relaxation / relaxation
    keep, zero, tiny = one - relaxation, one - one, lengths.dtype.type(1e-12)
    for t in range(frames):
        for e in range(num_edges):
            parent, child = edges[e, 0], edges[e, 1]
            k, penalty = stiffness[e], penalties[t, e]
            inverse = one / (penalty + max(k, zero))
            for v in range(count):
                x = offsets[0, t, child, v] - offsets[0, t, parent, v]
                y = offsets[1, t, child, v] - offsets[1, t, parent, v]
                z = offsets[2, t, child, v] - offsets[2, t, parent, v]
                x += reference[0, t, child, v] - reference[0, t, parent, v]
                y += reference[1, t, child, v] - reference[1, t, parent, v]
                z += reference[2, t, child, v] - reference[2, t, parent, v]
                length = lengths[t, e, v]
                if k < zero:
                    miss = np.sqrt(x * x + y * y + z * z) - length
                    squared[t, v] += miss * miss
                ux, uy, uz = dual[0, t, e, v], dual[1, t, e, v], dual[2, t, e, v]
                if not is_first:
                    # The last z is aim + u; over-relaxation mixes it in.
                    x = relaxation * x + keep * (aim[0, t, e, v] + ux)
                    y = relaxation * y + keep * (aim[1, t, e, v] + uy)
                    z = relaxation * z + keep * (aim[2, t, e, v] + uz)
                x, y, z = x + ux, y + uy, z + uz
                norm = np.sqrt(x * x + y * y + z * z) + tiny
                wanted = length if k < zero else (penalty * norm + k * length) * inverse
                scale = wanted / norm
                ux, uy, uz = x - x * scale, y - y * scale, z - z * scale
                dual[0, t, e, v], dual[1, t, e, v], dual[2, t, e, v] = ux, uy, uz
                aim[0, t, e, v] = x * scale - ux
                aim[1, t, e, v] = y * scale - uy
                aim[2, t, e, v] = z * scale - uz


@numba.njit(cache=True, nogil=True)
def assemble(
    linear: AnyFloat,
    reference: AnyFloat,
    aim: AnyFloat,
    edges: Indices,
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


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def assemble_near(
    aim: AnyFloat,
    points: Indices,
    shares: AnyFloat,
    penalties: AnyFloat,
    rhs: AnyFloat,
) -> None:
    """Add penalty B^T (z - u) to `rhs`."""
    frames, num_pairs, count = aim.shape[1:]
    for axis in range(3):
        for t in range(frames):
            for e in range(num_pairs):
                penalty = penalties[t, e]
                if penalty <= 0:
                    continue
                for k in range(4):
                    point, factor = points[t, e, k], penalty * shares[t, e, k]
                    for v in range(count):
                        rhs[axis, t, point, v] += factor * aim[axis, t, e, v]


@numba.njit(cache=True, nogil=True)
def add_stencils(points: Indices, shares: Array, weights: Array, matrix: Array) -> None:
    """Add sum w B^T B to `matrix` (T, 44, 44)."""
    frames, num_pairs, size = points.shape
    for t in range(frames):
        for e in range(num_pairs):
            for i in range(size):
                for j in range(size):
                    matrix[t, points[t, e, i], points[t, e, j]] += weights[t, e] * shares[t, e, i] * shares[t, e, j]
