"""The training loop: Adam on one thread, the same bits in one go or segment by segment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from pasdedeux.errors import InputError
from pasdedeux.learning.model import Arrays, LogEntry
from pasdedeux.learning.networks.layers import Batch, WindowNetwork, initialise
from pasdedeux.learning.settings import NetworkSettings, WindowSettings

Narrow = npt.NDArray[np.float32]
Draw = Callable[[], tuple[Mapping[str, Narrow], str]]
"""Return the next batch, and where it is from in words, for when a step goes wrong."""

_MIN_RATE = 0.05
"""Learning rate at the end, as a share of that at the start, to which it falls evenly."""
_MOMENTS = ("exp_avg", "exp_avg_sq")


def adam(network: nn.Module) -> torch.optim.Adam:
    """Return the optimiser; `fit` sets its learning rate."""
    return torch.optim.Adam(network.parameters(), foreach=False)


def fit(
    name: str,
    loss: Callable[[Batch], Tensor],
    optimiser: torch.optim.Optimizer,
    settings: NetworkSettings,
    draw: Draw,
    steps: range,
) -> float:
    """Take some of the steps of a training on one thread and return the mean loss.

    Raises:
        InputError: A loss or a gradient is not finite.
    """
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    (group,) = optimiser.param_groups
    total = 0.0
    for step in steps:
        group["lr"] = settings.learning_rate * max(1.0 - step / settings.num_steps, _MIN_RATE)
        batch, what = draw()
        value = loss({key: torch.tensor(values) for key, values in batch.items()})
        optimiser.zero_grad()
        value.backward()
        if not all(bool(torch.isfinite(found).all()) for found in (value, *(one.grad for one in group["params"]))):
            raise InputError(f"{name}: step {step} came to a number that is not finite on {what}")
        optimiser.step()
        total += float(value.detach())
    return total / max(len(steps), 1)


def train_segment(
    name: str,
    network: WindowNetwork,
    settings: WindowSettings,
    draw: Draw,
    validate: Callable[[], Mapping[str, float]],
    *,
    segment: int,
    state: Arrays,
    generator: np.random.Generator,
) -> tuple[list[LogEntry], dict[str, npt.NDArray[Any]]]:
    """Take the steps of one segment; the network is left with the best parameters by validation so far.

    Args:
        name: Name of the model, for messages.
        network: The network.
        settings: Steps and rate.
        draw: Gives the next batch.
        validate: Figures of the network on validation items, if any; the first says which parameters are best.
        segment: Which segment, from 0.
        state: What the segment before left; empty for the first.
        generator: Draws the first parameters.

    Returns:
        Figures, and what the next segment goes on from.

    Raises:
        InputError: A loss is not finite; what the segment before left stands.
    """
    optimiser = adam(network)
    first = segment * settings.segment_steps
    steps = range(first, min(first + settings.segment_steps, settings.num_steps))
    if segment:
        network.load_state_dict(_part(state, "now"))
        moments = {moment: _part(state, moment) for moment in _MOMENTS}
        for key, parameter in network.named_parameters():
            kept = {moment: moments[moment][key] for moment in _MOMENTS}
            optimiser.state[parameter] = {"step": torch.tensor(float(first)), **kept}
    else:
        initialise(network, generator)
    try:
        log = [LogEntry(steps.stop, "train_loss", fit(name, network.loss, optimiser, settings, draw, steps))]
    except InputError as failure:
        if not segment:
            raise
        raise InputError(f"{failure}; what segment {segment - 1} left is kept") from None
    figures = validate()
    log += [LogEntry(steps.stop, quantity, value) for quantity, value in figures.items()]
    error, before = next(iter(figures.values()), np.nan), state["best_error"][0] if segment else np.inf
    is_best = not before <= error
    now = {key: value.clone() for key, value in network.state_dict().items()}
    best = now if is_best else _part(state, "best")
    left: dict[str, npt.NDArray[Any]] = {"best_error": np.array([error if is_best else before])}
    for key, parameter in network.named_parameters():
        left |= {f"now/{key}": now[key].numpy(), f"best/{key}": best[key].numpy()}
        left |= {f"{moment}/{key}": optimiser.state[parameter][moment].numpy() for moment in _MOMENTS}
    network.load_state_dict(best)
    return log, left


def _part(state: Arrays, name: str) -> dict[str, Tensor]:
    prefix = f"{name}/"
    return {key.removeprefix(prefix): torch.tensor(state[key]) for key in state if key.startswith(prefix)}
