"""Accuracy of estimated views against the true cameras of virtual video."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.frames import angle_between_directions
from pasdedeux.evaluation.scores import Score, summarise
from pasdedeux.kinematics.rotations import normalise

VIEW_BASELINES = ("mean_view",)


def view_errors(estimated: Array, weight: Array, truth: Array) -> dict[str, Array]:
    """Return the angle to the truth (annotation,), degrees, by method: NaN of an annotation without a view.

    Args:
        estimated: Views (annotation, hypothesis, 3), coordinates in the pair's local frame; NaN where there is none.
        weight: Their weights (annotation, hypothesis); 0 where there is none.
        truth: True views (annotation, 3).
    """
    is_there = np.isfinite(estimated).all(axis=-1) & (weight > 0)
    angle = np.where(is_there, angle_between_directions(estimated, truth[:, None, :]), np.inf)
    best = np.argmax(weight, axis=1)
    heaviest = np.take_along_axis(angle, best[:, None], axis=1)[:, 0]
    chosen = np.take_along_axis(estimated, best[:, None, None], axis=1)[:, 0]
    is_known = np.isfinite(heaviest)
    mean_view = normalise(chosen[is_known].mean(axis=0)) if is_known.any() else np.full(3, np.nan)
    methods = {
        "heaviest_hypothesis": heaviest,
        "best_hypothesis": angle.min(axis=1),
        "mean_view": angle_between_directions(np.broadcast_to(mean_view, truth.shape), truth),
    }
    return {name: np.where(is_known, np.rad2deg(values), np.nan) for name, values in methods.items()}


def view_scores(estimated: Array, weight: Array, truth: Array, *, split: str) -> list[Score]:
    """Score view hypotheses by their angle to the truth, beside the mean view of all annotations."""
    return [
        score
        for method, values in view_errors(estimated, weight, truth).items()
        for score in summarise(
            values,
            metric="view_error",
            method=method,
            unit="degrees",
            is_baseline=method in VIEW_BASELINES,
            split=split,
        )
    ]
