"""The published search: clusters partition the database, and results are part of those of a full search."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import (
    BOX_HEIGHT_M,
    Clusters,
    PublishedIndex,
    cluster_places,
    cluster_projections,
    place_projections,
    scale_to_box,
)
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.reconstruction.matching import Method, Searcher
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14
from tests.builders.walkers import database_of, walk

NUM_CLUSTERS = 40


@pytest.fixture(scope="module")
def database() -> Database:
    return database_of([walk(60, seed=seed) for seed in range(3)])


@pytest.fixture(scope="module")
def clusters(database: Database) -> Clusters:
    return cluster_projections(database, NUM_CLUSTERS, np.random.default_rng(0))


def queries(num_frames: int, *, seed: int) -> np.ndarray:
    image = walk(num_frames, seed=seed)[..., :2]
    return np.asarray(image - mid_hip(image)[:, None])


def distances_to_all(database: Database, query: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The plain form: eq. 1 per joint between boxes of one height, to every projection (frame, n)."""
    images = database.project().reshape(-1, 14, 2).astype(np.float64)
    images *= (BOX_HEIGHT_M / np.ptp(images[..., 1], axis=-1))[:, None, None]
    out = []
    for points, weight in zip(query, weights, strict=True):
        seen = (weight > 0) & np.isfinite(points).all(axis=-1)
        scaled = points[seen] * (BOX_HEIGHT_M / np.ptp(points[seen, 1]))
        out.append(np.linalg.norm(images[:, seen] - scaled, axis=-1) @ weight[seen] / weight[seen].sum())
    return np.array(out)


def test_clusters_partition_projections_and_contain_their_representative(
    database: Database, clusters: Clusters
) -> None:
    assert sorted(np.concatenate(clusters.members).tolist()) == list(range(database.num_projections))
    assert 0.9 * NUM_CLUSTERS <= len(clusters.members) <= NUM_CLUSTERS
    assert all(row in rows for row, rows in zip(clusters.representative, clusters.members, strict=True))
    again = cluster_projections(database, NUM_CLUSTERS, np.random.default_rng(0))
    assert np.array_equal(again.representative, clusters.representative)
    assert all(map(np.array_equal, again.members, clusters.members))


def test_places_keep_the_distances_of_points_on_a_line() -> None:
    x = np.random.default_rng(0).uniform(-1.0, 1.0, 400).astype(np.float32)
    images = np.stack([np.repeat(x[:, None], 14, axis=1), np.zeros((400, 14), dtype=np.float32)], axis=-1)
    places = place_projections(images, np.random.default_rng(1))
    found = np.linalg.norm(places[:, None] - places, axis=-1)
    np.testing.assert_allclose(found, 14.0 * np.abs(x[:, None] - x), atol=1e-3)


def test_equal_projections_and_more_clusters_than_projections_leave_no_empty_cluster() -> None:
    places = np.repeat(np.random.default_rng(0).normal(size=(3, 4)), 20, axis=0)
    found = cluster_places(places, 100, np.random.default_rng(0))
    assert sorted(np.concatenate(found.members).tolist()) == list(range(60))
    assert all(len(members) for members in found.members)


def test_the_search_gives_the_ten_best_of_each_of_five_clusters(database: Database, clusters: Clusters) -> None:
    query, weights = queries(40, seed=11), np.ones((40, 14))
    query[4, 3] = np.nan
    weights[5, 7], weights[6] = 0.0, np.linspace(0.2, 1.0, 14)
    true = distances_to_all(database, query, weights)
    query[3] = np.nan
    found = PublishedIndex(database, clusters).search(query, weights)
    assert (found.projection[3] == -1).all()
    label = np.empty(database.num_projections, dtype=int)
    for number, own in enumerate(clusters.members):
        label[own] = number
    for frame in np.flatnonzero(np.arange(40) != 3):
        own = found.projection[frame][found.projection[frame] >= 0]
        np.testing.assert_allclose(found.distance_m[frame, : len(own)], true[frame, own], rtol=1e-4)
        assert (np.diff(found.distance_m[frame, : len(own)]) >= 0).all()
        nearest = np.argsort(true[frame, clusters.representative])[:5]
        assert set(label[own]) == set(nearest)
        for cluster in nearest:
            members = clusters.members[cluster]
            best = np.sort(true[frame, members])[:10]
            np.testing.assert_allclose(np.sort(true[frame, own[label[own] == cluster]]), best, rtol=1e-4)
    known = np.arange(40) != 3
    is_best = found.distance_m[known, 0] <= true[known].min(axis=1) + 1e-5
    assert 0.3 < is_best.mean() <= 1.0


def test_the_size_of_a_query_does_not_matter(database: Database, clusters: Clusters) -> None:
    query, index = queries(10, seed=12), PublishedIndex(database, clusters)
    found = index.search(query)
    for factor in (0.1, 7.0):
        np.testing.assert_allclose(index.search(factor * query).distance_m, found.distance_m, rtol=1e-4)
    line = np.zeros((1, 14, 2), dtype=np.float32)
    line[..., 0] = np.arange(14)
    assert np.isfinite(scale_to_box(line)).all()


def test_clusters_of_another_database_and_none_are_refused(database: Database, clusters: Clusters) -> None:
    smaller = Database(database.poses_m[:50], database.is_sequence_start[:50])
    with pytest.raises(InputError, match=r"clusters hold 5400 projections and are of another database .* of 1500"):
        Searcher.of(smaller, clusters)
    searcher = Searcher.of(database)
    assert Method.PUBLISHED not in searcher.methods
    with pytest.raises(InputError, match=r"has no clusters; .* set num_clusters \(500 in the paper\)"):
        reconstruct_track(searcher, track_of(walk(30, seed=11)), Method.PUBLISHED)


def track_of(world: np.ndarray) -> Track:
    px = 1000.0 * world[..., :2] * [1.0, -1.0]
    return Track(px, np.ones(px.shape[:2]), 24.0, Lens(1e9, (0.0, 0.0)))


def test_the_method_reconstructs_a_new_walk_on_the_databases_own_body(database: Database, clusters: Clusters) -> None:
    searcher, world = Searcher.of(database, clusters), 0.9 * walk(60, seed=11)
    assert searcher.pitched(0.2).methods == searcher.methods == tuple(Method)
    track = reconstruct_track(searcher, track_of(world), Method.PUBLISHED)
    lengths = bone_lengths(OP14, track.positions_m)
    np.testing.assert_allclose(lengths, np.broadcast_to(REFERENCE_LENGTHS_M, lengths.shape), atol=1e-6)
    centred = track.positions_m - mid_hip(track.positions_m)[:, None]
    truth = (world - mid_hip(world)[:, None]) / 0.9
    still = np.linalg.norm(truth - truth.mean(axis=0), axis=-1).mean()
    assert np.linalg.norm(centred - truth, axis=-1).mean() < 0.8 * still
