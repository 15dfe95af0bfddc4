"""The expected error of a lifted pair, estimated without ground truth.

If draws contain the pair, the fit to the image changes their mean little, otherwise much.  The depth of people who are
far apart or stretched out can have a larger error, however well draws fit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pasdedeux.arrays import Array

ERROR_PER_CORRECTION, ERROR_PER_SIZE, SHARE_WITH_OWN_DRAW = 1.14, 0.107, 0.83
LOW_SHARE, HIGH_SHARE = 0.63, 1.58
"""Weights of the mean error of a joint: per correction by the fit, and per size of the image; factor if a draw lifted
from the image contributed; and the interval of true errors over expected ones that holds in 80 %.

Least squares of logarithms over 1,360 lifts of 15 takes' virtual video (eleven of salsa, four duets; seen and unseen
takes, whole or with 15 % of the joints hidden; draws grown, and of chains).  If weights are fitted without the judged
take, expected and true errors correlate at 0.71, and 78 % of the errors are in the interval (0.69 and 79 % for 306
whole images of takes without draws; 57 % for the duets from which draws were made).  For a take of salsa lifted from 2D
alone, which was not used for any fit, 87 % are in the interval (70 % without the third number; 14 cm expected, 13
true).  The spread of near draws and d_I add nothing; among images with a draw of their own, nothing predicts the error
(0.08)."""

OVER_TIME_FACTOR, OVER_TIME_POWER = 0.52, 0.38
LOW_OVER_TIME, HIGH_OVER_TIME = 0.68, 1.61
"""The same for pairs lifted with others of their camera: factor and power of the product of two expected errors, that
of the pair alone and that by poses and places of the scene, metres; and the interval that holds in 80 %.  Least squares
of logarithms over 196 pairs of 14 videos of six families of takes, each lifted from grown pairs of the others."""

OF_DATABASE = 0.76
LOW_OF_DATABASE, HIGH_OF_DATABASE = 0.45, 1.96
"""The same for pairs lifted by takes of a projection database: factor on the expected error by poses and places of the
scene, and its interval.  Means of logarithms over 302 pairs of the same videos, with a database without their families,
and the scatter within families and between them.  With families left out in turn, 88 % are in the interval, as are 88 %
of 112 pairs of the built-in duets, which were not used for any fit.  The expected error of the pair alone holds for
draws: with it, the score of intervals falls (docs/decisions)."""


class ExpectedError(NamedTuple):
    """Expected mean distance of a joint from the ground truth, pairs centred, metres; 80 % lie between the limits.

    NaN where nothing is seen.
    """

    value_m: float
    low_m: float
    high_m: float


def expected_error(image_m: Array, mean_m: Array, lifted_m: Array, *, has_own_draw: bool) -> ExpectedError:
    """Return the expected error of a lifted pair.

    Args:
        image_m: Its image (person=2, joint=17, 2), metres; NaN where a joint is not seen.
        mean_m: Weighted mean of the nearest draws (2, 17, 3), metres, camera axes; without draws that were lifted from
            this image, which always agree with it.
        lifted_m: The lifted pair, in the same axes.
        has_own_draw: Whether a draw that was lifted from this image contributed.
    """
    seen = image_m[np.isfinite(image_m).all(axis=-1)]
    if not len(seen):
        return ExpectedError(math.nan, math.nan, math.nan)
    size = math.sqrt(float(((seen - seen.mean(axis=0)) ** 2).sum(axis=1).mean()))
    correction = float(np.linalg.norm(lifted_m - mean_m, axis=-1).mean())
    value = ERROR_PER_CORRECTION * correction + ERROR_PER_SIZE * size
    value *= SHARE_WITH_OWN_DRAW if has_own_draw else 1.0
    return ExpectedError(value, LOW_SHARE * value, HIGH_SHARE * value)


def expected_over_time(alone: ExpectedError | None, together_m: float) -> ExpectedError:
    """Return the expected error of a pair that was lifted with others of its camera.

    Args:
        alone: Expected error of the pair lifted alone; None if all were lifted by a projection database, not by draws.
        together_m: Expected error by the reconstruction of all of them, from poses and place.
    """
    if alone is None:
        value = OF_DATABASE * together_m
        return ExpectedError(value, LOW_OF_DATABASE * value, HIGH_OF_DATABASE * value)
    value = OVER_TIME_FACTOR * (alone.value_m * together_m) ** OVER_TIME_POWER
    return ExpectedError(value, LOW_OVER_TIME * value, HIGH_OVER_TIME * value)
