"""Proposals: where a chain looks next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.sampling.moves import Move, MoveMixture
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS, NUM_PER_PERSON
from pasdedeux.sampling.proposal_kernels import log_ratio_of_steps, move_blocks
from pasdedeux.sampling.velocity import Speeds
from pasdedeux.skeletons import PAIR17

__all__ = ["GaussianBlocks", "Local", "Proposed", "Resolved", "Scales", "VelocityBias"]

Array = npt.NDArray[np.float64]
Local = npt.NDArray[np.int64]
"""What a proposal must know of a point beyond its parameters: the annotations that are nearest to it."""


@dataclass(frozen=True)
class Resolved:
    """What a proposal that depends on where it stands knows once it looked round at the proposed point.

    Args:
        log_correction: log Q(here | there) - log Q(there | here): what eq. 10 adds.
        local: What the proposal must know of the proposed point.
    """

    log_correction: float
    local: Local | None


@dataclass(frozen=True)
class Proposed:
    """A proposed point.

    Args:
        parameters: The point.
        log_correction: log Q(here | there) - log Q(there | here): what eq. 10 adds; 0 for a symmetric proposal.  At
            most so much when there is `resolve`.
        resolve: Looks round at the proposed point, which is dear, for the correction itself; None where it is known.
        move: Which parameters moved together, for those who learn scales.
    """

    parameters: Array
    log_correction: float = 0.0
    resolve: Callable[[], Resolved] | None = None
    move: Move | None = None


@dataclass(frozen=True)
class Scales:
    """Factors on a proposal's standard deviations, learned in warm-up and then kept.

    Args:
        log_block: Logarithm of each block's factor, (34,).
        log_move: Logarithm of each move's factor on top, (14,).

    Raises:
        InputError: Shapes that do not fit, or a value that is not finite.
    """

    log_block: Array = field(default_factory=lambda: np.zeros(NUM_BLOCKS))
    log_move: Array = field(default_factory=lambda: np.zeros(MoveMixture.NUM_MOVES))

    def __post_init__(self) -> None:
        """Check shapes and finiteness."""
        if self.log_block.shape != (NUM_BLOCKS,) or self.log_move.shape != (MoveMixture.NUM_MOVES,):
            raise InputError(f"scales have shapes {self.log_block.shape} and {self.log_move.shape}")
        if not (np.isfinite(self.log_block).all() and np.isfinite(self.log_move).all()):
            raise InputError("a scale of a proposal is not finite")

    def of(self, move: Move) -> Array:
        """Return the factor of each block of a move."""
        return np.asarray(np.exp(self.log_block[list(move.blocks)] + self.log_move[move.index]))


@dataclass(frozen=True)
class VelocityBias:
    """What the velocity-biased kernel looks round with.

    Args:
        speeds: Squared speeds of the annotated pairs.
        nearest: Gives, for parameters (108,), the annotated pair nearest to each projection (D* of eq. 12); -1 for
            nobody.  The same pair, moved rigidly, must give the same.
    """

    speeds: Speeds
    nearest: Callable[[Array], Local]


@dataclass(frozen=True)
class GaussianBlocks:
    """Gaussian steps of some blocks at a time: a root, or a joint's bone.

    A root turns by a small rotation in the world (isotropic, so the step does not depend on how the pair stands: it is
    symmetric for the invariant measure on rotations) and shifts; a bone turns about its two axes and changes its
    length, together with its counterpart on the other side of the body.

    Without `bias` the step is symmetric.  With it, it is velocity-biased (Yin et al. 2018, eq. 12): the variance of
    every rotation and shift grows by the mean squared speed of the annotations nearest to the pair's projections.  It
    then depends on where the chain stands, and both densities enter eq. 10.  As the step back is the step's own
    negative (the inverse of a turn), those are the densities of one displacement under the variances here and there.

    Args:
        root_rotation_rad: Standard deviation of a root's turn about each axis, radians (sigma_0 of eq. 12, as below).
        root_position_m: Standard deviation of a root's shift along each axis, metres.
        joint_rotation_rad: Standard deviation of a bone's turn about each of its two axes, radians.
        length_change: Standard deviation of the relative change of a bone's length.
        mixture: Which blocks move together.
        scales: Learned factors on all of these.
        bias: Makes the kernel velocity-biased.

    Raises:
        InputError: A scale is negative or not finite, or one is 0 that the velocity-biased kernel divides by.
    """

    root_rotation_rad: float = 0.02
    root_position_m: float = 0.005
    joint_rotation_rad: float = 0.04
    length_change: float = 0.005
    mixture: MoveMixture = field(default_factory=MoveMixture)
    scales: Scales = field(default_factory=Scales)
    bias: VelocityBias | None = None

    def __post_init__(self) -> None:
        """Check the scales."""
        turns = (self.root_rotation_rad, self.root_position_m, self.joint_rotation_rad)
        scales = (*turns, self.length_change)
        if not all(np.isfinite(scale) and scale >= 0.0 for scale in scales):
            raise InputError(f"proposal scales must be finite and not negative, found {scales}")
        if self.bias is not None and not all(scale > 0.0 for scale in turns):
            raise InputError(f"the velocity-biased kernel needs positive scales of rotations and shifts, found {turns}")

    def with_scales(self, scales: Scales) -> GaussianBlocks:
        """Return the same proposal with other learned factors."""
        return replace(self, scales=scales)

    def look_round(self, parameters: Array) -> Local | None:
        """Return what the proposal must know of a point; None when it is the same everywhere."""
        return None if self.bias is None else self.bias.nearest(parameters)

    def __call__(self, parameters: Array, local: Local | None, rng: np.random.Generator) -> Proposed:
        """Propose a step from parameters (108,); `local` is what `look_round` gives there."""
        move = self.mixture.draw(rng)
        blocks = np.array(move.blocks, dtype=np.int64)
        noise = rng.standard_normal((len(blocks), 6))
        turn, shift = self._deviations(local)
        proposed = parameters.copy()
        move_blocks(
            proposed, blocks, self.scales.of(move), noise, turn, shift, self.length_change, _TIED_LENGTHS, NUM_JOINTS
        )
        if self.bias is None:
            return Proposed(proposed, move=move)

        def resolve() -> Resolved:
            there = self.look_round(proposed)
            known = log_ratio_of_steps(blocks, noise, turn, shift, *self._deviations(there), False, NUM_JOINTS)
            return Resolved(float(known), there)

        most = log_ratio_of_steps(blocks, noise, turn, shift, *self._least_deviations, True, NUM_JOINTS)
        return Proposed(proposed, float(most), resolve, move)

    def _deviations(self, local: Local | None) -> tuple[Array, Array]:
        """Return eq. 12's standard deviations before learned factors: of turns (34,) and of the roots' shifts (2,)."""
        turn, shift = self._least_deviations
        if self.bias is None:
            return turn, shift
        if local is None:
            raise InputError("the velocity-biased kernel must look round at a state before it can leave it")
        turn_squared, shift_squared = self.bias.speeds.mean(local)
        return np.sqrt(turn**2 + turn_squared), np.sqrt(shift**2 + shift_squared)

    @cached_property
    def _least_deviations(self) -> tuple[Array, Array]:
        turn = np.full(NUM_BLOCKS, self.joint_rotation_rad)
        turn[::NUM_JOINTS] = self.root_rotation_rad
        return turn, np.full(2, self.root_position_m)


def _tied_lengths(block: int) -> tuple[int, int]:
    """Return the length parameters that change with a block's bone: its own and its counterpart's, -1 for none."""
    person, joint = divmod(block, NUM_JOINTS)
    if joint == 0:
        return -1, -1
    first, *rest = (NUM_PER_PERSON * person + 5 + 3 * one for one in sorted({joint, PAIR17.mirror[joint]}))
    return first, rest[0] if rest else -1


_TIED_LENGTHS = np.array([_tied_lengths(block) for block in range(NUM_BLOCKS)], dtype=np.int64)
