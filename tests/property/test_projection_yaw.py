"""Refine yaw between its steps: never further from the query, and right where it is known."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.search import Neighbours, build_index
from pasdedeux.reconstruction.yaw import refine_yaws
from tests.builders.walkers import CAMERAS, walk_database


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), camera=st.sampled_from(CAMERAS), noise_m=st.floats(0, 0.3), missing=st.floats(0, 0.9))
def test_refined_candidates_are_never_further_and_their_distance_is_that_of_the_camera(
    seed: int, camera: DatabaseCamera, noise_m: float, missing: float
) -> None:
    database = walk_database(seed, camera)
    rng = np.random.default_rng(seed)
    pose = database.turned(rng.integers(0, 25, 4), rng.uniform(0, 30, 4))
    query = camera.project(pose) + rng.normal(0, noise_m, (4, 14, 2))
    query[rng.uniform(size=(4, 14)) < missing] = np.nan
    weights = rng.uniform(0, 1, (4, 14)) + 1e-3
    found = build_index(database).search(query, weights, num_neighbours=6)
    refined, yaw_steps = refine_yaws(database, found, query, weights)
    is_real = refined.projection >= 0
    np.testing.assert_array_equal(np.sort(refined.projection), np.sort(found.projection))
    assert (np.diff(np.where(is_real, refined.distance_m, 9.0)) >= 0).all()
    before = {(at, p): d for at in range(4) for p, d in zip(found.projection[at], found.distance_m[at], strict=True)}
    limit = np.array([[before[at, p] for p in refined.projection[at]] for at in range(4)])
    assert (refined.distance_m[is_real] <= limit[is_real] * (1.0 + 1e-5) + 1e-6).all()
    assert np.isinf(refined.distance_m[~is_real]).all()
    assert (np.abs(yaw_steps - refined.yaw_index)[is_real] <= 1.3).all()
    image = camera.project(database.turned(np.maximum(refined.row, 0), yaw_steps))
    away = np.linalg.norm(image - query[:, None], axis=-1)
    weight = np.where(np.isfinite(away), weights[:, None], 0.0)
    mean = np.sum(weight * np.nan_to_num(away), axis=-1) / np.maximum(weight.sum(axis=-1), 1e-12)
    np.testing.assert_allclose(refined.distance_m[is_real], mean[is_real], atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), camera=st.sampled_from(CAMERAS), part=st.floats(-0.5, 0.5))
def test_a_yaw_between_the_steps_is_found_again(seed: int, camera: DatabaseCamera, part: float) -> None:
    database = walk_database(seed, camera)
    rng = np.random.default_rng(seed)
    row, step = rng.integers(0, 20, 5), rng.integers(0, 30, 5)
    query = camera.project(database.turned(row, step + part))
    at_step = Neighbours((row * 30 + step)[:, None], np.zeros((5, 1)), 30)
    refined, yaw_steps = refine_yaws(database, at_step, query)
    # Poses are kept in float32 and golden section stops within 0.06 mrad.
    np.testing.assert_allclose(yaw_steps[:, 0], step + part, atol=1e-3)
    assert (refined.distance_m < 1e-4).all()


def test_batched_and_single_queries_agree() -> None:
    database = walk_database(0, DatabaseCamera())
    query = database.project()[:3, 4] + np.random.default_rng(0).normal(0, 0.02, (3, 14, 2))
    found = build_index(database).search(query, num_neighbours=5)
    _, yaw_steps = refine_yaws(database, found, query)
    for at in range(3):
        single = Neighbours(found.projection[at], found.distance_m[at], 30)
        np.testing.assert_array_equal(refine_yaws(database, single, query[at])[1], yaw_steps[at])
