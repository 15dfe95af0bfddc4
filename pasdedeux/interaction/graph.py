"""The Delaunay graph over the joints of a pair: which joints' differences are interaction coordinates.

After Yin et al. (2018), section 4.3.  The plain form over one point set, in the plane or in space; the fast planar
triangulation is in `triangulation`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.interaction.triangulation import jitter

Edges = npt.NDArray[np.int32]

_MAX_POINTS = 1 << 31


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
        simplices = Delaunay(points + jitter(num_points, dimension)).simplices
    except QhullError:
        # Flat even after the jitter, by Qhull's own tolerance: let Qhull joggle (its QJ option is deterministic).
        simplices = Delaunay(points + jitter(num_points, dimension), qhull_options="QJ Qbb Qc").simplices
    columns = [simplices[:, [i, j]] for i in range(dimension + 1) for j in range(i)]
    return _sorted_edges(np.concatenate(columns))


def _sorted_edges(pairs: npt.NDArray[np.integer]) -> Edges:
    # An edge as one number sorts alike, and numpy's unique rows cost many times as much.
    ordered = np.sort(pairs.astype(np.int64), axis=1)
    keys = np.unique(ordered[:, 0] * _MAX_POINTS + ordered[:, 1])
    return np.stack(np.divmod(keys, _MAX_POINTS), axis=1).astype(np.int32)
