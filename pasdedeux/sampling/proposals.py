"""Proposals: where a chain looks next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import multiply, rotvec_from_unitquat, unitquat_from_rotvec
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS, NUM_PER_PERSON, block_indices
from pasdedeux.skeletons import PAIR17

__all__ = ["GaussianBlocks", "Proposed"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Proposed:
    """A proposed point.

    Args:
        parameters: The point.
        log_correction: log Q(here | there) - log Q(there | here): what eq. 10 adds; 0 for a symmetric proposal.
    """

    parameters: Array
    log_correction: float = 0.0


@dataclass(frozen=True)
class GaussianBlocks:
    """Symmetric Gaussian steps of a few blocks at a time: a root, or a joint's bone.

    Between 1 and `most_blocks` of the 34 blocks are chosen uniformly.  A root turns by a small rotation in the world
    (isotropic, so the step does not depend on how the pair stands: it is symmetric for the invariant measure on
    rotations) and shifts; a bone turns about its two axes and changes its length, together with its counterpart on the
    other side of the body.

    Args:
        root_rotation_rad: Standard deviation of a root's turn about each axis, radians.
        root_position_m: Standard deviation of a root's shift along each axis, metres.
        joint_rotation_rad: Standard deviation of a bone's turn about each of its two axes, radians.
        length_change: Standard deviation of the relative change of a bone's length.
        most_blocks: Blocks moved at once, at most.

    Raises:
        InputError: A scale is negative or not finite, or `most_blocks` is not between 1 and 34.
    """

    root_rotation_rad: float = 0.02
    root_position_m: float = 0.005
    joint_rotation_rad: float = 0.04
    length_change: float = 0.005
    most_blocks: int = 4

    def __post_init__(self) -> None:
        """Check the scales."""
        scales = (self.root_rotation_rad, self.root_position_m, self.joint_rotation_rad, self.length_change)
        if not all(np.isfinite(scale) and scale >= 0.0 for scale in scales):
            raise InputError(f"proposal scales must be finite and not negative, found {scales}")
        if not 1 <= self.most_blocks <= NUM_BLOCKS:
            raise InputError(f"between 1 and {NUM_BLOCKS} blocks can move at once, found {self.most_blocks}")

    def __call__(self, parameters: Array, rng: np.random.Generator) -> Proposed:
        """Propose a step from parameters (108,)."""
        proposed = parameters.copy()
        count = int(rng.integers(1, self.most_blocks + 1))
        for block in rng.choice(NUM_BLOCKS, size=count, replace=False, shuffle=False):
            indices = block_indices(int(block))
            if len(indices) == 6:
                noise = rng.standard_normal(6)
                turn = unitquat_from_rotvec(self.root_rotation_rad * noise[:3])
                before = unitquat_from_rotvec(proposed[indices[:3]])
                proposed[indices[:3]] = rotvec_from_unitquat(multiply(turn, before))
                proposed[indices[3:]] += self.root_position_m * noise[3:]
                continue
            noise = rng.standard_normal(3)
            proposed[indices[:2]] += self.joint_rotation_rad * noise[:2]
            for index in _TIED_LENGTHS[int(block)]:
                proposed[index] += self.length_change * noise[2]
        return Proposed(proposed)


def _tied_lengths(block: int) -> tuple[int, ...]:
    """Give the length parameters that change with a block's bone: its own and its counterpart's."""
    person, joint = divmod(block, NUM_JOINTS)
    joints = {joint, PAIR17.mirror[joint]}
    return tuple(NUM_PER_PERSON * person + 5 + 3 * one for one in sorted(joints)) if joint else ()


_TIED_LENGTHS = tuple(_tied_lengths(block) for block in range(NUM_BLOCKS))
