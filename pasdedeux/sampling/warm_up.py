"""Warm-up: the steps at the beginning of a chain that learn how far to step, and are then forgotten.

Scales are learned by stochastic approximation (Robbins and Monro 1951; Andrieu and Thoms 2008, section 4.2): after
every step the logarithms concerned move by a falling gain times the difference of acceptance from its target.  Draws
are dropped and the scales frozen, so the chain that is kept has one proposal that leaves its target as it is.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.sampling.chain import ChainState, Gauge, LogDensity, step
from pasdedeux.sampling.density import Evaluation, PairDensity
from pasdedeux.sampling.proposals.proposal import Context, Proposal, Scales

P = TypeVar("P", bound=Proposal)

TARGET_ACCEPTANCE = 0.234
"""Accepted share that is aimed at: optimal for random walks in many dimensions (Roberts, Gelman and Gilks 1997)."""
GAIN_EXPONENT = 0.6
"""The n-th update of a scale has the gain n^-0.6: its sum diverges, that of its square does not."""
MAX_LOG = float(np.log(20.0))
"""A scale never becomes more than 20 times larger or smaller than it was set."""
DISPERSING_TEMPERATURE = 2.0
"""Starts are drawn from the square root of the density: about twice as far from its mode as draws will be."""


def warm_up(
    rng: np.random.Generator,
    state: ChainState,
    log_density: LogDensity,
    propose: P,
    *,
    num_steps: int,
    target_acceptance: float = TARGET_ACCEPTANCE,
    gauge: Gauge | None = None,
) -> tuple[ChainState, P]:
    """Run a chain for some steps; return where it arrived, with the proposal whose scales it learned.

    A step teaches each of its blocks; one that does not say which they are teaches nothing.

    Args:
        rng: Source of randomness; it moves on.
        state: Where the chain is.
        log_density: Target.
        propose: Proposal with the scales to begin with.
        num_steps: Steps; 0 changes nothing.
        target_acceptance: Accepted share aimed at.
        gauge: As for `run_segment`; applied once at the end.

    Raises:
        InputError: The number of steps is negative, or the target is not between 0 and 1.
    """
    if num_steps < 0 or not 0.0 < target_acceptance < 1.0:
        raise InputError(
            f"a warm-up takes 0 steps or more towards an acceptance between 0 and 1, found {num_steps} steps and "
            f"{target_acceptance:g}"
        )
    learned = propose.scales.log_block.copy()
    num_taught = np.zeros(len(learned))
    for _ in range(num_steps):
        state, info = step(rng, state, log_density, propose)
        if info.blocks is None:
            continue
        error = float(info.is_accepted) - target_acceptance
        num_taught[info.blocks] += 1.0
        learned[info.blocks] += error * num_taught[info.blocks] ** -GAIN_EXPONENT
        learned = learned.clip(-MAX_LOG, MAX_LOG)
        propose = propose.with_scales(Scales(learned.copy()))
    if gauge is not None and num_steps:
        state = ChainState(gauge(state.parameters), state.evaluation, state.context)
    return state, propose


@dataclass(frozen=True)
class _Tempered:
    """A density with its logarithm divided by the temperature of dispersed starts; its bounds stay."""

    target: PairDensity

    def __call__(self, parameters: Array, at_least: float = -np.inf) -> Evaluation:
        log_measure = self.target.chart.log_measure(parameters)
        level = DISPERSING_TEMPERATURE * (at_least - log_measure) + log_measure if np.isfinite(log_measure) else np.inf
        found = self.target(parameters, level)
        return replace(found, log_density=found.log_density / DISPERSING_TEMPERATURE)


def disperse(
    rng: np.random.Generator, parameters: Array, target: PairDensity, propose: P, *, num_steps: int
) -> tuple[ChainState, P]:
    """Return a start of its own for a chain, drawn from a wider density than its target, and the scales on the way.

    R-hat compares chains within and between: chains that all start at one point agree before they have seen anything
    (Gelman and Rubin 1992, section 2.1).

    Args:
        rng: Source of randomness; it moves on.
        parameters: Where the seed is, (108,).
        target: The density that will be sampled.
        propose: Proposal with the scales to begin with.
        num_steps: Steps on the wider density; 0 starts at the seed.
    """
    context = propose.prepare(parameters)
    if num_steps:
        wider = _Tempered(target)
        state = ChainState(parameters, wider(parameters), context)
        state, propose = warm_up(rng, state, wider, propose, num_steps=num_steps, gauge=target.chart.gauge_fixed)
        parameters, context = state.parameters, state.context
    return ChainState(parameters, target(parameters), context), propose


def proposal_to_json(scales: Scales, context: Context | None) -> str:
    """Return what a chain must remember of its proposal, as JSON without loss: learned scales, context of its place."""
    return json.dumps(
        {
            "log_block": scales.log_block.tolist(),
            "context": None if context is None else context.tolist(),
        }
    )


def proposal_from_json(text: str) -> tuple[Scales, Context | None]:
    """Return what `proposal_to_json` wrote.

    Raises:
        InputError: The text is something else.
    """
    try:
        state = json.loads(text)
        scales = Scales(np.array(state["log_block"], dtype=float))
        context = None if state["context"] is None else np.array(state["context"], dtype=np.int64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"not the state of a proposal: {error}") from error
    return scales, context
