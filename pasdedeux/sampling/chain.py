"""Metropolis-Hastings: one step, and a segment of kept draws, as pure functions of state and generator."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.sampling.densities.density import Evaluation
from pasdedeux.sampling.parameters import NUM_BLOCKS

Context = npt.NDArray[np.int64]
"""Data that a proposal needs at a point before a step: the annotations nearest to it, (view,)."""
Blocks = npt.NDArray[np.int64]
"""Blocks that a step moved (see `NUM_BLOCKS`)."""


@dataclass(frozen=True)
class ChainState:
    """State of a chain between steps.

    Args:
        parameters: Where the chain is.
        evaluation: Target at `parameters`; its density must be positive.
        context: Data of the proposal for this point; None if it needs none.
        log_scales: Logarithms of the factors on the proposal's deviations of each block, (34,), learned in warm-up.
    """

    parameters: Array
    evaluation: Evaluation
    context: Context | None = None
    log_scales: Array = field(default_factory=lambda: np.zeros(NUM_BLOCKS))


@dataclass(frozen=True)
class Correction:
    """Data for the correction of a state-dependent proposal, prepared at the proposed point.

    Args:
        log_ratio: log Q(here | there) - log Q(there | here): what eq. 10 adds.
        context: Data of the proposal for the proposed point.
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
        correct: Computes the exact ratio, which is expensive; None if `log_ratio` is exact.
        blocks: Blocks that moved, for warm-up, which learns their scales; None where scales are not learned.
    """

    parameters: Array
    log_ratio: float = 0.0
    correct: Callable[[], Correction] | None = None
    blocks: Blocks | None = None


LogDensity = Callable[[Array, float], Evaluation]
"""The target at a point; its value is not needed below the given level."""
Propose = Callable[[np.random.Generator, ChainState], Proposed]
Gauge = Callable[[Array], Array]


@dataclass(frozen=True)
class StepInfo:
    """Diagnostics of a step, from which scales are learned in warm-up."""

    is_accepted: bool
    blocks: Blocks | None = None


@dataclass(frozen=True)
class Segment:
    """The kept draws of a stretch of a chain.

    Args:
        parameters: Draws (draw, d).
        log_density: Target at each draw, as a density over poses, (draw,).
        log_prior: Prior at each draw, (draw,).
        log_likelihood: Likelihood at each draw, (draw,).
        num_accepted: Accepted proposals since the draw before, (draw,).
    """

    parameters: Array
    log_density: Array
    log_prior: Array
    log_likelihood: Array
    num_accepted: npt.NDArray[np.int64]


def step(
    rng: np.random.Generator, state: ChainState, log_density: LogDensity, propose: Propose
) -> tuple[ChainState, StepInfo]:
    """Take one Metropolis-Hastings step (eq. 10 of Yin et al. 2018).

    The acceptance threshold is drawn first, so the density may stop once it falls below it. If the exact ratio of
    the proposal is expensive, its upper bound is tested first; the result is the same.

    Args:
        rng: Source of randomness.
        state: Where the chain is.
        log_density: Target.
        propose: Proposal.
    """
    proposed = propose(rng, state)
    uncorrected = state.evaluation.log_target - rng.standard_exponential()
    level = uncorrected - proposed.log_ratio
    refused = state, StepInfo(is_accepted=False, blocks=proposed.blocks)
    evaluation = log_density(proposed.parameters, level)
    if not (evaluation.log_target >= level and evaluation.log_target > -np.inf):
        return refused
    context = None
    if proposed.correct is not None:
        correction = proposed.correct()
        if not evaluation.log_target >= uncorrected - correction.log_ratio:
            return refused
        context = correction.context
    moved = ChainState(proposed.parameters, evaluation, context, state.log_scales)
    return moved, StepInfo(is_accepted=True, blocks=proposed.blocks)


def run_segment(
    rng: np.random.Generator,
    state: ChainState,
    log_density: LogDensity,
    propose: Propose,
    *,
    num_draws: int,
    thin: int = 1,
    gauge: Gauge | None = None,
) -> tuple[ChainState, Segment]:
    """Run a chain for `num_draws` kept draws of `thin` steps each.

    Args:
        rng: Source of randomness; it moves on, so a following call continues the chain exactly.
        state: Where the chain is.
        log_density: Target.
        propose: Proposal.
        num_draws: Draws kept.
        thin: Steps per kept draw.
        gauge: Moves a kept draw rigidly to its stored place; target and proposal do not depend on that.
    """
    draws: list[ChainState] = []
    num_accepted = np.zeros(num_draws, dtype=np.int64)
    for draw in range(num_draws):
        for _ in range(thin):
            state, info = step(rng, state, log_density, propose)
            num_accepted[draw] += info.is_accepted
        if gauge is not None and num_accepted[draw]:
            state = replace(state, parameters=gauge(state.parameters))
        draws.append(state)
    segment = Segment(
        parameters=np.stack([draw.parameters for draw in draws]),
        log_density=np.array([draw.evaluation.log_density for draw in draws]),
        log_prior=np.array([draw.evaluation.log_prior for draw in draws]),
        log_likelihood=np.array([draw.evaluation.log_likelihood for draw in draws]),
        num_accepted=num_accepted,
    )
    return state, segment


def generator_to_json(rng: np.random.Generator) -> str:
    """Return the state of a generator (PCG64) as JSON, for `generator_from_json`."""
    return json.dumps(rng.bit_generator.state, sort_keys=True)


def generator_from_json(text: str) -> np.random.Generator:
    """Return a generator that continues exactly where the one of `generator_to_json` stood."""
    bits = np.random.PCG64(0)
    bits.state = json.loads(text)
    return np.random.Generator(bits)


def proposal_to_json(state: ChainState) -> str:
    """Return the learned scales and the context of a chain's proposal as JSON, without loss."""
    context = None if state.context is None else state.context.tolist()
    return json.dumps({"log_block": state.log_scales.tolist(), "context": context})


def proposal_from_json(text: str) -> tuple[Array, Context | None]:
    """Return the learned scales (34,), and the context of the place, that `proposal_to_json` wrote."""
    state = json.loads(text)
    context = state["context"]
    return np.array(state["log_block"]), None if context is None else np.array(context, dtype=np.int64)
