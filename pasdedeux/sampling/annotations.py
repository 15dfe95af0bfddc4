"""Annotated pairs in metres, from pixels and estimated views, and the bank of views they are compared under."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import angle_between_directions
from pasdedeux.cameras.view_density import ViewDensity
from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise

__all__ = ["MIN_CANDIDATES", "AnnotatedPairs", "GatheredPairs", "ViewBank", "build_bank", "gather_pairs"]

Array = npt.NDArray[np.float64]

MIN_CANDIDATES = 20
"""Annotations a view is compared with even when none is within the view bandwidth."""


@dataclass(frozen=True)
class AnnotatedPairs:
    """Annotated pairs in metres with the views they are seen under; an annotation may come with several views.

    Args:
        points_m: Image points (entry, person=2, joint=17, 2), metres, x right, y up; all finite.
        directions: View of each entry in the pair's local frame, unit (a, b, c), (entry, 3).
        annotation_index: Which annotation an entry is a view hypothesis of, (entry,).

    Raises:
        InputError: No entry, shapes that do not fit, or a value that is not finite.
    """

    points_m: Array
    directions: Array
    annotation_index: npt.NDArray[np.int64]

    def __post_init__(self) -> None:
        """Check shapes and finiteness."""
        count = len(self.points_m)
        if count == 0:
            raise InputError("no annotated pair is left: the likelihood needs at least one with all joints and a view")
        if self.points_m.shape != (count, 2, 17, 2) or self.directions.shape != (count, 3):
            raise InputError(
                f"annotations {self.points_m.shape} and views {self.directions.shape} do not fit: "
                "expected (entry, 2, 17, 2) and (entry, 3)"
            )
        if len(self.annotation_index) != count:
            raise InputError(f"{count} annotated pairs but {len(self.annotation_index)} annotation indices")
        if not (np.isfinite(self.points_m).all() and np.isfinite(self.directions).all()):
            raise InputError("an annotated pair or its view has a value that is not finite")


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


@dataclass(frozen=True)
class ViewBank:
    """The fixed views of one seed and the entries each is compared with.

    Args:
        directions: Views (m, 3) in the pair's local frame.
        candidates: Entries compared with each view, nearest view first, (m, most); -1 beyond the valid ones.
        counts: Number of valid candidates of each view, (m,).
    """

    directions: Array
    candidates: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]


def build_bank(
    directions: Array, pairs: AnnotatedPairs, *, num_candidates: int = 500, view_bandwidth_rad: float = 0.5
) -> ViewBank:
    """Return the bank of views (m, 3): each with the nearest `num_candidates` annotations by view.

    An annotation enters a view once, by its nearest hypothesis.  Annotations farther than the bandwidth are dropped as
    long as 20 stay.

    Raises:
        InputError: There is no view or `num_candidates` is not positive.
    """
    if len(directions) == 0 or num_candidates < 1:
        raise InputError(f"a bank needs views and candidates, found {len(directions)} and {num_candidates}")
    chosen: list[npt.NDArray[np.int64]] = []
    for direction in directions:
        angle = angle_between_directions(direction, pairs.directions)
        order = np.argsort(angle, kind="stable")
        _, first = np.unique(pairs.annotation_index[order], return_index=True)
        order = order[np.sort(first)][:num_candidates]
        num_similar = int(np.searchsorted(angle[order], view_bandwidth_rad, side="right"))
        chosen.append(order[: max(num_similar, MIN_CANDIDATES)])
    max_count = max(len(own) for own in chosen)
    candidates = np.full((len(directions), max_count), -1, dtype=np.int64)
    for row, own in enumerate(chosen):
        candidates[row, : len(own)] = own
    return ViewBank(
        directions=np.asarray(directions, dtype=np.float64),
        candidates=candidates,
        counts=np.array([len(own) for own in chosen], dtype=np.int64),
    )
