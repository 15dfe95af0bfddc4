"""Odds of a lifted pair among the other lifts of its own image: what a density says once the image is given.

A density of pairs says how common a pair is, and real pairs are rare and common alike: a rare one scores below the
corruption of a common one.  Where the image is known, what remains to be told is depth: which side of the image plane a
limb is on, and how far person B is from person A.  So the pair's density is divided by that of everything else that the
image could be: log p(pair | image) with the other lifts standing for all.  Our own; that is Bayes' rule, and it needs
no more than the density itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pasdedeux.experiments.agreement import Agreement
from pasdedeux.plausibility import JointLimits, Occupancy
from pasdedeux.sampling.prior import PriorSettings
from pasdedeux.skeletons import PAIR17

__all__ = ["LiftDensity", "other_lifts"]

Array = npt.NDArray[np.float64]

SLIDES_M = np.arange(1, 8) * 0.08
"""How far person B is slid towards the camera and away from it, metres."""
BONE_WEIGHT = 0.5
"""Weight of the summed pose prior: its bones are not independent."""
CONTACT_WEIGHT = 0.5
"""Weight of the penetration of one body by the other: captured bodies are in each other too."""
_WHOLE_BODIES = [0, 1, 14]
"""Which of the other lifts mirror both people, person A and person B."""

_LIMBS = PAIR17.limbs


def other_lifts(seen_m: Array) -> Array:
    """Return other pairs with the image of a pair (person=2, joint=17, 3), metres, in camera axes, (lift=41, 2, 17, 3).

    Mirrored in depth: both people, each about its pelvis, and of each limb both bones, the lower or the upper one; and
    person B slid in depth.
    """
    everybody = seen_m * np.array([1.0, 1.0, -1.0])
    lifts = [everybody]
    for person in range(2):
        depth = seen_m[person, :, 2]
        depths = [2.0 * depth[0] - depth]
        for root, middle, end in _LIMBS:
            for is_upper, is_lower in ((True, True), (False, True), (True, False)):
                mirrored = depth.copy()
                mirrored[middle] = depth[root] + (-1.0 if is_upper else 1.0) * (depth[middle] - depth[root])
                mirrored[end] = mirrored[middle] + (-1.0 if is_lower else 1.0) * (depth[end] - depth[middle])
                depths.append(mirrored)
        for one in depths:
            lift = seen_m.copy()
            lift[person, :, 2] = one
            lifts.append(lift)
    for slide in (*SLIDES_M, *-SLIDES_M):
        lift = seen_m.copy()
        lift[1, :, 2] += slide
        lifts.append(lift)
    return np.stack(lifts)


@dataclass(frozen=True)
class LiftDensity:
    """The density that lifts of one image are compared by.

    Agreement with grown pairs, with less of the contact, and what is known of each person alone: the learned prior of
    every bone, and joint limits as in the prior of chains.  The weights were chosen on pairs of one salsa take.

    Args:
        agreement: Agreement with grown pairs.
        limits: Ranges of joint angles.
        occupancy: Pose prior learned from capture; an empty one knows nothing.
        prior: Bandwidth of the joint limits.
    """

    agreement: Agreement
    limits: JointLimits
    occupancy: Occupancy
    prior: PriorSettings = field(default_factory=PriorSettings)

    def logs(self, lifts_m: Array) -> Array:
        """Return the log of the density of lifts (n, 2, 17, 3), metres, of one image, up to a constant, (n,).

        Only the grown pairs that are posed like the first lift, or like what it is when either person or both are
        mirrored, count for all of them.
        """
        mirrored = other_lifts(lifts_m[0])[_WHOLE_BODIES]
        likely = self.agreement.among(np.concatenate([lifts_m[:1], mirrored]))
        terms = [likely.terms(lift) for lift in lifts_m]
        agreed = np.array([one.total - (1.0 - CONTACT_WEIGHT) * one.contact for one in terms])
        bones = self.occupancy.bone_logs(lifts_m).sum(axis=(1, 2))
        beyond = self.limits.nearest_valid(lifts_m).squared_distance_m2.sum(axis=-1)
        return np.asarray(agreed + BONE_WEIGHT * bones + self.prior.log_prior(beyond))

    def odds(self, seen_m: Array) -> Array:
        """Return the log of the share of pairs (n, 2, 17, 3), metres, in camera axes, among all lifts of their images.

        (n,), each at most 0.
        """
        odds = np.empty(len(seen_m))
        for row, pair in enumerate(np.asarray(seen_m, dtype=np.float64)):
            logs = self.logs(np.concatenate([pair[None], other_lifts(pair)]))
            odds[row] = logs[0] - np.logaddexp.reduce(logs)
        return odds
