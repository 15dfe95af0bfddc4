"""The dissimilarities in compiled loops; `dissimilarity` holds the definitions they are tested against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import BETA_M, edge_weights
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.triangulation import delaunay_edges_fast


@dataclass(frozen=True)
class EdgeTable:
    """The edges of many point sets with their weights, padded to one length.

    Args:
        edges: Edges i < j, (set, edge, 2); 0, 0 beyond the valid ones.
        weights: Weights that sum to 1 in each set, (set, edge); 0 beyond the valid ones.
        counts: Number of valid edges, (set,).
    """

    edges: npt.NDArray[np.int32]
    weights: Array
    counts: npt.NDArray[np.int32]


def edge_table(points: Array) -> EdgeTable:
    """Return the Delaunay edges and weights (eq. 8) of point sets (set, n, 2), metres; NaN where not seen."""
    edges, counts = delaunay_edges_fast(points)
    return _weigh(points, edges, counts)


def edge_table_3d(points: Array) -> EdgeTable:
    """Return edges of the Delaunay tetrahedra, and weights, of point sets (set, n, 3), metres (scipy, 0.3 ms a set).

    Raises:
        InputError: A coordinate is not finite.
    """
    is_bad = ~np.isfinite(points).all(axis=(-1, -2))
    if is_bad.any():
        raise InputError(f"point set {int(np.argmax(is_bad))}: a coordinate is not finite")
    per_set = [delaunay_edges(cloud) for cloud in points]
    longest = max((len(edges) for edges in per_set), default=0)
    edges = np.zeros((len(points), longest, 2), dtype=np.int32)
    for row, set_edges in enumerate(per_set):
        edges[row, : len(set_edges)] = set_edges
    return _weigh(points, edges, np.array([len(set_edges) for set_edges in per_set], dtype=np.int32))


def _weigh(points: Array, edges: npt.NDArray[np.int32], counts: npt.NDArray[np.int32]) -> EdgeTable:
    weights = np.zeros(edges.shape[:2])
    for row, count in enumerate(counts):
        weights[row, :count] = edge_weights(points[row], edges[row, :count])
    return EdgeTable(edges=edges, weights=weights, counts=counts)


@inner_kernel()
def fill_edge_weights(x, y, edges, count, weights):  # type: ignore[no-untyped-def]
    """Write the weights of eq. 8 of one planar point set into `weights`; they sum to 1."""
    total = 0.0
    for e in range(count):
        i, j = edges[e, 0], edges[e, 1]
        dx, dy = x[j] - x[i], y[j] - y[i]
        weights[e] = 1.0 / max(BETA_M, np.sqrt(dx * dx + dy * dy))
        total += weights[e]
    for e in range(count):
        weights[e] /= total


@inner_kernel()
def side_sum(dx, dy, edges, count, weights):  # type: ignore[no-untyped-def]
    """Return one side of eq. 8: the weighted sum over edges of the length of the difference of edge vectors.

    `dx`, `dy` are the differences of the aligned points, so an edge's difference is theirs subtracted.
    """
    total = 0.0
    for e in range(count):
        i, j = edges[e, 0], edges[e, 1]
        u, v = dx[j] - dx[i], dy[j] - dy[i]
        total += weights[e] * np.sqrt(u * u + v * v)
    return total


@inner_kernel()
def keep_seen_edges(edges, count, weights, is_seen, kept, kept_weights):  # type: ignore[no-untyped-def]
    """Write the edges of which both ends are seen, and their weights scaled to sum to 1; give their number."""
    number, total = 0, 0.0
    for e in range(count):
        if is_seen[edges[e, 0]] and is_seen[edges[e, 1]]:
            kept[number, 0], kept[number, 1] = edges[e, 0], edges[e, 1]
            kept_weights[number] = weights[e]
            total += weights[e]
            number += 1
    for e in range(number):
        kept_weights[e] /= total
    return number


@compiled(inline="always")
def _minor(m, r0, r1, r2, c0, c1, c2):  # type: ignore[no-untyped-def]
    return (
        m[r0, c0] * (m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1])
        - m[r0, c1] * (m[r1, c0] * m[r2, c2] - m[r1, c2] * m[r2, c0])
        + m[r0, c2] * (m[r1, c0] * m[r2, c1] - m[r1, c1] * m[r2, c0])
    )


@inner_kernel()
def _null_vector(key, shift, m, q):  # type: ignore[no-untyped-def]
    """Write the unit vector that `key` - `shift` maps nearest to zero into q (from the adjugate); false if zero."""
    scale = 0.0
    for i in range(4):
        for j in range(4):
            m[i, j] = key[i, j]
            scale = max(scale, abs(key[i, j]))
        m[i, i] -= shift
    best, row = -1.0, 0
    for i in range(4):
        o0 = 1 if i == 0 else 0
        o1 = 2 if i <= 1 else 1
        o2 = 3 if i <= 2 else 2
        cofactor = abs(_minor(m, o0, o1, o2, o0, o1, o2))
        if cofactor > best:
            best, row = cofactor, i
    if best <= 1e-12 * scale * scale * scale:
        return False
    r0 = 1 if row == 0 else 0
    r1 = 2 if row <= 1 else 1
    r2 = 3 if row <= 2 else 2
    norm = 0.0
    for j in range(4):
        c0 = 1 if j == 0 else 0
        c1 = 2 if j <= 1 else 1
        c2 = 3 if j <= 2 else 2
        value = _minor(m, r0, r1, r2, c0, c1, c2)
        q[j] = value if (row + j) % 2 == 0 else -value
        norm += q[j] * q[j]
    norm = np.sqrt(norm)
    for j in range(4):
        q[j] /= norm
    return True


@compiled()
def best_turn(moving, fixed, key, m, q, rotmat):  # type: ignore[no-untyped-def]
    """Write the proper rotation that turns centred points `moving` (n, 3) best onto centred `fixed` (n, 3).

    Largest eigenvector of Horn's 4x4 matrix (Horn 1987) by Newton steps on its characteristic polynomial from above
    (Theobald 2005), then one Rayleigh step; LAPACK if the largest eigenvalue is not simple.  `key`, `m` (4, 4) and `q`
    (4,) are scratch, `rotmat` (3, 3) the result.
    """
    xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
    squares = 0.0
    for k in range(moving.shape[0]):
        mx, my, mz = moving[k, 0], moving[k, 1], moving[k, 2]
        fx, fy, fz = fixed[k, 0], fixed[k, 1], fixed[k, 2]
        xx += mx * fx
        xy += mx * fy
        xz += mx * fz
        yx += my * fx
        yy += my * fy
        yz += my * fz
        zx += mz * fx
        zy += mz * fy
        zz += mz * fz
        squares += mx * mx + my * my + mz * mz + fx * fx + fy * fy + fz * fz
    key[0, 0] = xx + yy + zz
    key[1, 1] = xx - yy - zz
    key[2, 2] = yy - xx - zz
    key[3, 3] = zz - xx - yy
    key[0, 1] = key[1, 0] = yz - zy
    key[0, 2] = key[2, 0] = zx - xz
    key[0, 3] = key[3, 0] = xy - yx
    key[1, 2] = key[2, 1] = xy + yx
    key[1, 3] = key[3, 1] = zx + xz
    key[2, 3] = key[3, 2] = yz + zy
    # characteristic polynomial t^4 + c2 t^2 + c1 t + c0 of a traceless matrix
    c2 = -2.0 * (xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz + zx * zx + zy * zy + zz * zz)
    c1 = -8.0 * (xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx))
    c0 = 0.0
    for j in range(4):
        cc0 = 1 if j == 0 else 0
        cc1 = 2 if j <= 1 else 1
        cc2 = 3 if j <= 2 else 2
        value = _minor(key, 1, 2, 3, cc0, cc1, cc2)
        c0 += key[0, j] * (value if j % 2 == 0 else -value)
    t = 0.5 * squares
    for _ in range(60):
        slope = 4.0 * t * t * t + 2.0 * c2 * t + c1
        if slope <= 0.0:
            break
        step = (((t * t + c2) * t + c1) * t + c0) / slope
        t -= step
        if abs(step) <= 1e-12 * abs(t):
            break
    is_found = _null_vector(key, t, m, q)
    if is_found:
        t = 0.0
        for i in range(4):
            for j in range(4):
                t += q[i] * key[i, j] * q[j]
        _null_vector(key, t, m, q)
    else:
        _, vectors = np.linalg.eigh(key)
        for i in range(4):
            q[i] = vectors[i, 3]
    w, x, y, z = q[0], q[1], q[2], q[3]
    rotmat[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    rotmat[0, 1] = 2.0 * (x * y - w * z)
    rotmat[0, 2] = 2.0 * (x * z + w * y)
    rotmat[1, 0] = 2.0 * (x * y + w * z)
    rotmat[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    rotmat[1, 2] = 2.0 * (y * z - w * x)
    rotmat[2, 0] = 2.0 * (x * z - w * y)
    rotmat[2, 1] = 2.0 * (y * z + w * x)
    rotmat[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@compiled(inline="always")
def turned_gap(rotmat, moving, fixed, k):  # type: ignore[no-untyped-def]
    """Return the difference vector from point k of `fixed` (n, 3) to the rotated point k of `moving` (n, 3)."""
    x, y, z = moving[k, 0], moving[k, 1], moving[k, 2]
    return (
        rotmat[0, 0] * x + rotmat[0, 1] * y + rotmat[0, 2] * z - fixed[k, 0],
        rotmat[1, 0] * x + rotmat[1, 1] * y + rotmat[1, 2] * z - fixed[k, 1],
        rotmat[2, 0] * x + rotmat[2, 1] * y + rotmat[2, 2] * z - fixed[k, 2],
    )


@compiled(inline="always")
def turned_squares(rotmat, moving, fixed):  # type: ignore[no-untyped-def]
    """Return the squared distances of `moving` (n, 3), turned, to `fixed` (n, 3), summed over the points."""
    total = 0.0
    for k in range(moving.shape[0]):
        u, v, w = turned_gap(rotmat, moving, fixed, k)
        total += u * u
        total += v * v
        total += w * w
    return total
