"""Coverage of real pairs by draws, beside sets of real frames: the curve and the scale "as good as N real frames"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.figures import Curve, curve_figure
from pasdedeux.evaluation.scores import Score
from pasdedeux.sampling.coverage import CoverageCurve, coverage_curve

__all__ = [
    "as_good_as_real_frames",
    "coverage_figure",
    "coverage_note",
    "coverage_scores",
    "curve_points",
    "real_frame_levels",
]

Array = npt.NDArray[np.float64]

_REAL_COUNTS = (1, 3, 10, 30, 100, 300, 1000)
"""Sizes of the sets of real frames (the counts of the published scale)."""


def curve_points(num_draws: int, num_points: int) -> list[int]:
    """Give the numbers of draws at which coverage is measured: even on a log scale from 1 to all."""
    return sorted({round(float(n)) for n in np.geomspace(1, max(num_draws, 1), num_points)})


def real_frame_levels(truth_m: Array, real_m: Array, generator: np.random.Generator) -> CoverageCurve:
    """Give the coverage of real pairs by growing random sets of other real pairs.

    Args:
        truth_m: Pairs to be covered (truth, 2, joint, 3), metres.
        real_m: Pairs to draw from (frame, 2, joint, 3); none of them may be in `truth_m`.
        generator: Draws the order.
    """
    order = generator.permutation(len(real_m))[: _REAL_COUNTS[-1]]
    counts = [count for count in _REAL_COUNTS if count <= len(order)]
    return coverage_curve(truth_m, real_m[order], counts)


def as_good_as_real_frames(coverage_m: float, levels: CoverageCurve) -> float:
    """Give N so that N real frames cover as well, by log-linear interpolation in D_C.

    Below the least level 0 is given when even one real frame covers better, and the greatest count when none does.
    """
    values, counts = levels.cartesian_m, levels.num_draws.astype(np.float64)
    if coverage_m > values[0]:
        return 0.0
    return float(np.exp(np.interp(-coverage_m, -values, np.log(counts))))


def coverage_scores(
    curves: Mapping[str, CoverageCurve], levels: CoverageCurve, *, split: str, num_truth: int
) -> list[Score]:
    """Give the curves and their ends as scores; prior-only and the real frames are baselines."""
    scores = []
    for method, curve in {**curves, "real_frames": levels}.items():
        is_baseline = method in ("prior_only", "real_frames", "seeds")
        for measure, values in (("D_I", curve.interaction_m), ("D_C", curve.cartesian_m)):
            points = [*zip(curve.num_draws.tolist(), values.tolist(), strict=True)]
            points.append((float("nan"), float(values[-1])))
            scores += [
                Score("coverage", f"coverage_{measure}", method, value, "m", is_baseline, split, "all", at, num_truth)
                for at, value in points
            ]
        if method != "real_frames":
            worth = as_good_as_real_frames(float(curve.cartesian_m[-1]), levels)
            scores.append(
                Score("coverage", "as_good_as_real_frames", method, worth, "frames", is_baseline, split, "all")
            )
    return scores


def coverage_note(curves: Mapping[str, CoverageCurve], *, split: str) -> str:
    """Say in a sentence whether the annotations helped: densities that use them against prior-only, at all draws."""
    if "prior_only" not in curves or len(curves) < 2:
        return ""
    baseline = float(curves["prior_only"].cartesian_m[-1])
    parts = [
        f"{name} is {'better' if (own := float(curve.cartesian_m[-1])) < baseline else 'not better'} "
        f"({100 * own:.1f} against {100 * baseline:.1f} cm in D_C)"
        for name, curve in curves.items()
        if name not in ("prior_only", "seeds")
    ]
    return f"Coverage of {split.replace('_', ' ')} frames against prior-only: {'; '.join(parts)}."


def coverage_figure(curves: Mapping[str, CoverageCurve], levels: CoverageCurve, *, split: str) -> bytes:
    """Draw coverage in D_C against the number of draws, real frames as levels; PNG bytes."""
    shown: Sequence[Curve] = [
        Curve(
            name,
            curve.num_draws.astype(np.float64),
            100 * curve.cartesian_m,
            is_baseline=name in ("prior_only", "seeds"),
        )
        for name, curve in curves.items()
    ]
    return curve_figure(
        shown,
        title=f"coverage of {split.replace('_', ' ')} frames",
        x_label="draws",
        y_label="mean distance to the nearest draw, D_C (cm)",
        is_log_x=True,
        levels={
            f"{count} real frames": 100 * value
            for count, value in zip(levels.num_draws.tolist(), levels.cartesian_m.tolist(), strict=True)
        },
    )
