"""Warm-up: the first steps of a chain, which learn step sizes and are then dropped.

Scales are learned by stochastic approximation (Robbins and Monro 1951; Andrieu and Thoms 2008, section 4.2): after
every step the logarithms concerned move by a falling gain times the difference of acceptance from its target.  Draws
are dropped and the scales frozen, so the chain that is kept has one proposal that leaves its target as it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.sampling.chain import ChainState, Gauge, LogDensity, Propose, step
from pasdedeux.sampling.densities.density import Evaluation, PairDensity
from pasdedeux.sampling.proposals.proposal import Proposal

TARGET_ACCEPTANCE = 0.234
"""Target of the accepted share: optimal for random walks in many dimensions (Roberts, Gelman and Gilks 1997)."""
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
    propose: Propose,
    *,
    num_steps: int,
    gauge: Gauge | None = None,
) -> ChainState:
    """Run a chain for some steps; return where it arrived, with the scales it learned.

    The scale of each block that a step moved is updated; a step without blocks updates none.

    Args:
        rng: Source of randomness; it moves on.
        state: Where the chain is, with the scales to begin with.
        log_density: Target.
        propose: Proposal.
        num_steps: Steps; 0 changes nothing.
        gauge: As for `run_segment`; applied once at the end.
    """
    num_taught = np.zeros(len(state.log_scales))
    for _ in range(num_steps):
        state, info = step(rng, state, log_density, propose)
        if info.blocks is None:
            continue
        error = float(info.is_accepted) - TARGET_ACCEPTANCE
        num_taught[info.blocks] += 1.0
        learned = state.log_scales.copy()
        learned[info.blocks] += error * num_taught[info.blocks] ** -GAIN_EXPONENT
        state = replace(state, log_scales=learned.clip(-MAX_LOG, MAX_LOG))
    return replace(state, parameters=gauge(state.parameters)) if gauge is not None and num_steps else state


def disperse(
    rng: np.random.Generator, parameters: Array, target: PairDensity, proposal: Proposal, *, num_steps: int
) -> ChainState:
    """Return a dispersed start for a chain, drawn from a wider density than its target, with the scales learned there.

    R-hat compares chains within and between: chains that all start at one point agree before they have seen anything
    (Gelman and Rubin 1992, section 2.1).

    Args:
        rng: Source of randomness; it moves on.
        parameters: Where the seed is, (108,).
        target: The density that will be sampled.
        proposal: Proposal.
        num_steps: Steps on the wider density; 0 starts at the seed.
    """

    def wider(parameters: Array, at_least: float = -np.inf) -> Evaluation:
        """Return the target with its logarithm divided by the temperature of dispersed starts, and the same bounds."""
        log_measure = target.chart.log_measure(parameters)
        level = DISPERSING_TEMPERATURE * (at_least - log_measure) + log_measure if np.isfinite(log_measure) else np.inf
        log_density = target(parameters, level)
        return replace(log_density, log_density=log_density.log_density / DISPERSING_TEMPERATURE)

    state = ChainState(parameters, wider(parameters), proposal.init(parameters))
    state = warm_up(rng, state, wider, proposal.propose, num_steps=num_steps, gauge=target.chart.gauge_fixed)
    return replace(state, evaluation=target(state.parameters))
