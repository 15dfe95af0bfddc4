"""The Delaunay graph over the joints of a pair: its edges define the interaction coordinates.

After Yin et al. (2018), section 4.3.  The plain form over one point set, in the plane or in space; the fast planar
triangulation is in `triangulation`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags
from pasdedeux.errors import InputError
from pasdedeux.interaction.triangulation import jitter

Edges = npt.NDArray[np.int32]

_CORNERS = {dimension: np.triu_indices(dimension + 1, k=1) for dimension in (2, 3)}
"""Both ends of the edges of a simplex."""
_jitter = lru_cache(maxsize=8)(jitter)


def delaunay_edges(points: Array) -> Edges:
    """Return the Delaunay edges of points (n, 2), or the edges of the Delaunay tetrahedra of points (n, 3), metres.

    Points are moved by a fixed jitter of at most 1e-7 m first, so coincident, collinear and cocircular points have one
    answer.  Fewer points than a simplex needs are all joined.

    Raises:
        InputError: A coordinate is not finite.
    """
    if not np.isfinite(points).all():
        joint = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise InputError(f"point {joint} is not finite: a graph over joints needs all of them")
    num_points, dimension = points.shape
    if num_points <= dimension:
        return np.stack(np.triu_indices(num_points, k=1), axis=1).astype(np.int32)
    from scipy.spatial import Delaunay, QhullError  # here: planning need not wait for it

    try:
        simplices = Delaunay(points + _jitter(num_points, dimension)).simplices
    except QhullError:
        # Flat even after the jitter, by Qhull's own tolerance: let Qhull joggle (its QJ option is deterministic).
        simplices = Delaunay(points + _jitter(num_points, dimension), qhull_options="QJ Qbb Qc").simplices
    # Flags, because sorting pairs of points would take the time of Qhull again.
    return np.stack(np.nonzero(simplex_neighbours(simplices, num_points) & _is_above(num_points)), axis=1).astype(
        np.int32
    )


def simplex_neighbours(simplices: Edges, num_points: int) -> Flags:
    """Return which points share one of the triangles or tetrahedra (simplex, corner), (n, n)."""
    start, end = _CORNERS[simplices.shape[1] - 1]
    is_joined = np.zeros((num_points, num_points), dtype=bool)
    is_joined[simplices[:, start], simplices[:, end]] = True
    return np.asarray(is_joined | is_joined.T)


@lru_cache(maxsize=8)
def _is_above(num_points: int) -> Flags:
    """Return which pairs i, j of points have i < j, (n, n)."""
    return np.triu(np.ones((num_points, num_points), dtype=bool), k=1)
