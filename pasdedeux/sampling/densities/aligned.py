"""Likelihoods that compare an image with annotations after the best turn and shift in the plane, by another measure.

The densities that Yin et al. (2018), Fig. 9, compare with: eqs. 6 and 9 as they stand, with another dissimilarity in
place of d_I.  Their bandwidths are not published.  Here the dissimilarity is multiplied by what makes nearest
neighbours among the annotations as far apart, in the median, as they are in d_I (`matched_scale`), so that all
densities are equally sharp at the data.  Only annotations that show all joints are compared with.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.cameras.frames import angle_between_directions, project_pair
from pasdedeux.cameras.view_density import VIEW_DEVIATION_RAD
from pasdedeux.compiled import inner_kernel
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity, plane_residual
from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs
from pasdedeux.sampling.densities.annotated import AnnotationSettings, Pooling
from pasdedeux.sampling.densities.density import Likelihood, Nearest
from pasdedeux.spread import evenly_spread

_NUM_MATCHED = 60


class AlignedLikelihood(Likelihood):
    """Eqs. 6 and 9 (Yin et al. 2018) over a fixed bank of views with another dissimilarity.

    Args:
        settings: Views, candidates, bandwidth and pooling.
        rng: Draws the views.
        annotated: Annotated pairs with their views.

    Raises:
        InputError: No annotation shows all joints.
    """

    sigma_l: float

    def __init__(self, settings: AnnotationSettings, rng: np.random.Generator, annotated: GatheredPairs) -> None:
        pairs = annotated.pairs
        self._whole = np.flatnonzero(pairs.is_seen.all(axis=(1, 2)))
        if not len(self._whole):
            raise InputError("none of the annotated pairs shows all joints, which only the density 'ic' can do without")
        whole = pairs.some(self._whole)
        bank = settings.bank(rng, replace(annotated, pairs=whole, weights=annotated.weights[self._whole]))
        self.sigma_l, self._pooling, self.directions = settings.bandwidth(annotated), settings.pooling, bank.directions
        self._slots, self._counts = np.maximum(bank.candidates, 0), bank.counts
        self._points = whole.centred_m
        # A candidate per lane: (view, joint, axis, candidate).
        self._lanes = np.ascontiguousarray(np.moveaxis(self._points[self._slots], 1, 3))
        self._scale = matched_scale(self, whole)
        # Views this far behind the best add less than 1e-14 of the sum together.
        self._margin = 2.0 * self.sigma_l**2 / self._scale * float(np.log(len(bank.directions) * 1e14))

    @abstractmethod
    def dissimilarity(self, image_m: Array, annotations_m: Array) -> Array:
        """Return the dissimilarity of an image (n, 2) and annotations (k, n, 2), metres, after the best turn, (k,).

        Computed by definition, slowly; inf for an annotation that is not compared.
        """

    @abstractmethod
    def _search(self, images_m: Array, limit: float, margin: float) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return the least dissimilarity of each view that can matter, (m,), and the slot that has it.

        Args:
            images_m: Centred images of the pair, (m, 2, n), metres.
            limit: Dissimilarity above which nothing matters unless a smaller one is found.
            margin: How far behind the best view another still matters.
        """

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return the log of eq. 6 for a pair (2, 17, 3), metres; -inf once it is known to be below `at_least`."""
        limit, margin = np.inf, np.inf
        if self._pooling is Pooling.MEAN:
            # The mean over views is at most the best view: it alone must reach the floor.
            margin = self._margin
            limit = np.inf if at_least == -np.inf else -at_least * 2.0 * self.sigma_l**2 / self._scale
        least, _ = self._search(self._images(pair_m), limit, margin)
        value = self._pooling.log_of(least * self._scale, self.sigma_l)
        return value if value >= at_least else -np.inf

    def plain(self, pair_m: Array) -> float:
        """Return the same from all candidates of every view."""
        least = np.full(len(self.directions), np.inf)
        for view, image in enumerate(self._images(pair_m)):
            view_slots = self._slots[view, : self._counts[view]]
            least[view] = self.dissimilarity(image.T, self._points[view_slots]).min(initial=np.inf)
        return self._pooling.log_of(least * self._scale, self.sigma_l)

    def nearest(self, pair_m: Array) -> Nearest:
        """Return the entry nearest to the pair (2, 17, 3) under every view, and how far, scaled to d_I."""
        least, slot = self._search(self._images(pair_m), np.inf, np.inf)
        return Nearest(np.where(slot >= 0, self._whole[np.maximum(slot, 0)], -1), least * self._scale)

    def _images(self, pair_m: Array) -> Array:
        """Return the centred images of a pair (2, 17, 3) under all views, (m, 2, n), metres."""
        images = project_pair(pair_m, self.directions).reshape(len(self.directions), -1, 2)
        return np.ascontiguousarray(np.moveaxis(images - images.mean(axis=1, keepdims=True), 2, 1))


def matched_scale(likelihood: AlignedLikelihood, pairs: AnnotatedPairs) -> float:
    """Return the factor that makes nearest annotations as far apart as in d_I, in the median over 60 evenly spread.

    The nearest is the one with the least rigid residual among those with a similar view; 1 when there are no neighbours
    or they coincide.
    """
    points = merge_axes(pairs.points_m, 1, -1)
    interaction, aligned = [], []
    for row in evenly_spread(len(points), _NUM_MATCHED):
        is_similar = angle_between_directions(pairs.directions[row], pairs.directions) < VIEW_DEVIATION_RAD
        others = np.flatnonzero(is_similar & (pairs.annotation_index != pairs.annotation_index[row]))
        if len(others):
            nearest = points[others[int(np.argmin(plane_residual(points[row], points[others])))]]
            interaction.append(interaction_dissimilarity(points[row], nearest))
            aligned.append(float(likelihood.dissimilarity(points[row], nearest[None])[0]))
    median = float(np.median(aligned)) if aligned else 0.0
    return float(np.median(interaction)) / median if median > 0.0 else 1.0


@inner_kernel()
def align_lanes(x, y, lanes, count, cosine, sine):  # type: ignore[no-untyped-def]
    """Write cosine and sine of the best turn of centred points onto each candidate, a candidate per lane.

    Args:
        x: The points, (n,), metres.
        y: The same upwards.
        lanes: Candidates (n, 2, most), centred, metres.
        count: Number of candidates.
        cosine: Result (most,).
        sine: Result (most,).
    """
    for c in range(count):
        cosine[c] = sine[c] = 0.0
    for k in range(x.shape[0]):
        px, py = lanes[k, 0], lanes[k, 1]
        for c in range(count):
            cosine[c] += x[k] * px[c] + y[k] * py[c]
            sine[c] += x[k] * py[c] - y[k] * px[c]
    for c in range(count):
        # Coincident points have no best turn: the smallest number avoids 0 / 0.
        length = max(np.sqrt(cosine[c] * cosine[c] + sine[c] * sine[c]), 1e-300)
        cosine[c] /= length
        sine[c] /= length
