"""Search whole pairs: the tree finds what brute force finds, with people in either order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.projections import search_brute_force
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.pairs import centre_pairs, pair_database, search_pairs
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.search import build_index
from tests.builders.walkers import CAMERAS, walk


def make_pairs(num_frames: int, *, seed: int = 0) -> np.ndarray:
    worlds = [walk(num_frames, seed=seed + person) + np.array([0.7 * person, 0.0, 0.2 * person]) for person in (0, 1)]
    return centre_pairs(np.stack(worlds, axis=1))


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 1000),
    camera=st.sampled_from(CAMERAS),
    num_yaws=st.sampled_from([1, 12]),
    num_neighbours=st.sampled_from([1, 20, 300]),
    missing=st.floats(0, 1),
)
def test_the_nearest_pairs_are_the_best_of_both_orders_by_brute_force(
    seed: int, camera: DatabaseCamera, num_yaws: int, num_neighbours: int, missing: float
) -> None:
    pairs = np.concatenate([make_pairs(12, seed=seed)] * 2)
    database = pair_database(pairs, num_yaws=num_yaws, camera=camera)
    rng = np.random.default_rng(seed)
    query = database.project()[rng.integers(0, 24, 4), 0].reshape(4, 2, 14, 2) + rng.normal(0, 0.03, (4, 2, 14, 2))
    query[rng.uniform(size=(4, 2, 14)) < missing] = np.nan
    weights = rng.uniform(0, 1, (4, 2, 14))
    found, exchanged = search_pairs(build_index(database), query, weights, num_neighbours=num_neighbours)
    both = [
        search_brute_force(database, image.reshape(4, 28, 2), weight.reshape(4, 28), num_neighbours=num_neighbours)
        for image, weight in ((query, weights), (query[:, ::-1], weights[:, ::-1]))
    ]
    for at in range(4):
        matches = [
            (distance, is_exchanged, projection)
            for is_exchanged, neighbours in enumerate(both)
            for distance, projection in zip(neighbours.distance_m[at], neighbours.projection[at], strict=True)
            if projection >= 0
        ]
        distance, is_exchanged, projection = np.array(sorted(matches)[:num_neighbours]).reshape(-1, 3).T
        count = len(projection)
        np.testing.assert_array_equal(found.distance_m[at, :count], distance)
        np.testing.assert_array_equal(exchanged[at, :count], is_exchanged)
        np.testing.assert_array_equal(found.projection[at, :count], projection)
        np.testing.assert_array_equal(found.row[at, :count], projection // num_yaws)
        np.testing.assert_array_equal(found.yaw_index[at, :count], projection % num_yaws)
        assert (found.projection[at, count:] == -1).all()
        assert not exchanged[at, count:].any()
    single, _ = search_pairs(build_index(database), query[1], weights[1], num_neighbours=num_neighbours)
    np.testing.assert_array_equal(single.projection, found.projection[1])


def test_people_in_either_order_find_the_same_pair_which_fills_in_one_who_is_hidden() -> None:
    database = pair_database(make_pairs(40), camera=DatabaseCamera())
    image = database.project()[17, 9].reshape(2, 14, 2)
    hidden = image.copy()
    hidden[1] = np.nan
    for query, is_exchanged in ((image, False), (image[::-1], True), (hidden, False)):
        found, exchanged = search_pairs(build_index(database), query, np.ones((2, 14)), num_neighbours=1)
        assert (found.row[0], found.yaw_index[0]) == (17, 9)
        assert found.distance_m[0] == 0.0
        assert exchanged[0] == is_exchanged


def test_pairs_do_not_depend_on_where_they_stood_and_lie_along_x() -> None:
    worlds = np.stack([walk(9, seed=person) + np.array([0.5 * person, 0.0, 0.4]) for person in (0, 1)], axis=1)
    pairs = centre_pairs(worlds)
    moved = worlds @ yaw_rotmat(2.1).T + np.array([3.0, 0.5, -2.0])
    np.testing.assert_allclose(centre_pairs(moved), pairs, atol=1e-9)
    hips = mid_hip(pairs)
    np.testing.assert_allclose(hips.mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(hips[..., 2], 0.0, atol=1e-12)
    assert (hips[:, 1, 0] > 0).all()


def test_pairs_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="expected"):
        centre_pairs(np.zeros((3, 14, 3)))
    with pytest.raises(InputError, match="at least one pose"):
        pair_database(np.zeros((0, 2, 14, 3)), camera=CAMERAS[0])
    with pytest.raises(InputError, match="row 1: a value is not finite"):
        pair_database(np.array([np.zeros((2, 14, 3)), np.full((2, 14, 3), np.nan)]), camera=CAMERAS[0])
    with pytest.raises(InputError, match="pair query"):
        search_pairs(build_index(pair_database(make_pairs(2), camera=CAMERAS[0])), np.zeros((14, 2)), np.ones(14))
