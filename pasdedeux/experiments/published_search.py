"""The published search: clusters from an embedding and k-means, a query compared with their representatives only.

Yiannakides et al. (2019, sections 4 and 5) scale all projections, and every query, so that their bounding boxes are
equally high, put them into few dimensions by multi-dimensional scaling of eq. 1, cluster them by k-means and keep the
projection nearest to each centroid as its representative; a query takes the 10 best projections, by eq. 1 in the image,
of each of the 5 clusters whose representatives are nearest to it.  It is kept for comparison: the exact search
(`search`) always finds what this one may miss, and a scale over a track does not change with a raised arm as boxes do.

Where we differ: the distances of all pairs (12 hours in the paper) are not needed, because a projection's place follows
from its distances to a few hundred landmarks (landmark MDS, de Silva and Tenenbaum 2004).  Joints not seen are masked,
also in the box; the paper assumes that all are seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.compiled import compiled
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_STATURE_M
from pasdedeux.projections.search import Neighbours, prepare_query
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

__all__ = [
    "BOX_HEIGHT_M",
    "Codebook",
    "PublishedSettings",
    "bounding_box_height",
    "build_codebook",
    "scale_to_box",
    "search_published",
]

BOX_HEIGHT_M = REFERENCE_STATURE_M
"""Height of every image's bounding box; the paper does not say which."""
_MIN_BOX_M = 0.1

Array = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]


class PublishedSettings(Settings):
    """How the clusters are made."""

    num_clusters: int = Field(500, ge=1, description="Clusters; the paper came to 500 (section 6.1)")
    num_dimensions: int = Field(5, ge=1, description="Dimensions of the embedding; the paper found 2 to 5 equally good")
    num_landmarks: int = Field(300, ge=1, description="Projections that all others are placed by")
    num_rounds: int = Field(20, ge=1, description="Rounds of k-means at most")


@dataclass(frozen=True)
class Codebook:
    """Clusters of projections.

    Args:
        representatives_m: The projection nearest to each cluster's centroid (cluster, 14, 2), its box `BOX_HEIGHT_M`
            high.
        members: Projection numbers of each cluster, ascending.
    """

    representatives_m: Floats32
    members: tuple[Integers, ...]


def build_codebook(database: Database, rng: np.random.Generator, settings: PublishedSettings | None = None) -> Codebook:
    """Return the clusters of a database's projections; at most as many as there are projections.

    Args:
        database: Database of n projections.
        rng: Draws the landmarks and the first centroids.
        settings: How.
    """
    settings = settings or PublishedSettings()
    count = database.num_projections
    points = _embed(database, rng, settings)
    num_clusters = min(settings.num_clusters, count)
    label, distance = _cluster(points, rng, num_clusters, settings.num_rounds)
    order = np.lexsort((np.arange(count), label))
    members = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    middles = np.array([one[np.argmin(distance[one])] for one in members])
    return Codebook(scale_to_box(database.projections(middles)), tuple(members))


def bounding_box_height(keypoints: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return the height (*batch,) of the box of the seen joints (*batch, 14, 2), as the paper scales; NaN for none."""
    y = keypoints[..., 1]
    is_seen = np.isfinite(y)
    high = np.max(np.where(is_seen, y, -np.inf), axis=-1)
    low = np.min(np.where(is_seen, y, np.inf), axis=-1)
    return np.where(is_seen.any(axis=-1), high - low, np.nan)


def scale_to_box(projections: Floats32) -> Floats32:
    """Return projections (*batch, 14, 2) with bounding boxes `BOX_HEIGHT_M` high, the origin kept; NaN stays NaN.

    Boxes lower than `_MIN_BOX_M` of a metre are taken to be that high: a line has no size.
    """
    height = np.maximum(bounding_box_height(projections.astype(np.float64)), _MIN_BOX_M)
    return np.asarray(projections * (BOX_HEIGHT_M / height)[..., None, None], dtype=np.float32)


def _cluster(points: Floats32, rng: np.random.Generator, num_clusters: int, num_rounds: int) -> tuple[Integers, Array]:
    """Return the cluster of each point (n, d) by k-means, and its distance to the centroid (n,)."""
    from sklearn.cluster import KMeans  # here: a second that those who do not cluster need not wait for

    first = points[rng.choice(len(points), num_clusters, replace=False)]
    found = KMeans(num_clusters, init=first, n_init=1, max_iter=num_rounds, copy_x=False).fit(points)
    away = points - found.cluster_centers_[found.labels_]
    return found.labels_.astype(np.int64), np.linalg.norm(away, axis=1)


def search_published(
    database: Database,
    codebook: Codebook,
    query_m: npt.ArrayLike,
    weights: npt.ArrayLike | None = None,
    *,
    num_clusters: int = 5,
    num_each: int = 10,
) -> Neighbours:
    """Return the 10 best projections of each of the 5 clusters nearest to each query (frame, 14, 2), best first.

    The metric is eq. 1 over the joints seen, in images whose boxes are `BOX_HEIGHT_M` high.  Frames without any joint
    have no neighbours.
    """
    seen = np.array(query_m, dtype=np.float32)
    if weights is not None:
        seen[np.broadcast_to(np.asarray(weights), seen.shape[:-1]) <= 0] = np.nan
    query, weight = prepare_query(scale_to_box(seen), weights)
    query, weight = query.reshape(-1, OP14.num_joints, 2), weight.reshape(-1, OP14.num_joints)
    count = num_clusters * num_each
    found = np.full((len(query), count), -1, dtype=np.int64)
    distance = np.full((len(query), count), np.inf)
    for frame, (points, joint_weight) in enumerate(zip(query, weight, strict=True)):
        total = float(joint_weight.sum(dtype=np.float64))
        if total <= 0:
            continue
        nearest = np.argsort(_summed(codebook.representatives_m, points, joint_weight), kind="stable")[:num_clusters]
        kept, values = [], []
        for cluster in nearest:
            members = codebook.members[cluster]
            summed = _summed(scale_to_box(database.projections(members)), points, joint_weight)
            best = np.argsort(summed, kind="stable")[:num_each]
            kept.append(members[best])
            values.append(summed[best])
        numbers, sums = np.concatenate(kept), np.concatenate(values)
        order = np.lexsort((numbers, sums))
        found[frame, : len(order)] = numbers[order]
        distance[frame, : len(order)] = sums[order].astype(np.float64) / total
    return Neighbours(found, distance, database.num_yaws)


def _summed(projections: Floats32, query: Floats32, weight: Floats32) -> Floats32:
    """Return the weighted sum of joint distances (n,) of projections (n, 14, 2) to a query (14, 2)."""
    return np.asarray(np.linalg.norm(projections - query, axis=-1) @ weight)


def _parts(database: Database) -> Iterator[Floats32]:
    """Return all projections, boxes equally high, some thousand at a time (n, 14, 2)."""
    step = max(1, 20_000 // database.num_yaws)
    for first in range(0, database.num_rows, step):
        yield scale_to_box(database.project(first, first + step).reshape(-1, OP14.num_joints, 2))


def _embed(database: Database, rng: np.random.Generator, settings: PublishedSettings) -> Floats32:
    """Place all projections (n, d) by their distances to landmarks (landmark MDS)."""
    count = database.num_projections
    chosen = np.sort(rng.choice(count, min(settings.num_landmarks, count), replace=False))
    landmarks = scale_to_box(database.projections(chosen))
    among = _distances_to(landmarks, landmarks).astype(np.float64) ** 2
    mean = among.mean(axis=0)
    centred = -0.5 * (among - mean[:, None] - mean[None] + mean.mean())
    values, vectors = np.linalg.eigh(centred)
    size = min(settings.num_dimensions, int((values > 1e-9 * max(values[-1], 1e-30)).sum()) or 1)
    top = slice(len(values) - size, len(values))
    vectors = vectors[:, top] * np.where(vectors[:, top].sum(axis=0) < 0, -1.0, 1.0)  # a sign for every eigenvector
    lift = (vectors / np.sqrt(np.maximum(values[top], 1e-12))).T
    placed = [
        (-0.5 * (_distances_to(part, landmarks).astype(np.float64) ** 2 - mean) @ lift.T).astype(np.float32)
        for part in _parts(database)
    ]
    return np.concatenate(placed)


@compiled()
def _distances_to(points: Floats32, landmarks: Floats32) -> Floats32:
    """Return eq. 1 between projections (n, 14, 2) and landmarks (m, 14, 2)."""
    out = np.zeros((points.shape[0], landmarks.shape[0]), dtype=np.float32)
    for i in range(points.shape[0]):
        for j in range(landmarks.shape[0]):
            total = np.float32(0.0)
            for joint in range(points.shape[1]):
                dx = points[i, joint, 0] - landmarks[j, joint, 0]
                dy = points[i, joint, 1] - landmarks[j, joint, 1]
                total += np.sqrt(dx * dx + dy * dy)
            out[i, j] = total
    return out
