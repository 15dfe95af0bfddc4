"""Repair: short chains from many pairs make them plausible and keep them like their annotations.

A chain stays near its start, because modes of the density differ by about 100 nats.  A set that covers a motion
therefore starts many chains and takes a hundred steps of each.  The likelihood and the prior are sharpened: otherwise
the chains drift along the many directions in which the density is flat.  The last state of each chain is kept. These
states are not draws of one distribution.  Our own use of the chains of Yin et al. (2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.sampling.chain import ChainState, Segment, run_segment
from pasdedeux.sampling.densities.density import PairDensity
from pasdedeux.sampling.proposals.blocks import GaussianBlocks
from pasdedeux.sampling.warm_up import warm_up
from pasdedeux.settings import Settings
from pasdedeux.spread import evenly_spread

_STEPS = GaussianBlocks()
_NUM_TAUGHT, _STEPS_TAUGHT = 5, 200
"""Chains that the step sizes are learned on, and their steps."""


class RepairSettings(Settings):
    """Settings of repair: short chains from every grown and filled pair."""

    repair_steps: int = Field(default=100, ge=1, description="Steps from each pair where chains start from every one")
    repair_sigma_l: float = Field(default=0.25, gt=0, description="Factor on sigma_l in these steps")
    repair_sigma_p: float = Field(default=0.5, gt=0, description="Factor on sigma_p_m in these steps")


def learn_scales(targets: Sequence[PairDensity], rng: np.random.Generator) -> Array:
    """Return the logarithms of step sizes (34,): means over chains from the pairs of a few of these densities."""
    learned = [
        warm_up(rng, _start(target), target, _STEPS.propose, num_steps=_STEPS_TAUGHT)
        for target in (targets[at] for at in evenly_spread(len(targets), _NUM_TAUGHT))
    ]
    return np.asarray(np.mean([state.log_scales for state in learned], axis=0))


def repair(target: PairDensity, rng: np.random.Generator, log_scales: Array, num_steps: int) -> Segment:
    """Run a short chain from the pair of a density, and return its last state as a segment of one draw."""
    state, gauge = replace(_start(target), log_scales=log_scales), target.chart.gauge_fixed
    return run_segment(rng, state, target, _STEPS.propose, num_draws=1, thin=num_steps, gauge=gauge)[1]


def _start(target: PairDensity) -> ChainState:
    return ChainState(target.chart.seed_parameters(), target.seed_evaluation)
