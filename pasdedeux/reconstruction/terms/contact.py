"""Two bodies that share a frame: they do not pass through each other, and hands that stay in place touch."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers, merge_axes
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.reconstruction.terms.placed import By, Couple, PlacedPeople, SeenPeople, Unknown, beside
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm
from pasdedeux.skeletons import OP14

_PARENTS = np.array(OP14.parents)
_HANDS = [
    place for place, (_, child) in enumerate(OP14.bones) if OP14.joint_names[child] in ("left_wrist", "right_wrist")
]
_TOUCH_IMAGE_M, _TOUCH_S, _TOUCH_KEEP_M = 0.05, 3.0, 0.1
"""A hand may touch if it is at most so far from the other's image, for so long, and moves along the bone by no more."""


@dataclass(frozen=True)
class SurfaceTerm(SceneTerm):
    """gap / (mean size * deviation) between the surfaces of some bones of two people.

    Args:
        couple: The two people.
    """

    couple: Couple
    deviation_m: ClassVar[float]
    alike_s = 0.7

    @abstractmethod
    def bones(self, scene: PlacedPeople) -> tuple[Integers, Integers]:
        """Return frames of both (n,) and the bones of the first and the second there (2, n)."""

    @abstractmethod
    def counts(self, gaps: Array) -> Flags:
        """Tell which gaps (n,) count."""

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (n,)."""
        rows, bones = self.bones(scene)
        gaps = scene.gaps[self.couple.people].gap_m[rows, *bones] / self._unit(scene)
        return np.asarray(np.where(self.counts(gaps), gaps, 0.0))

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        seen, sides, between, unit = scene.seen, self.couple.sides, scene.gaps[self.couple.people], self._unit(scene)
        rows, bones = self.bones(scene)
        gaps, joints, share = between.gap_m[rows, *bones] / unit, between.bones[bones], between.share[rows, *bones]
        ends = []
        for side, (number, at) in enumerate(sides):
            start, end = (scene.joints[number][:, at[rows], joint] for joint in (_PARENTS[joints[side]], joints[side]))
            ends.append(start + share[:, side, None] * (end - start))
        apart = ends[1][0] - ends[0][0]
        along = apart / np.maximum(unit * np.linalg.norm(apart, axis=1, keepdims=True), 1e-9)
        moved = np.stack([-(ends[0] * along).sum(axis=-1), (ends[1] * along).sum(axis=-1)])
        # Growing bodies become thicker, and the deviation wider.
        people = list(self.couple.people)
        sizes, radii = scene.sizes[people], np.take_along_axis(scene.radii_m(self.couple), joints, axis=1)
        grown = moved[:, By.SIZE] - radii / unit - 0.5 * gaps * (sizes / sizes.mean())[:, None]
        slopes = beside(*moved[:, By.DISTANCE], *grown, moved[:, By.LENS].sum(axis=0))
        columns = beside(*(seen.starts[number] + at[rows] for number, at in sides), *seen.sizes[people], Unknown.LENS)
        return Jacobian(columns, slopes * self.counts(gaps)[:, None])

    def _unit(self, scene: PlacedPeople) -> float:
        return float(scene.sizes[list(self.couple.people)].mean() * self.deviation_m)


@dataclass(frozen=True)
class GapTerm(SurfaceTerm):
    """Gap between the nearest bones, where bodies overlap.

    Args:
        is_carrying: Whether one of the two carries the other, so that they touch all the time.
    """

    is_carrying: bool = False
    deviation_m = 0.05

    def bones(self, scene: PlacedPeople) -> tuple[Integers, Integers]:
        """Return all frames of both and the nearest bones."""
        gap_m = scene.gaps[self.couple.people].gap_m
        return np.arange(len(gap_m)), np.stack(np.divmod(merge_axes(gap_m, 1).argmin(axis=1), gap_m.shape[-1]))

    def counts(self, gaps: Array) -> Flags:
        """Return which gaps count: those of overlapping bodies."""
        return (gaps < 0.0) | self.is_carrying


@dataclass(frozen=True)
class TouchTerm(SurfaceTerm):
    """Gap between a hand and the bone of the other that it touches in the image, where they are apart.

    A hand in front of the other's image need not be on the body, so this term makes no place more certain.

    Args:
        touching: Whether each hand may be on each bone of the other (shared frame, A's two hands and B's two, bone).
    """

    touching: Flags
    deviation_m = 0.08
    is_robust = True
    is_certain = False

    def bones(self, scene: PlacedPeople) -> tuple[Integers, Integers]:
        """Return frames and bones of each touch: for each hand, the nearest bone on which it may be."""
        bone = np.where(self.touching, _of_hands(scene.gaps[self.couple.people].gap_m), np.inf).argmin(axis=2)
        rows, hand = np.nonzero(self.touching.any(axis=2))
        bones = np.stack([np.array(_HANDS * 2)[hand], bone[rows, hand]])
        return rows, np.where(hand < len(_HANDS), bones, bones[::-1])

    def counts(self, gaps: Array) -> Flags:
        """Return which gaps count: those of hands away from the partner."""
        return gaps > 0.0


def touching_hands(seen: SeenPeople, couple: Couple) -> Flags:
    """Tell on which bones of the other each hand stays in the image (shared frame, A's two hands and B's two, bone).

    A hand that only passes or dances in front of the other moves along the bone.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # here: 0.2 s that planning does not need

    people = [seen.people[number] for number in couple.people]
    both = np.stack([seen.people[number].track.positions_m[at] for number, at in couple.sides], axis=1)
    lengths = np.median(np.stack([bone_lengths(OP14, both[:, person]) for person in (0, 1)]), axis=1)
    depth = -both[..., 2].mean(axis=(1, 2))
    flat = both / -both[..., 2:] * depth[:, None, None, None]
    flat[..., 2] = 0.0
    between = surface_gaps(flat, np.stack([person.radii_m for person in people]), OP14)
    gap = _of_hands(between.gap_m)
    along = _of_hands(between.share[..., 1], between.share[..., 0])
    along = along * lengths[[1, 1, 0, 0]][:, between.bones]
    length = 2 * round(0.5 * _TOUCH_S * seen.rate_hz) + 1
    high, low = (op(along, length, axis=0) for op in (maximum_filter1d, minimum_filter1d))
    stays = maximum_filter1d(gap, length, axis=0) < _TOUCH_IMAGE_M
    stays &= high - low < _TOUCH_KEEP_M
    return maximum_filter1d(stays.astype(np.uint8), length, axis=0).astype(bool)


def _of_hands(first: Array, second: Array | None = None) -> Array:
    """Choose from (frame, bone of A, bone of B): A's hands with each bone of B, then B's hands with each bone of A."""
    second = first if second is None else second
    return np.concatenate([first[:, _HANDS], second[:, :, _HANDS].swapaxes(1, 2)], axis=1)
