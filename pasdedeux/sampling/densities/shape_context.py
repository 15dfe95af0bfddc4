"""The likelihood by the shape context of the images (Yin et al. 2018, Fig. 9)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.interaction.dissimilarity import plane_residual
from pasdedeux.interaction.shape_context import (
    NUM_PLANE_BINS,
    NUM_SECTORS,
    plane_bins,
    plane_polar,
    plane_shape_dissimilarity,
    shared_gains,
)
from pasdedeux.sampling.annotations import GatheredPairs
from pasdedeux.sampling.densities.aligned import AlignedLikelihood, align_lanes
from pasdedeux.sampling.densities.annotated import AnnotationSettings
from pasdedeux.sampling.densities.density import Density

NUM_RANKED = 32
"""Number of candidates of a view, those with the least rigid residual, that are compared: shape contexts are
expensive."""


class ShapeContextLikelihood(AlignedLikelihood):
    """The mean chi-squared cost of the joints' shape contexts, from 0 to 1."""

    def __init__(self, settings: AnnotationSettings, rng: np.random.Generator, annotated: GatheredPairs) -> None:
        super().__init__(settings, rng, annotated)
        num_points = self._points.shape[1]
        self._squares = (self._lanes**2).sum(axis=(1, 2))
        self._histograms = np.zeros((*self._points.shape[:2], NUM_PLANE_BINS), dtype=np.uint8)
        self._gains = shared_gains(num_points - 1)
        for histogram, points in zip(self._histograms, self._points, strict=True):
            np.add.at(histogram, (np.arange(num_points)[:, None], plane_bins(points)), 1)

    def dissimilarity(self, image_m: Array, annotations_m: Array) -> Array:
        """Return the shape-context cost of an image (n, 2) and the most similar annotations of (k, n, 2), (k,)."""
        cost = np.full(len(annotations_m), np.inf)
        ranked = np.argsort(plane_residual(image_m, annotations_m), kind="stable")[:NUM_RANKED]
        cost[ranked] = plane_shape_dissimilarity(image_m, annotations_m[ranked])
        return cost

    def _search(self, images_m: Array, limit: float, margin: float) -> tuple[Array, npt.NDArray[np.int64]]:
        best, slot = np.full(len(images_m), np.inf), np.full(len(images_m), -1, dtype=np.int64)
        shells, turns = plane_polar(np.moveaxis(images_m, 1, 2))
        bank = (self._counts, self._slots, self._lanes, self._squares, self._histograms)
        lower_shape(images_m, shells, turns, *bank, self._gains, NUM_RANKED, limit, margin, best, slot)
        return best, slot


SHAPE_CONTEXT = Density("shape_context", "shape context of the images", ShapeContextLikelihood, reads_annotations=True)
"""A density for comparison with the published one: by a descriptor of shape."""


@compiled()
def lower_shape(  # type: ignore[no-untyped-def]
    images, shells, turns, counts, slots, lanes, squares, histograms, gains, num_ranked, limit, margin, best, best_slot
):
    """Write the least shape-context cost of each view that can matter, and the slot that has it.

    Args:
        images: Centred images (m, 2, n), metres.
        shells: First bin of the shell of every other joint, seen from each, (m, n, n - 1).
        turns: Its angle, in turns, (m, n, n - 1).
        counts: Candidates of each view, (m,).
        slots: Annotation of each candidate, (m, most).
        lanes: Centred candidates (m, n, 2, most), metres.
        squares: Sums of their squares, (m, most), square metres.
        histograms: Joints in each bin of the annotations, (annotation, n, bin), uint8.
        gains: Reduction of the cost by one more joint in a bin, (n, n): see `shared_gains`.
        num_ranked: Candidates of a view that are compared, those with the least rigid residual.
        limit: Cost above which nothing matters unless a smaller one is found.
        margin: How far behind the best view another still matters.
        best: Least costs (m,), inf before; changed in place.
        best_slot: Annotations that have them, (m,); changed in place.
    """
    num_views, num_points, most = images.shape[0], images.shape[2], slots.shape[1]
    cosine, sine, residual = np.empty((num_views, most)), np.empty((num_views, most)), np.empty(most)
    ranked = np.empty((num_views, most), dtype=np.int64)
    for view in range(num_views):
        count = counts[view]
        align_lanes(images[view, 0], images[view, 1], lanes[view], count, cosine[view], sine[view])
        residual[:count] = squares[view, :count]
        for k in range(num_points):
            x, y, px, py = images[view, 0, k], images[view, 1, k], lanes[view, k, 0], lanes[view, k, 1]
            for c in range(count):
                # The residual after the turn, without the image's own square.
                along, across = x * px[c] + y * py[c], x * py[c] - y * px[c]
                residual[c] -= 2.0 * (cosine[view, c] * along + sine[view, c] * across)
        ranked[view, :count] = np.argsort(residual[:count], kind="mergesort")
    in_bin = np.zeros(histograms.shape[2], dtype=np.int64)
    overall = limit
    # The first of every view, then the second of every view: good candidates come early and exclude others.
    for rank in range(min(num_ranked, most)):
        for view in range(num_views):
            if rank >= counts[view]:
                continue
            candidate = ranked[view, rank]
            slot = slots[view, candidate]
            turn = np.arctan2(sine[view, candidate], cosine[view, candidate]) / (2.0 * np.pi)
            bound = num_points * min(best[view], overall + margin)
            cost = 0.0
            for i in range(num_points):
                cost += 1.0
                in_bin[:] = 0
                for j in range(num_points - 1):
                    angle = turns[view, i, j] + turn
                    angle += np.float64(angle < 0.0) - np.float64(angle >= 1.0)
                    at = shells[view, i, j] + min(int(angle * NUM_SECTORS), NUM_SECTORS - 1)
                    cost -= gains[in_bin[at], histograms[slot, i, at]]
                    in_bin[at] += 1
                if cost > bound:
                    break
            if cost <= bound:
                best[view], best_slot[view] = cost / num_points, slot
            overall = min(overall, best[view])
