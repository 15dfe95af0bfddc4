"""Steps that are wider where the annotations nearby move (Yin et al. 2018, eq. 12).

The variance of every rotation and shift grows by the mean squared speed of the annotations nearest to the pair's
projections.  It then depends on where the chain stands, and both densities enter eq. 10.  As the step back is the
step's own negative (the inverse of a turn), those are the densities of one displacement under the variances here and
there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS
from pasdedeux.sampling.proposals.blocks import GaussianBlocks
from pasdedeux.sampling.proposals.kernels import log_ratio_of_steps
from pasdedeux.sampling.proposals.proposal import Context, Correction, Proposal, ProposalInputs, ProposalKind, Proposed
from pasdedeux.sampling.speeds import Speeds


def _no_speeds() -> Speeds:
    return Speeds(np.zeros((0, NUM_BLOCKS)), np.zeros((0, 2)))


@dataclass(frozen=True)
class VelocityBlocks(GaussianBlocks):
    """Gaussian steps, wider where annotations nearby move.

    Args:
        steps: Standard deviations without speed (sigma_0 of eq. 12), none of them 0, and how many blocks move together.
        scales: Learned factors.
        speeds: Squared speeds of the annotated pairs.
        nearest: Gives, for parameters (108,), the annotated pair nearest to each projection (D* of eq. 12); -1 for
            none.  The same pair, moved rigidly, must give the same.
    """

    speeds: Speeds = field(default_factory=_no_speeds)
    nearest: Callable[[Array], Context] = field(default=lambda _: np.zeros(0, dtype=np.int64), repr=False)

    def prepare(self, parameters: Array) -> Context | None:
        """Return the annotations nearest to each projection of a point (108,)."""
        return self.nearest(parameters)

    def __call__(self, parameters: Array, context: Context | None, rng: np.random.Generator) -> Proposed:
        """Propose a step from parameters (108,); `context` is what `prepare` returns there."""
        blocks = self._drawn(rng)
        noise = rng.standard_normal((len(blocks), 6))
        turn, shift = self._widened(context)
        proposed = self._moved(parameters, blocks, noise, self.scales.of(blocks), turn, shift)

        def correct() -> Correction:
            there = self.prepare(proposed)
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


class VelocityKind(ProposalKind):
    """Wider steps where the annotations nearby move (eq. 12)."""

    name = "velocity"
    reads_annotations = True

    def build(self, inputs: ProposalInputs) -> Proposal:
        """Return velocity-biased steps; the inputs have annotations and their speeds."""
        nearest, speeds, chart = inputs.nearest, inputs.speeds, inputs.chart
        assert nearest is not None
        assert speeds is not None
        return VelocityBlocks(speeds=speeds, nearest=lambda parameters: nearest(chart.positions_fast(parameters)))
