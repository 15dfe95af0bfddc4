"""Errors of augmentation models over test variants, as scores and as curves over the scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pasdedeux.evaluation.figures import Curve, curve_figure
from pasdedeux.evaluation.model_metrics import ModelErrors
from pasdedeux.evaluation.scores import Score

__all__ = ["model_figure", "model_scores"]

_METRICS = {"E_r": ("e_r_cm", "cm"), "E_b": ("e_b_mm", "mm"), "JPD": ("jpd_cm", "cm")}


def model_scores(
    errors: Mapping[str, Sequence[ModelErrors]], *, baselines: Sequence[str], split: str, item: str
) -> list[Score]:
    """Return mean E_r, E_b and JPD of each model over the test variants; a JPD that is NaN everywhere is left out."""
    scores = []
    for model, found in errors.items():
        for metric, (name, unit) in _METRICS.items():
            values = np.array([getattr(error, name) for error in found])
            values = values[np.isfinite(values)]
            if len(values):
                scores.append(
                    Score(
                        topic="models",
                        metric=metric,
                        method=model,
                        value=float(values.mean()),
                        unit=unit,
                        is_baseline=model in baselines,
                        split=split,
                        item=item,
                        count=len(values),
                    )
                )
    return scores


def model_figure(
    scales: Sequence[float], errors: Mapping[str, Sequence[ModelErrors]], *, baselines: Sequence[str], split: str
) -> bytes:
    """Draw E_r of each model against the scale of the test variants (mean over takes); PNG bytes."""
    at = np.array(scales)
    known = np.unique(np.round(at[np.isfinite(at)], 6))
    curves = []
    for model, found in errors.items():
        values = np.array([error.e_r_cm for error in found])
        means = np.array([values[np.isclose(at, scale)].mean() for scale in known])
        curves.append(Curve(model, known, means, is_baseline=model in baselines))
    return curve_figure(
        curves,
        title=f"models on {split.replace('_', ' ')} test variants",
        x_label="scale of person A",
        y_label="E_r (cm)",
    )
