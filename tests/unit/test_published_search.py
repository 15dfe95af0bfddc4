"""The published search: clusters partition the database, and it finds part of what the exact search finds."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import Codebook, PublishedSettings, build_codebook, recall, search_published
from pasdedeux.projections.retarget import centre_and_face
from pasdedeux.projections.search import search_brute_force
from tests.walkers import walk

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
    projections = database.project().reshape(-1, 14, 2)
    for representative, members in zip(codebook.representatives_m, codebook.members, strict=True):
        assert np.abs(projections[members] - representative).max(axis=(1, 2)).min() < 1e-5


def test_the_same_seed_gives_the_same_clusters(database: Database, codebook: Codebook) -> None:
    again = build_codebook(database, np.random.default_rng(0), SETTINGS)
    assert all(np.array_equal(one, other) for one, other in zip(again.members, codebook.members, strict=True))


def test_it_finds_most_of_the_best_and_never_beats_the_exact_search(database: Database, codebook: Codebook) -> None:
    query = walk(40, seed=11)[..., :2]
    query = query - 0.5 * (query[:, [8]] + query[:, [11]])
    query[3] = np.nan
    exact = search_brute_force(database, query)
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
    np.testing.assert_allclose(found.distance_m[:, 0], search_brute_force(database, query).distance_m[:, 0], rtol=1e-5)


def test_counts_below_one_are_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        PublishedSettings(num_clusters=0)
