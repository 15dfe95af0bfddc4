"""Definition of a density: an `init` that makes a likelihood from settings and annotated pairs.

`PairDensity` is prior times likelihood round one seed (Yin et al. 2018, eq. 1), as it is or truncated (eq. 11): what
chains sample.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior, PriorSettings, PriorTerms
from pasdedeux.skeletons import PAIR17

PRIOR_ONLY = "prior_only"
"""The density without annotations, with which others are compared."""


@dataclass(frozen=True)
class Nearest:
    """The annotations that are nearest to a pair.

    Args:
        entry: Entry nearest under each view, (view,); -1 for a view without any.
        dissimilarity_m: Its dissimilarity, (view,), metres; inf without any.
    """

    entry: npt.NDArray[np.int64]
    dissimilarity_m: Array


class Likelihood(ABC):
    """The factor of a density besides the prior: a fixed function of the pair that never exceeds 1.

    It does not change when the pair moves rigidly, is finite on real pairs, and equals its plain form.  One that
    compares a pair with annotations also states its bandwidth, its views and the nearest annotations, which draws are
    stored with and the velocity-biased proposal needs.
    """

    sigma_l: float | None = None
    """Its bandwidth (eq. 9); None without annotations."""
    directions: Array = np.empty((0, 3))
    """Its views in the pair's local frame, (view, 3)."""

    @abstractmethod
    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return the log likelihood of a pair (2, 17, 3), metres; -inf once it is known to be below `at_least`."""

    @abstractmethod
    def plain(self, pair_m: Array) -> float:
        """Compute the same by definition, slowly, as a reference for tests and benchmarks."""

    def nearest(self, pair_m: Array) -> Nearest:
        """Return the annotation nearest to a pair (2, 17, 3), metres, under every view, even a negligible one."""
        return Nearest(np.empty(0, dtype=np.int64), np.empty(0))


MAX_APART_M = 2.0
"""Greatest distance of the mid-hips of the two, metres, or the seed's where that is more: the terms of eq. 2 do not
bound it, so the prior alone would have no integral."""


class TargetSettings(PriorSettings):
    """Settings of every density: the physical prior, and its reach around the seed."""

    truncation: Annotated[float, Field(gt=1)] | Literal["none"] = Field(
        default="none",
        description="c of eq. 11: the density is cut below f0 / c and above c f0, f0 the seed's (published: 100); "
        "none: it is sampled as it is",
    )


_DEFAULT_TARGET = TargetSettings()


@dataclass(frozen=True)
class Evaluation:
    """A density at one point, logs up to a constant.

    Args:
        log_density: The density over poses, truncated; -inf outside, or once known to lie below the floor asked for.
        log_prior: Log of eq. 2; NaN when a density has none.
        log_likelihood: Log of eq. 6; 0 for a density without likelihood, NaN when it was not needed.
        log_measure: Log of the volume of poses per volume of parameters; 0 where parameters are the poses.
    """

    log_density: float
    log_prior: float = float("nan")
    log_likelihood: float = float("nan")
    log_measure: float = 0.0

    @property
    def log_target(self) -> float:
        """Log of the density over the parameters, which a chain compares."""
        return self.log_density + self.log_measure


class PairDensity:
    """The density round one seed.

    With f0 the seed's density and c the truncation, the target is 0 below f0 / c, f between, and c f0 above (eq. 11). A
    window around one pose would cut off most of the mass of a density of so many dimensions: log f of its draws varies
    by tens, and a seed may lie anywhere in that range.  It is a density over poses, flat in the directions of bones
    without evidence; `PairChart.log_measure` converts it to one over the parameters.  The target does not change when
    the pair moves rigidly.

    Args:
        chart: Parameters round the seed.
        prior: Physical prior.
        likelihood: Likelihood.
        settings: Its reach around the seed; by default that of studies.

    Raises:
        InputError: The seed's density is 0, with the term that made it so.
    """

    def __init__(
        self,
        chart: PairChart,
        prior: PhysicalPrior,
        likelihood: Likelihood,
        settings: TargetSettings = _DEFAULT_TARGET,
    ) -> None:
        self.chart = chart
        self._prior = prior
        self._likelihood = likelihood
        seed = chart.seed_parameters()
        pair_m = chart.positions(seed)
        self._max_apart_m = max(MAX_APART_M, _apart_m(pair_m))
        terms = prior.terms(seed, pair_m)
        log_likelihood = likelihood.log_likelihood(pair_m)
        self.log_seed = terms.log_prior + log_likelihood
        """Log of the seed's density before truncation."""
        if not np.isfinite(self.log_seed):
            raise InputError(_why_zero(terms, prior, log_likelihood))
        window = math.inf if isinstance(settings.truncation, str) else math.log(settings.truncation)
        self.log_floor = self.log_seed - window
        """Log density below which the target is 0."""
        self.log_ceiling = self.log_seed + window
        """Log density above which the target is flat."""
        self.seed_evaluation = Evaluation(self.log_seed, terms.log_prior, log_likelihood)

    def __call__(self, parameters: Array, at_least: float = -np.inf) -> Evaluation:
        """Return the target at parameters (108,), stopping once it is known to lie below `at_least`.

        The result decides any comparison of `log_target` with `at_least` as the full density would.
        """
        log_measure = self.chart.log_measure(parameters)
        if log_measure == -np.inf:
            return Evaluation(-np.inf, log_measure=log_measure)
        floor = max(at_least - log_measure, self.log_floor)
        pair_m = self.chart.positions(parameters)
        if _apart_m(pair_m) > self._max_apart_m:
            return Evaluation(-np.inf, log_measure=log_measure)
        log_prior = self._prior.terms(parameters, pair_m).log_prior
        # No likelihood exceeds 1, so its log is at most 0.
        if log_prior < floor:
            return Evaluation(-np.inf, log_prior, log_measure=log_measure)
        log_likelihood = self._likelihood.log_likelihood(pair_m, at_least=floor - log_prior)
        total = log_prior + log_likelihood
        if total < floor:
            return Evaluation(-np.inf, log_prior, log_likelihood, log_measure)
        return Evaluation(min(total, self.log_ceiling), log_prior, log_likelihood, log_measure)


def _apart_m(pair_m: Array) -> float:
    """Return the distance of the mid-hips of a pair (2, 17, 3)."""
    x, y, z = pair_m[1, PAIR17.root] - pair_m[0, PAIR17.root]
    return math.sqrt(x * x + y * y + z * z)


def _why_zero(terms: PriorTerms, prior: PhysicalPrior, log_likelihood: float) -> str:
    allowed = prior.settings.max_invalid_angles
    if terms.num_invalid > allowed:
        return (
            f"the seed has density 0: the prior found {terms.num_invalid} joint angles out of range, "
            f"{terms.num_invalid - allowed} more than the {allowed} allowed "
            f"(the nearest valid poses are {100 * terms.limit_distance_m:.1f} cm away)"
        )
    if not np.isfinite(terms.log_prior):
        return "the seed has density 0: the prior is 0 although joint limits and bone lengths are met"
    return (
        f"the seed has density 0: the likelihood is {np.exp(log_likelihood):g}, "
        "no view of the bank has an annotation to compare with"
    )


@dataclass(frozen=True)
class Density:
    """A density that a study may choose by its name.

    Args:
        name: Name in `chains.densities` and of the draws.
        meaning: A few words for people.
        init: Makes its likelihood near one seed from `AnnotationSettings`, a generator for values drawn once and then
            fixed, and the annotated pairs with their views; raises an InputError that names missing data.
        reads_annotations: Whether it needs annotations; without, `init` is given None for them and their settings.
    """

    name: str
    meaning: str
    init: Callable[..., Likelihood]
    reads_annotations: bool = False


class PriorOnly(Likelihood):
    """No likelihood: the physical prior only."""

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return 0."""
        return 0.0

    def plain(self, pair_m: Array) -> float:
        """Return 0."""
        return 0.0


PRIOR_ONLY_DENSITY = Density(PRIOR_ONLY, "the physical prior alone", lambda *_: PriorOnly())
