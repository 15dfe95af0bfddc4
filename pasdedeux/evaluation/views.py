"""Accuracy of estimated views against the true cameras of virtual video, also under more noise and occlusion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import (
    TorsoBasis,
    ViewOptions,
    angle_between_directions,
    annotate,
    estimate_views,
    view_accuracy,
)
from pasdedeux.evaluation.scores import Score, summarise
from pasdedeux.kinematics.rotations import normalise

__all__ = ["CONDITIONS", "view_robustness", "view_scores"]

Array = npt.NDArray[np.float64]

CONDITIONS = ((0.0, 0.0), (3.5, 0.0), (7.0, 0.0), (0.0, 0.2), (3.5, 0.2))
"""Noise in pixels of a person 600 px tall (3.5 is 1 cm of a person 1.7 m tall), and share of joints hidden."""


def view_scores(estimated: Array, weight: Array, truth: Array, *, split: str) -> list[Score]:
    """Score view hypotheses by their angle to the truth, beside the mean view of all annotations.

    Args:
        estimated: Views (annotation, hypothesis, 3), coordinates in the pair's local frame; NaN where there is none.
        weight: Their weights (annotation, hypothesis); 0 where there is none.
        truth: True views (annotation, 3).
        split: Part of the data.
    """
    is_there = np.isfinite(estimated).all(axis=-1) & (weight > 0)
    angle = np.where(is_there, angle_between_directions(estimated, truth[:, None, :]), np.inf)
    best = np.argmax(weight, axis=1)
    heaviest = np.take_along_axis(angle, best[:, None], axis=1)[:, 0]
    chosen = np.take_along_axis(estimated, best[:, None, None], axis=1)[:, 0]
    is_known = np.isfinite(heaviest)
    mean_view = normalise(chosen[is_known].mean(axis=0)) if is_known.any() else np.full(3, np.nan)
    methods = {
        "heaviest_hypothesis": (heaviest, False),
        "best_hypothesis": (angle.min(axis=1), False),
        "mean_view": (angle_between_directions(np.broadcast_to(mean_view, truth.shape), truth), True),
    }
    scores = []
    for method, (values, is_baseline) in methods.items():
        scores += summarise(
            np.rad2deg(values[is_known]),
            metric="view_error",
            method=method,
            unit="degrees",
            is_baseline=is_baseline,
            split=split,
        )
    return scores


def view_robustness(
    generator: np.random.Generator,
    exact_px: Array,
    truth: Array,
    camera_index: npt.NDArray[np.int64],
    basis: TorsoBasis,
    options: ViewOptions,
) -> list[Score]:
    """Score the likeliest hypothesis and the best one where annotations are made noisier and joints are hidden.

    Args:
        generator: Makes noise and occlusion.
        exact_px: Exact images of pairs (n, person=2, joint=17, 2), pixels.
        truth: True views (n, 3).
        camera_index: Camera of each pair, (n,).
        basis: Torso basis of other takes.
        options: How views are estimated.

    Pairs of which too few torso joints are seen have no view and are not in the figures but in their count.
    """
    scores = []
    for noise_px, occlusion in CONDITIONS:
        seen = annotate(generator, exact_px, noise_px=noise_px, occlusion=occlusion)
        estimates = estimate_views(
            seen.px, basis, confidence=seen.confidence, camera_index=camera_index, options=options
        )
        accuracy = view_accuracy(estimates, truth)
        item = f"noise {noise_px:g} px, {occlusion:.0%} hidden"
        for method, radians in (("heaviest_hypothesis", accuracy.best_rad), ("best_hypothesis", accuracy.nearest_rad)):
            scores += summarise(np.rad2deg(radians), metric="view_error", method=method, unit="degrees", item=item)
    return scores
