"""Compare the search tree with brute force over all projections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.projections import search_brute_force
from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.search import ProjectionIndex, build_index
from tests.builders.walkers import CAMERAS, walk_database


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 1000),
    camera=st.sampled_from(CAMERAS),
    num_yaws=st.sampled_from([1, 7, 30]),
    num_frames=st.integers(2, 40),
    num_neighbours=st.sampled_from([1, 3, 50, 400]),
    missing=st.floats(0, 1),
    is_weighted=st.booleans(),
)
def test_the_tree_equals_brute_force_with_masks_and_weights(
    seed: int,
    camera: DatabaseCamera,
    num_yaws: int,
    num_frames: int,
    num_neighbours: int,
    missing: float,
    is_weighted: bool,
) -> None:
    # The same walk twice: every distance is a tie, which the projection number must break.
    database = walk_database(seed, camera, num_frames=num_frames, num_yaws=num_yaws)
    rng = np.random.default_rng(seed + 1)
    query = database.project()[:, 0][rng.integers(0, database.num_rows, 6)].astype(np.float64)
    query += rng.normal(0, [0.0, 0.02, 0.5], (6, 14, 2, 3)).sum(axis=-1) * rng.integers(0, 2, (6, 1, 1))
    query[rng.uniform(size=(6, 14)) < missing] = np.nan
    weights = rng.uniform(0, 1, (6, 14)) if is_weighted else None
    found = build_index(database).search(query, weights, num_neighbours=num_neighbours)
    expected = search_brute_force(database, query, weights, num_neighbours=num_neighbours)
    np.testing.assert_array_equal(found.projection, expected.projection)
    np.testing.assert_array_equal(found.distance_m, expected.distance_m)


@pytest.fixture(scope="module")
def database() -> Database:
    return walk_database(3, DatabaseCamera(), num_frames=200)


@pytest.fixture(scope="module")
def index(database: Database) -> ProjectionIndex:
    return build_index(database)


def test_batched_and_single_queries_agree(database: Database, index: ProjectionIndex) -> None:
    query = database.project(0, 9)[:, 4].reshape(3, 3, 14, 2) + 0.01
    batched = index.search(query, num_neighbours=20)
    assert batched.projection.shape == (3, 3, 20)
    for at in np.ndindex(3, 3):
        single = index.search(query[at], num_neighbours=20)
        np.testing.assert_array_equal(single.projection, batched.projection[at])
        np.testing.assert_array_equal(single.distance_m, batched.distance_m[at])


def test_a_projection_of_the_database_finds_itself(database: Database, index: ProjectionIndex) -> None:
    image = database.project(17, 18)[0, 11]
    found = index.search(image, num_neighbours=1)
    assert (found.row[0], found.yaw_index[0], found.distance_m[0]) == (17, 11, 0.0)


def test_missing_joints_and_their_weights_do_not_change_the_distance_of_the_seen(index: ProjectionIndex) -> None:
    rng = np.random.default_rng(5)
    query = rng.normal(0, 0.3, (14, 2))
    query[[4, 9]] = np.nan
    masked = index.search(query, num_neighbours=5)
    weights = np.ones(14)
    weights[[4, 9]] = 0.0
    query[[4, 9]] = 7.0
    weighted = index.search(query, weights, num_neighbours=5)
    scaled = index.search(query, weights * 0.25, num_neighbours=5)
    np.testing.assert_array_equal(masked.projection, weighted.projection)
    np.testing.assert_array_equal(masked.distance_m, weighted.distance_m)
    np.testing.assert_allclose(scaled.distance_m, weighted.distance_m, rtol=1e-5)


def test_nothing_seen_finds_nothing(index: ProjectionIndex) -> None:
    found = index.search(np.full((14, 2), np.nan), num_neighbours=3)
    assert (found.projection == -1).all()
    assert np.isinf(found.distance_m).all()
    assert (found.row == -1).all()


def test_queries_of_another_skeleton_and_negative_weights_are_refused(index: ProjectionIndex) -> None:
    with pytest.raises(InputError, match="expected"):
        index.search(np.zeros((17, 2)))
    with pytest.raises(InputError, match="weights"):
        index.search(np.zeros((14, 2)), -np.ones(14))
