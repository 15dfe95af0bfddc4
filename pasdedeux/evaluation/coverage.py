"""Coverage of real pairs by draws, beside sets of real frames: the curve and the scale "as good as N real frames"."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.evaluation.figures import Curve, CurvePanel, panel_figure
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.scores import Score, scores_of, summarise
from pasdedeux.sampling.coverage import Coverage, CoverageCurve, coverage_curve
from pasdedeux.sampling.densities.density import PRIOR_ONLY

_MAX_DRAWS, _MAX_REAL = 200, 1500
_REAL_COUNTS = (1, 3, 10, 30, 100, 300, 1000)
"""Sizes of the sets of real frames (the counts of the published scale)."""


def curve_points(num_draws: int, num_points: int) -> list[int]:
    """Return the numbers of draws at which coverage is measured: even on a log scale from 1 to all."""
    return sorted({round(float(n)) for n in np.geomspace(1, max(num_draws, 1), num_points)})


def real_frame_levels(truth_m: Array, real_m: Array, generator: np.random.Generator) -> CoverageCurve:
    """Return the coverage of real pairs by growing random sets of other real pairs.

    Args:
        truth_m: Pairs to be covered (truth, 2, joint, 3), metres.
        real_m: Pairs to draw from (frame, 2, joint, 3); none of them may be in `truth_m`.
        generator: Draws the order.
    """
    order = generator.permutation(len(real_m))[: _REAL_COUNTS[-1]]
    counts = [count for count in _REAL_COUNTS if count <= len(order)]
    return coverage_curve(truth_m, real_m[order], counts)


def as_good_as_real_frames(coverage: float, levels: Array, counts: npt.NDArray[np.int64]) -> float:
    """Return N so that N real frames cover as well, by log-linear interpolation.

    Args:
        coverage: C(G, S) of the draws.
        levels: C(G, S) of `counts` real frames, (n,), in the same measure.
        counts: Numbers of real frames, rising, (n,).

    Below the least level 0 is given when even one real frame covers better, and the greatest count when none does.
    """
    if coverage > levels[0]:
        return 0.0
    return float(np.exp(np.interp(-coverage, -np.minimum.accumulate(levels), np.log(counts.astype(np.float64)))))


def coverage_scores(
    curves: Mapping[str, CoverageCurve], levels: CoverageCurve, *, split: str, num_truth: int
) -> list[Score]:
    """Return the curves and their ends as scores; prior-only and the real frames are baselines."""
    scores = []
    for method, curve in {**curves, "real_frames": levels}.items():
        is_baseline = method == "real_frames" or of_prior(method)
        for measure, values, unit in _measures(curve):
            points = [*zip(curve.num_draws.tolist(), values.tolist(), strict=True)]
            points.append((float("nan"), float(values[-1])))
            scores += [
                Score(f"coverage_{measure}", method, value, unit, is_baseline, split, "all", at, num_truth)
                for at, value in points
            ]
        if method != "real_frames":
            worth = {
                f"as_good_as_real_frames_{measure}": as_good_as_real_frames(float(own[-1]), real, levels.num_draws)
                for (measure, own, _), (_, real, _) in zip(_measures(curve), _measures(levels), strict=True)
            }
            scores += scores_of(worth, method, "frames", is_baseline=is_baseline, split=split)
            scores.append(Score("num_draws", method, float(curve.num_draws[-1]), "", is_baseline, split))
    return scores


def _measures(curve: CoverageCurve) -> list[tuple[str, Array, str]]:
    """Return the three measures with their values along the curve and their unit."""
    return [("D_I", curve.interaction_m, "m"), ("D_C", curve.cartesian_m, "m"), ("D_S", curve.shape, "")]


def of_prior(method: str) -> bool:
    """Tell whether draws are a baseline: those of the prior alone, also from the first seed or with grown seeds."""
    return method.startswith(PRIOR_ONLY)


def nearest_by_method(curves: Mapping[str, CoverageCurve], grown: str) -> dict[str, Array]:
    """Return the least D_C of each real pair (truth,), metres, to draws, and to draws and grown seeds together."""
    alone = {method: curve.min_cartesian_m for method, curve in curves.items()}
    others = [name for name in alone if name != grown and grown in alone]
    return alone | {f"{name}_and_{grown}": np.minimum(alone[name], alone[grown]) for name in others}


def union_scores(curves: Mapping[str, CoverageCurve], levels: CoverageCurve, grown: str, *, split: str) -> list[Score]:
    """Return the coverage in D_C of the draws of each method together with the grown seeds they started from."""
    scores = []
    for name, least in nearest_by_method(curves, grown).items():
        if name not in curves:
            worth = as_good_as_real_frames(float(least.mean()), levels.cartesian_m, levels.num_draws)
            for metric, value, unit in (
                ("coverage_D_C", float(least.mean()), "m"),
                ("as_good_as_real_frames_D_C", worth, "frames"),
            ):
                scores.append(Score(metric, name, value, unit, of_prior(name), split, count=len(least)))
    return scores


def realism_scores(
    draws: Mapping[str, npt.NDArray[np.floating]], real_m: Array, generator: np.random.Generator, *, split: str
) -> list[Score]:
    """Return how far draws are from their nearest real pair, in D_C: the other direction of coverage.

    Args:
        draws: Draws (draw, person=2, joint=17, 3), metres, by method; at most 200 of each are looked at.
        real_m: Real pairs (n, 2, 17, 3), metres; at most 1,500 of them are looked at.
        generator: Chooses the real pairs.
        split: Part of the data.
    """
    real = real_m[generator.permutation(len(real_m))[:_MAX_REAL]]
    scores = []
    for method, pairs in draws.items():
        nearest = Coverage(np.asarray(pairs[:_MAX_DRAWS], dtype=np.float64))
        nearest.add(real)
        scores += summarise(
            nearest.cartesian_m,
            metric="draw_to_nearest_real_D_C",
            method=method,
            unit="m",
            is_baseline=method.startswith(PRIOR_ONLY),
            split=split,
        )
    return scores


def coverage_figure(curves: Mapping[str, CoverageCurve], levels: CoverageCurve, *, split: str) -> bytes:
    """Draw coverage in D_I, D_C and D_S against the number of draws (Yin et al. 2018, Fig. 9); SVG bytes.

    Real frames are levels, in D_C and D_S as in D_I.
    """
    by_method = {name: (_measures(curve), curve.num_draws.astype(np.float64)) for name, curve in curves.items()}
    panels = []
    for index, (measure, real, unit) in enumerate(_measures(levels)):
        factor = 100.0 if unit == "m" else 1.0
        panels.append(
            CurvePanel(
                curves=[
                    Curve(
                        in_words(name),
                        counts,
                        factor * measures[index][1],
                        is_baseline=of_prior(name),
                    )
                    for name, (measures, counts) in by_method.items()
                ],
                y_label=f"{measure} to the nearest draw" + (" (cm)" if unit == "m" else ""),
                levels={
                    f"{count} real": factor * value
                    for count, value in zip(levels.num_draws.tolist(), real.tolist(), strict=True)
                },
            )
        )
    return panel_figure(panels, title=f"coverage of {split.replace('_', ' ')} frames", x_label="draws")
