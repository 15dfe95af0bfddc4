"""Test that empty arrays of pairs, frames or images give empty results, without a warning or an error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pasdedeux.arrays import merge_axes
from pasdedeux.augmentation.source import points_of
from pasdedeux.cameras.frames import pair_frame, project_pair
from pasdedeux.completion.errors import lifted_errors
from pasdedeux.completion.retrieval import nearest_images
from pasdedeux.interaction.nearest import cartesian_distances, image_distances, interaction_distances, pair_table
from pasdedeux.interaction.shape_context import plane_shape_dissimilarity, shape_bins
from pasdedeux.interaction.surfaces import closest_joint_distance, surface_gaps
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility.joint_limits import angles_and_slack
from pasdedeux.skeletons import PAIR17

NONE, PAIR = np.zeros((0, 2, 17, 3)), np.random.default_rng(0).normal(0.0, 0.4, (1, 2, 17, 3))
UP = np.array([0.0, 1.0, 0.0])
OF_NOTHING: dict[str, tuple[Callable[[], Any], tuple[int, ...]]] = {
    "points_of": (lambda: points_of(NONE), (0, 34, 3)),
    "pair_frame": (lambda: pair_frame(NONE).axes, (0, 3, 3)),
    "project_pair": (lambda: project_pair(NONE, UP), (0, 2, 17, 2)),
    "project_pair into no view": (lambda: project_pair(PAIR[0], np.zeros((0, 3))), (0, 2, 17, 2)),
    "shape_bins": (lambda: shape_bins(NONE), (0, 34, 33)),
    "plane_shape_dissimilarity": (lambda: plane_shape_dissimilarity(NONE[:, 0, :, :2], NONE[:, 1, :, :2]), (0,)),
    "pair_table": (lambda: pair_table(NONE).points, (0, 34, 3)),
    "interaction_distances": (lambda: interaction_distances(NONE, PAIR), (0, 1)),
    "cartesian_distances": (lambda: cartesian_distances(PAIR, NONE), (1, 0)),
    "image_distances": (lambda: image_distances(NONE[..., :2], PAIR[..., :2]), (0, 1)),
    "nearest_images": (lambda: nearest_images(PAIR[0], NONE[..., :2], np.zeros((0, 3)), count=3)[1], (0,)),
    "lifted_errors": (lambda: next(iter(lifted_errors(NONE, NONE).values())), (0,)),
    "closest_joint_distance": (lambda: closest_joint_distance(NONE), (0,)),
    "surface_gaps": (lambda: surface_gaps(NONE, np.full((2, 17), 0.05), PAIR17).closest_m, (0,)),
    "bone_lengths": (lambda: bone_lengths(PAIR17, NONE), (0, 2, 17)),
    "angles_and_slack": (lambda: angles_and_slack(NONE)[0], (0, 2, angles_and_slack(PAIR)[0].shape[-1])),
}


@pytest.mark.parametrize("name", OF_NOTHING)
def test_empty_arrays_give_empty_results(name: str) -> None:
    call, shape = OF_NOTHING[name]
    assert np.shape(call()) == shape


@pytest.mark.parametrize(
    ("start", "stop", "shape"),
    [(1, None, (0, 102)), (1, -1, (0, 34, 3)), (-3, -1, (0, 34, 3)), (0, 2, (0, 17, 3)), (2, 3, (0, 2, 17, 3))],
)
def test_axes_are_merged_in_order_whether_or_not_one_is_empty(
    start: int, stop: int | None, shape: tuple[int, ...]
) -> None:
    assert merge_axes(NONE, start, stop).shape == shape
    full = np.arange(4 * 102).reshape(4, 2, 17, 3)
    merged = merge_axes(full, start, stop)
    assert merged.ndim == len(shape)
    np.testing.assert_array_equal(merged.ravel(), full.ravel())
