"""What pairs that look alike agree on: where the other person stands, and where each limb points.

Grown pairs come from annotations under many views, so what one image hides another shows.  Given how the two bodies of
a pair are posed, each centred on its own, a kernel density over the grown pairs posed alike says where person B is
against person A (`placement`), and where the two bones of each limb point (`limbs`, the least likely of eight).  Being
conditional, they do not mistake a rare pair for a wrong one; the density of the grown pairs' poses themselves (`pose`)
says how rare it is.  With the depth to which the *two* bodies penetrate each other they make the term `agreement`.
Penetration within a body is left out: captured and lifted people have so much of it that it hides all else.  Our own;
weights and floors were chosen by the study `density`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.interaction.kernels import best_turn, turned_squares
from pasdedeux.kinematics import align_rigid
from pasdedeux.plausibility import capsule_model
from pasdedeux.skeletons import PAIR17

__all__ = ["Agreement", "AgreementTerms", "plain_agreement"]

Array = npt.NDArray[np.float64]

POSE_WIDTH_M = 0.03
"""How alike pairs are posed to be compared: width of the root mean square joint distance, metres."""
PLACEMENT_WIDTH_M, LIMB_WIDTH_M = 0.06, 0.08
POSE_WEIGHT = 0.5
"""More would tell lifted pairs from corrupted ones worse."""
PLACEMENT_WEIGHT, PLACEMENT_FLOOR, LIMB_FLOOR = 2.0, -6.0, -15.0
"""Logs do not fall below the floors: a real pair that nothing grown is like has an end."""
PENETRATION_WIDTH_M = 0.01

_LIMBS = np.array(PAIR17.limbs, dtype=np.int64)
_NUM_LIMBS = 2 * len(_LIMBS)


@dataclass(frozen=True)
class AgreementTerms:
    """What agreement is made of, logs, each at most 0 up to rounding.

    Args:
        pose: How both are posed, each centred on its own.
        placement: Where person B is against A, given how both are posed.
        limbs: Where the least likely of the eight limbs points, given how both are posed.
        contact: Minus the penetration of one body by the other, in centimetres.
    """

    pose: float
    placement: float
    limbs: float
    contact: float

    @property
    def total(self) -> float:
        """Log of the density up to a constant, at most 0."""
        placement = _floored(self.placement, PLACEMENT_FLOOR)
        return POSE_WEIGHT * self.pose + PLACEMENT_WEIGHT * placement + _floored(self.limbs, LIMB_FLOOR) + self.contact


def _floored(value: float, floor: float) -> float:
    """Mix a density of at most 1 with a flat one of height exp(floor), scaled back to at most 1."""
    return float(np.logaddexp(value, floor) - np.log1p(np.exp(floor)))


class Agreement:
    """Agreement with grown pairs, as a compiled kernel.

    Args:
        grown_m: Grown pairs (grown, person=2, joint=17, 3), metres; at least one.

    Raises:
        InputError: There is no grown pair, or one that is not finite.
    """

    def __init__(self, grown_m: Array) -> None:
        grown = np.ascontiguousarray(grown_m, dtype=np.float64)
        if not len(grown) or not np.isfinite(grown).all():
            raise InputError("agreement needs at least one grown pair, all of its positions finite")
        self._model = capsule_model(PAIR17)
        self._log_count = float(np.log(len(grown)))
        self._hold(*_apart(grown), _limbs_of(grown))

    def _hold(self, centred: Array, offset: Array, limbs: Array) -> None:
        self._centred, self._offset, self._limbs = centred, offset, limbs
        self._work = np.empty((2 + _NUM_LIMBS, len(centred)))

    def among(self, pairs_m: Array, *, most: int = 400) -> Agreement:
        """Return the same over fewer grown pairs: the `most` posed most like each of some pairs (n, 2, 17, 3), metres.

        For pairs close to these its terms are those of all, but for what the grown pairs left out would have added.
        """
        kept = np.zeros(len(self._centred), dtype=bool)
        for pair in pairs_m:
            self.terms(pair)
            kept[np.argsort(-self._work[0], kind="stable")[:most]] = True
        fewer = copy(self)
        fewer._hold(*(np.ascontiguousarray(part[kept]) for part in (self._centred, self._offset, self._limbs)))
        return fewer

    def terms(self, pair_m: Array) -> AgreementTerms:
        """Return the terms of a pair (2, 17, 3), metres."""
        pair = np.ascontiguousarray(pair_m, dtype=np.float64)
        centred, offset = _apart(pair[None])
        pose, placement, limbs = _kernel_logs(
            centred[0],
            offset[0],
            _limbs_of(pair[None])[0],
            self._centred,
            self._offset,
            self._limbs,
            self._work,
            np.array([POSE_WIDTH_M, PLACEMENT_WIDTH_M, LIMB_WIDTH_M]),
            self._log_count,
        )
        return AgreementTerms(
            pose=pose,
            placement=placement,
            limbs=limbs,
            contact=-float(self._model.penetration(pair)[2]) / PENETRATION_WIDTH_M,
        )

    def nearest_m(self, pair_m: Array, *, count: int = 10) -> float:
        """Return the mean distance of a pair (2, 17, 3) from the `count` nearest grown ones, metres.

        The root mean square over the joints, after the turn that fits each grown pair's poses best.
        """
        self.terms(pair_m)
        pose = -2.0 * POSE_WIDTH_M**2 * self._work[0]
        place = -2.0 * PLACEMENT_WIDTH_M**2 * (self._work[1] - self._work[0])
        # Half of the joints are off by half of the offset to one side, half to the other.
        return float(np.sqrt(np.sort(pose + 0.25 * place)[:count]).mean())


def plain_agreement(pair_m: Array, grown_m: Array) -> tuple[float, float, float]:
    """Return `pose`, `placement`, `limbs` of a pair (2, 17, 3) by definition, over grown pairs (grown, 2, 17, 3)."""
    moving, offset = _apart(np.asarray(pair_m, dtype=np.float64)[None])
    fixed, offsets = _apart(np.asarray(grown_m, dtype=np.float64))
    moving = np.broadcast_to(moving, fixed.shape)
    aligned = align_rigid(moving, fixed)
    moved = aligned.apply(moving)
    weight = -0.5 * ((moved - fixed) ** 2).sum(axis=(1, 2)) / fixed.shape[1] / POSE_WIDTH_M**2
    turned = np.einsum("nij,j->ni", aligned.rotmat, offset[0])
    limbs = np.einsum("nij,laj->nlai", aligned.rotmat, _limbs_of(np.asarray(pair_m)[None])[0])
    place = -0.5 * ((turned - offsets) ** 2).sum(axis=1) / PLACEMENT_WIDTH_M**2
    point = -0.5 * ((limbs - _limbs_of(np.asarray(grown_m))) ** 2).sum(axis=(2, 3)) / LIMB_WIDTH_M**2
    every = np.logaddexp.reduce(weight)
    return (
        float(every - np.log(len(weight))),
        float(np.logaddexp.reduce(weight + place) - every),
        float((np.logaddexp.reduce(weight[:, None] + point, axis=0) - every).min()),
    )


def _apart(pairs_m: Array) -> tuple[Array, Array]:
    """Return pairs with each person centred on its own (n, 34, 3), and where person B's centre is from A's (n, 3)."""
    centre = pairs_m.mean(axis=2, keepdims=True)
    centred = (pairs_m - centre).reshape(len(pairs_m), -1, 3)
    return np.ascontiguousarray(centred), np.ascontiguousarray(centre[:, 1, 0] - centre[:, 0, 0])


def _limbs_of(pairs_m: Array) -> Array:
    """Return where the middle and the end of each limb are from its root, (n, limb=8, 2, 3)."""
    vectors = pairs_m[:, :, _LIMBS[:, 1:]] - pairs_m[:, :, _LIMBS[:, :1]]
    return np.ascontiguousarray(vectors.reshape(len(pairs_m), _NUM_LIMBS, 2, 3))


@compiled()
def _kernel_logs(centred, offset, limbs, others, offsets, other_limbs, work, widths, log_count):  # type: ignore[no-untyped-def]
    """Return the logs of the kernel density of poses and of the two given the pose; `work` is (2 + limbs, other)."""
    num_others, num_points, num_limbs = others.shape[0], others.shape[1], limbs.shape[0]
    key, m, q, turn = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty((3, 3))
    for one in range(num_others):
        fixed = others[one]
        best_turn(centred, fixed, key, m, q, turn)
        squared = turned_squares(turn, centred, fixed)
        weight = -0.5 * squared / num_points / (widths[0] * widths[0])
        work[0, one] = weight
        squared = turned_squares(turn, offset.reshape(1, 3), offsets[one : one + 1])
        work[1, one] = weight - 0.5 * squared / (widths[1] * widths[1])
        for limb in range(num_limbs):
            squared = turned_squares(turn, limbs[limb], other_limbs[one, limb])
            work[2 + limb, one] = weight - 0.5 * squared / (widths[2] * widths[2])
    every = _log_sum(work[0])
    lowest = np.inf
    for limb in range(num_limbs):
        lowest = min(lowest, _log_sum(work[2 + limb]) - every)
    return every - log_count, _log_sum(work[1]) - every, lowest


@compiled()
def _log_sum(logs):  # type: ignore[no-untyped-def]
    highest = logs.max()
    total = 0.0
    for value in logs:
        total += np.exp(value - highest)
    return highest + np.log(total)
