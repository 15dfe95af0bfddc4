"""Gaussian steps of some blocks at a time: a root, or a joint's bone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import multiply, rotvec_from_unitquat, unitquat_from_rotvec
from pasdedeux.sampling.chain import Blocks, ChainState, Proposed
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS, NUM_PER_PERSON
from pasdedeux.sampling.proposals.proposal import Proposal, ProposalKind
from pasdedeux.skeletons import PAIR17


@dataclass(frozen=True)
class StepSizes:
    """Sizes of steps before warm-up scales them, and the number of blocks moved together; our choice.

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
class GaussianBlocks(Proposal):
    """Symmetric Gaussian steps.

    A root turns by a small rotation in the world (isotropic, so the step does not depend on how the pair stands: it is
    symmetric for the invariant measure on rotations) and shifts; a bone turns about its two axes and changes its
    length, together with its counterpart on the other side of the body.

    Args:
        steps: Standard deviations, and how many blocks move together.
    """

    steps: StepSizes = StepSizes()

    def propose(self, rng: np.random.Generator, state: ChainState) -> Proposed:
        """Propose a step."""
        blocks, noise = self._drawn(rng)
        return Proposed(self._moved(state, blocks, noise, *self._deviations), blocks=blocks)

    def _drawn(self, rng: np.random.Generator) -> tuple[Blocks, Array]:
        """Return the blocks of a step, 1 to `max_blocks` of them, wherever the chain is, and normal noise (n, 6)."""
        # An unused number: it preserves the sequence of random numbers, and so the draws, of earlier versions.
        rng.random()
        count = int(rng.integers(1, self.steps.max_blocks + 1))
        blocks = rng.choice(NUM_BLOCKS, size=count, replace=False, shuffle=False)
        return blocks, rng.standard_normal((count, 6))

    def _moved(self, state: ChainState, blocks: Blocks, noise: Array, turn: Array, shift: Array) -> Array:
        """Return the parameters after a step with these deviations of turns (34,) and of the roots' shifts (2,)."""
        moved, factors = state.parameters.copy(), np.exp(state.log_scales[blocks])
        _move_blocks(moved, blocks, factors, noise, turn, shift, self.steps.length_change, _TIED_LENGTHS, NUM_JOINTS)
        return moved

    @cached_property
    def _deviations(self) -> tuple[Array, Array]:
        """Standard deviations before learned factors: of turns (34,) and of the roots' shifts (2,)."""
        turn = np.full(NUM_BLOCKS, self.steps.joint_rotation_rad)
        turn[::NUM_JOINTS] = self.steps.root_rotation_rad
        return turn, np.full(2, self.steps.root_position_m)


UNBIASED = ProposalKind("unbiased", lambda _: GaussianBlocks())
"""The same steps everywhere."""


def _tied_lengths(block: int) -> tuple[int, int]:
    """Return the length parameters that change with a block's bone: its own and its counterpart's, -1 for none."""
    person, joint = divmod(block, NUM_JOINTS)
    if joint == 0:
        return -1, -1
    first, *rest = (NUM_PER_PERSON * person + 5 + 3 * side for side in sorted({joint, PAIR17.mirror[joint]}))
    return first, rest[0] if rest else -1


_TIED_LENGTHS = np.array([_tied_lengths(block) for block in range(NUM_BLOCKS)], dtype=np.int64)


@compiled()
def _move_blocks(parameters, blocks, factors, noise, turn, shift, length_change, tied, num_joints):  # type: ignore[no-untyped-def]
    """Move blocks of `parameters` in place: roots turn in the world and shift, bones turn and change their length.

    Args:
        parameters: Parameters (108,).
        blocks: Blocks that move, (n,).
        factors: Factor on their deviations, (n,).
        noise: Standard normal numbers (n, 6); a bone needs three.
        turn: Standard deviations of the blocks' turns, (34,).
        shift: Those of the roots' shifts, (2,).
        length_change: That of the bones' lengths.
        tied: Length parameter of each block and of its counterpart, (34, 2); the second is -1 where it has none.
        num_joints: Joints of a person.
    """
    for at in range(blocks.shape[0]):
        block = blocks[at]
        person, joint = block // num_joints, block % num_joints
        start = person * (3 + 3 * num_joints)
        size = factors[at] * turn[block]
        if joint == 0:
            turn_by = unitquat_from_rotvec((size * noise[at, 0], size * noise[at, 1], size * noise[at, 2]))
            before = unitquat_from_rotvec((parameters[start], parameters[start + 1], parameters[start + 2]))
            after = rotvec_from_unitquat(multiply(turn_by, before))
            parameters[start], parameters[start + 1], parameters[start + 2] = after
            for axis in range(3):
                parameters[start + 3 + axis] += factors[at] * shift[person] * noise[at, 3 + axis]
            continue
        start += 3 + 3 * joint
        parameters[start] += size * noise[at, 0]
        parameters[start + 1] += size * noise[at, 1]
        for side in range(2):
            if tied[block, side] >= 0:
                parameters[tied[block, side]] += factors[at] * length_change * noise[at, 2]
