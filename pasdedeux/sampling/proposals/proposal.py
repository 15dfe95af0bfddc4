"""Definition of a proposal: a step of a chain, with the data for eq. 10 (Yin et al. 2018)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.sampling.chain import ChainState, Context, Proposed
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.speeds import Speeds


class Proposal(ABC):
    """Steps of a chain over the 108 parameters of a pair.

    A step draws all of its randomness from the given generator, does not change the point it starts from, and states
    the ratio of its densities both ways, so that the chain is in detailed balance with its target.  It multiplies its
    deviations by the learned factors of the state, and reports the blocks that moved, for warm-up.
    """

    def init(self, parameters: Array) -> Context | None:
        """Return the data needed for a step from a point (108,); None if none are."""
        return None

    @abstractmethod
    def propose(self, rng: np.random.Generator, state: ChainState) -> Proposed:
        """Propose a step from where the chain is; the state's context is what `init` returns there."""


@dataclass(frozen=True)
class ProposalInputs:
    """Inputs of a proposal.

    Args:
        chart: Parameters round the seed.
        nearest: Gives, for a pair (2, 17, 3), metres, the annotation nearest to each of its projections, (view,), -1
            for none; no view for a density that compares with no annotations.
        speeds: Squared speeds of the annotations; None without them.
    """

    chart: PairChart
    nearest: Callable[[Array], Context]
    speeds: Speeds | None = None


@dataclass(frozen=True)
class ProposalKind:
    """A kind of proposal that a study may choose by its name.

    Args:
        name: Value of `chains.proposal`.
        init: Makes the proposal round one seed.
        reads_annotations: Whether it needs annotations and their speeds; densities without are sampled by the default.
    """

    name: str
    init: Callable[[ProposalInputs], Proposal]
    reads_annotations: bool = False
