"""The physical prior of a pair: joint limits, interpenetration, bone lengths (Yin et al. 2018, eq. 2).

log prior = -(|theta - theta_valid|^2 + alpha eta^2) / (2 sigma_p^2), over joint positions in metres: the squared
distance to the nearest poses within joint limits, and the squared sum of penetration depths.  It is -inf when more than
8 joint angles of the pair are invalid.  Bone lengths stay within 5 % of the seed's and equal on both sides of a body,
which the paper's terms do not bound.  All scoring of pairs by eq. 2 uses this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.plausibility.capsules import capsule_model, pair_penetration
from pasdedeux.plausibility.joint_limits import MAX_INVALID_ANGLES, JointLimits
from pasdedeux.plausibility.joint_limits_kernel import move_to_nearest_valid
from pasdedeux.plausibility.ranges import NUM_ANGLES
from pasdedeux.sampling.parameters import LENGTH_INDICES, MIRRORED_LENGTH, NUM_JOINTS, PairChart
from pasdedeux.settings import Settings
from pasdedeux.skeletons import PAIR17

Value = TypeVar("Value", float, Array)

_TIE_TOLERANCE = 1e-9


class PriorSettings(Settings):
    """The weights and limits of eq. 2, shared by seeds, growth, chains and judgements."""

    alpha: float = Field(default=10.0, ge=0, description="Weight of the squared penetration in the prior (eq. 2)")
    sigma_p_m: float = Field(default=0.05, gt=0, description="Bandwidth of the prior (eq. 2), metres")
    max_invalid_angles: int = Field(
        default=MAX_INVALID_ANGLES, ge=0, description="Invalid joint angles beyond which a pair is impossible"
    )
    length_tolerance: float = Field(
        default=0.05, ge=0, lt=0.5, description="Greatest relative change of a bone's length"
    )

    def violation_m2(self, squared_distance_m2: Value, penetration_m: Value) -> Value:
        """Return the squared distance to valid poses plus alpha times the squared penetration, square metres."""
        return squared_distance_m2 + self.alpha * (penetration_m * penetration_m)

    def log_prior(self, violation_m2: Value) -> Value:
        """Return the log of eq. 2 of a possible pair, up to a constant."""
        return -violation_m2 / (2.0 * self.sigma_p_m**2)


DEFAULT_PRIOR = PriorSettings()


@dataclass(frozen=True)
class PriorTerms:
    """Settings of the prior.

    Args:
        log_prior: Log of eq. 2 up to a constant; -inf when the pair is impossible.
        num_invalid: Joint angles out of range, of both people.
        limit_distance_m: Distance to the nearest poses within joint limits, root of the sum of squares, metres.
        penetration_m: Sum of penetration depths, metres.
    """

    log_prior: float
    num_invalid: int
    limit_distance_m: float
    penetration_m: float


class PhysicalPrior:
    """Eq. 2 round one seed.

    Args:
        chart: Parameters round the seed; its bone lengths set the capsules' radii.
        limits: Joint limits.
        settings: Weights and limits; the defaults when not given.
    """

    def __init__(self, chart: PairChart, limits: JointLimits, settings: PriorSettings = DEFAULT_PRIOR) -> None:
        self.settings = settings
        self._ranges_rad = limits.ranges_rad
        self._model = capsule_model(PAIR17)
        self._radii = np.ascontiguousarray(self._model.radii_of(chart.seed_m[None]))
        self._work = np.empty((2, NUM_ANGLES))
        self._valid = np.empty((NUM_JOINTS, 3))
        self._sums = np.empty(3)

    def terms(self, parameters: Array, pair_m: Array) -> PriorTerms:
        """Return the prior and its parts of parameters (108,) that give positions (2, 17, 3), metres."""
        lengths = parameters[LENGTH_INDICES]
        is_tied = np.abs(lengths - parameters[MIRRORED_LENGTH]).max() <= _TIE_TOLERANCE
        num_invalid, squared = 0, 0.0
        for person in range(2):
            count, distance = move_to_nearest_valid(pair_m[person], self._ranges_rad, self._work, self._valid)
            num_invalid += count
            squared += distance
        depth = pair_penetration(
            pair_m, self._radii, self._model.parents, self._model.within, self._model.between, self._sums
        )
        is_possible = (
            num_invalid <= self.settings.max_invalid_angles
            and np.abs(lengths).max() <= self.settings.length_tolerance
            and is_tied
        )
        return PriorTerms(
            log_prior=self.settings.log_prior(self.settings.violation_m2(squared, depth)) if is_possible else -np.inf,
            num_invalid=int(num_invalid),
            limit_distance_m=float(np.sqrt(squared)),
            penetration_m=float(depth),
        )
