"""Detector faults put into clean keypoints, and how well a repair finds them."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.people.faults import RepairedCrowd
from pasdedeux.people.identity import body_size_px
from pasdedeux.skeletons import OP14

__all__ = ["KINDS", "Faulty", "JointCounts", "count_joints", "inject"]

Array = npt.NDArray[np.float64]

KINDS = ("body", "arms", "legs", "exchanged", "stolen", "merged")
"""Sides of the whole body, of arms, of legs swapped; a limb exchanged with the partner's; a limb found on the partner
only; a person whose every joint is now and then the partner's."""

_MIRROR = np.array(OP14.mirror)
_ARMS, _LEGS = np.array(OP14.arms).ravel(), np.array(OP14.legs).ravel()
_LIMBS = [np.array(limb[1:]) for side in zip(OP14.arms, OP14.legs, strict=True) for limb in side]
_VISIBLE = 0.06
"""A fault that moves a joint by less than this share of the body's height cannot be seen, and does no harm."""


@dataclass(frozen=True)
class Faulty:
    """Keypoints (person, frame, 14, 2), confidences, and which joints are visibly wrong (person, frame, 14)."""

    keypoints_px: Array
    confidence: Array
    is_wrong: npt.NDArray[np.bool_]


def inject(
    rng: np.random.Generator, keypoints_px: Array, confidence: Array, kind: str, *, every: int = 40, longest: int = 6
) -> Faulty:
    """Put a fault of 1 to `longest` frames into every stretch of `every` frames, of one of the people."""
    points, people = keypoints_px.copy(), len(keypoints_px)
    for start in range(5, keypoints_px.shape[1] - longest - 5, every):
        first = start + int(rng.integers(0, every - longest - 5))
        frames = slice(first, first + int(rng.integers(1, longest + 1)))
        person = int(rng.integers(people))
        own, other = points[person, frames], points[1 - person, frames].copy()
        limb = _LIMBS[int(rng.integers(4))]
        if kind in {"body", "arms", "legs"}:
            joints = {"body": np.concatenate([_ARMS, _LEGS]), "arms": _ARMS, "legs": _LEGS}[kind]
            own[:, joints] = own[:, _MIRROR[joints]]
        elif kind == "exchanged":
            points[1 - person, frames][:, limb] = own[:, limb]
            own[:, limb] = other[:, limb]
        elif kind == "stolen":
            own[:, limb] = other[:, limb]
        else:
            joints = np.flatnonzero(rng.random(14) < 0.5)
            own[:, joints] = other[:, joints]
    moved = np.linalg.norm(points - keypoints_px, axis=-1)
    return Faulty(points, confidence, moved > _VISIBLE * np.nanmedian(body_size_px(keypoints_px, confidence)))


@dataclass(frozen=True)
class JointCounts:
    """What a repair did, in joints over people and frames; counts of several videos add up.

    Args:
        wrong: Visibly wrong before.
        found: Of these, changed or masked.
        changed: Changed or masked at all, by more than can be missed.
        repaired: Of the wrong ones, right afterwards.
        left: Of the wrong ones, still wrong and not masked.
    """

    wrong: int = 0
    found: int = 0
    changed: int = 0
    repaired: int = 0
    left: int = 0

    def __add__(self, other: JointCounts) -> JointCounts:
        """Add up."""
        return JointCounts(*(one + two for one, two in zip(astuple(self), astuple(other), strict=True)))

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the wrong joints found, put right, and still wrong and believed, and of the changed ones wrong.

        NaN where none is wrong, or none was changed.
        """
        return {
            "share_of_wrong_joints_found": _share(self.found, self.wrong),
            "share_of_changed_joints_that_were_wrong": _share(self.found, self.changed),
            "share_of_wrong_joints_put_right": _share(self.repaired, self.wrong),
            "share_of_wrong_joints_left": _share(self.left, self.wrong),
        }


def _share(count: int, among: int) -> float:
    return count / among if among else float("nan")


def count_joints(faulty: Faulty, true_px: Array, found: RepairedCrowd) -> JointCounts:
    """Count what a repair of injected faults did, against the true keypoints (person, frame, 14, 2)."""
    is_changed = found.is_touched.copy()
    # Joints that a repair moved by less than can be seen are neither found nor falsely accused.
    moved = np.linalg.norm(found.keypoints_px - faulty.keypoints_px, axis=-1)
    size = np.nanmedian(body_size_px(true_px, np.ones(true_px.shape[:-1])))
    is_changed &= found.is_masked | (moved > _VISIBLE * size)
    off = np.linalg.norm(found.keypoints_px - true_px, axis=-1)
    is_right = off < 0.5 * _VISIBLE * size
    wrong = faulty.is_wrong
    counts = [wrong, wrong & is_changed, is_changed, wrong & is_right, wrong & ~is_right & ~found.is_masked]
    return JointCounts(*(int(np.count_nonzero(one)) for one in counts))
