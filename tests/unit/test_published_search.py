"""The published search: clusters partition the database, and it finds part of what the exact search finds."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.experiments.published_search import (
    BOX_HEIGHT_M,
    Codebook,
    PublishedSettings,
    bounding_box_height,
    build_codebook,
    scale_to_box,
    search_published,
)
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import centre_and_face
from pasdedeux.projections.search import Neighbours, recall
from tests.builders.walkers import walk


def look_at_scaled(database: Database, query: np.ndarray) -> Neighbours:
    """The plain form: every projection, by the metric of the published search."""
    projections = scale_to_box(database.project().reshape(-1, 14, 2))
    distance = np.linalg.norm(scale_to_box(query.astype(np.float32))[:, None] - projections, axis=-1).mean(axis=-1)
    order = np.argsort(distance, axis=-1, kind="stable")[:, :50]
    return Neighbours(order, np.take_along_axis(distance, order, axis=-1), database.num_yaws)


SETTINGS = PublishedSettings(num_clusters=40, num_landmarks=100)


@pytest.fixture(scope="module")
def database() -> Database:
    motions = [walk(60, seed=seed) for seed in range(3)]
    poses = np.concatenate([centre_and_face(motion).poses_m for motion in motions]).astype(np.float32)
    return Database(poses, np.tile(np.arange(60) == 0, 3))


@pytest.fixture(scope="module")
def codebook(database: Database) -> Codebook:
    return build_codebook(database, np.random.default_rng(0), SETTINGS)


def test_every_projection_is_in_one_cluster_and_its_representative_is_a_member(
    database: Database, codebook: Codebook
) -> None:
    together = np.concatenate(codebook.members)
    assert sorted(together.tolist()) == list(range(database.num_projections))
    projections = scale_to_box(database.project().reshape(-1, 14, 2))
    np.testing.assert_allclose(bounding_box_height(codebook.representatives_m), BOX_HEIGHT_M, rtol=1e-6)
    for representative, members in zip(codebook.representatives_m, codebook.members, strict=True):
        assert np.abs(projections[members] - representative).max(axis=(1, 2)).min() < 1e-5


def test_the_same_seed_gives_the_same_clusters(database: Database, codebook: Codebook) -> None:
    again = build_codebook(database, np.random.default_rng(0), SETTINGS)
    assert all(np.array_equal(one, other) for one, other in zip(again.members, codebook.members, strict=True))


def test_it_finds_most_of_the_best_and_never_beats_the_exact_search(database: Database, codebook: Codebook) -> None:
    query = walk(40, seed=11)[..., :2]
    query = query - 0.5 * (query[:, [8]] + query[:, [11]])
    query[3] = np.nan
    exact = look_at_scaled(database, query)
    found = search_published(database, codebook, query)
    assert (found.projection[3] == -1).all()
    known = np.arange(40) != 3
    assert (found.distance_m[known, 0] >= exact.distance_m[known, 0] - 1e-6).all()
    assert 0.4 < recall(found, exact) <= 1.0
    assert recall(exact, exact, num_best=50) == 1.0


def test_all_clusters_give_the_exact_best(database: Database, codebook: Codebook) -> None:
    query = walk(10, seed=12)[..., :2]
    query = query - 0.5 * (query[:, [8]] + query[:, [11]])
    found = search_published(database, codebook, query, num_clusters=40)
    np.testing.assert_allclose(found.distance_m[:, 0], look_at_scaled(database, query).distance_m[:, 0], rtol=1e-5)


def test_the_size_of_a_query_does_not_matter_to_boxes_of_one_height(database: Database, codebook: Codebook) -> None:
    query = walk(10, seed=12)[..., :2]
    query = query - 0.5 * (query[:, [8]] + query[:, [11]])
    query[4, 3] = np.nan
    weights = np.ones((10, 14))
    weights[5, 7] = 0.0
    found = search_published(database, codebook, query, weights)
    for factor in (0.1, 7.0):
        again = search_published(database, codebook, factor * query, weights)
        np.testing.assert_allclose(again.distance_m, found.distance_m, rtol=1e-4)
    boxes = bounding_box_height(scale_to_box(query.astype(np.float32)))
    np.testing.assert_allclose(boxes, BOX_HEIGHT_M, rtol=1e-6)


def test_counts_below_one_are_refused() -> None:
    with pytest.raises(ValidationError, match="num_clusters"):
        PublishedSettings(num_clusters=0)
