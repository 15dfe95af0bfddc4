"""What augmentation brings to recognition and prediction of motion, as tables 4 and 5 of Li et al. (2024)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.scores import Score, bootstrap_interval
from pasdedeux.learning.clips import CLIP_HZ

WITH, WITHOUT = "with_augmentation", "without_augmentation"
STILL, LARGEST = "last_pose_held", "largest_class"
BASELINES = (WITHOUT, STILL, LARGEST)
"""What learning with variants has to beat."""
HORIZONS_S = (0.2, 0.4, 0.6, 0.8, 1.0)


def prediction_scores(jme: Array, ame: Array, method: str, *, split: str, item: str) -> list[Score]:
    """Return JME and AME (n, 10) of clips, cm, at the published horizons, and their means over the whole second."""
    scores = []
    for metric, errors in (("JME", jme), ("AME", ame)):
        more: dict[str, Any] = {"is_baseline": method in BASELINES, "split": split, "item": item, "count": len(errors)}
        scores.append(Score(f"{metric}_mean", method, float(errors.mean()), "cm", **more))
        for horizon in HORIZONS_S:
            at = round(horizon * CLIP_HZ) - 1
            scores.append(Score(metric, method, float(errors[:, at].mean()), "cm", at=horizon, **more))
    return scores


def recognition_table(scores: Sequence[Score]) -> list[TextTable]:
    """Return accuracy with and without augmentation, and the effect over seeds with its interval."""
    rows = []
    for split in sorted({score.split for score in scores}, reverse=True):
        found = _paired([score for score in scores if score.split == split and score.metric == "accuracy"])
        if found:
            with_, without = (np.array(values) for values in zip(*found.values(), strict=True))
            rows.append((split, f"{with_.mean():.2f}", f"{without.mean():.2f}", _effect(with_ - without)))
    headings = ("training / validation / test", "with", "without", "effect (95 % over seeds)")
    caption = "As table 5 of the paper: accuracy of recognition, %, with and without augmentation"
    return [TextTable(caption, headings, tuple(rows))] if rows else []


def prediction_table(scores: Sequence[Score]) -> list[TextTable]:
    """Return JME and AME of every motion and horizon, and the effect of augmentation over seeds.

    Motions of one seed share what was trained, so they are drawn together.
    """
    rows = []
    for metric in ("JME", "AME"):
        mine = [score for score in scores if score.metric == metric]
        motions = sorted({score.item.rpartition(",")[0] for score in mine})
        for motion in motions:
            cells = []
            for horizon in HORIZONS_S:
                here = [s for s in mine if s.item.rpartition(",")[0] == motion and np.isclose(s.at, horizon)]
                means = [_mean([s.value for s in here if s.method == method]) for method in (WITH, WITHOUT, STILL)]
                cells.append(" / ".join(means))
            rows.append((motion, metric, *cells))
        effects = []
        for horizon in HORIZONS_S:
            pairs = _paired([score for score in mine if np.isclose(score.at, horizon)])
            seeds = [item.rpartition(",")[2] for item in pairs]
            effects.append(_effect(np.array([one - other for one, other in pairs.values()]), seeds) if pairs else "")
        if motions:
            rows.append(("effect (95 % over seeds)", metric, *effects))
    headings = ("motion", "error", *(f"{horizon} s" for horizon in HORIZONS_S))
    caption = "As table 4 of the paper: error of prediction, cm, with augmentation / without / last pose held"
    return [TextTable(caption, headings, tuple(rows))] if rows else []


def _paired(scores: Sequence[Score]) -> Mapping[str, tuple[float, float]]:
    """Return the figures with and without augmentation of each item that has both."""
    one, other = ({s.item: s.value for s in scores if s.method == method} for method in (WITH, WITHOUT))
    return {item: (one[item], other[item]) for item in sorted(set(one) & set(other))}


def _effect(differences: Array, units: Sequence[str] | None = None) -> str:
    low, high = bootstrap_interval(differences, units=units)
    interval = f" ({low:+.2f} to {high:+.2f})" if np.isfinite(low) else ""
    return f"{differences.mean():+.2f}{interval}"


def _mean(values: Sequence[float]) -> str:
    return f"{np.mean(values):.2f}" if values else "-"
