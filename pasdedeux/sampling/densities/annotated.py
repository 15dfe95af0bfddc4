"""Settings shared by densities of annotations: views, bandwidth and pooling (Yin et al. 2018, eqs. 5, 6 and 9)."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.cameras.view_density import draw_views
from pasdedeux.sampling.annotations import GatheredPairs, ViewBank, build_bank
from pasdedeux.settings import Settings


class Pooling(StrEnum):
    """How the views of a pair are pooled."""

    EVERY_VIEW = "every_view"
    """The mean of their logarithms: a pair must look like annotations from everywhere."""
    MEAN = "mean"
    """The mean of their likelihoods, as published (eq. 6): one good view is enough."""

    def log_of(self, dissimilarity_m: Array, sigma_l: float) -> float:
        """Return the log of the pooled likelihood of the smallest dissimilarity of each view; inf where it has none."""
        smallest = float(dissimilarity_m.min())
        if not np.isfinite(smallest):
            return -np.inf
        scale = 2.0 * sigma_l**2
        if self is Pooling.EVERY_VIEW:
            return float(-dissimilarity_m[np.isfinite(dissimilarity_m)].mean() / scale)
        return float(np.log(np.mean(np.exp(-(dissimilarity_m - smallest) / scale))) - smallest / scale)


class AnnotationSettings(Settings):
    """The annotations compared with a pair, and the bandwidth (Yin et al. 2018, eqs. 6 and 9)."""

    num_views: int = Field(default=20, ge=1, le=1000, description="Views of the fixed bank of each seed (m of eq. 6)")
    num_candidates: int = Field(default=500, ge=1, description="Annotations compared with each view, nearest by view")
    sigma_l: Annotated[float, Field(gt=0)] | Literal["leave_one_out"] = Field(
        default="leave_one_out",
        description="Bandwidth of the likelihood, 2 sigma_l^2 in metres (eq. 9; published: 0.01); leave_one_out: the "
        "one under which each annotation is likeliest given the others",
    )
    pooling: Pooling = Field(
        default=Pooling.EVERY_VIEW,
        description="How views are pooled: every_view, the mean of their logarithms, or mean, that of their "
        "likelihoods, as published (eq. 6)",
    )

    def bandwidth(self, annotated: GatheredPairs) -> float:
        """Return sigma_l."""
        return annotated.leave_one_out.sigma_l if isinstance(self.sigma_l, str) else self.sigma_l

    def bank(self, rng: np.random.Generator, annotated: GatheredPairs) -> ViewBank:
        """Return a bank of views that are drawn once from the view density (eq. 5)."""
        views = draw_views(rng, annotated.pairs.directions, annotated.weights, self.num_views)
        return build_bank(views, annotated.pairs, num_candidates=self.num_candidates)
