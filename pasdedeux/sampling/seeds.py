"""Choice of seeds among real frames: close interactions, plausible, and far from each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.interaction.surfaces import closest_joint_distance
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.prior import DEFAULT_PRIOR, PriorSettings
from pasdedeux.skeletons import PAIR17

CLOSE_SHARE = 0.25
"""Share of a take's frames, those with the closest people, that count as close interaction."""
SOUND_SHARE = 0.5
"""Share of the close frames, those with the smallest violation of the prior, that may become seeds."""
MIN_POOL = 16
"""Least number of frames of a take among which seeds are chosen, however few are close and sound."""


@dataclass(frozen=True)
class SeedQuality:
    """Fitness of pairs as starts of chains.

    Args:
        num_invalid: Joint angles out of range, of both people, (pair,).
        violation_m2: Squared distance to valid poses plus alpha times squared penetration, (pair,): eq. 2's exponent.
        closest_m: Distance between the closest joints of the two people, (pair,), metres.
        prior: The prior they were scored with.
    """

    num_invalid: npt.NDArray[np.int64]
    violation_m2: Array
    closest_m: Array
    prior: PriorSettings

    @property
    def log_prior(self) -> Array:
        """Log of eq. 2 (Yin et al. 2018), (pair,), with its own bone lengths; finite for impossible ones too."""
        return self.prior.log_prior(self.violation_m2)

    @property
    def is_possible(self) -> npt.NDArray[np.bool_]:
        """Whether the prior of a pair is above 0, (pair,)."""
        return np.asarray(self.num_invalid <= self.prior.max_invalid_angles)


def seed_quality(pairs_m: Array, limits: JointLimits, prior: PriorSettings = DEFAULT_PRIOR) -> SeedQuality:
    """Return the fitness of pairs (pair, person=2, joint=17, 3), metres, as seeds, each with its own bone lengths."""
    pairs = np.ascontiguousarray(pairs_m, dtype=np.float64)
    nearest = limits.nearest_valid(pairs)
    squared, depth_m = nearest.squared_distance_m2.sum(axis=-1), capsule_model(PAIR17).penetration(pairs).sum(axis=1)
    return SeedQuality(
        num_invalid=nearest.num_invalid.sum(axis=-1),
        violation_m2=prior.violation_m2(squared, depth_m),
        closest_m=closest_joint_distance(pairs),
        prior=prior,
    )


def choose_seeds(
    pairs_m: Array, take_index: npt.NDArray[np.int64], quality: SeedQuality, num_seeds: int
) -> npt.NDArray[np.int64]:
    """Choose frames as seeds: indices (num_seeds,) into pairs (pair, person=2, joint=17, 3), metres.

    Asking for more seeds keeps the first ones.

    Of each take's frames with positive prior those with the closest people are kept, of these the ones that violate the
    prior least; the first seed is the soundest of all, each next one the frame farthest in D_C from all chosen, taking
    turns over the takes.

    Raises:
        InputError: There are fewer frames to choose from than seeds asked for.
    """
    possible = np.flatnonzero(quality.is_possible & np.isfinite(quality.violation_m2))
    pools = []
    for take in np.unique(take_index[possible]):
        of_take = possible[take_index[possible] == take]
        close = _smallest(of_take, quality.closest_m, max(int(CLOSE_SHARE * len(of_take)), 2 * MIN_POOL))
        pools.append(_smallest(close, quality.violation_m2, max(int(SOUND_SHARE * len(close)), MIN_POOL)))
    pool = np.concatenate(pools) if pools else possible
    if len(pool) < num_seeds:
        raise InputError(
            f"{num_seeds} seeds were asked for, but only {len(pool)} of {len(pairs_m)} frames can be one: people near "
            f"each other, at most {quality.prior.max_invalid_angles} joint angles out of range ({len(possible)})"
        )
    chosen = [int(pool[np.argmin(quality.violation_m2[pool])])]
    points = np.asarray(pairs_m[pool], dtype=np.float64).reshape(len(pool), -1, 3)
    distance = np.full(len(pool), np.inf)
    used = np.zeros(int(take_index.max()) + 1, dtype=np.int64)
    while len(chosen) < num_seeds:
        latest = np.asarray(pairs_m[chosen[-1]], dtype=np.float64).reshape(-1, 3)
        distance = np.minimum(distance, cartesian_dissimilarity(points, latest))
        used[take_index[chosen[-1]]] += 1
        is_free = ~np.isin(pool, chosen)
        turns = used[take_index[pool]]
        is_due = is_free & (turns == turns[is_free].min())
        chosen.append(int(pool[np.argmax(np.where(is_due, distance, -1.0))]))
    return np.array(chosen, dtype=np.int64)


def _smallest(indices: npt.NDArray[np.int64], values: Array, count: int) -> npt.NDArray[np.int64]:
    return indices[np.argsort(values[indices], kind="stable")[:count]]
