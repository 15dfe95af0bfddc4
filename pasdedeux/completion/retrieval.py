"""Lifting by sampling: the draws that look most like an annotation, as 3D pairs in the camera's axes.

Yin et al. 2018, Fig. 2.  The paper shows the nearest draw alone.  Several near draws say where they agree on depth, and
several hypotheses of the view compete: a view is known to some 10 degrees, which is more depth than a pose leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.completion.draw_index import DrawIndex, Nearest
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import plane_residual

__all__ = ["Retrieval", "image_residual", "retrieve"]

Array = npt.NDArray[np.float64]

NEIGHBOUR_DEVIATION_M = 0.03
"""Width of the weights of near draws, by how much farther they are than the nearest, metres."""


@dataclass(frozen=True)
class Retrieval:
    """Draws that look like an annotation, nearest first, where the annotation saw them.

    Args:
        pairs_m: The draws (k, person=2, joint=17, 3), metres, camera axes (x right, y up, z towards the camera); over
            the joints seen they share the image's centroid, and depth 0 there.
        weight: How much each says, (k,); they sum to 1.
        nearest: Which draws they are, under which view, and how far.
    """

    pairs_m: Array
    weight: Array
    nearest: Nearest

    @property
    def mean_m(self) -> Array:
        """The weighted mean of the pairs, (2, 17, 3), metres; its bones are a little short."""
        return np.tensordot(self.weight, self.pairs_m, axes=1)


def retrieve(
    index: DrawIndex,
    image_m: Array,
    directions: Array,
    *,
    count: int = 8,
    deviation_m: float = NEIGHBOUR_DEVIATION_M,
) -> Retrieval:
    """Return the draws nearest to an image, moved to where it saw them.

    Args:
        index: Draws.
        image_m: Image points (person=2, joint=17, 2), metres, x right, y up; NaN where not seen.
        directions: Hypotheses of the view in the pair's local frame, (view, 3).
        count: Draws wanted.
        deviation_m: Width of their weights: exp(-(d^2 - d_nearest^2) / (2 deviation^2)).

    Raises:
        InputError: No view, fewer than 4 joints seen, or a width that is not positive.
    """
    if not deviation_m > 0.0:
        raise InputError(f"the width of the weights of near draws is {deviation_m} m, it must be positive")
    nearest = index.nearest(image_m, directions, count=count)
    squared = nearest.distance_m**2
    weight = np.exp(-0.5 * (squared - squared[0]) / deviation_m**2)
    pairs = index.placed(nearest.draw, np.asarray(directions)[nearest.view], image_m)
    return Retrieval(pairs_m=pairs, weight=weight / weight.sum(), nearest=nearest)


def image_residual(pair_m: Array, image_m: Array) -> float:
    """Return how far a pair (person=2, joint=17, 3), camera axes, is from an image (2, 17, 2) where joints are seen.

    Root mean square distance in the image plane, metres, after the best turn and shift in it; NaN where nothing is
    seen.
    """
    is_seen = np.isfinite(image_m).all(axis=-1)
    if not is_seen.any():
        return float("nan")
    return float(np.sqrt(plane_residual(pair_m[is_seen][:, :2], image_m[is_seen]) / is_seen.sum()))
