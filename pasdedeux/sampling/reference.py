"""A reference for the truncation of eq. 11 (Yin et al. 2018) that does not depend on how well one seed is annotated.

The published reference is the seed's own density.  An annotation's dissimilarity to its nearest neighbours among the
others says how far a real pair that is *not* annotated lies from those that are: a pair no farther off is as plausible
as what we want to find.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import angle_between_directions
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import BETA_M, interaction_dissimilarity, plane_residual
from pasdedeux.sampling.likelihood import AnnotatedPairs

__all__ = ["left_out_dissimilarity", "left_out_log_likelihood"]

Array = npt.NDArray[np.float64]

NUM_LEFT_OUT = 60
"""Annotations that are left out in turn, evenly spread."""
NUM_COMPARED = 12
"""Others that each is compared with: the nearest by what the best rotation in the plane leaves."""
NUM_RESAMPLED = 500
"""Sets of views that a quantile is taken over."""


def left_out_dissimilarity(pairs: AnnotatedPairs, *, view_bandwidth_rad: float = 0.5, beta_m: float = BETA_M) -> Array:
    """Return the least d_I (eq. 8), metres, of evenly spread annotations to any other with a similar view, (n,).

    Annotations without another one in the bandwidth are left out altogether.
    """
    points = pairs.points_m.reshape(len(pairs.points_m), -1, 2)
    found = []
    for row in np.unique(np.linspace(0, len(points) - 1, NUM_LEFT_OUT).round().astype(int)):
        is_near = angle_between_directions(pairs.directions[row], pairs.directions) <= view_bandwidth_rad
        others = np.flatnonzero(is_near & (pairs.annotation_index != pairs.annotation_index[row]))
        if len(others):
            nearest = np.argsort(plane_residual(points[row], points[others]), kind="stable")[:NUM_COMPARED]
            found.append(
                min(
                    float(interaction_dissimilarity(points[row], points[one], beta_m=beta_m)) for one in others[nearest]
                )
            )
    return np.array(found)


def left_out_log_likelihood(
    dissimilarity_m: Array, num_views: int, rng: np.random.Generator, *, sigma_l: float = 0.01, quantile: float = 0.5
) -> float:
    """Return a quantile of the log likelihood (eqs. 6 and 9) of a real pair that is not annotated.

    Its views' least dissimilarities are taken to be independent draws from those of left-out annotations.

    Args:
        dissimilarity_m: Least d_I of left-out annotations, (n,), metres.
        num_views: Views of the bank.
        rng: Resamples.
        sigma_l: Bandwidth; 2 sigma_l^2 is in metres.
        quantile: 0.5 for a pair in the middle, lower for one that is annotated worse.

    Raises:
        InputError: No annotation has another one with a similar view.
    """
    if not len(dissimilarity_m):
        raise InputError("no two annotations have similar views: there is no left-out density to refer to")
    scale = 2.0 * sigma_l**2
    drawn = rng.choice(dissimilarity_m, size=(NUM_RESAMPLED, num_views))
    least = drawn.min(axis=1, keepdims=True)
    logs = np.log(np.exp(-(drawn - least) / scale).mean(axis=1)) - least[:, 0] / scale
    return float(np.quantile(logs, quantile))
