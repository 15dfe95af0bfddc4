"""Judging a density before it is sampled: can its terms tell real pairs from corrupted ones?

A corrupted pair looks exactly like the real one in one image: mirrored in depth, with one limb bent the other way, with
one person nearer or further, with bodies in each other, or with every bone's depth turned as in another pair.  That
image is counted as annotated, so the best view of both is perfect (d_I = 0) and cannot tell them apart.  A term that
cannot either says nothing about 3D truth, however well it scores.

The two frames before and after an annotation were tried as a term and left out: how likely the image's velocities are
when bones turn as little as they need tells limbs mirrored in depth with an AUC of 0.56 and slides with 0.48 to 0.55,
and adds nothing beside the odds.  The mirrored limb moves as smoothly as the true one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import pair_frame, view_rotmat
from pasdedeux.errors import InputError
from pasdedeux.experiments.agreement import Agreement
from pasdedeux.experiments.image_odds import LiftDensity
from pasdedeux.interaction import closest_joint_distance
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility import JointLimits, Occupancy, capsule_model
from pasdedeux.sampling.annotations import AnnotatedPairs, ViewBank
from pasdedeux.sampling.coverage import Coverage
from pasdedeux.sampling.growth_kernels import place_bones
from pasdedeux.sampling.likelihood import InteractionLikelihood
from pasdedeux.sampling.prior import PriorSettings, pair_violations
from pasdedeux.skeletons import PAIR17

__all__ = [
    "Comparison",
    "Corrupted",
    "Corruption",
    "TermComparer",
    "area_under_curve",
    "camera_axes",
    "corrupt",
    "paired_accuracy",
]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

CLOSE_GAP_M = 0.2
"""Pairs with a smaller gap than this are slid in depth; with a larger one a slide may be as real as the pair."""
_TIGHTNESS = 1e-4
"""Weight of the depths against the image when a pair is lifted badly: the image stays within a millimetre."""
SIGMA_L = 0.01
"""Bandwidth of the published likelihood; 2 sigma_l^2 is in metres (Yin et al. 2018, eq. 9)."""
_MEAN_VIEW_WIDTH_M = 0.01
_ANKLES = PAIR17.indices(("left_ankle", "right_ankle"))
_LIMBS = PAIR17.limbs


class Corruption(StrEnum):
    """What is done to a real pair."""

    DEPTH_MIRRORED = "depth_mirrored"
    LIMB_FLIPPED = "limb_flipped"
    SLID_10 = "slid_10_cm"
    SLID_20 = "slid_20_cm"
    SLID_40 = "slid_40_cm"
    INSIDE_5 = "penetrating_5_cm"
    INSIDE_10 = "penetrating_10_cm"
    BADLY_LIFTED = "badly_lifted"


_SLIDE_M = {Corruption.SLID_10: 0.1, Corruption.SLID_20: 0.2, Corruption.SLID_40: 0.4}
_INSIDE_M = {Corruption.INSIDE_5: 0.05, Corruption.INSIDE_10: 0.10}


@dataclass(frozen=True)
class Corrupted:
    """Corrupted pairs.

    Args:
        rows: Which real pairs they are, (m,): those it could be done to.
        pairs_m: The corrupted pairs (m, person=2, joint=17, 3), metres, in camera axes: x right, y up, z to the camera.
        seen_m: The real pairs in the same axes; the images are the same.
        moved_m: How far the joint moved most, (m,), metres.
    """

    rows: Indices
    pairs_m: Array
    seen_m: Array

    @property
    def moved_m(self) -> Array:
        """Greatest distance that a joint moved, (m,), metres."""
        return np.asarray(np.linalg.norm(self.pairs_m - self.seen_m, axis=-1).max(axis=(1, 2), initial=0.0))


def corrupt(rng: np.random.Generator, pairs_m: Array, directions: Array, kind: Corruption) -> Corrupted:
    """Corrupt pairs as one image of each does not show.

    Args:
        rng: Chooses limbs, signs and the pairs that depths are taken from.
        pairs_m: Real pairs (n, person=2, joint=17, 3), metres.
        directions: View of each pair that the corruption hides from, in its local frame, (n, 3).  Bodies are pushed
            into each other along the line between the people, so there that is the view.
        kind: What is done.
    """
    seen = camera_axes(pairs_m, directions, kind)
    rows: Indices = np.arange(len(pairs_m), dtype=np.int64)
    sign = rng.choice([-1.0, 1.0], size=len(seen))
    false = seen.copy()
    if kind is Corruption.DEPTH_MIRRORED:
        false[..., 2] *= -1.0
    elif kind is Corruption.LIMB_FLIPPED:
        for row, person, limb in zip(
            rows, rng.integers(2, size=len(rows)), rng.integers(4, size=len(rows)), strict=True
        ):
            root, *rest = _LIMBS[limb]
            false[row, person, rest, 2] = 2.0 * seen[row, person, root, 2] - seen[row, person, rest, 2]
    elif kind in _SLIDE_M:
        rows = np.flatnonzero(closest_joint_distance(pairs_m) < CLOSE_GAP_M)
        false[:, 1, :, 2] += (_SLIDE_M[kind] * sign)[:, None]
    elif kind in _INSIDE_M:
        moved = [_pushed(pair, _INSIDE_M[kind]) for pair in seen]
        rows = np.array([row for row in rows if moved[row] is not None], dtype=np.int64)
        for row in rows:
            false[row] = moved[row]
    else:
        order, parents = np.array(PAIR17.order), np.array(PAIR17.parents)
        tightness = np.full(seen.shape[1:3], _TIGHTNESS)
        for own, other in enumerate(rng.permutation(len(seen)).tolist()):
            image, depth = np.ascontiguousarray(seen[own, ..., :2]), np.ascontiguousarray(seen[other, ..., 2])
            place_bones(image, depth, bone_lengths(PAIR17, seen[own]), order, parents, tightness, false[own])
    return Corrupted(rows=rows, pairs_m=false[rows], seen_m=seen[rows])


def camera_axes(pairs_m: Array, directions: Array, kind: Corruption) -> Array:
    """Return pairs (n, person=2, joint=17, 3), metres, in the axes of the camera that a corruption hides from.

    Args:
        pairs_m: Pairs.
        directions: View of each in its local frame, (n, 3); where bodies are pushed into each other it is not used.
        kind: What is to be done.
    """
    frame = pair_frame(pairs_m)
    towards = frame.direction(directions)
    if kind in _INSIDE_M:
        towards = normalise(pairs_m[:, 0, 0] - pairs_m[:, 1, 0])
    axes = view_rotmat(towards, frame.axes[..., 1])
    return np.einsum("nij,npkj->npki", axes, pairs_m)


def _pushed(pair: Array, depth_m: float) -> Array | None:
    """Move person B towards A until the bodies penetrate each other by `depth_m` more in sum; None if they never do."""
    towards = pair[0, 0] - pair[1, 0]
    length = float(np.linalg.norm(towards))
    start = capsule_model(PAIR17).penetration(pair)[2]
    for step in np.arange(0.005, length, 0.005):
        moved = pair.copy()
        moved[1] += step / max(length, 1e-9) * towards
        if capsule_model(PAIR17).penetration(moved)[2] - start >= depth_m:
            return moved
    return None


@dataclass(frozen=True)
class TermComparer:
    """Everything that terms of a density are made from.

    Args:
        limits: Ranges of joint angles.
        occupancy: Pose prior learned from capture; an empty one knows nothing.
        annotated: Annotated pairs.
        bank: Views and the annotations compared with each.
        grown_m: Grown pairs (grown, person=2, joint=17, 3), metres; may be none.
        prior: Weights of eq. 2.
    """

    limits: JointLimits
    occupancy: Occupancy
    annotated: AnnotatedPairs
    bank: ViewBank
    grown_m: Array
    prior: PriorSettings = field(default_factory=PriorSettings)

    def values(self, pairs_m: Array) -> dict[str, Array]:
        """Return the terms of pairs (n, person=2, joint=17, 3), each (n,), larger where a pair is the likelier.

        - `joint_limits`, `penetration`: minus the squared distances of eq. 2 (Yin et al. 2018); `prior`: its log;
        - `contact`: minus the penetration of one body by the other alone; `ground`: minus how much higher the lowest
          ankle of one person is than the other's, along both backbones;
        - `pose_prior`: the least likely bone of the learned prior; `pose_prior_sum`: the sum over the bones;
        - `likelihood`: eqs. 6 and 9 as published, `mean_view` (a geometric mean of likelihoods), `median_view`,
          `worst_view`: minus the mean, median and 90th percentile of the least d_I over the views of the bank, all with
          one more view that fits perfectly;
        - with grown pairs: `grown_D_I`, `grown_D_C`, minus the least distance to one; `grown_near`, minus the mean one
          to the ten nearest; `placement` and `limbs` of `agreement`; and `agreement`, the density that chains sample:
          those with `contact` and the joint limits; `agreement_and_pose_prior`: that and `pose_prior`;
          `agreement_and_mean_view`: that and `mean_view` at 1 cm.
        """
        pairs = np.ascontiguousarray(pairs_m, dtype=np.float64)
        found = pair_violations(pairs, self.limits)
        distance, inside = found.squared_distance_m2, found.penetration_m
        prior = self.prior.log_prior(self.prior.violation_m2(distance, inside.sum(axis=1)))
        # So wide that no view is left out as too far behind the best.
        matcher = InteractionLikelihood(self.annotated, self.bank, sigma_l=1.0)
        views = np.array([[*matcher.match(pair).dissimilarity_m, 0.0] for pair in pairs])
        from scipy.special import logsumexp  # here: planning need not wait for it

        shares = self.occupancy.bone_logs(pairs)
        up = pair_frame(pairs).axes[..., 1]
        lowest = np.einsum("npki,ni->npk", pairs[:, :, _ANKLES], up).min(axis=-1)
        terms = {
            "joint_limits": -distance,
            "penetration": -(inside.sum(axis=1) ** 2),
            "contact": -inside[:, 2],
            "ground": -np.abs(lowest[:, 1] - lowest[:, 0]),
            "prior": prior,
            "pose_prior": shares.min(axis=(1, 2)),
            "pose_prior_sum": shares.sum(axis=(1, 2)),
            "likelihood": logsumexp(-views / (2.0 * SIGMA_L**2), axis=1) - np.log(views.shape[1]),
            "mean_view": -views.mean(axis=1),
            "median_view": -np.median(views, axis=1),
            "worst_view": -np.percentile(views, 90.0, axis=1),
        }
        if len(self.grown_m):
            coverage = Coverage(pairs)
            coverage.add(self.grown_m)
            agreement = Agreement(self.grown_m)
            parts = [agreement.terms(pair) for pair in pairs]
            terms["grown_D_I"] = -coverage.interaction_m
            terms["grown_D_C"] = -coverage.cartesian_m
            terms["grown_near"] = -np.array([agreement.nearest_m(pair) for pair in pairs])
            terms["placement"] = np.array([part.placement for part in parts])
            terms["limbs"] = np.array([part.limbs for part in parts])
            terms["agreement"] = np.array([part.total for part in parts]) + self.prior.log_prior(distance)
            terms["agreement_and_pose_prior"] = terms["agreement"] + terms["pose_prior"]
            terms["agreement_and_mean_view"] = terms["agreement"] + terms["mean_view"] / _MEAN_VIEW_WIDTH_M
        return {name: np.asarray(values) for name, values in terms.items()}

    def comparisons(self, rng: np.random.Generator, real_m: Array, directions: Array) -> dict[Corruption, Comparison]:
        """Try every kind of corruption on real pairs (n, person=2, joint=17, 3), metres.

        With grown pairs there is one term more, `image_odds`: the odds of the pair among the lifts of the image that
        the corruption does not show in.  Kinds that can be done to no pair are left out.

        Args:
            rng: As for `corrupt`.
            real_m: Real pairs.
            directions: View of each, in its local frame, (n, 3).
        """
        own, own_odds, found = self.values(real_m), {}, {}
        for kind in Corruption:
            corrupted = corrupt(rng, real_m, directions, kind)
            if not len(corrupted.rows):
                continue
            real = {name: values[corrupted.rows] for name, values in own.items()}
            false = self.values(corrupted.pairs_m)
            if len(self.grown_m):
                is_pushed = kind in _INSIDE_M
                if is_pushed not in own_odds:
                    own_odds[is_pushed] = self.odds(camera_axes(real_m, directions, kind))
                real["image_odds"] = own_odds[is_pushed][corrupted.rows]
                false["image_odds"] = self.odds(corrupted.pairs_m)
            found[kind] = Comparison(real, false, corrupted.moved_m)
        return found

    def odds(self, seen_m: Array) -> Array:
        """Return the odds of pairs (n, 2, 17, 3), metres, in camera axes, among the lifts of their images, (n,)."""
        return LiftDensity(Agreement(self.grown_m), self.limits, self.occupancy, self.prior).odds(seen_m)


@dataclass(frozen=True)
class Comparison:
    """Terms of real pairs and of their corruptions, row by row.

    Args:
        real: Each term of the real pairs, (n,).
        corrupted: Each term of their corruptions, (n,).
        moved_m: How far the joint that moved most did, (n,), metres.
    """

    real: dict[str, Array]
    corrupted: dict[str, Array]
    moved_m: Array

    def from_m(self, min_m: float) -> Comparison:
        """Return the rows in which a joint moved at least as far as `min_m`, metres."""
        far = self.moved_m >= min_m
        real, corrupted = ({name: one[far] for name, one in part.items()} for part in (self.real, self.corrupted))
        return Comparison(real, corrupted, self.moved_m[far])


def area_under_curve(real: Array, corrupted: Array) -> float:
    """Return the AUC: the chance that a real pair's value (n,) exceeds a corrupted one's (m,); ties count half.

    Raises:
        InputError: There is no real or no corrupted pair.
    """
    if not len(real) or not len(corrupted):
        raise InputError(f"an AUC needs real and corrupted pairs, found {len(real)} and {len(corrupted)}")
    above = (real[:, None] > corrupted[None]).mean()
    return float(above + 0.5 * (real[:, None] == corrupted[None]).mean())


def paired_accuracy(real: Array, corrupted: Array) -> float:
    """Return the share of pairs whose value (n,) exceeds that of their own corruption (n,); ties count half.

    Both are lifts of one image: what a chain that starts from a wrong one would have to know.

    Raises:
        InputError: There is no pair, or the numbers differ.
    """
    if not len(real) or len(real) != len(corrupted):
        raise InputError(f"pairs are compared one by one, found {len(real)} real and {len(corrupted)} corrupted")
    return float((real > corrupted).mean() + 0.5 * (real == corrupted).mean())
