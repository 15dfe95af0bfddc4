"""Random articulated pairs and annotations of them, for benchmarks and tests that need no captured motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.frames import project_pair
from pasdedeux.cameras.view_density import draw_views
from pasdedeux.kinematics.rotations import normalise, yaw_rotmat
from pasdedeux.sampling.annotations import AnnotatedPairs, ViewBank, build_bank
from pasdedeux.sampling.parameters import LENGTH_INDICES, NUM_PARAMETERS, POSITION_INDICES, ROTATION_INDICES, PairChart
from pasdedeux.skeletons import PAIR17

_STANDING = {
    "pelvis": (0.0, 0.95, 0.0),
    "spine": (0.0, 1.10, 0.01),
    "chest": (0.0, 1.30, 0.0),
    "neck": (0.0, 1.48, -0.01),
    "head": (0.0, 1.65, 0.02),
    "left_shoulder": (0.18, 1.42, 0.0),
    "left_elbow": (0.24, 1.15, 0.04),
    "left_wrist": (0.26, 0.97, 0.20),
    "left_hip": (0.10, 0.92, 0.0),
    "left_knee": (0.11, 0.50, 0.03),
    "left_ankle": (0.11, 0.09, -0.02),
}
"""A person standing with bent elbows, facing +Z, 1.75 m tall, the left side; metres, made up."""


def standing_pair(*, distance_m: float = 0.6) -> Array:
    """Return two people (2, 17, 3), metres, who stand `distance_m` apart and face each other along X."""
    person = np.array([_STANDING[name.replace("right_", "left_")] for name in PAIR17.joint_names])
    person[[name.startswith("right_") for name in PAIR17.joint_names], 0] *= -1.0
    first = person @ yaw_rotmat(np.pi / 2).T
    second = person @ yaw_rotmat(-np.pi / 2).T
    aside = np.array([distance_m / 2, 0.0, 0.0])
    return np.stack([first - aside, second + aside])


def random_pairs(rng: np.random.Generator, num_pairs: int, *, spread_rad: float = 0.3) -> Array:
    """Return articulated variations (pair, 2, 17, 3), metres, of the standing pair, with its bone lengths."""
    return PairChart(standing_pair()).positions(random_parameters(rng, num_pairs, spread_rad=spread_rad))


def random_parameters(rng: np.random.Generator, num_pairs: int, *, spread_rad: float = 0.3) -> Array:
    """Return the parameters (pair, 108) of `random_pairs`, around the standing pair."""
    parameters = np.tile(PairChart(standing_pair()).seed_parameters(), (num_pairs, 1))
    noise = spread_rad * rng.normal(size=(num_pairs, NUM_PARAMETERS))
    noise[:, LENGTH_INDICES.ravel()] = 0.0
    noise[:, POSITION_INDICES.ravel()] *= 0.3
    noise[:, ROTATION_INDICES[:, 0]] *= 0.5
    noise[:, ROTATION_INDICES[:, 2]] *= 0.5
    return parameters + noise


def random_annotations(rng: np.random.Generator, pairs_m: Array, num_annotations: int) -> AnnotatedPairs:
    """Return annotations of randomly chosen pairs (pair, 2, 17, 3) under random views, true views kept."""
    which = rng.integers(len(pairs_m), size=num_annotations)
    directions = normalise(rng.normal(size=(num_annotations, 3)) * [1.0, 0.3, 1.0])
    points = project_pair(pairs_m[which], directions)
    turn = rng.normal(scale=0.1, size=num_annotations)
    c, s = np.cos(turn)[:, None, None], np.sin(turn)[:, None, None]
    turned = np.stack([c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]], axis=-1)
    return AnnotatedPairs(
        points_m=turned, directions=directions, annotation_index=np.arange(num_annotations, dtype=np.int64)
    )


def random_bank(rng: np.random.Generator, annotations: AnnotatedPairs, num_views: int, **options: Any) -> ViewBank:
    """Return the bank of annotations for so many views, drawn near theirs; options are of `build_bank`."""
    views = draw_views(rng, annotations.directions, np.ones(len(annotations.directions)), num_views)
    return build_bank(views, annotations, **options)
