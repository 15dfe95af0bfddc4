"""Annotated pairs in metres, from pixels and estimated views, as the likelihood takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.view_density import ViewDensity
from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.sampling.likelihood import AnnotatedPairs

__all__ = ["GatheredPairs", "gather_pairs"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GatheredPairs:
    """Annotations that the likelihood can use.

    Args:
        pairs: Annotated pairs, an entry per annotation and view hypothesis.
        weights: Weight of each entry's view in the view density, (entry,).
        num_skipped: Annotations left out because a joint, the scale or the view was missing.
        metres_per_pixel: Scale of each person in each entry, (entry, person=2).
    """

    pairs: AnnotatedPairs
    weights: Array
    num_skipped: int
    metres_per_pixel: Array

    def view_density(self, *, deviation_rad: float = 0.5) -> ViewDensity:
        """Return the density of views over these annotations (Yin et al. 2018, eq. 5)."""
        return ViewDensity(self.pairs.directions, self.weights, deviation_rad)


def gather_pairs(
    pair17_px: Array,
    metres_per_pixel: Array,
    directions: Array,
    weights: Array,
    annotation_index: npt.NDArray[np.int64],
) -> GatheredPairs:
    """Return the annotations with all joints and a view, in metres.

    Args:
        pair17_px: Keypoints of each entry, (entry, person=2, joint=17, 2), pixels; NaN where missing.
        metres_per_pixel: Scale of each person, (entry, person=2).
        directions: View of each entry, (entry, 3).
        weights: Weight of the entry's view, (entry,); entries without weight are left out.
        annotation_index: Which annotation the entry is a hypothesis of, (entry,).

    Raises:
        InputError: No annotation is left.
    """
    points = pair_in_metres(pair17_px, metres_per_pixel)
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
    return GatheredPairs(
        pairs=pairs,
        weights=weights[is_whole],
        num_skipped=num_skipped,
        metres_per_pixel=np.asarray(metres_per_pixel, dtype=np.float64)[is_whole],
    )
