"""Warm-up: the steps at the beginning of a chain that learn how far to step, and are then forgotten.

Scales are learned by stochastic approximation (Robbins and Monro 1951; Andrieu and Thoms 2008, section 4.2): after
every step the logarithms concerned move by a falling gain times the difference of acceptance from its target.  Draws
are dropped and the scales frozen, so the chain that is kept has one kernel that leaves its target as it is.
"""

from __future__ import annotations

import json

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.sampling.chain import ChainState, LogDensity, Settle, step
from pasdedeux.sampling.guided import Guided
from pasdedeux.sampling.proposals import GaussianBlocks, Local, Scales

__all__ = ["kernel_from_json", "kernel_to_json", "warm_up"]

TARGET_ACCEPTANCE = 0.234
"""Accepted share that is aimed at: optimal for random walks in many dimensions (Roberts, Gelman and Gilks 1997)."""
GAIN_EXPONENT = 0.6
"""The n-th update of a scale has the gain n^-0.6: its sum diverges, that of its square does not."""
MOST_LOG = float(np.log(20.0))
"""A scale never becomes more than 20 times larger or smaller than it was set."""


def warm_up(
    rng: np.random.Generator,
    state: ChainState,
    log_density: LogDensity,
    propose: GaussianBlocks | Guided,
    *,
    num_steps: int,
    target_acceptance: float = TARGET_ACCEPTANCE,
    settle: Settle | None = None,
) -> tuple[ChainState, GaussianBlocks | Guided]:
    """Run a chain for some steps and give where it arrived, with the proposal whose scales it learned.

    A step of `few` teaches each of its blocks; any other teaches its own move.  Guided steps teach nothing: how often
    they are accepted says more about the annotation than about the scales.

    Args:
        rng: Source of randomness; it moves on.
        state: Where the chain is.
        log_density: Target.
        propose: Proposal with the scales to begin with.
        num_steps: Steps; 0 changes nothing.
        target_acceptance: Accepted share aimed at.
        settle: As for `run_segment`; applied once at the end.

    Raises:
        InputError: The number of steps is negative, or the target is not between 0 and 1.
    """
    if num_steps < 0 or not 0.0 < target_acceptance < 1.0:
        raise InputError(f"a warm-up of {num_steps} steps towards an acceptance of {target_acceptance:g} cannot be")
    scales = propose.scales
    blocks, moves = scales.log_block.copy(), scales.log_move.copy()
    block_count, move_count = np.zeros(len(blocks)), np.zeros(len(moves))
    for _ in range(num_steps):
        state, info = step(rng, state, log_density, propose)
        if info.move is None:
            continue
        error = float(info.is_accepted) - target_acceptance
        if info.move.index == 0:
            own = list(info.move.blocks)
            block_count[own] += 1.0
            blocks[own] += error * block_count[own] ** -GAIN_EXPONENT
        else:
            own = [info.move.index]
            move_count[own] += 1.0
            moves[own] += error * move_count[own] ** -GAIN_EXPONENT
        blocks, moves = blocks.clip(-MOST_LOG, MOST_LOG), moves.clip(-MOST_LOG, MOST_LOG)
        propose = propose.with_scales(Scales(blocks, moves))
    if settle is not None and num_steps:
        state = ChainState(settle(state.parameters), state.evaluation, state.local)
    return state, propose


def kernel_to_json(scales: Scales, local: Local | None) -> str:
    """Return what a chain must remember of its kernel, as JSON without loss: learned scales, and what it saw around."""
    return json.dumps(
        {
            "log_block": scales.log_block.tolist(),
            "log_move": scales.log_move.tolist(),
            "local": None if local is None else local.tolist(),
        }
    )


def kernel_from_json(text: str) -> tuple[Scales, Local | None]:
    """Return back what `kernel_to_json` wrote.

    Raises:
        InputError: The text is something else.
    """
    try:
        state = json.loads(text)
        scales = Scales(np.array(state["log_block"], dtype=float), np.array(state["log_move"], dtype=float))
        local = None if state["local"] is None else np.array(state["local"], dtype=np.int64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"not the state of a kernel: {error}") from error
    return scales, local
