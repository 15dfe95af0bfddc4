"""Likelihoods with another dissimilarity than interaction coordinates: Cartesian and shape context.

The densities that Yin et al. (2018), Fig. 9, compare with: eqs. 6 and 9 as they stand, with the mean joint distance or
the shape-context cost of the images, after the best turn in the plane, in place of d_I.  Their bandwidth is not
published.  Here the dissimilarity is multiplied by what makes nearest neighbours among the annotations as far apart, in
the median, as they are in d_I (`matched_scale`), so that all densities are equally sharp at the data.
"""

from __future__ import annotations

from enum import StrEnum

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import angle_between_directions, project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction import align_plane, interaction_dissimilarity, plane_residual, plane_shape_dissimilarity
from pasdedeux.interaction.shape_context import INNER_RADIUS_M, NUM_SECTORS, NUM_SHELLS
from pasdedeux.sampling.likelihood import AnnotatedPairs, Match, ViewBank

__all__ = ["ImageMeasure", "MeasuredLikelihood", "image_dissimilarity", "matched_scale"]

Array = npt.NDArray[np.float64]

_NUM_MATCHED = 60
_NUM_BINS = NUM_SHELLS * NUM_SECTORS


class ImageMeasure(StrEnum):
    """How the image of a pair is compared with an annotated one."""

    CARTESIAN = "cartesian"
    SHAPE_CONTEXT = "shape_context"


def image_dissimilarity(moving: Array, fixed: Array, measure: ImageMeasure) -> Array:
    """Give the dissimilarity (*batch,) of images (*batch, n, 2), metres, after the best turn in the plane.

    Cartesian: the mean distance of the joints, metres; shape context: between 0 and 1.
    """
    if measure is ImageMeasure.SHAPE_CONTEXT:
        return plane_shape_dissimilarity(moving, fixed)
    return np.asarray(np.linalg.norm(align_plane(moving, fixed) - fixed, axis=-1).mean(axis=-1))


def matched_scale(pairs: AnnotatedPairs, measure: ImageMeasure) -> float:
    """Give the factor that makes nearest annotations as far apart as in d_I, in the median over 60 evenly spread ones.

    The nearest is the one with the least rigid residual among those whose view is within half a radian; 1 when there
    are no neighbours or they coincide.
    """
    points = pairs.points_m.reshape(len(pairs.points_m), -1, 2)
    interaction, own = [], []
    for row in np.unique(np.linspace(0, len(points) - 1, _NUM_MATCHED).round().astype(int)):
        is_near = angle_between_directions(pairs.directions[row], pairs.directions) < 0.5
        others = np.flatnonzero(is_near & (pairs.annotation_index != pairs.annotation_index[row]))
        if not len(others):
            continue
        nearest = points[others[int(np.argmin(plane_residual(points[row], points[others])))]]
        interaction.append(interaction_dissimilarity(points[row], nearest))
        own.append(float(image_dissimilarity(points[row], nearest, measure)))
    median = float(np.median(own)) if own else 0.0
    return float(np.median(interaction)) / median if median > 0.0 else 1.0


class MeasuredLikelihood:
    """Eqs. 6 and 9 (Yin et al. 2018) over a fixed bank with another dissimilarity, as compiled kernels.

    Args:
        pairs: Annotated pairs.
        bank: Views and their candidates.
        measure: The dissimilarity.
        sigma_l: Bandwidth; 2 sigma_l^2 is in metres of d_I, to which the dissimilarity is scaled.
        num_ranked: Shape contexts of a view that are compared, nearest by rigid residual; Cartesian distances are all.

    Raises:
        InputError: `sigma_l` or `num_ranked` is not positive.
    """

    def __init__(
        self,
        pairs: AnnotatedPairs,
        bank: ViewBank,
        measure: ImageMeasure,
        *,
        sigma_l: float = 0.01,
        num_ranked: int = 32,
    ) -> None:
        if not sigma_l > 0.0 or num_ranked < 1:
            raise InputError(f"sigma_l and num_ranked must be positive, found {sigma_l} and {num_ranked}")
        self.measure = measure
        self.scale = matched_scale(pairs, measure)
        self._exponent = self.scale / (2.0 * sigma_l**2)
        self._num_ranked = num_ranked
        self._bank = bank
        used = np.unique(bank.candidates[bank.candidates >= 0])
        points = pairs.points_m[used].reshape(len(used), -1, 2)
        self._used = used
        self._points = np.ascontiguousarray(points - points.mean(axis=1, keepdims=True))
        self._slots = np.searchsorted(used, np.maximum(bank.candidates, used[0]))
        self._counts = (
            _histograms(self._points) if measure is ImageMeasure.SHAPE_CONTEXT else np.zeros((0, 0, 0), np.uint8)
        )
        self._best = np.empty(len(bank.directions))
        self._slot = np.empty(len(bank.directions), dtype=np.int64)

    def match(self, pair_m: Array, *, at_least: float = -np.inf) -> Match:
        """Give the log likelihood of a pair (2, 17, 3), metres; -inf when it lies below `at_least`.

        The least dissimilarities of the views are in metres, scaled to d_I.
        """
        self._search(pair_m)
        least = float(self._best.min())
        log_likelihood = -np.inf
        if np.isfinite(least):
            mean = np.mean(np.exp(-(self._best - least) * self._exponent))
            log_likelihood = float(np.log(mean) - least * self._exponent)
        entry = np.where(self._slot >= 0, self._used[np.maximum(self._slot, 0)], -1)
        return Match(
            log_likelihood=log_likelihood if log_likelihood >= at_least else -np.inf,
            dissimilarity_m=self._best * self.scale,
            entry=entry,
        )

    def nearest(self, pair_m: Array) -> npt.NDArray[np.int64]:
        """Give the entry nearest to the pair (2, 17, 3) under every view, (m,); -1 for a view without any."""
        return self.match(pair_m).entry

    def _search(self, pair_m: Array) -> None:
        """Fill the least dissimilarity of each view and who has it."""
        images = project_pair(pair_m, self._bank.directions).reshape(len(self._best), -1, 2)
        images = np.ascontiguousarray(images - images.mean(axis=1, keepdims=True))
        if self.measure is ImageMeasure.CARTESIAN:
            _best_cartesian(images, self._bank.counts, self._slots, self._points, self._best, self._slot)
        else:
            _best_shape(
                images,
                self._bank.counts,
                self._slots,
                self._points,
                self._counts,
                self._num_ranked,
                self._best,
                self._slot,
            )

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Give the log likelihood alone."""
        return self.match(pair_m, at_least=at_least).log_likelihood


def _histograms(points: Array) -> npt.NDArray[np.uint8]:
    """Give how many other joints fall into each bin, (entry, n, bin)."""
    counts = np.zeros((len(points), points.shape[1], _NUM_BINS), dtype=np.uint8)
    for entry in range(len(points)):
        _fill_histograms(points[entry], counts[entry])
    return counts


@numba.njit(cache=True, nogil=True)
def _shell(dx, dy):  # type: ignore[no-untyped-def]
    radius = max(np.sqrt(dx * dx + dy * dy), 1e-12)
    return min(max(int(np.floor(np.log2(radius / INNER_RADIUS_M))) + 1, 0), NUM_SHELLS - 1)


@numba.njit(cache=True, nogil=True)
def _fill_histograms(points, counts):  # type: ignore[no-untyped-def]
    """Count the bins of points (n, 2); `counts` (n, bin) is overwritten."""
    counts[:] = 0
    for i in range(points.shape[0]):
        for j in range(points.shape[0]):
            if i != j:
                dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                share = np.arctan2(dy, dx) / (2.0 * np.pi) % 1.0
                counts[i, _shell(dx, dy) * NUM_SECTORS + min(int(share * NUM_SECTORS), NUM_SECTORS - 1)] += 1


@numba.njit(cache=True, nogil=True)
def _best_cartesian(images, counts, slots, points, best, best_slot):  # type: ignore[no-untyped-def]
    """Write the least mean joint distance of each view and the slot that has it."""
    num_points = images.shape[1]
    for view in range(images.shape[0]):
        best[view], best_slot[view] = np.inf, -1
        moving = images[view]
        for at in range(counts[view]):
            slot = slots[view, at]
            fixed = points[slot]
            cosine, sine = _turn(moving, fixed)
            limit = best[view] * num_points
            total = 0.0
            for k in range(num_points):
                dx = cosine * moving[k, 0] - sine * moving[k, 1] - fixed[k, 0]
                dy = sine * moving[k, 0] + cosine * moving[k, 1] - fixed[k, 1]
                total += np.sqrt(dx * dx + dy * dy)
                if total >= limit:
                    break
            if total < limit:
                best[view], best_slot[view] = total / num_points, slot


@numba.njit(cache=True, nogil=True)
def _turn(moving, fixed):  # type: ignore[no-untyped-def]
    dot = cross = 0.0
    for k in range(moving.shape[0]):
        dot += moving[k, 0] * fixed[k, 0] + moving[k, 1] * fixed[k, 1]
        cross += moving[k, 0] * fixed[k, 1] - moving[k, 1] * fixed[k, 0]
    length = np.sqrt(dot * dot + cross * cross)
    if length > 1e-300:
        return dot / length, cross / length
    return 1.0, 0.0


@numba.njit(cache=True, nogil=True)
def _best_shape(images, counts, slots, points, histograms, num_ranked, best, best_slot):  # type: ignore[no-untyped-def]
    """Write the least shape-context cost of each view among the candidates nearest by rigid residual."""
    num_points = histograms.shape[1]
    own = np.zeros(histograms.shape[2], dtype=np.int64)
    shells = np.zeros((num_points, num_points), dtype=np.int64)
    shares = np.zeros((num_points, num_points))
    bins = np.empty(num_points, dtype=np.int64)
    for view in range(images.shape[0]):
        best[view], best_slot[view] = np.inf, -1
        moving = images[view]
        for i in range(num_points):
            for j in range(num_points):
                dx, dy = moving[j, 0] - moving[i, 0], moving[j, 1] - moving[i, 1]
                shells[i, j] = NUM_SECTORS * _shell(dx, dy)
                shares[i, j] = np.arctan2(dy, dx) / (2.0 * np.pi)
        residual = np.empty(counts[view])
        for at in range(counts[view]):
            fixed = points[slots[view, at]]
            dot = cross = squares = 0.0
            for k in range(num_points):
                dot += moving[k, 0] * fixed[k, 0] + moving[k, 1] * fixed[k, 1]
                cross += moving[k, 0] * fixed[k, 1] - moving[k, 1] * fixed[k, 0]
                squares += fixed[k, 0] ** 2 + fixed[k, 1] ** 2
            residual[at] = squares - 2.0 * np.sqrt(dot * dot + cross * cross)
        order = np.argsort(residual)
        for rank in range(min(num_ranked, counts[view])):
            slot = slots[view, order[rank]]
            cosine, sine = _turn(moving, points[slot])
            turn = np.arctan2(sine, cosine) / (2.0 * np.pi)
            limit = best[view] * num_points
            cost = 0.0
            for i in range(num_points):
                for j in range(num_points):
                    if i != j:
                        share = (shares[i, j] + turn) % 1.0
                        bins[j] = shells[i, j] + min(int(share * NUM_SECTORS), NUM_SECTORS - 1)
                        own[bins[j]] += 1
                shared = 0.0
                for j in range(num_points):
                    # A bin is counted at its first joint and emptied, ready for the next.
                    if i != j and own[bins[j]]:
                        one, two = own[bins[j]], histograms[slot, i, bins[j]]
                        shared += 2.0 * one * two / (one + two)
                        own[bins[j]] = 0
                cost += 1.0 - shared / (num_points - 1)
                if cost >= limit:
                    break
            cost /= num_points
            if cost < best[view]:
                best[view], best_slot[view] = cost, slot
