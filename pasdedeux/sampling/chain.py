"""Metropolis-Hastings: one step, and a segment of kept draws, as pure functions of state and generator."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.sampling.density import Evaluation
from pasdedeux.sampling.proposals.proposal import Blocks, Context, Proposed

LogDensity = Callable[[Array, float], Evaluation]
Propose = Callable[[Array, Context | None, np.random.Generator], Proposed]
Gauge = Callable[[Array], Array]


@dataclass(frozen=True)
class ChainState:
    """What the next step needs: where the chain is, the target there, and what the proposal must know of the place."""

    parameters: Array
    evaluation: Evaluation
    context: Context | None = None


@dataclass(frozen=True)
class StepInfo:
    """What a person wants to know of a step, and what learns scales from it."""

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

    The level that the proposed point must reach is drawn first, so the density may stop as soon as it is missed.  Where
    the ratio of the proposal's densities is only known once the proposal was prepared at the proposed point, which is
    dear, its bound decides whether that is worth it; the result is as if it had been known at once.

    Args:
        rng: Source of randomness.
        state: Where the chain is; its density must be positive.
        log_density: Target; called with a point and the level below which its value does not matter.
        propose: Proposal.
    """
    proposed = propose(state.parameters, state.context, rng)
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
    return ChainState(proposed.parameters, evaluation, context), StepInfo(is_accepted=True, blocks=proposed.blocks)


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
        gauge: Moves a kept draw rigidly to the representative that is stored; the target there is the same, and so is
            what the proposal must know of it.

    Raises:
        InputError: `num_draws` or `thin` is not positive.
    """
    if num_draws < 1 or thin < 1:
        raise InputError(f"a segment needs draws and steps, found {num_draws} draws of {thin} steps")
    draws: list[ChainState] = []
    num_accepted = np.zeros(num_draws, dtype=np.int64)
    for draw in range(num_draws):
        for _ in range(thin):
            state, info = step(rng, state, log_density, propose)
            num_accepted[draw] += info.is_accepted
        if gauge is not None and num_accepted[draw]:
            state = ChainState(gauge(state.parameters), state.evaluation, state.context)
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
    """Return the state of a generator as JSON, for `generator_from_json`."""
    return json.dumps(rng.bit_generator.state, sort_keys=True)


def generator_from_json(text: str) -> np.random.Generator:
    """Return a generator that continues exactly where the one of `generator_to_json` stood.

    Raises:
        InputError: The text is not the state of a PCG64 generator.
    """
    try:
        state = json.loads(text)
        if state["bit_generator"] != "PCG64":
            raise ValueError(state["bit_generator"])
        bits = np.random.PCG64(0)
        bits.state = state
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"not the state of a PCG64 generator: {error}") from error
    return np.random.Generator(bits)
