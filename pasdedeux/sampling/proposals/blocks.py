"""Gaussian steps of some blocks at a time: a root, or a joint's bone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS, NUM_PER_PERSON
from pasdedeux.sampling.proposals.kernels import move_blocks
from pasdedeux.sampling.proposals.proposal import (
    Blocks,
    Context,
    Proposal,
    ProposalInputs,
    ProposalKind,
    Proposed,
    Scales,
)
from pasdedeux.skeletons import PAIR17


@dataclass(frozen=True)
class Steps:
    """How far steps go before warm-up has learned factors on them, and how much they move together; ours.

    Args:
        root_rotation_rad: Of a root's rotation, radians.
        root_position_m: Of a root's position, metres.
        joint_rotation_rad: Of a bone's rotation, radians.
        length_change: Of a bone's relative length.
        max_blocks: Roots and bones moved by one step, at most.
    """

    root_rotation_rad: float = 0.02
    root_position_m: float = 0.005
    joint_rotation_rad: float = 0.04
    length_change: float = 0.005
    max_blocks: int = 4


@dataclass(frozen=True)
class GaussianBlocks:
    """Symmetric Gaussian steps.

    A root turns by a small rotation in the world (isotropic, so the step does not depend on how the pair stands: it is
    symmetric for the invariant measure on rotations) and shifts; a bone turns about its two axes and changes its
    length, together with its counterpart on the other side of the body.

    Args:
        steps: Standard deviations, and how many blocks move together.
        scales: Learned factors on them.
    """

    steps: Steps = field(default_factory=Steps)
    scales: Scales = field(default_factory=Scales)

    def with_scales(self, scales: Scales) -> Self:
        """Return the same proposal with other learned factors."""
        return replace(self, scales=scales)

    def prepare(self, parameters: Array) -> Context | None:
        """Return nothing: the step is the same everywhere."""
        return None

    def __call__(self, parameters: Array, context: Context | None, rng: np.random.Generator) -> Proposed:
        """Propose a step from parameters (108,)."""
        blocks = self._drawn(rng)
        noise = rng.standard_normal((len(blocks), 6))
        moved = self._moved(parameters, blocks, noise, self.scales.of(blocks), *self._deviations)
        return Proposed(moved, blocks=blocks)

    def _drawn(self, rng: np.random.Generator) -> Blocks:
        """Return the blocks of a step, 1 to `max_blocks` of them: with chances that do not depend on the place."""
        # A number that nothing uses: chains keep the random numbers, and so the draws, that they have always had.
        rng.random()
        count = int(rng.integers(1, self.steps.max_blocks + 1))
        return rng.choice(NUM_BLOCKS, size=count, replace=False, shuffle=False)

    def _moved(
        self, parameters: Array, blocks: npt.NDArray[np.int64], noise: Array, factors: Array, turn: Array, shift: Array
    ) -> Array:
        """Return the parameters after a step with these deviations of turns (34,) and of the roots' shifts (2,)."""
        moved = parameters.copy()
        length_change = self.steps.length_change
        move_blocks(moved, blocks, factors, noise, turn, shift, length_change, _TIED_LENGTHS, NUM_JOINTS)
        return moved

    @cached_property
    def _deviations(self) -> tuple[Array, Array]:
        """Standard deviations before learned factors: of turns (34,) and of the roots' shifts (2,)."""
        turn = np.full(NUM_BLOCKS, self.steps.joint_rotation_rad)
        turn[::NUM_JOINTS] = self.steps.root_rotation_rad
        return turn, np.full(2, self.steps.root_position_m)


class UnbiasedKind(ProposalKind):
    """The same steps everywhere."""

    name = "unbiased"

    def build(self, inputs: ProposalInputs) -> Proposal:
        """Return symmetric Gaussian steps."""
        return GaussianBlocks()


def _tied_lengths(block: int) -> tuple[int, int]:
    """Return the length parameters that change with a block's bone: its own and its counterpart's, -1 for none."""
    person, joint = divmod(block, NUM_JOINTS)
    if joint == 0:
        return -1, -1
    first, *rest = (NUM_PER_PERSON * person + 5 + 3 * one for one in sorted({joint, PAIR17.mirror[joint]}))
    return first, rest[0] if rest else -1


_TIED_LENGTHS = np.array([_tied_lengths(block) for block in range(NUM_BLOCKS)], dtype=np.int64)
