"""The density that chains sample: prior times likelihood (Yin et al. 2018, eq. 1), as it is or truncated (eq. 11)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, ClassVar, Final, Generic, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs, ViewBank, build_bank
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior, PriorSettings, PriorTerms
from pasdedeux.settings import Settings
from pasdedeux.skeletons import PAIR17

LEFT_OUT: Final = "left_out"
"""The bandwidth that annotations left out in turn ask for (`pasdedeux.sampling.bandwidth`)."""
PRIOR_ONLY = "prior_only"
"""The density that knows no annotation: what others are compared with."""


class Likelihood(Protocol):
    """The log of a likelihood that never exceeds 1 and does not change when the pair moves rigidly."""

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return it for a pair (2, 17, 3), metres; -inf as soon as it is known to lie below `at_least`."""
        ...

    def plain(self, pair_m: Array) -> float:
        """Return the same by its definition, slowly: what tests and benchmarks compare with."""
        ...


@dataclass(frozen=True)
class Match:
    """How well a pair agrees with the annotations.

    Args:
        log_likelihood: Log of eq. 6, -inf when it was found to lie below the floor asked for.
        dissimilarity_m: Least d_I of each view, (m,), metres; inf where it cannot matter to the result.
        entry: Entry that reached it, (m,); -1 where none did.
    """

    log_likelihood: float
    dissimilarity_m: Array
    entry: npt.NDArray[np.int64]


@runtime_checkable
class ImageLikelihood(Likelihood, Protocol):
    """A likelihood that compares projections of the pair with annotations."""

    sigma_l: float
    """Its bandwidth (eq. 9)."""
    directions: Array
    """Its views in the pair's local frame, (view, 3)."""

    def match(self, pair_m: Array, *, at_least: float = -np.inf) -> Match:
        """Return the log likelihood of a pair (2, 17, 3), metres, with what is nearest to it under the views."""
        ...

    def nearest(self, pair_m: Array) -> npt.NDArray[np.int64]:
        """Return the entry nearest to the pair (2, 17, 3) under every view, (view,); -1 for a view without any."""
        ...


MAX_APART_M = 2.0
"""Greatest distance of the mid-hips of the two, metres, or the seed's where that is more: the terms of eq. 2 do not
bound it, so the prior alone would have no integral."""
_SIGMA_V_RAD = 0.5
"""Bandwidth of the view density, radians (Yin et al. 2018, eq. 5)."""


class TargetSettings(PriorSettings):
    """What every density is made with: the physical prior, and how far round the seed it reaches."""

    truncation: Annotated[float, Field(gt=1)] | Literal["none"] = Field(
        default="none",
        description="c of eq. 11: the density is cut below f0 / c and above c f0, f0 the seed's (published: 100); "
        "none: it is sampled as it is",
    )


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
        """Log of the density over the parameters: what a chain compares."""
        return self.log_density + self.log_measure


class PairDensity:
    """The density round one seed.

    With f0 the seed's density and c the truncation, the target is 0 below f0 / c, f between, and c f0 above (eq. 11).
    A window round one pose cuts off what a density of so many dimensions has its mass in: log f of its draws varies by
    tens, and a seed may lie anywhere in that.  It is a density over poses, flat in the directions of bones where
    nothing is known; `PairChart.log_measure` makes it one over the parameters.  The target does not change when the
    pair moves rigidly.

    Args:
        chart: Parameters round the seed.
        prior: Physical prior.
        likelihood: Likelihood; None samples the prior alone.
        settings: How far round the seed it reaches; that of studies by default.
        max_apart_m: Greatest distance of the mid-hips, metres, or the seed's where that is more.

    Raises:
        InputError: The seed's density is 0, with the term that made it so.
    """

    def __init__(
        self,
        chart: PairChart,
        prior: PhysicalPrior,
        likelihood: Likelihood | None,
        settings: TargetSettings | None = None,
        *,
        max_apart_m: float = MAX_APART_M,
    ) -> None:
        settings = settings or TargetSettings()
        self.chart = chart
        self._prior = prior
        self._likelihood = likelihood
        seed = chart.seed_parameters()
        pair_m = chart.positions_fast(seed)
        self._max_apart_m = max(max_apart_m, _apart_m(pair_m))
        terms = prior.terms(seed, pair_m)
        log_likelihood = 0.0 if likelihood is None else likelihood.log_likelihood(pair_m)
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
        """Return the target at parameters (108,); work ends as soon as it is known to lie below `at_least`.

        The result decides any comparison of `log_target` with `at_least` as the full density would.
        """
        log_measure = self.chart.log_measure(parameters)
        if log_measure == -np.inf:
            return Evaluation(-np.inf, log_measure=log_measure)
        floor = max(at_least - log_measure, self.log_floor)
        pair_m = self.chart.positions_fast(parameters)
        if _apart_m(pair_m) > self._max_apart_m:
            return Evaluation(-np.inf, log_measure=log_measure)
        log_prior = self._prior.terms(parameters, pair_m).log_prior
        # No likelihood exceeds 1, so its log is at most 0.
        if log_prior < floor:
            return Evaluation(-np.inf, log_prior, log_measure=log_measure)
        log_likelihood = 0.0
        if self._likelihood is not None:
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


class Reads(StrEnum):
    """What a density reads beside a seed and joint limits; what reads annotations has `ImageSettings`."""

    NOTHING = "nothing"
    ANNOTATIONS = "annotations and their views"


@dataclass(frozen=True)
class DensityInputs:
    """What a density may be made from.

    Args:
        seed_m: The seed (person=2, joint=17, 3), metres.
        rng: Draws what the density fixes once for its seed.
        annotated: Annotated pairs with their views; None for a density that does not read them.
    """

    seed_m: Array
    rng: np.random.Generator
    annotated: GatheredPairs | None = None


S = TypeVar("S", bound=Settings)


class DensityKind(ABC, Generic[S]):
    """A density that a study may choose by its name.

    Its likelihood is finite on real pairs, at most 1, invariant to rigid motion of the pair, and equal to its plain
    form.
    """

    name: ClassVar[str]
    """Name in `chains.densities`, and of the draws."""
    meaning: ClassVar[str]
    """A few words for people."""
    reads: ClassVar[Reads] = Reads.NOTHING
    settings: type[S]
    """Its settings; they stand in the section `chains` beside those of the other kinds."""

    @abstractmethod
    def likelihood(self, settings: S, inputs: DensityInputs) -> Likelihood | None:
        """Return the likelihood near one seed; None for the prior alone.

        Raises:
            InputError: The inputs do not suffice, with what is missing.
        """

    def prior(self, settings: TargetSettings) -> PriorSettings:
        """Return the settings of the prior that goes with the likelihood, from those of the study."""
        return settings

    def target(
        self,
        chart: PairChart,
        limits: JointLimits,
        likelihood: Likelihood | None,
        settings: TargetSettings,
    ) -> PairDensity:
        """Return the density round one seed.

        Raises:
            InputError: The seed has density 0, with the term that made it so.
        """
        return PairDensity(chart, PhysicalPrior(chart, limits, self.prior(settings)), likelihood, settings)


class PriorOnlyKind(DensityKind[Settings]):
    """The physical prior alone."""

    name = PRIOR_ONLY
    meaning = "the physical prior alone"
    settings = Settings

    def likelihood(self, settings: Settings, inputs: DensityInputs) -> None:
        """Return nothing."""
        return


class Pooling(StrEnum):
    """How what the views of a pair say is pooled."""

    EVERY_VIEW = "every_view"
    """The mean of their logarithms: a pair must look like annotations from everywhere."""
    MEAN = "mean"
    """The mean of their likelihoods, as published (eq. 6): one good view is enough."""


class ImageSettings(Settings):
    """Which annotations a pair is compared with, and how sharply (Yin et al. 2018, eqs. 6 and 9)."""

    num_views: int = Field(default=20, ge=1, le=1000, description="Views of the fixed bank of each seed (m of eq. 6)")
    num_candidates: int = Field(default=500, ge=1, description="Annotations compared with each view, nearest by view")
    sigma_l: Annotated[float, Field(gt=0)] | Literal["left_out"] = Field(
        default=LEFT_OUT,
        description="Bandwidth of the likelihood, 2 sigma_l^2 in metres (eq. 9; published: 0.01); left_out: where "
        "annotations that are left out in turn are likeliest",
    )
    pooling: Pooling = Field(
        default=Pooling.EVERY_VIEW,
        description="What the views of a pair say together: every_view, the mean of their logarithms, or mean, that of "
        "their likelihoods, as published (eq. 6)",
    )


I = TypeVar("I", bound=ImageSettings)  # noqa: E741


class ImageKind(DensityKind[I]):
    """A density that compares projections of a pair with annotations: eqs. 6 and 9 with some dissimilarity."""

    reads = Reads.ANNOTATIONS

    def likelihood(self, settings: I, inputs: DensityInputs) -> ImageLikelihood:
        """Return the likelihood over a bank of views that are drawn once from the view density (eq. 5)."""
        assert inputs.annotated is not None
        views = inputs.annotated.view_density(deviation_rad=_SIGMA_V_RAD)
        bank = build_bank(
            views.sample(inputs.rng, settings.num_views),
            inputs.annotated.pairs,
            num_candidates=settings.num_candidates,
            view_bandwidth_rad=_SIGMA_V_RAD,
        )
        sigma_l = inputs.annotated.left_out.sigma_l if isinstance(settings.sigma_l, str) else settings.sigma_l
        return self.compare(settings, inputs.annotated.pairs, bank, sigma_l)

    @abstractmethod
    def compare(self, settings: I, pairs: AnnotatedPairs, bank: ViewBank, sigma_l: float) -> ImageLikelihood:
        """Return the likelihood of a bandwidth over a bank of views."""
