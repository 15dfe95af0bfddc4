"""The bandwidth of the likelihood by leave-one-out over the annotations (Yin et al. 2018 do not say how to choose it).

Eq. 9's exp(-d_I / s), s = 2 sigma_l^2, is a density of images round one annotation.  d_I is homogeneous in the
displacement, so over the D = 2 n - 3 numbers in which an image of n joints may differ from another (turns and shifts in
the plane are none) its integral is proportional to s^D.  An annotation whose nearest other one is at distance d has the
leave-one-out log likelihood -d / s - D log s up to a constant, and over many s = sum d / sum D is the likeliest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.cameras.frames import angle_between_directions
from pasdedeux.cameras.view_density import VIEW_DEVIATION_RAD
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity, plane_residual
from pasdedeux.spread import evenly_spread

PUBLISHED_SIGMA_L = 0.01
"""Bandwidth of Yin et al. 2018, eq. 9, read in metres: 2 sigma_l^2 is 0.2 mm of d_I."""
SAME_MOMENT = 30
"""Frames of a video nearer to each other than this show nearly the same pose and are not compared."""

_NUM_JUDGED = 100
_NUM_COMPARED = 10
"""Number of others with the least rigid residual for which d_I is computed: the nearest is among the first few."""
_SAME_M = 1e-6
"""d_I per degree of freedom below which images count as copies, metres."""
_MIN_SHARED = 10
"""Joints that two annotations must both show to be compared."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Leave-one-out over annotations.

    Args:
        nearest_m: d_I to the nearest other annotation with a similar view, (annotation,), metres.
        freedom: Degrees of freedom between the image of each and that one, (annotation,).
    """

    nearest_m: Array
    freedom: Array

    @property
    def sigma_l(self) -> float:
        """The likeliest bandwidth; the published one if nothing can be compared, or all images are the same."""
        total, freedom = float(self.nearest_m.sum()), float(self.freedom.sum())
        return math.sqrt(0.5 * total / freedom) if total > _SAME_M * freedom else PUBLISHED_SIGMA_L

    def log_likelihood(self, sigma_l: float) -> float:
        """Return the mean leave-one-out log likelihood, up to a constant; NaN without any."""
        if not len(self.nearest_m):
            return math.nan
        scale = 2.0 * sigma_l**2
        return float(np.mean(-self.nearest_m / scale - self.freedom * math.log(scale)))


def leave_one_out(points_m: Array, directions: Array, moment: npt.NDArray[np.int64]) -> LeaveOneOut:
    """Leave out up to 100 annotations in turn, evenly spread, each with all that show nearly the same moment.

    Args:
        points_m: Annotations (annotation, person=2, joint=17, 2), metres; NaN where a joint is not seen.
        directions: View of each, unit, (annotation, 3).
        moment: When each was, in frames, (annotation,); those of other videos lie at least `SAME_MOMENT` apart.
    """
    points = merge_axes(points_m, 1, -1)
    is_seen = np.asarray(np.isfinite(points).all(axis=-1))
    nearest, freedom = [], []
    for row in evenly_spread(len(points), _NUM_JUDGED):
        is_similar = angle_between_directions(directions[row], directions) < VIEW_DEVIATION_RAD
        num_shared = (is_seen & is_seen[row]).sum(axis=1)
        is_another = np.abs(moment - moment[row]) >= SAME_MOMENT
        others = np.flatnonzero(is_similar & is_another & (num_shared >= _MIN_SHARED))
        if not len(others):
            continue
        residual = plane_residual(points[row], points[others]) / num_shared[others]
        tried = others[np.argsort(residual, kind="stable")[:_NUM_COMPARED]]
        dissimilarities = [interaction_dissimilarity(points[row], points[other]) for other in tried]
        nearest.append(min(dissimilarities))
        freedom.append(2.0 * num_shared[tried[int(np.argmin(dissimilarities))]] - 3.0)
    return LeaveOneOut(np.array(nearest), np.array(freedom))
