"""What a proposal is: where a chain looks next, and what eq. 10 (Yin et al. 2018) must know of the step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.sampling.parameters import NUM_BLOCKS, PairChart
from pasdedeux.sampling.speeds import Speeds

Context = npt.NDArray[np.int64]
"""What a proposal must know of a point before it can leave it: the annotations that are nearest to it, (view,)."""
Blocks = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Correction:
    """What a proposal that depends on where it stands knows once it was prepared at the proposed point.

    Args:
        log_ratio: log Q(here | there) - log Q(there | here): what eq. 10 adds.
        context: What the proposal must know of the proposed point.
    """

    log_ratio: float
    context: Context | None


@dataclass(frozen=True)
class Proposed:
    """A proposed point.

    Args:
        parameters: The point.
        log_ratio: log Q(here | there) - log Q(there | here): what eq. 10 adds; 0 for a symmetric proposal.  An upper
            bound of it when there is `correct`.
        correct: Prepares the proposal at the proposed point, which is dear, for the ratio itself; None where it is
            known.
        blocks: Blocks that moved (see `NUM_BLOCKS`), for those who learn scales; None where scales are not learned.
    """

    parameters: Array
    log_ratio: float = 0.0
    correct: Callable[[], Correction] | None = None
    blocks: Blocks | None = None


@dataclass(frozen=True)
class Scales:
    """Factors on a proposal's standard deviations, learned in warm-up and then kept.

    Args:
        log_block: Logarithm of each block's factor, (34,).

    Raises:
        InputError: A shape that does not fit, or a value that is not finite.
    """

    log_block: Array = field(default_factory=lambda: np.zeros(NUM_BLOCKS))

    def __post_init__(self) -> None:
        """Check shape and finiteness."""
        if self.log_block.shape != (NUM_BLOCKS,):
            raise InputError(f"scales have the shape {self.log_block.shape}, not ({NUM_BLOCKS},)")
        if not np.isfinite(self.log_block).all():
            raise InputError("a scale of a proposal is not finite")

    def of(self, blocks: Blocks) -> Array:
        """Return the factor of each of these blocks."""
        return np.asarray(np.exp(self.log_block[blocks]))


class Proposal(Protocol):
    """Steps of a chain over the 108 parameters of a pair.

    A step draws all of its randomness from the generator it is given, leaves the point it starts from as it is, and
    states the ratio of its densities both ways, so that the chain is in detailed balance with its target.
    """

    @property
    def scales(self) -> Scales:
        """Learned factors on the size of the steps."""
        ...

    def with_scales(self, scales: Scales) -> Self:
        """Return the same proposal with other learned factors."""
        ...

    def prepare(self, parameters: Array) -> Context | None:
        """Return what must be known of a point (108,) before it can be left; None when nothing must."""
        ...

    def __call__(self, parameters: Array, context: Context | None, rng: np.random.Generator) -> Proposed:
        """Propose a step from parameters (108,); `context` is what `prepare` returns there."""
        ...


@dataclass(frozen=True)
class ProposalInputs:
    """What a proposal may be made from.

    Args:
        chart: Parameters round the seed.
        nearest: Gives, for a pair (2, 17, 3), metres, the annotation nearest to each of its projections, (view,), -1
            for none; None for a density that compares with no annotations.
        speeds: Squared speeds of the annotations; None without them.
    """

    chart: PairChart
    nearest: Callable[[Array], Context] | None = None
    speeds: Speeds | None = None


class ProposalKind(ABC):
    """A kind of proposal that a study may choose by its name."""

    name: ClassVar[str]
    """Value of `chains.proposal`."""
    reads_annotations: ClassVar[bool] = False
    """Whether it needs annotations and their speeds; densities without annotations are sampled by the plain kind."""

    @abstractmethod
    def build(self, inputs: ProposalInputs) -> Proposal:
        """Return the proposal round one seed."""
