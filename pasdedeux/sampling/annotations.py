"""Annotated pairs in metres, from pixels and estimated views, and the bank of views for comparisons."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.cameras.frames import angle_between_directions
from pasdedeux.cameras.torso import MIN_TORSO_JOINTS, TORSO_INDICES
from pasdedeux.cameras.view_density import VIEW_DEVIATION_RAD
from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.sampling.bandwidth import SAME_MOMENT, LeaveOneOut, leave_one_out
from pasdedeux.skeletons import COUNTED17

MIN_CANDIDATES = 20
"""Number of annotations compared with a view even if none is within the view bandwidth."""


MIN_SEEN_SHARE = 0.5
"""Share of the joints of both people that an annotation must show to be compared with."""


def shows_enough(points: Array) -> npt.NDArray[np.bool_]:
    """Return which annotations (*batch, person=2, joint=17, 2) show enough joints; NaN where a joint is not seen.

    Half of the joints that count (`COUNTED17`), and of each person the four of the torso that a view needs.
    """
    is_seen = np.asarray(np.isfinite(points).all(axis=-1))
    has_torsos = (is_seen[..., TORSO_INDICES].sum(axis=-1) >= MIN_TORSO_JOINTS).all(axis=-1)
    return np.asarray(has_torsos & (is_seen[..., COUNTED17].mean(axis=(-1, -2)) >= MIN_SEEN_SHARE))


def is_left_out(
    sequence_id: Sequence[str], frame: npt.NDArray[np.integer], every: int, stills: Collection[str] = ()
) -> npt.NDArray[np.bool_]:
    """Return which annotations (row,) draws are not made from: every n-th moment.

    A moment is `SAME_MOMENT` frames of a video, which show nearly the same pose, or one frame of `stills`; the first
    one left out is in the middle of the first `every`.  None where `every` is 0, or moments are too few.

    >>> is_left_out(["a", "a", "a", "b"], np.array([0, 29, 30, 0]), 2).tolist()
    [False, False, True, False]
    """
    if not every:
        return np.zeros(len(frame), dtype=bool)
    length = np.array([1 if name in stills else SAME_MOMENT for name in sequence_id])
    names = np.unique(np.asarray(sequence_id), return_inverse=True)[1]
    number = np.unique(np.stack([names, np.asarray(frame) // length]), axis=1, return_inverse=True)[1].reshape(-1)
    return np.asarray(number % every == every // 2)


@dataclass(frozen=True)
class AnnotatedPairs:
    """Annotated pairs in metres with the views they are seen under; an annotation may come with several views.

    Args:
        points_m: Image points (entry, person=2, joint=17, 2), metres, x right, y up; NaN where a joint is not seen.
        directions: View of each entry in the pair's local frame, unit (a, b, c), (entry, 3).
        annotation_index: Which annotation an entry is a view hypothesis of, (entry,).

    Raises:
        InputError: An entry shows too little, or a view is not finite.
    """

    points_m: Array
    directions: Array
    annotation_index: npt.NDArray[np.int64]

    def __post_init__(self) -> None:
        """Check every entry."""
        if not (shows_enough(self.points_m).all() and np.isfinite(self.directions).all()):
            raise InputError("an annotated pair shows too few joints, or its view is not finite")

    @property
    def is_seen(self) -> npt.NDArray[np.bool_]:
        """Which joints are seen, (entry, person=2, joint=17)."""
        return np.asarray(np.isfinite(self.points_m).all(axis=-1))

    def some(self, entries: npt.NDArray[np.int64]) -> AnnotatedPairs:
        """Return some of the entries."""
        return AnnotatedPairs(self.points_m[entries], self.directions[entries], self.annotation_index[entries])

    @property
    def centred_m(self) -> Array:
        """Image points of both people (entry, n, 2), metres, centred on the mean of the seen ones; 0 where not seen."""
        points = merge_axes(self.points_m, 1, -1)
        is_seen = merge_axes(self.is_seen, 1)[..., None]
        mean = np.where(is_seen, points, 0.0).sum(axis=1, keepdims=True) / is_seen.sum(axis=1, keepdims=True)
        return np.where(is_seen, points - mean, 0.0)


@dataclass(frozen=True)
class GatheredPairs:
    """Annotations that the likelihood can use.

    Args:
        pairs: Annotated pairs, an entry per annotation and view hypothesis.
        weights: Weight of each entry's view in the view density, (entry,).
        num_skipped: Number of skipped annotations, which show too little, or have no scale or view.
        metres_per_pixel: Scale of each person in each entry, (entry, person=2).
        moment: When each annotation was, as `leave_one_out` takes it, (annotation,); all far apart where not given.
    """

    pairs: AnnotatedPairs
    weights: Array
    num_skipped: int
    metres_per_pixel: Array
    moment: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @cached_property
    def leave_one_out(self) -> LeaveOneOut:
        """Comparison of each annotation with the others, under its first view, from which the bandwidth follows."""
        annotation, first = np.unique(self.pairs.annotation_index, return_index=True)
        moment = self.moment[annotation] if len(self.moment) else SAME_MOMENT * annotation
        return leave_one_out(self.pairs.points_m[first], self.pairs.directions[first], moment)

    @cached_property
    def view_spread_rad(self) -> float:
        """Largest angle from their mean of nine in ten likeliest views, radians."""
        annotation, which = np.unique(self.pairs.annotation_index, return_inverse=True)
        order = np.lexsort((-self.weights, which))
        first = order[np.searchsorted(which[order], np.arange(len(annotation)))]
        directions = self.pairs.directions[first]
        return float(np.percentile(angle_between_directions(directions.mean(axis=0), directions), 90.0))


def gather_pairs(
    pair17_px: Array,
    metres_per_pixel: Array,
    directions: Array,
    weights: Array,
    annotation_index: npt.NDArray[np.int64],
) -> GatheredPairs:
    """Return the annotations that show enough (`shows_enough`) and have a view, in metres.

    Args:
        pair17_px: Keypoints of each entry, (entry, person=2, joint=17, 2), pixels; NaN where missing.
        metres_per_pixel: Scale of each person, (entry, person=2).
        directions: View of each entry, (entry, 3).
        weights: Weight of the entry's view, (entry,); entries without weight are skipped.
        annotation_index: Which annotation the entry is a hypothesis of, (entry,).

    Raises:
        InputError: No annotation is left.
    """
    points = pair_in_metres(pair17_px, metres_per_pixel)
    is_usable = shows_enough(points) & np.isfinite(directions).all(axis=1)
    is_usable &= np.isfinite(weights) & (weights > 0.0) & (np.linalg.norm(directions, axis=1) > 1e-9)
    num_annotations = len(np.unique(annotation_index))
    num_skipped = num_annotations - len(np.unique(annotation_index[is_usable]))
    if not is_usable.any():
        raise InputError(
            f"none of the {num_annotations} annotated pairs shows half of the joints, four torso joints of both people "
            "among them, and has a view: the likelihood needs at least one"
        )
    pairs = AnnotatedPairs(
        points_m=points[is_usable],
        directions=normalise(directions[is_usable]),
        annotation_index=np.asarray(annotation_index[is_usable], dtype=np.int64),
    )
    return GatheredPairs(
        pairs=pairs,
        weights=weights[is_usable],
        num_skipped=num_skipped,
        metres_per_pixel=np.asarray(metres_per_pixel, dtype=np.float64)[is_usable],
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
    directions: Array,
    pairs: AnnotatedPairs,
    *,
    num_candidates: int = 500,
    view_bandwidth_rad: float = VIEW_DEVIATION_RAD,
) -> ViewBank:
    """Return the bank of views (m, 3): each with the nearest `num_candidates` annotations by view.

    An annotation enters a view once, by its nearest hypothesis.  Annotations farther than the bandwidth are dropped as
    long as 20 stay.
    """
    chosen: list[npt.NDArray[np.int64]] = []
    for direction in directions:
        angle = angle_between_directions(direction, pairs.directions)
        order = np.argsort(angle, kind="stable")
        _, first = np.unique(pairs.annotation_index[order], return_index=True)
        order = order[np.sort(first)][:num_candidates]
        num_similar = int(np.searchsorted(angle[order], view_bandwidth_rad, side="right"))
        chosen.append(order[: max(num_similar, MIN_CANDIDATES)])
    max_count = max(len(entries) for entries in chosen)
    candidates = np.full((len(directions), max_count), -1, dtype=np.int64)
    for row, entries in enumerate(chosen):
        candidates[row, : len(entries)] = entries
    return ViewBank(
        directions=np.asarray(directions, dtype=np.float64),
        candidates=candidates,
        counts=np.array([len(entries) for entries in chosen], dtype=np.int64),
    )
