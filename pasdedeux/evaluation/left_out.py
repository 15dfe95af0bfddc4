"""Annotations that draws were not made from: how near draws come to them in 2D, and a map of annotations.

This needs no truth: where draws reach what people really do, an image that nobody has used has a draw that looks like
it (the goal that Yin et al. 2018 state).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.retrieval import nearest_by_image
from pasdedeux.evaluation.embedding import PairMap
from pasdedeux.evaluation.figures import Curve, CurvePanel, draw_pair, figure_svg, new_figure, panel_figure
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.scores import Score, summarise

_COUNTS = (10, 100, 1_000, 10_000)
_NUM_DRAWN = 14
"""Annotations that are drawn on the map as people."""
_DRAWN_SHARE = 0.13
"""Height of two people on the map, as a share of its width."""


@dataclass(frozen=True)
class LeftOutCurve:
    """Least d_I of each annotation to any of the first draws, (point, annotation), metres, and how many those are."""

    num_draws: npt.NDArray[np.int64]
    nearest_m: Array


def left_out_curve(
    images_m: Sequence[Array], directions: Sequence[Array], pairs_m: npt.NDArray[np.floating]
) -> LeftOutCurve:
    """Return how near draws come to images, as draws grow in number.

    Args:
        images_m: Images (person=2, joint=17, 2), metres; NaN where a joint is not seen.
        directions: View hypotheses of each, (view, 3): the best one counts.
        pairs_m: Draws in the order in which they count, (draw, person=2, joint=17, 3), metres, at least one.
    """
    counts = np.unique([*(count for count in _COUNTS if count < len(pairs_m)), len(pairs_m)])
    nearest = np.empty((len(counts), len(images_m)))
    for point, count in enumerate(counts):
        index = DrawIndex(pairs_m[:count])
        for at, (image, views) in enumerate(zip(images_m, directions, strict=True)):
            nearest[point, at] = nearest_by_image(index, image, views)[1][0]
    # The nearest of few is among many too; that d_I is computed of some only must not hide it.
    return LeftOutCurve(counts, np.minimum.accumulate(nearest, axis=0))


def left_out_scores(curves: Mapping[str, LeftOutCurve], baselines: Sequence[str], *, split: str) -> list[Score]:
    """Return how near draws of each method come to the annotations, of all draws and as they grow in number."""
    scores = []
    for method, curve in curves.items():
        more = {"is_baseline": method in baselines, "split": split}
        scores += summarise(curve.nearest_m[-1], metric="left_out_d_I", method=method, unit="m", **more)
        count = curve.nearest_m.shape[1]
        scores += [
            Score("left_out_d_I", method, float(one.mean()), "m", method in baselines, split, "all", float(at), count)
            for at, one in zip(curve.num_draws, curve.nearest_m, strict=True)
            if len(curve.num_draws) > 1
        ]
    return scores


def left_out_figure(curves: Mapping[str, Mapping[str, LeftOutCurve]], baselines: Sequence[str]) -> bytes:
    """Draw how near draws come as they grow in number, a panel for each part, by method; give SVG bytes.

    What has one point is a level.
    """
    panels = []
    for split, methods in curves.items():
        means = {name: 100.0 * curve.nearest_m.mean(axis=1) for name, curve in methods.items()}
        panels.append(
            CurvePanel(
                [
                    Curve(in_words(name), methods[name].num_draws.astype(np.float64), mean, name in baselines)
                    for name, mean in means.items()
                    if len(mean) > 1
                ],
                f"d_I to the nearest (cm), {split.replace('_', ' ')}",
                {in_words(name): float(mean[0]) for name, mean in means.items() if len(mean) == 1},
            )
        )
    return panel_figure(panels, title="images that draws were not made from", x_label="draws, or real frames")


def annotation_map_figure(images_m: Array, nearest: Mapping[str, Array], left_out_m: Array) -> bytes:
    """Draw a map of annotations (Yin et al. 2018, Fig. 5b) and where draws are on it; give SVG bytes.

    Args:
        images_m: Annotations (n, person=2, joint=17, 2), metres, at least three that differ.
        nearest: Of draws of each density, which annotations are nearest to them: images (m, 2, 17, 2), one for each
            draw.
        left_out_m: Annotations that draws were not made from, (k, 2, 17, 2).

    Raises:
        InputError: There are fewer than three annotations, or all are the same.
    """
    plane = PairMap.of(images_m)
    figure, ((axis,),) = new_figure(6.4, 5.0)
    points = {"linewidths": 0, "rasterized": True}
    axis.scatter(*(100 * plane.places.T), s=7, color="#9aa3b0", label="annotation", **points)
    for number, (method, images) in enumerate(nearest.items()):
        own, count = np.unique(images, axis=0, return_counts=True)
        label = f"nearest to draws: {in_words(method)}"
        size = 12.0 + 150.0 * count / count.sum()
        axis.scatter(*(100 * plane.place(own).T), s=size, alpha=0.6, color=f"C{number + 6}", label=label, **points)
    if len(left_out_m):
        axis.plot(*(100 * plane.place(left_out_m).T), "kx", markersize=4, linestyle="none", label="left out")
    scale = _DRAWN_SHARE * 100 * float(np.ptp(plane.places[:, 0])) / 1.7
    for at in _far_apart(plane.places, _NUM_DRAWN):
        draw_pair(axis, scale * images_m[at], 100 * plane.places[at])
    axis.set_aspect("equal")
    axis.tick_params(labelsize=6)
    width, height = (float(np.ptp(limits)) for limits in (axis.get_xlim(), axis.get_ylim()))
    figure.set_figheight(float(np.clip(0.9 + 5.6 * height / width, 2.4, 7.0)))  # equal axes leave the rest white
    axis.set_xlabel("cm of d_I", fontsize=7)
    axis.legend(fontsize=6)
    return figure_svg(figure, title=f"annotations by how alike they are ({plane.share:.0%} of the spread shown)")


def _far_apart(places: Array, count: int) -> list[int]:
    """Return some places that are far from each other, the farthest from the middle first."""
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    gap = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return chosen
