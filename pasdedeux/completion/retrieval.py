"""Lifting by sampling: the draws that look most like an annotation, as 3D pairs in the camera's axes.

Yin et al. 2018, Fig. 2.  The paper takes the nearest draw alone.  We average several near draws, because depths on
which they agree are surer, and compare several hypotheses of the view, whose error of some 10 degrees matters more for
depth than the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers, merge_axes
from pasdedeux.cameras.frames import project_pair
from pasdedeux.completion.draw_index import DrawIndex, NearestDraws
from pasdedeux.interaction.dissimilarity import plane_residual
from pasdedeux.interaction.nearest import image_distances

_NUM_NEIGHBOURS = 8
"""Number of near draws that are averaged."""
_NEIGHBOUR_DEVIATION_M = 0.03
"""Width s of the weights exp(-(d^2 - d_nearest^2) / (2 s^2)) of near draws."""
_NUM_RANKED_DRAWS, _NUM_RANKED_IMAGES = 12, 20
"""Numbers of draws and images, nearest by position, that are ranked again by d_I."""


@dataclass(frozen=True)
class Retrieval:
    """Draws that look like an annotation, nearest first, in its camera's axes.

    Args:
        pairs_m: The draws (k, person=2, joint=17, 3), metres, camera axes (x right, y up, z towards the camera); over
            the joints seen they share the image's centroid, and depth 0 there.
        weight: Weight of each, (k,); they sum to 1.
        nearest: Their indices, views and distances.
    """

    pairs_m: Array
    weight: Array
    nearest: NearestDraws

    @property
    def mean_m(self) -> Array:
        """The weighted mean of the pairs, (2, 17, 3), metres; its bones are slightly short."""
        return np.tensordot(self.weight, self.pairs_m, axes=1)


def retrieve(
    index: DrawIndex, image_m: Array, directions: Array, *, without: Sequence[int] | Integers = ()
) -> Retrieval:
    """Return the draws nearest to an image, in its camera's axes.

    Args:
        index: Draws.
        image_m: Image points (person=2, joint=17, 2), metres, x right, y up; NaN where not seen.
        directions: Hypotheses of the view in the pair's local frame, (view, 3).
        without: Draws to exclude, unless there are no others.

    Raises:
        InputError: No view, or fewer than 4 joints seen.
    """
    near = index.nearest(image_m, directions, count=_NUM_NEIGHBOURS + len(without))
    others = np.flatnonzero(~np.isin(near.draw, without))[:_NUM_NEIGHBOURS]
    chosen = others if len(others) else slice(None)
    nearest = NearestDraws(near.draw[chosen], near.view[chosen], near.distance_m[chosen])
    squared = nearest.distance_m**2
    weight = np.exp(-0.5 * (squared - squared[0]) / _NEIGHBOUR_DEVIATION_M**2)
    pairs = index.placed(nearest.draw, np.asarray(directions)[nearest.view], image_m)
    return Retrieval(pairs_m=pairs, weight=weight / weight.sum(), nearest=nearest)


def nearest_by_image(index: DrawIndex, image_m: Array, directions: Array, *, count: int = 1) -> tuple[Array, Array]:
    """Return the draws nearest to an image in d_I, each under its best view, among those nearest by position.

    Args:
        index: Draws.
        image_m: Image points (person=2, joint=17, 2), metres; NaN where not seen.
        directions: Hypotheses of the view in the pair's local frame, (view, 3).
        count: Number of draws.

    Returns:
        The draws (k, 2, 17, 3) in axes of the image's camera, nearest first, and d_I, (k,), metres.
    """
    near = index.nearest(image_m, directions, count=_NUM_RANKED_DRAWS)
    placed = index.placed(near.draw, np.asarray(directions)[near.view], image_m)
    distance = image_distances(image_m[None], placed[..., :2])[0]
    order = np.argsort(distance, kind="stable")[:count]
    return placed[order], distance[order]


def nearest_images(pair_m: Array, images_m: Array, directions: Array, *, count: int) -> tuple[Integers, Array]:
    """Return the images that look most like a pair, each compared under its own view, by d_I.

    Args:
        pair_m: A pair (person=2, joint=17, 3), metres, in any axes.
        images_m: Images (n, 2, 17, 2), metres; NaN where a joint is not seen.
        directions: View of each in the pair's local frame, (n, 3).
        count: Number of images.

    Returns:
        Indices of the images, nearest first, and d_I, (k,), metres.
    """
    seen = project_pair(pair_m, directions)
    flat, images = (merge_axes(points, 1, -1) for points in (seen, images_m))
    residual = plane_residual(flat, images) / np.isfinite(images).all(axis=-1).sum(axis=1)
    ranked = np.argsort(residual, kind="stable")[:_NUM_RANKED_IMAGES]
    distance = np.array([image_distances(seen[at][None], images_m[at][None])[0, 0] for at in ranked])
    order = np.argsort(distance, kind="stable")[:count]
    return ranked[order], distance[order]


def image_residual(pair_m: Array, image_m: Array) -> float:
    """Return the distance of a pair (person=2, joint=17, 3), camera axes, from an image (2, 17, 2) over seen joints.

    It is the root mean square distance in the image plane, metres, after the best turn and shift; NaN if nothing is
    seen.
    """
    is_seen = np.isfinite(image_m).all(axis=-1)
    if not is_seen.any():
        return float("nan")
    return float(np.sqrt(plane_residual(pair_m[is_seen][:, :2], image_m[is_seen]) / is_seen.sum()))
