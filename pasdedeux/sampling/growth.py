"""Frontier growth: lift annotation after annotation from pairs that are already lifted, starting with a few seeds.

A chain hardly leaves its seed. Growth reaches far: of all annotations not lifted yet, take the one whose image
is closest to some lifted pair seen from the annotation's own view; move that pair to match it (the image plane from the
annotation, depth and bone lengths from the pair); if the physical prior finds it possible, it may lift others.

Depth comes from several lifted pairs that look alike, not from one, and once everything is lifted the neighbours agree:
the depth of each grown pair becomes that of the pairs that look like it under its view.  Their image planes differ, so
annotations complement each other.  A joint that an annotation does not show counts in no distance, and is placed in the
image as well as in depth by those pairs.  Grown pairs are not draws: they are starts for chains, and a set that covers
the motion. Our own; Yin et al. (2018) start from one seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.cameras.frames import pair_frame, project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import align_plane
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import AnnotatedPairs
from pasdedeux.sampling.growth_kernels import LANES, keep_nearest, place_near_image, write_image_distances
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.sampling.prior import DEFAULT_PRIOR, PriorSettings
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread

Indices = npt.NDArray[np.int64]

_ORDER = np.array(PAIR17.order)
_PARENTS = np.array(PAIR17.parents)
_NUM_POINTS = 2 * PAIR17.num_joints
_TREE = np.zeros((PAIR17.num_joints, PAIR17.num_joints))
for _child, _parent in enumerate(PAIR17.parents):
    if _parent >= 0:
        _TREE[[_child, _parent], [_child, _parent]] += 1.0
        _TREE[[_child, _parent], [_parent, _child]] -= 1.0


_IMAGE_DEVIATION_M = 0.02
"""Error of an annotated joint."""
_DEPTH_DEVIATION_M = 0.05
"""Error of a bone's depth taken from lifted pairs."""
_TIGHTNESS = (_IMAGE_DEVIATION_M / _DEPTH_DEVIATION_M) ** 2
"""Weight of a squared depth error against a squared image error."""
FARTHEST_M = 0.25
"""Annotations farther than this from all lifted pairs are not lifted."""
_NUM_NEIGHBOURS = 8
"""Most lifted pairs over which a depth is averaged."""
_NEIGHBOUR_DEVIATION_M = 0.03
"""Width of their weights, as a function of their distance beyond the nearest."""
_NUM_SWEEPS = 3
"""Number of rounds in which grown neighbours agree on their depths."""


@dataclass(frozen=True)
class Growth:
    """Grown pairs in the order in which they grew.

    Args:
        pairs_m: Pairs (n, person=2, joint=17, 3), metres, gauge-fixed.
        entry: Entry of the annotated pairs that each was lifted to, (n,).
        parent: What each was lifted from, the nearest one: indices below the number of seeds are seeds, (n,); later
            ones are grown pairs, counted on from there.
        generation: Steps from a seed, (n,), from 1.
        image_distance_m: Distance of the annotation from the parent under the annotation's view, (n,), metres.
        log_prior: Log of eq. 2 (Yin et al. 2018) with the pair's own bone lengths, (n,).
        is_possible: Whether the joint limits are kept, (n,): agreeing on depths may have changed it.
        num_refused: Annotations whose lifted pair was refused.
        num_left: Requested annotations that no lifted pair came near.
    """

    pairs_m: Array
    entry: Indices
    parent: Indices
    generation: Indices
    image_distance_m: Array
    log_prior: Array
    is_possible: npt.NDArray[np.bool_]
    num_refused: int
    num_left: int


def grow(
    seeds_m: Array,
    annotated: AnnotatedPairs,
    limits: JointLimits,
    *,
    num_grown: int,
    prior: PriorSettings = DEFAULT_PRIOR,
) -> Growth:
    """Lift up to `num_grown` annotations from seeds (seed, person=2, joint=17, 3), metres, nearest first.

    If there are more annotations, they are chosen evenly in their order: the nearest to the seeds alone would leave out
    all other motion (salsa, 1,000 of 6,000: held-out frames are 9.0 cm from the nearest pair, and 16.0 so).

    Every annotation is lifted at most once, by the hypothesis of its view that matches best.  Bone lengths are those of
    the pair lifted from.  No randomness; ties go to the entry that comes first.  `prior` refuses and scores pairs.

    Raises:
        InputError: There is no seed, or one with a position that is not finite.
    """
    if not len(seeds_m) or not np.isfinite(seeds_m).all():
        raise InputError("growth needs at least one seed, all of its positions finite")
    wanted = np.flatnonzero(np.isin(annotated.annotation_index, _spread(annotated.annotation_index, num_grown)))
    frontier = _Frontier(annotated.some(wanted))
    for seed in np.asarray(seeds_m, dtype=np.float64):
        frontier.add(_Lifted(seed, bone_lengths(PAIR17, seed)))
    num_refused = 0
    while len(frontier.lifted) - len(seeds_m) < num_grown:
        entry = frontier.nearest()
        if entry < 0:
            break
        pair = frontier.lift(entry)
        if limits.num_invalid(pair).sum() > prior.max_invalid_angles:
            num_refused += 1
            continue
        parent = int(frontier.which[entry, 0])
        nearest = frontier.lifted[parent]
        distance_m = float(frontier.distance_m[entry, 0])
        frontier.add(_Lifted(pair, nearest.lengths, entry, parent, nearest.generation + 1, distance_m))
    for _ in range(_NUM_SWEEPS):
        frontier.agree(len(seeds_m))
    growth = frontier.growth(len(seeds_m), limits, num_refused, prior)
    return replace(growth, entry=wanted[growth.entry])


def _spread(annotation_index: Indices, count: int) -> Indices:
    """Return this many annotations, or all, evenly spread."""
    there = np.unique(annotation_index)
    return np.asarray(there[evenly_spread(len(there), count)])


class ViewedImages:
    """Images and views of some entries, ready for the residuals of any pair.

    Args:
        images: Centred images, coordinate before joint, (entry, 2, 34), metres; 0 where a joint is not seen.
        is_seen: Which joints are seen, (entry, 34).
        directions: Views (entry, 3) in the pair's local frame.

    With C = sum p X' the covariance of image and pair and w the direction to the camera, |a + ib|^2 of the best turn in
    the plane is |C_x|^2 - (C_x w)^2 + |C_y|^2 - (C_y w)^2 + 2 w (C_x x C_y), so the pair is never projected at all.
    """

    def __init__(self, images: Array, is_seen: npt.NDArray[np.bool_], directions: Array) -> None:
        blocks = np.zeros((-(-len(images) // LANES) * LANES, *images.shape[1:]))
        blocks[: len(images)] = images
        blocks = blocks.reshape(-1, LANES, *images.shape[1:])
        self._images, self._directions = (
            np.ascontiguousarray(np.moveaxis(blocks, 1, -1)),
            np.ascontiguousarray(directions),
        )
        self._squares = (images**2).sum(axis=(1, 2))
        self._num_missing = (~is_seen).sum(axis=1)
        missing_first = np.argsort(is_seen, axis=1, kind="stable")
        self._missing = np.ascontiguousarray(missing_first[:, : self._num_missing.max(initial=0)])

    def residuals(self, pair_m: Array) -> Array:
        """Return the distance of a pair (2, 17, 3), metres, under the views from the images, (entry,), metres.

        Root mean square over the joints that are seen, after the best turn in the plane.
        """
        points = pair_m.reshape(_NUM_POINTS, 3)
        points = np.ascontiguousarray((points - points.mean(axis=0)).T)
        axes = np.ascontiguousarray(pair_frame(pair_m).axes)
        residual = np.empty(len(self._directions))
        images = (self._directions, self._images, self._squares, self._missing, self._num_missing)
        write_image_distances(points, points @ points.T, axes, *images, residual)
        return residual


@dataclass(frozen=True)
class _Lifted:
    """A pair (2, 17, 3) with its bone lengths (2, 17), and how it was lifted (unless it is a seed)."""

    pair_m: Array
    lengths: Array
    entry: int = -1
    parent: int = -1
    generation: int = 0
    image_distance_m: float = 0.0


class _Frontier:
    """All lifted pairs so far, and for each entry the most similar ones."""

    def __init__(self, annotated: AnnotatedPairs) -> None:
        points = annotated.centred_m
        self.images = np.ascontiguousarray(np.swapaxes(points, 1, 2))
        self.is_seen = annotated.is_seen.reshape(len(points), _NUM_POINTS)
        self.directions = annotated.directions
        self._views = ViewedImages(self.images, self.is_seen, self.directions)
        self.annotation = annotated.annotation_index
        self.is_done = np.zeros(len(points), dtype=bool)
        self.distance_m, self.which = self._nobody(len(points))
        self.lifted: list[_Lifted] = []

    def _nobody(self, count: int) -> tuple[Array, Indices]:
        shape = (count, _NUM_NEIGHBOURS)
        return np.full(shape, np.inf), np.full(shape, -1, dtype=np.int64)

    def add(self, lifted: _Lifted) -> None:
        """Add a pair from which similar annotations may be lifted."""
        self.lifted.append(lifted)
        keep_nearest(self._views.residuals(lifted.pair_m), len(self.lifted) - 1, self.distance_m, self.which)

    def nearest(self) -> int:
        """Return the entry nearest to anything lifted, and close its annotation; -1 when none is near enough."""
        distance = np.where(self.is_done, np.inf, self.distance_m[:, 0])
        entry = int(np.argmin(distance))
        if not distance[entry] <= FARTHEST_M:
            return -1
        self.is_done |= self.annotation == self.annotation[entry]
        return entry

    def lift(self, entry: int) -> Array:
        """Return the pair (2, 17, 3) that matches an entry, in camera axes."""
        which = self.which[entry]
        return self._placed(entry, self.distance_m[entry], which, self.lifted[int(which[0])].lengths)

    def _placed(self, entry: int, distance_m: Array, which: Indices, lengths: Array) -> Array:
        is_there = which >= 0
        squared = distance_m[is_there] ** 2
        weight = np.exp(-0.5 * (squared - squared[0]) / _NEIGHBOUR_DEVIATION_M**2)
        weight = weight / weight.sum()
        pairs = np.stack([self.lifted[index].pair_m for index in which[is_there]])
        points = pairs.reshape(len(pairs), _NUM_POINTS, 3)
        towards = pair_frame(pairs).direction(self.directions[entry])
        depths = np.einsum("knx,kx->kn", points - points.mean(axis=1, keepdims=True), towards)
        depth = weight @ depths
        placed = np.empty((2, PAIR17.num_joints, 3))
        image, is_seen = np.ascontiguousarray(self.images[entry].T), self.is_seen[entry]
        if not is_seen.all():
            shown = np.where(is_seen[:, None], image, np.nan)
            seen = project_pair(pairs, self.directions[entry]).reshape(len(pairs), _NUM_POINTS, 2)
            image = _completed(shown, np.einsum("k,knx->nx", weight, align_plane(seen, shown)))
        # Unseen joints are as uncertain in the image as in depth.
        tightness = np.where(is_seen, _TIGHTNESS, 1.0).reshape(2, -1)
        image = image.reshape(2, PAIR17.num_joints, 2)
        place_near_image(image, depth.reshape(2, -1), lengths, _ORDER, _PARENTS, tightness, placed)
        return placed

    def agree(self, num_seeds: int) -> None:
        """Give every grown pair the depth of the other pairs that look like it under its view."""
        entries = np.array([pair.entry for pair in self.lifted[num_seeds:]], dtype=np.int64)
        if not len(entries) or len(self.lifted) < 2:
            return
        distance_m, which = self._nobody(len(entries))
        views = ViewedImages(self.images[entries], self.is_seen[entries], self.directions[entries])
        for index, pair in enumerate(self.lifted):
            residual = views.residuals(pair.pair_m)
            if index >= num_seeds:
                residual[index - num_seeds] = np.inf
            keep_nearest(residual, index, distance_m, which)
        self.lifted[num_seeds:] = [
            replace(pair, pair_m=self._placed(pair.entry, distance_m[row], which[row], pair.lengths))
            for row, pair in enumerate(self.lifted[num_seeds:])
        ]

    def growth(self, num_seeds: int, limits: JointLimits, num_refused: int, prior: PriorSettings) -> Growth:
        """Turn every pair upright as its parent and give them all."""
        fixed = [gauge_fix(pair.pair_m) for pair in self.lifted[:num_seeds]]
        grown = self.lifted[num_seeds:]
        for pair in grown:
            fixed.append(gauge_fix(pair.pair_m, fixed[pair.parent]))
        pairs = np.array(fixed[num_seeds:]).reshape(-1, 2, PAIR17.num_joints, 3)
        quality = seed_quality(pairs, limits, prior)
        return Growth(
            pairs_m=pairs,
            entry=np.array([pair.entry for pair in grown], dtype=np.int64),
            parent=np.array([pair.parent for pair in grown], dtype=np.int64),
            generation=np.array([pair.generation for pair in grown], dtype=np.int64),
            image_distance_m=np.array([pair.image_distance_m for pair in grown], dtype=np.float64),
            log_prior=quality.log_prior,
            is_possible=quality.is_possible,
            num_refused=num_refused,
            num_left=len(np.unique(self.annotation)) - len(grown) - num_refused,
        )


def _completed(shown: Array, alike: Array) -> Array:
    """Return an image (n, 2), NaN where a joint is not seen, completed by one of a pair that looks like it (n, 2).

    An unseen joint is placed as in the other pair, displaced by the mean of its neighbours in the skeleton.
    """
    displacement = (shown - alike).reshape(2, PAIR17.num_joints, 2)
    for shifts in displacement:
        is_missing = np.isnan(shifts[:, 0])
        pull = _TREE[np.ix_(is_missing, ~is_missing)] @ shifts[~is_missing]
        shifts[is_missing] = np.linalg.solve(_TREE[np.ix_(is_missing, is_missing)], -pull)
    return alike + displacement.reshape(shown.shape)
