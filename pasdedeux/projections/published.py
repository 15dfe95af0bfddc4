"""The published search: projections are clustered, and a query is compared with representatives of clusters first.

Yiannakides et al. (2019, sections 4 and 5) scale all projections, and every query, so that their bounding boxes are
equally high.  They embed them in few dimensions by multi-dimensional scaling of eq. 1, cluster them by k-means, and
keep the projection nearest to each centroid as its representative.  A query takes the 10 best projections, by eq. 1, of
each of the 5 clusters whose representatives are nearest to it.  The exact search (`search`) finds what this one may
miss.

Differences from the paper: the distance matrix of 216,000 projections has 187 GB in float32 (12 hours in the paper), so
a projection is embedded by its distances to landmarks (landmark MDS, de Silva and Tenenbaum 2004).  Unseen joints are
masked, also in the box; the paper assumes that all are seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Floats32, Integers
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_STATURE_M
from pasdedeux.projections.search import Neighbours, prepare_query

BOX_HEIGHT_M = REFERENCE_STATURE_M
"""Height of every image's bounding box; the paper does not state one."""
_MIN_BOX_M = 0.1
"""Smallest height of a box, because a line has no size."""
_NUM_DIMENSIONS = 4
"""Dimensions of the embedding; the paper found 2 to 5 equally good."""
_NUM_LANDMARKS = 300
_FLAT = 1e-6
"""Axes with a smaller share of the largest eigenvalue are rounding errors of float32, and are ignored."""
_KMEANS_STOP = 1e-4
"""k-means ends when the mean distance to the centroids falls by less, sums over joints in metres."""
_NUM_NEAREST_CLUSTERS = 5
"""Number of clusters searched for a query (section 5)."""
_NUM_OF_CLUSTER = 10
"""Number of projections taken from each (section 5)."""


@dataclass(frozen=True)
class Clusters:
    """Clusters of a database's projections.

    Args:
        representative: Number of the projection nearest to each centroid (cluster,).
        members: Numbers of each cluster's projections, ascending.
    """

    representative: Integers
    members: tuple[Integers, ...]


def cluster_projections(database: Database, num_clusters: int, rng: np.random.Generator) -> Clusters:
    """Return the clusters of a database's projections; those that stay empty are dropped.

    Args:
        database: Database of one camera.
        num_clusters: Number of clusters (500 in the paper).
        rng: Draws the landmarks and the first centroids.
    """
    return cluster_places(place_projections(box_images(database), rng), num_clusters, rng)


def box_images(database: Database) -> Floats32:
    """Return all projections (projection, J, 2), their bounding boxes `BOX_HEIGHT_M` high."""
    images = np.empty((database.num_projections, database.num_joints, 2), dtype=np.float32)
    step = max(1, 20_000 // database.num_yaws)
    for row in range(0, database.num_rows, step):
        part = scale_to_box(database.project(row, row + step).reshape(-1, *images.shape[1:]))
        images[row * database.num_yaws :][: len(part)] = part
    return images


def scale_to_box(images: Floats32) -> Floats32:
    """Return images (*batch, J, 2) scaled about their origin to boxes `BOX_HEIGHT_M` high; NaN stays NaN."""
    y = images[..., 1]
    is_seen = np.isfinite(y)
    high = np.where(is_seen, y, -np.inf).max(axis=-1)
    low = np.where(is_seen, y, np.inf).min(axis=-1)
    height = np.where(is_seen.any(axis=-1), np.maximum(high - low, _MIN_BOX_M), 1.0)
    return np.asarray(images * (BOX_HEIGHT_M / height)[..., None, None], dtype=np.float32)


def place_projections(images: Floats32, rng: np.random.Generator) -> Array:
    """Return the embedding (projection, d) of images (projection, J, 2) by landmark MDS of eq. 1."""
    chosen = np.sort(rng.choice(len(images), min(_NUM_LANDMARKS, len(images)), replace=False))
    landmarks = images[chosen]
    squared = _summed_distances(landmarks, landmarks) ** 2
    mean = squared.mean(axis=0)
    values, vectors = np.linalg.eigh(-0.5 * (squared - mean[:, None] - mean + mean.mean()))
    values, vectors = values[-_NUM_DIMENSIONS:], vectors[:, -_NUM_DIMENSIONS:]
    vectors = vectors * np.where(vectors.sum(axis=0) < 0, -1.0, 1.0)  # LAPACK leaves the sign open
    lift = vectors / np.sqrt(np.where(values > _FLAT * values[-1], values, np.inf))
    step = 20_000
    parts = (images[start : start + step] for start in range(0, len(images), step))
    # Not BLAS, whose rounding of a row depends on the shape of the product.
    return np.concatenate(
        [np.einsum("nl,ld->nd", 0.5 * (mean - _summed_distances(p, landmarks) ** 2), lift) for p in parts]
    )


def cluster_places(places: Array, num_clusters: int, rng: np.random.Generator) -> Clusters:
    """Return the clusters of embedded projections (projection, d) by k-means from drawn ones; drop empty clusters."""
    from scipy.cluster.vq import kmeans, vq  # here: planning does not need it

    first = np.sort(rng.choice(len(places), min(num_clusters, len(places)), replace=False))
    centroids, _ = kmeans(places, places[first], thresh=_KMEANS_STOP)
    label, distance = vq(places, centroids)
    order = np.argsort(label, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    return Clusters(np.array([numbers[np.argmin(distance[numbers])] for numbers in members]), tuple(members))


@dataclass(frozen=True)
class PublishedIndex:
    """A database prepared for the published search.

    Raises:
        InputError: The clusters do not contain each projection of the database once.
    """

    database: Database
    clusters: Clusters

    def __post_init__(self) -> None:
        """Check that the clusters are of this database."""
        numbers = np.sort(np.concatenate(self.clusters.members)) if self.clusters.members else np.zeros(0)
        if not np.array_equal(numbers, np.arange(self.database.num_projections)):
            raise InputError(
                f"the clusters hold {len(numbers)} projections and are of another database than this one of "
                f"{self.database.num_projections}; build the database and its clusters with one study"
            )

    @cached_property
    def _images(self) -> tuple[Floats32, tuple[Floats32, ...]]:
        """Representatives (cluster, J, 2), and the members of each cluster (n, J, 2)."""
        images = box_images(self.database)
        return images[self.clusters.representative], tuple(images[numbers] for numbers in self.clusters.members)

    def search(self, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> Neighbours:
        """Return the 10 best projections of each of the 5 clusters nearest to each query, best first.

        Args:
            query_m: Queries (*batch, J, 2), metres, x right, y up, mid-hip at the origin; NaN where not seen.
            weights: Weights (*batch, J) of the joints, 1 when not given.

        Returns:
            Neighbours (*batch, 50), distances by eq. 1 per joint between images of equal boxes, ties by projection
            number; none where no joint was seen.
        """
        seen = np.array(query_m, dtype=np.float32)
        if weights is not None:
            seen[np.broadcast_to(np.asarray(weights), seen.shape[:-1]) <= 0] = np.nan
        query, weight = prepare_query(scale_to_box(seen), weights, num_joints=self.database.num_joints)
        shape = (*query.shape[:-2], _NUM_NEAREST_CLUSTERS * _NUM_OF_CLUSTER)
        numbers_found = np.full(shape, -1, dtype=np.int64)
        distance = np.full(shape, np.inf)
        for at in np.ndindex(shape[:-1]):
            if weight[at].any():
                numbers, summed = self._best(query[at], weight[at])
                numbers_found[at][: len(numbers)] = numbers
                distance[at][: len(numbers)] = summed / weight[at].sum(dtype=np.float64)
        return Neighbours(numbers_found, distance, self.database.num_yaws)

    def _best(self, query: Floats32, weight: Floats32) -> tuple[Integers, Array]:
        """Return the best projections (n,) of the nearest clusters, and their weighted sums of distances (n,)."""
        representatives, images = self._images
        away = _summed_distances(representatives, query[None], weight)[:, 0]
        numbers, sums = [], []
        for cluster in np.argsort(away, kind="stable")[:_NUM_NEAREST_CLUSTERS]:
            summed = _summed_distances(images[cluster], query[None], weight)[:, 0]
            best = np.argsort(summed, kind="stable")[:_NUM_OF_CLUSTER]
            numbers.append(self.clusters.members[cluster][best])
            sums.append(summed[best])
        number, total = np.concatenate(numbers), np.concatenate(sums)
        order = np.lexsort((number, total))
        return number[order], total[order]


def _summed_distances(images: Floats32, others: Floats32, weight: Floats32 | None = None) -> Array:
    """Return eq. 1 between images (n, J, 2) and others (m, J, 2), joints weighted (J,), as (n, m)."""
    out = np.zeros((len(images), len(others)))
    _add_distances(images, others, np.ones(images.shape[1], dtype=np.float32) if weight is None else weight, out)
    return out


@compiled()
def _add_distances(images: Floats32, others: Floats32, weight: Floats32, out: Array) -> None:
    for image in range(images.shape[0]):
        for other in range(others.shape[0]):
            total = np.float32(0.0)
            for joint in range(images.shape[1]):
                dx = images[image, joint, 0] - others[other, joint, 0]
                dy = images[image, joint, 1] - others[other, joint, 1]
                total += weight[joint] * np.sqrt(dx * dx + dy * dy)
            out[image, other] = total
