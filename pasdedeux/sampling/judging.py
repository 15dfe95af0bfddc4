"""Judging a density before it is sampled: can its terms tell real pairs from corrupted ones?

A corrupted pair looks like the real one in one image, or nearly: mirrored in depth, with one limb bent the other way,
with one person nearer or further, with bodies in each other, or with depths that are another pair's.  A term that
cannot tell them apart says nothing about 3D truth, however well it scores.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import pair_frame, view_rotmat
from pasdedeux.errors import InputError
from pasdedeux.interaction import gap_m
from pasdedeux.interaction.kernels import edge_table
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.plausibility.capsules_kernel import clip_penetration
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.coverage import Coverage
from pasdedeux.sampling.growth_kernels import place_bones
from pasdedeux.sampling.likelihood import AnnotatedPairs, ViewBank, plain_log_likelihood
from pasdedeux.sampling.seeds import SIGMA_P_M
from pasdedeux.skeletons import PAIR17

__all__ = ["Corruption", "corrupt", "separation", "term_values"]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

CLOSE_GAP_M = 0.2
"""Pairs with a smaller gap than this are slid in depth; with a larger one a slide may be as real as the pair."""
_TIGHTNESS = 0.16
_GROWN_WIDTH_M = 0.02
_PRIOR_SHARE = 0.05
_LIMBS = [
    PAIR17.indices((f"{side}_{root}", f"{side}_{middle}", f"{side}_{end}"))
    for root, middle, end in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
    for side in ("left", "right")
]


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


def corrupt(rng: np.random.Generator, pairs_m: Array, directions: Array, kind: Corruption) -> tuple[Indices, Array]:
    """Corrupt pairs as one image of each does not show.

    Args:
        rng: Chooses limbs, signs and the pairs that depths are taken from.
        pairs_m: Real pairs (n, person=2, joint=17, 3), metres.
        directions: View of each pair that the corruption hides from, in its local frame, (n, 3).
        kind: What is done.

    Returns:
        Indices (m,) of the pairs it could be done to, and the corrupted pairs (m, 2, 17, 3), metres, camera axes.
    """
    frame = pair_frame(pairs_m)
    axes = view_rotmat(frame.direction(directions), frame.axes[..., 1])
    seen = np.einsum("nij,npkj->npki", axes, pairs_m)
    rows: Indices = np.arange(len(pairs_m), dtype=np.int64)
    sign = rng.choice([-1.0, 1.0], size=len(seen))
    if kind is Corruption.DEPTH_MIRRORED:
        return rows, seen * np.array([1.0, 1.0, -1.0])
    if kind is Corruption.LIMB_FLIPPED:
        for row, person, limb in zip(
            rows, rng.integers(2, size=len(rows)), rng.integers(4, size=len(rows)), strict=True
        ):
            root, *rest = _LIMBS[limb]
            seen[row, person, rest, 2] = 2.0 * seen[row, person, root, 2] - seen[row, person, rest, 2]
        return rows, seen
    if kind in _SLIDE_M:
        rows = np.flatnonzero(gap_m(pairs_m) < CLOSE_GAP_M)
        slid = seen[rows]
        slid[:, 1, :, 2] += (_SLIDE_M[kind] * sign[rows])[:, None]
        return rows, slid
    if kind in _INSIDE_M:
        moved = [_pushed(pair, _INSIDE_M[kind]) for pair in seen]
        rows = np.array([row for row in rows if moved[row] is not None], dtype=np.int64)
        return rows, np.array([pair for pair in moved if pair is not None]).reshape(-1, *seen.shape[1:])
    order, parents = np.array(PAIR17.order), np.array(PAIR17.parents)
    lifted = np.empty_like(seen)
    for own, other in enumerate(rng.permutation(len(seen)).tolist()):
        image, depth = np.ascontiguousarray(seen[own, ..., :2]), np.ascontiguousarray(seen[other, ..., 2])
        place_bones(image, depth, bone_lengths(PAIR17, seen[own]), order, parents, _TIGHTNESS, lifted[own])
    return rows, lifted


def _pushed(pair: Array, depth_m: float) -> Array | None:
    """Move person B towards A until the bodies penetrate each other by `depth_m` more in sum; None if they never do."""
    towards = pair[0, 0] - pair[1, 0]
    length = float(np.linalg.norm(towards))
    start = _penetration(pair[None])[0, 2]
    for step in np.arange(0.005, length, 0.005):
        moved = pair.copy()
        moved[1] += step / max(length, 1e-9) * towards
        if _penetration(moved[None])[0, 2] - start >= depth_m:
            return moved
    return None


def _penetration(pairs_m: Array) -> Array:
    model = capsule_model(PAIR17)
    pairs = np.ascontiguousarray(pairs_m, dtype=np.float64)
    return np.concatenate(
        [
            clip_penetration(pair[None], model.radii_of(pair[None]), model.parents, model.within, model.between)
            for pair in pairs
        ]
    )


def term_values(
    pairs_m: Array, limits: JointLimits, annotated: AnnotatedPairs, bank: ViewBank, grown_m: Array
) -> dict[str, Array]:
    """Give terms a density can be made of, each (n,), larger where a pair is the likelier.

    - `joint_limits`, `penetration`: minus the squared distances of eq. 2 (Yin et al. 2018); `prior`: its log;
    - `likelihood`: eqs. 6 and 9 as published; `mean_view`, `worst_view`: minus the mean and the 90th percentile of the
      least d_I over the views of the bank;
    - `grown_D_I`, `grown_D_C`: minus the least distance to the grown pairs (grown, 2, 17, 3), when there are any, and
      `grown_and_prior`: the first at 2 cm with eq. 2 at a twentieth.
    """
    nearest = limits.nearest_valid(pairs_m)
    inside = _penetration(pairs_m).sum(axis=1)
    table = edge_table(annotated.points_m.reshape(len(annotated.points_m), -1, 2))
    matches = [plain_log_likelihood(pair, annotated, bank, table=table) for pair in pairs_m]
    views = np.array([match.dissimilarity_m for match in matches])
    distance = nearest.squared_distance_m2.sum(axis=-1)
    prior = -(distance + 10.0 * inside**2) / (2.0 * SIGMA_P_M**2)
    terms = {
        "joint_limits": -distance,
        "penetration": -(inside**2),
        "prior": prior,
        "likelihood": np.array([match.log_likelihood for match in matches]),
        "mean_view": -views.mean(axis=1),
        "worst_view": -np.percentile(views, 90.0, axis=1),
    }
    if len(grown_m):
        coverage = Coverage(pairs_m)
        coverage.add(grown_m)
        terms["grown_D_I"] = -coverage.interaction_m
        terms["grown_D_C"] = -coverage.cartesian_m
        terms["grown_and_prior"] = terms["grown_D_I"] / _GROWN_WIDTH_M + _PRIOR_SHARE * prior
    return {name: np.asarray(values) for name, values in terms.items()}


def separation(real: Array, corrupted: Array) -> float:
    """Give the AUC: the chance that a real pair's value (n,) exceeds a corrupted one's (m,); ties count half.

    Raises:
        InputError: There is no real or no corrupted pair.
    """
    if not len(real) or not len(corrupted):
        raise InputError(f"an AUC needs real and corrupted pairs, found {len(real)} and {len(corrupted)}")
    above = (real[:, None] > corrupted[None]).mean()
    return float(above + 0.5 * (real[:, None] == corrupted[None]).mean())
