"""Likelihoods with another dissimilarity than interaction coordinates: Cartesian and shape context.

The densities that Yin et al. (2018), Fig. 9, compare with: eqs. 6 and 9 as they stand, with the mean joint distance or
the shape-context cost of the images, after the best turn in the plane, in place of d_I.  Their bandwidth is not
published.  Here the dissimilarity is multiplied by what makes nearest neighbours among the annotations as far apart, in
the median, as they are in d_I (`matched_scale`), so that all densities are equally sharp at the data.  They mask
nothing: only annotations that show all joints are compared with.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.cameras import angle_between_directions, project_pair
from pasdedeux.errors import InputError
from pasdedeux.experiments.measured_kernels import best_cartesian, best_shape, fill_histograms
from pasdedeux.interaction import align_plane, interaction_dissimilarity, plane_residual, plane_shape_dissimilarity
from pasdedeux.interaction.shape_context import NUM_SECTORS, NUM_SHELLS
from pasdedeux.sampling.annotations import AnnotatedPairs, ViewBank
from pasdedeux.sampling.bandwidth import PUBLISHED_SIGMA_L
from pasdedeux.sampling.density import ImageKind, ImageSettings, Match, Pooling
from pasdedeux.sampling.likelihood import pooled_log
from pasdedeux.spread import evenly_spread

__all__ = [
    "CartesianKind",
    "ImageMeasure",
    "MeasuredLikelihood",
    "ShapeContextKind",
    "image_dissimilarity",
    "matched_scale",
]

Array = npt.NDArray[np.float64]

_NUM_MATCHED = 60
_NUM_BINS = NUM_SHELLS * NUM_SECTORS


class ImageMeasure(StrEnum):
    """How the image of a pair is compared with an annotated one."""

    CARTESIAN = "cartesian"
    SHAPE_CONTEXT = "shape_context"


def image_dissimilarity(moving: Array, fixed: Array, measure: ImageMeasure) -> Array:
    """Return the dissimilarity (*batch,) of images (*batch, n, 2), metres, after the best turn in the plane.

    Cartesian: the mean distance of the joints, metres; shape context: between 0 and 1.
    """
    if measure is ImageMeasure.SHAPE_CONTEXT:
        return plane_shape_dissimilarity(moving, fixed)
    return np.asarray(np.linalg.norm(align_plane(moving, fixed) - fixed, axis=-1).mean(axis=-1))


def matched_scale(pairs: AnnotatedPairs, measure: ImageMeasure) -> float:
    """Return factor that makes nearest annotations as far apart as in d_I, in the median over 60 evenly spread ones.

    The nearest is the one with the least rigid residual among those whose view is within half a radian; 1 when there
    are no neighbours or they coincide.  Annotations that lack a joint do not count.
    """
    is_whole = pairs.is_seen.all(axis=(1, 2))
    directions, index = pairs.directions[is_whole], pairs.annotation_index[is_whole]
    points = pairs.points_m[is_whole].reshape(len(index), -1, 2)
    interaction, own = [], []
    for row in evenly_spread(len(points), _NUM_MATCHED):
        is_near = angle_between_directions(directions[row], directions) < 0.5
        others = np.flatnonzero(is_near & (index != index[row]))
        if not len(others):
            continue
        nearest = points[others[int(np.argmin(plane_residual(points[row], points[others])))]]
        interaction.append(interaction_dissimilarity(points[row], nearest))
        own.append(float(image_dissimilarity(points[row], nearest, measure)))
    median = float(np.median(own)) if own else 0.0
    return float(np.median(interaction)) / median if median > 0.0 else 1.0


class MeasuredLikelihood:
    """Eqs. 6 and 9 (Yin et al. 2018) over a fixed bank with another dissimilarity, as compiled kernels.

    Views far behind the best one contribute less than rounding and are left out.

    Args:
        pairs: Annotated pairs.
        bank: Views and their candidates, all of which show every joint.
        measure: The dissimilarity.
        sigma_l: Bandwidth; 2 sigma_l^2 is in metres of d_I, to which the dissimilarity is scaled.
        pooling: How the views are pooled.
        num_ranked: Shape contexts of a view that are compared, nearest by rigid residual; Cartesian distances are all.
        is_exact: Compare all shape contexts, to the end: the oracle.

    Raises:
        InputError: `sigma_l` or `num_ranked` is not positive.
    """

    def __init__(
        self,
        pairs: AnnotatedPairs,
        bank: ViewBank,
        measure: ImageMeasure,
        *,
        sigma_l: float = PUBLISHED_SIGMA_L,
        pooling: Pooling = Pooling.MEAN,
        num_ranked: int = 64,
        is_exact: bool = False,
    ) -> None:
        if not sigma_l > 0.0 or num_ranked < 1:
            raise InputError(f"sigma_l and num_ranked must be positive, found {sigma_l} and {num_ranked}")
        self.measure = measure
        self.scale = matched_scale(pairs, measure)
        self._exponent = self.scale / (2.0 * sigma_l**2)
        # Views this far behind the best add less than 1e-14 of the sum together.
        self._margin = float(np.log(len(bank.directions) * 1e14)) / self._exponent
        self._num_ranked = num_ranked
        self._is_exact = is_exact
        self._pairs, self._bank, self.sigma_l = pairs, bank, sigma_l
        self.directions, self._pooling = bank.directions, pooling
        used = np.unique(bank.candidates[bank.candidates >= 0])
        points = pairs.points_m[used].reshape(len(used), -1, 2)
        self._used = used
        self._points = np.ascontiguousarray(points - points.mean(axis=1, keepdims=True))
        self._slots = np.searchsorted(used, np.maximum(bank.candidates, used[0]))
        self._counts = np.zeros((len(used), points.shape[1], _NUM_BINS), np.uint8)
        if measure is ImageMeasure.SHAPE_CONTEXT:
            fill_histograms(self._points, self._counts)
        # A candidate per lane, float32: (view, joint, candidate).
        table = np.moveaxis(self._points[self._slots].astype(np.float32), 1, 2)
        self._lanes_x, self._lanes_y = (np.ascontiguousarray(table[..., axis]) for axis in range(2))
        self._squares = (table**2).sum(axis=(1, 3))
        self._best = np.empty(len(bank.directions))
        self._slot = np.empty(len(bank.directions), dtype=np.int64)

    def match(self, pair_m: Array, *, at_least: float = -np.inf) -> Match:
        """Return the log likelihood of a pair (2, 17, 3), metres; -inf when it lies below `at_least`.

        The least dissimilarities of the views are in metres, scaled to d_I; inf where they cannot matter.
        """
        least, log_likelihood = np.inf, -np.inf
        if self._pooling is Pooling.EVERY_VIEW:
            self._search(pair_m, np.inf, np.inf)
            log_likelihood = pooled_log(self._best * self.scale, self.sigma_l, self._pooling)
        else:
            # The mean over views is at most the best view: it alone must reach the floor.
            self._search(pair_m, np.inf if at_least == -np.inf else -at_least / self._exponent, self._margin)
            least = float(self._best.min())
        if np.isfinite(least):
            is_near = self._best <= least + self._margin
            self._best[~is_near], self._slot[~is_near] = np.inf, -1
            mean = np.exp(-(self._best[is_near] - least) * self._exponent).sum() / len(self._best)
            log_likelihood = float(np.log(mean) - least * self._exponent)
        return Match(
            log_likelihood=log_likelihood if log_likelihood >= at_least else -np.inf,
            dissimilarity_m=self._best * self.scale,
            entry=self._entries(),
        )

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return the log likelihood alone."""
        return self.match(pair_m, at_least=at_least).log_likelihood

    def plain(self, pair_m: Array) -> float:
        """Return the log likelihood by its definition."""
        best = np.full(len(self._bank.directions), np.inf)
        for view, image in enumerate(project_pair(pair_m, self._bank.directions).reshape(len(best), 1, -1, 2)):
            own = self._bank.candidates[view, : self._bank.counts[view]]
            fixed = self._pairs.points_m[own].reshape(len(own), -1, 2)
            best[view] = image_dissimilarity(image, fixed, self.measure).min(initial=np.inf)
        return pooled_log(best * self.scale, self.sigma_l, self._pooling)

    def nearest(self, pair_m: Array) -> npt.NDArray[np.int64]:
        """Return the entry nearest to the pair (2, 17, 3) under every view, (m,); -1 for a view without any."""
        self._search(pair_m, np.inf, np.inf)
        return self._entries()

    def _entries(self) -> npt.NDArray[np.int64]:
        return np.where(self._slot >= 0, self._used[np.maximum(self._slot, 0)], -1)

    def _search(self, pair_m: Array, limit: float, margin: float) -> None:
        """Fill the least dissimilarity of each view, as far as it matters, and who has it."""
        images = project_pair(pair_m, self._bank.directions).reshape(len(self._best), -1, 2)
        images = np.ascontiguousarray(np.moveaxis(images - images.mean(axis=1, keepdims=True), 2, 1))
        lanes = (self._lanes_x, self._lanes_y, self._squares)
        counts, slots, found = self._bank.counts, self._slots, (self._best, self._slot)
        if self.measure is ImageMeasure.CARTESIAN:
            best_cartesian(images, counts, slots, self._points, *lanes, limit, margin, *found)
        else:
            how = (self._num_ranked, self._is_exact)
            best_shape(images, counts, slots, self._counts, *lanes, *how, limit, margin, *found)


class CartesianKind(ImageKind[ImageSettings]):
    """The likelihood by the mean distance of the joints in the image."""

    name = "cartesian"
    meaning = "mean joint distance of the images"
    needs_all_joints = True
    settings = ImageSettings

    def compare(
        self, settings: ImageSettings, pairs: AnnotatedPairs, bank: ViewBank, sigma_l: float
    ) -> MeasuredLikelihood:
        """Return the likelihood of a bandwidth over a bank of views."""
        return MeasuredLikelihood(pairs, bank, ImageMeasure.CARTESIAN, sigma_l=sigma_l, pooling=settings.pooling)


class ShapeContextSettings(ImageSettings):
    """Settings of the likelihood by shape context."""

    num_ranked: int = Field(
        default=64, ge=1, description="Shape contexts of a view compared, nearest by rigid residual"
    )


class ShapeContextKind(ImageKind[ShapeContextSettings]):
    """The likelihood by the shape-context cost of the images."""

    name = "shape_context"
    meaning = "shape context of the images"
    needs_all_joints = True
    settings = ShapeContextSettings

    def compare(
        self, settings: ShapeContextSettings, pairs: AnnotatedPairs, bank: ViewBank, sigma_l: float
    ) -> MeasuredLikelihood:
        """Return the likelihood of a bandwidth over a bank of views."""
        return MeasuredLikelihood(
            pairs,
            bank,
            ImageMeasure.SHAPE_CONTEXT,
            sigma_l=sigma_l,
            pooling=settings.pooling,
            num_ranked=settings.num_ranked,
        )
