"""Which parameters a step changes together: a few bones, a limb, a person, both roots.

A chain draws one of these moves at every step, with probabilities that do not depend on where it is, so the mixture
leaves the target as it is when each of them does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS
from pasdedeux.skeletons import PAIR17

__all__ = ["LIMBS", "Move", "MoveKind", "MoveMixture"]


class MoveKind(StrEnum):
    """What moves together."""

    FEW = "few"
    LIMB = "limb"
    PERSON = "person"
    ROOTS = "roots"


LIMBS = (PAIR17.indices(("spine", "chest", "neck", "head")), *PAIR17.limbs)
"""Bones of the trunk, the arms and the legs of one person, by the joint they end in."""


@dataclass(frozen=True)
class Move:
    """What one step changes.

    Args:
        index: Which of the mixture's moves this is, for what is learned of it; 0 for `few`.
        blocks: Blocks that move (see `block_indices`).
    """

    index: int
    blocks: tuple[int, ...]


_FIXED: dict[MoveKind, tuple[tuple[int, ...], ...]] = {
    MoveKind.LIMB: tuple(tuple(NUM_JOINTS * person + joint for joint in limb) for person in range(2) for limb in LIMBS),
    MoveKind.PERSON: tuple(tuple(range(NUM_JOINTS * person, NUM_JOINTS * (person + 1))) for person in range(2)),
    MoveKind.ROOTS: ((0, NUM_JOINTS),),
}
_FIRST = {MoveKind.FEW: 0, MoveKind.LIMB: 1, MoveKind.PERSON: 1 + 2 * len(LIMBS), MoveKind.ROOTS: 3 + 2 * len(LIMBS)}


@dataclass(frozen=True)
class MoveMixture:
    """Draws moves.

    Args:
        weights: How often each kind is drawn, relative to the others; a kind that is not named is never drawn.
        max_blocks: Blocks that `few` moves at once, between 1 and so many, chosen uniformly.

    Raises:
        InputError: A weight is negative or not finite, all are 0, or `max_blocks` is not between 1 and 34.
    """

    weights: Mapping[MoveKind, float] = field(default_factory=lambda: {MoveKind.FEW: 1.0})
    max_blocks: int = 4

    NUM_MOVES = 4 + 2 * len(LIMBS)
    """Moves that scales are kept for, whatever the weights."""

    def __post_init__(self) -> None:
        """Check weights and count."""
        values = list(self.weights.values())
        if not all(np.isfinite(value) and value >= 0.0 for value in values) or not sum(values) > 0.0:
            raise InputError(f"weights of moves must not be negative and one must be positive, found {values}")
        if not 1 <= self.max_blocks <= NUM_BLOCKS:
            raise InputError(f"between 1 and {NUM_BLOCKS} blocks can move at once, found {self.max_blocks}")
        kinds = [MoveKind(kind) for kind in self.weights]
        object.__setattr__(self, "_kinds", kinds)
        object.__setattr__(self, "_limits", np.cumsum(values) / sum(values))

    _kinds: list[MoveKind] = field(init=False, repr=False, compare=False)
    _limits: np.ndarray = field(init=False, repr=False, compare=False)

    def draw(self, rng: np.random.Generator) -> Move:
        """Draw a move."""
        kind = self._kinds[int(np.searchsorted(self._limits, rng.random(), side="right"))]
        if kind is MoveKind.FEW:
            count = int(rng.integers(1, self.max_blocks + 1))
            blocks = rng.choice(NUM_BLOCKS, size=count, replace=False, shuffle=False)
            return Move(0, tuple(int(block) for block in blocks))
        which = int(rng.integers(len(_FIXED[kind])))
        return Move(_FIRST[kind] + which, _FIXED[kind][which])
