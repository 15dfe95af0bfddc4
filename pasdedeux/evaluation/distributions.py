"""Distances between two sets of features: kernel and Fréchet distance, density and coverage, and their chance level.

On few clips the Fréchet distance is mostly bias, so the unbiased kernel distance comes first, and every figure is
compared with that of two halves of the real clips.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.scores import FEWEST_UNITS

KID_FACTOR = 1000.0
"""Factor on reported kernel distances."""
_NEIGHBOURS = 5
_NORMAL_95 = 1.96


def frechet_distance(left: Array, right: Array) -> float:
    """Return |m - n|^2 + tr(S + R - 2 (S R)^1/2) of features (n, d) and (m, d) taken for normal (Heusel et al. 2017).

    The sets need more than d members for covariances of full rank; d is at most 32 here.
    """
    between = float(((left.mean(axis=0) - right.mean(axis=0)) ** 2).sum())
    first, second = (np.atleast_2d(np.cov(features, rowvar=False)) for features in (left, right))
    values, vectors = np.linalg.eigh(first)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    mixed = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ second @ root), 0.0)).sum()
    return between + float(np.trace(first) + np.trace(second) - 2.0 * mixed)


def kernel_distance(first: Array, other: Array) -> float:
    """Return the unbiased squared maximum mean discrepancy with kernel (x y / d + 1)^3 (Binkowski et al. 2018).

    Its mean over draws from the same distribution is 0, so it may be negative.  Each set needs two members.
    """
    within = [
        (matrix.sum() - np.trace(matrix)) / (len(features) * (len(features) - 1))
        for features in (first, other)
        for matrix in (_kernel(features, features),)
    ]
    return float(sum(within) - 2.0 * _kernel(first, other).mean())


def _kernel(left: Array, right: Array) -> Array:
    return np.asarray((left @ right.T / left.shape[1] + 1.0) ** 3)


def kernel_interval(
    left: Array, right: Array, left_units: Sequence[str], right_units: Sequence[str]
) -> tuple[float, float]:
    """Return ends of a 95 % interval of `kernel_distance`, by the jackknife over units; NaN of fewer than 5 of either.

    Features of one unit, such as a variant, leave the sample together (Quenouille 1956, Arvesen 1969 for two samples);
    a bootstrap would pair clips with themselves, which the distance leaves out.
    """
    if min(len(set(left_units)), len(set(right_units))) < FEWEST_UNITS:
        return float("nan"), float("nan")
    # Terms within the other set do not depend on the omitted unit, so they are no part of the variance.
    variance = _jackknife_variance(left, right, left_units) + _jackknife_variance(right, left, right_units)
    middle, reach = kernel_distance(left, right), _NORMAL_95 * float(np.sqrt(variance))
    return middle - reach, middle + reach


def _jackknife_variance(features: Array, other: Array, units: Sequence[str]) -> float:
    """Return the jackknife variance of the kernel distance over units of `features`, from sums over pairs made once."""
    unit = np.unique(np.asarray(units), return_inverse=True)[1]
    is_of = np.eye(unit.max() + 1)[unit]
    pairs = _kernel(features, features)
    np.fill_diagonal(pairs, 0.0)
    of_unit = pairs @ is_of
    left = len(features) - is_of.sum(axis=0)
    within = pairs.sum() - 2.0 * of_unit.sum(axis=0) + (is_of * of_unit).sum(axis=0)
    across = _kernel(features, other).mean(axis=1)
    values = within / (left * (left - 1)) - 2.0 * (across.sum() - across @ is_of) / left
    return float((len(left) - 1) * values.var())


def density_coverage(real: Array, made: Array) -> tuple[float, float]:
    """Return density and coverage of features (m, d) among real ones (n, d), by the 5 nearest (Naeem et al. 2020).

    Density is the mean number of real neighbourhoods around a generated feature, over 5, about 1 for draws of the same
    distribution; coverage is the share of real neighbourhoods that contain a generated one.
    """
    from scipy.spatial.distance import cdist  # here: planning need not wait for it

    reach = np.sort(cdist(real, real), axis=1)[:, min(_NEIGHBOURS, len(real) - 1)]
    is_within = cdist(real, made) < reach[:, None]
    return float(is_within.sum(axis=0).mean() / _NEIGHBOURS), float(is_within.any(axis=1).mean())


def mean_distance(features: Array) -> float:
    """Return the mean distance of two of some features (n, d): their diversity; NaN of fewer than two.

    >>> mean_distance(np.array([[0.0], [1.0], [3.0]]))
    2.0
    """
    from scipy.spatial.distance import pdist  # here: planning need not wait for it

    return float(pdist(features).mean()) if len(features) > 1 else float("nan")


def halves(strata: Sequence[tuple[str, ...]], generator: np.random.Generator) -> tuple[list[int], list[int]]:
    """Split the indices of n items into two halves that have the same share of each stratum.

    Purely random halves would differ more in their interactions than models do.

    >>> halves([("hug", "a"), ("hug", "a"), ("judo", "b"), ("judo", "c")], np.random.default_rng(0))
    ([0, 2], [1, 3])
    """
    dealt = sorted(generator.permutation(len(strata)).tolist(), key=lambda at: strata[at])
    return dealt[::2], dealt[1::2]


def distances(real: Array, made: Array) -> dict[str, float]:
    """Return kernel distance (times 1000), Fréchet distance, density and coverage by name."""
    density, coverage = density_coverage(real, made)
    return {
        "KID": KID_FACTOR * kernel_distance(real, made),
        "FID": frechet_distance(real, made),
        "density": density,
        "coverage": coverage,
    }
