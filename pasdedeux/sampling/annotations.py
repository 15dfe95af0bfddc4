"""Annotated pairs in metres from pixels and estimated views, and views drawn from the view density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.sampling.likelihood import AnnotatedPairs
from pasdedeux.skeletons import PAIR17

__all__ = ["GatheredPairs", "draw_views", "gather_pairs", "points_from_pixels"]

Array = npt.NDArray[np.float64]

_FLIP_Y = np.array([1.0, -1.0])


@dataclass(frozen=True)
class GatheredPairs:
    """Annotations that the likelihood can use.

    Args:
        pairs: Annotated pairs, an entry per annotation and view hypothesis.
        weights: Weight of each entry among the hypotheses of its annotation, (entry,).
        num_skipped: Annotations left out because a joint, the scale or the view was missing.
    """

    pairs: AnnotatedPairs
    weights: Array
    num_skipped: int


def points_from_pixels(pair17_px: Array, metres_per_pixel: Array) -> Array:
    """Give image points (*batch, person=2, joint=17, 2) in metres, x right, y up, of pixels, x right, y down.

    Args:
        pair17_px: Keypoints (*batch, person=2, joint=17, 2), pixels; NaN stays NaN.
        metres_per_pixel: Scale of each person, (*batch, person=2).

    Each person is scaled about the own pelvis, and the line between the two by their mean scale.  That is the image
    seen along the line to the middle of the two, whatever the principal point.
    """
    pelvis = pair17_px[..., PAIR17.root, :]
    middle = pelvis.mean(axis=-2, keepdims=True)
    placed = (pelvis - middle) * metres_per_pixel.mean(axis=-1)[..., None, None]
    own = (pair17_px - pelvis[..., None, :]) * metres_per_pixel[..., None, None]
    return np.asarray((own + placed[..., None, :]) * _FLIP_Y)


def gather_pairs(
    pair17_px: Array,
    metres_per_pixel: Array,
    directions: Array,
    weights: Array,
    annotation_index: npt.NDArray[np.int64],
) -> GatheredPairs:
    """Give the annotations with all joints and a view, in metres.

    Args:
        pair17_px: Keypoints of each entry, (entry, person=2, joint=17, 2), pixels; NaN where missing.
        metres_per_pixel: Scale of each person, (entry, person=2).
        directions: View of each entry, (entry, 3).
        weights: Weight of the entry among its annotation's hypotheses, (entry,).
        annotation_index: Which annotation the entry is a hypothesis of, (entry,).

    Raises:
        InputError: No annotation is left.
    """
    points = points_from_pixels(np.asarray(pair17_px, dtype=np.float64), metres_per_pixel)
    is_whole = np.isfinite(points).all(axis=(1, 2, 3)) & np.isfinite(directions).all(axis=1)
    is_whole &= np.isfinite(weights) & (weights > 0.0) & (np.linalg.norm(directions, axis=1) > 1e-9)
    num_annotations = len(np.unique(annotation_index))
    num_skipped = num_annotations - len(np.unique(annotation_index[is_whole]))
    if not is_whole.any():
        raise InputError(
            f"none of the {num_annotations} annotated pairs has all joints of both people and a view: "
            "the likelihood needs at least one"
        )
    pairs = AnnotatedPairs(
        points_m=points[is_whole],
        directions=normalise(directions[is_whole]),
        annotation_index=np.asarray(annotation_index[is_whole], dtype=np.int64),
    )
    return GatheredPairs(pairs=pairs, weights=weights[is_whole], num_skipped=num_skipped)


def draw_views(
    rng: np.random.Generator, gathered: GatheredPairs, num_views: int, *, bandwidth_rad: float = 0.5
) -> Array:
    """Draw views (view, 3) from the view density, eq. 5 on the sphere (Yin et al. 2018).

    An annotation is chosen uniformly, one of its hypotheses by weight, and the direction is moved by a Gaussian in the
    tangent plane of standard deviation `bandwidth_rad` along each axis.
    """
    index = gathered.pairs.annotation_index
    order = np.argsort(index, kind="stable")
    starts = np.flatnonzero(np.diff(index[order], prepend=index[order[0]] - 1))
    ends = np.append(starts[1:], len(order))
    views = np.empty((num_views, 3))
    for row in range(num_views):
        chosen = int(rng.integers(len(starts)))
        entries = order[starts[chosen] : ends[chosen]]
        cumulative = np.cumsum(gathered.weights[entries])
        at = int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))
        centre = gathered.pairs.directions[entries[min(at, len(entries) - 1)]]
        first = normalise(np.cross(centre, np.eye(3)[int(np.argmin(np.abs(centre)))]))
        u, v = bandwidth_rad * rng.standard_normal(2)
        angle = np.hypot(u, v)
        tangent = (u * first + v * np.cross(centre, first)) * np.sinc(angle / np.pi)
        views[row] = np.cos(angle) * centre + tangent
    return normalise(views)
