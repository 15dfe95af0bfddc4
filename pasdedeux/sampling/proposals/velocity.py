"""Steps that are wider where the annotations nearby move (Yin et al. 2018, eq. 12).

The variance of every rotation and shift grows by the mean squared speed of the annotations nearest to the pair's
projections.  It then depends on the state of the chain, and both densities enter eq. 10.  As the step back is the
step's own negative (the inverse of a turn), those are the densities of one displacement under the variances here and
there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.sampling.chain import ChainState, Context, Correction, Proposed
from pasdedeux.sampling.parameters import NUM_JOINTS
from pasdedeux.sampling.proposals.blocks import GaussianBlocks
from pasdedeux.sampling.proposals.proposal import ProposalInputs, ProposalKind
from pasdedeux.sampling.speeds import Speeds


@dataclass(frozen=True, kw_only=True)
class VelocityBlocks(GaussianBlocks):
    """Gaussian steps, wider where annotations nearby move.

    Args:
        steps: Standard deviations without speed (sigma_0 of eq. 12), none of them 0, and how many blocks move together.
        speeds: Squared speeds of the annotated pairs.
        nearest: Gives, for parameters (108,), the annotated pair nearest to each projection (D* of eq. 12); -1 for
            none.  The same pair, moved rigidly, must give the same.
    """

    speeds: Speeds
    nearest: Callable[[Array], Context] = field(repr=False)

    def init(self, parameters: Array) -> Context:
        """Return the annotations nearest to each projection of a point (108,)."""
        return self.nearest(parameters)

    def propose(self, rng: np.random.Generator, state: ChainState) -> Proposed:
        """Propose a step with the width of the state's context."""
        blocks, noise = self._drawn(rng)
        turn, shift = self._widened(state.context)
        proposed = self._moved(state, blocks, noise, turn, shift)

        def correct() -> Correction:
            there = self.init(proposed)
            known = log_ratio_of_steps(blocks, noise, turn, shift, *self._widened(there), False, NUM_JOINTS)
            return Correction(float(known), there)

        bound = log_ratio_of_steps(blocks, noise, turn, shift, *self._deviations, True, NUM_JOINTS)
        return Proposed(proposed, float(bound), correct, blocks)

    def _widened(self, context: Context | None) -> tuple[Array, Array]:
        """Return eq. 12's standard deviations before learned factors: of turns (34,) and of the roots' shifts (2,)."""
        if context is None:
            raise InputError("the velocity-biased proposal must be prepared at a point before it can leave it")
        turn, shift = self._deviations
        turn_squared, shift_squared = self.speeds.mean(context)
        return np.sqrt(turn**2 + turn_squared), np.sqrt(shift**2 + shift_squared)


def _init(inputs: ProposalInputs) -> VelocityBlocks:
    assert inputs.speeds is not None
    return VelocityBlocks(
        speeds=inputs.speeds, nearest=lambda parameters: inputs.nearest(inputs.chart.positions(parameters))
    )


VELOCITY = ProposalKind("velocity", _init, reads_annotations=True)
"""Wider steps where the annotations nearby move (eq. 12)."""


@compiled()
def log_normal_ratio(count, square, here, there, is_bound):  # type: ignore[no-untyped-def]
    """Return log N(-x; 0, there) - log N(x; 0, here) of an x of `count` numbers whose square is here^2 times `square`.

    With `is_bound`, the greatest over all deviations from `there` on: it peaks at here^2 square / count.
    """
    if is_bound:
        there = max(there, here * math.sqrt(square / count))
    ratio = here / there
    return count * math.log(ratio) + 0.5 * square * (1.0 - ratio * ratio)


@compiled()
def log_ratio_of_steps(blocks, noise, turn, shift, turn_there, shift_there, is_bound, num_joints):  # type: ignore[no-untyped-def]
    """Return log Q(back) - log Q(forth) of one displacement; lengths and factors, the same both ways, cancel.

    Args:
        blocks: Blocks that moved, (n,).
        noise: The displacement in units of the deviations it was drawn with, (n, 6).
        turn: Those deviations of turns, (34,).
        shift: Those of shifts, (2,).
        turn_there: Deviations of turns at the other end, (34,).
        shift_there: Deviations of shifts there, (2,).
        is_bound: Give the greatest value for deviations there of at least so much instead.
        num_joints: Joints of a person.
    """
    total = 0.0
    for at in range(blocks.shape[0]):
        block = blocks[at]
        person = block // num_joints
        square = noise[at, 0] ** 2 + noise[at, 1] ** 2
        if block % num_joints == 0:
            moved = noise[at, 3] ** 2 + noise[at, 4] ** 2 + noise[at, 5] ** 2
            total += log_normal_ratio(3.0, moved, shift[person], shift_there[person], is_bound)
            total += log_normal_ratio(3.0, square + noise[at, 2] ** 2, turn[block], turn_there[block], is_bound)
        else:
            total += log_normal_ratio(2.0, square, turn[block], turn_there[block], is_bound)
    return total
