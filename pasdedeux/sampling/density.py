"""The density that chains sample: prior times likelihood, truncated round the seed (Yin et al. 2018, eqs. 1 and 11)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior, PriorTerms

__all__ = ["Evaluation", "Likelihood", "PairDensity"]

Array = npt.NDArray[np.float64]


class Likelihood(Protocol):
    """The log of a likelihood that never exceeds 1 and does not change when the pair moves rigidly."""

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return it for a pair (2, 17, 3), metres; -inf as soon as it is known to lie below `at_least`."""
        ...


@dataclass(frozen=True)
class Evaluation:
    """A density at one point, logs up to a constant.

    Args:
        log_density: The target, truncated; -inf outside, or once known to lie below the floor asked for.
        log_prior: Log of eq. 2; NaN when a density has none.
        log_likelihood: Log of eq. 6; 0 for a density without likelihood, NaN when it was not needed.
    """

    log_density: float
    log_prior: float = float("nan")
    log_likelihood: float = float("nan")


class PairDensity:
    """The truncated density round one seed.

    With f0 the seed's density and c the truncation, the target is 0 below f0 / c, f between, and c f0 above (eq. 11).
    The target does not change when the pair moves rigidly.

    Args:
        chart: Parameters round the seed.
        prior: Physical prior.
        likelihood: Likelihood; None samples the prior alone.
        truncation: c of eq. 11, above 1; inf leaves the density as it is.
        log_left_out: Log likelihood of a real pair that is not annotated (`reference`): a second f0, with the seed's
            prior.  The target is 0 below the lesser f0 / c and flat above c times the greater: from a seed that is
            annotated worse than real pairs are, a chain may climb to where they are; one that is annotated better may
            go down to them.  None refers to the seed alone.

    Raises:
        InputError: The seed's density is 0, with the term that made it so, or `truncation` is not above 1.
    """

    def __init__(
        self,
        chart: PairChart,
        prior: PhysicalPrior,
        likelihood: Likelihood | None,
        *,
        truncation: float = 100.0,
        log_left_out: float | None = None,
    ) -> None:
        if not truncation > 1.0:
            raise InputError(f"the truncation c must be above 1, found {truncation:g}")
        self.chart = chart
        self._prior = prior
        self._likelihood = likelihood
        seed = chart.seed_parameters()
        pair_m = chart.positions_fast(seed)
        terms = prior.terms(seed, pair_m)
        log_likelihood = 0.0 if likelihood is None else likelihood.log_likelihood(pair_m)
        self.log_seed = terms.log_prior + log_likelihood
        """Log of the seed's density before truncation."""
        if not np.isfinite(self.log_seed):
            raise InputError(_why_zero(terms, prior, log_likelihood))
        window = float(np.log(truncation))
        second = self.log_seed if log_left_out is None else terms.log_prior + log_left_out
        self.log_floor = min(self.log_seed, second) - window
        """Log density below which the target is 0."""
        self.log_ceiling = max(self.log_seed, second) + window
        """Log density above which the target is flat."""
        self.seed_evaluation = Evaluation(self.log_seed, terms.log_prior, log_likelihood)

    def __call__(self, parameters: Array, at_least: float = -np.inf) -> Evaluation:
        """Return the target at parameters (108,); work ends as soon as it is known to lie below `at_least`.

        The result decides any comparison with `at_least` as the full density would.
        """
        floor = max(at_least, self.log_floor)
        pair_m = self.chart.positions_fast(parameters)
        log_prior = self._prior.terms(parameters, pair_m).log_prior
        # No likelihood exceeds 1, so its log is at most 0.
        if log_prior < floor:
            return Evaluation(-np.inf, log_prior)
        log_likelihood = 0.0
        if self._likelihood is not None:
            log_likelihood = self._likelihood.log_likelihood(pair_m, at_least=floor - log_prior)
        total = log_prior + log_likelihood
        if total < floor:
            return Evaluation(-np.inf, log_prior, log_likelihood)
        return Evaluation(min(total, self.log_ceiling), log_prior, log_likelihood)


def _why_zero(terms: PriorTerms, prior: PhysicalPrior, log_likelihood: float) -> str:
    if terms.num_invalid > prior.most_invalid:
        return (
            f"the seed has density 0: the prior found {terms.num_invalid} joint angles out of range, "
            f"{terms.num_invalid - prior.most_invalid} more than the {prior.most_invalid} allowed "
            f"(the nearest valid poses are {100 * terms.limit_distance_m:.1f} cm away)"
        )
    if not np.isfinite(terms.log_prior):
        return "the seed has density 0: the prior is 0 although joint limits and bone lengths are met"
    return (
        f"the seed has density 0: the likelihood is {np.exp(log_likelihood):g}, "
        "no view of the bank has an annotation to compare with"
    )
