"""The training loop: Adam on one thread, the same bits in one go or segment by segment."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from pasdedeux.errors import InputError
from pasdedeux.learning.model import ACTIVITY, VALIDATION_FALL, Arrays, LogEntry
from pasdedeux.learning.networks.layers import Batch, WindowNetwork, activity, initialise
from pasdedeux.learning.settings import NetworkSettings, WindowSettings

Narrow = npt.NDArray[np.float32]
Draw = Callable[[], tuple[Mapping[str, Narrow], str]]
"""Return the next batch, with its origin in words for messages on errors."""

_MOMENTS = ("exp_avg", "exp_avg_sq")
_CPU = torch.device("cpu")


def adam(network: nn.Module) -> torch.optim.Adam:
    """Return the optimiser; `fit` sets its learning rate."""
    return torch.optim.Adam(network.parameters(), foreach=False)


def find_device(name: str, wanted: str) -> torch.device:
    """Return the device for "cpu", "cuda" or "auto" (a GPU if there is one).

    Raises:
        InputError: A GPU is asked for and there is none.
    """
    has_gpu = torch.cuda.is_available()
    if wanted == "cuda" and not has_gpu:
        raise InputError(f"{name}: training.device is cuda, and torch finds no GPU here; auto or cpu trains without")
    return torch.device("cuda" if has_gpu and wanted != "cpu" else "cpu")


def fit(
    name: str,
    loss: Callable[[Batch], Tensor],
    optimiser: torch.optim.Optimizer,
    settings: NetworkSettings,
    draw: Draw,
    steps: range,
    device: torch.device = _CPU,
) -> float:
    """Take some training steps, on the network's device or one thread, and return the mean loss.

    Raises:
        InputError: A loss is not finite, or the parameters after the last step are not.
    """
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(device == _CPU)  # on a GPU some sums have no fixed order
    # Filling takes 5 % of a step, and nothing reads the values.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    (group,) = optimiser.param_groups
    total = 0.0
    for step in steps:
        group["lr"] = settings.rate(step)
        batch, what = draw()
        value = loss({key: torch.tensor(values, device=device) for key, values in batch.items()})
        is_finite = math.isfinite(loss_value := float(value.detach()))
        total += loss_value
        if is_finite:
            optimiser.zero_grad()
            value.backward()
            optimiser.step()
        if is_finite and step == steps[-1]:  # before that, the next loss shows it
            is_finite = all(bool(torch.isfinite(tensor).all()) for tensor in group["params"])
        if not is_finite:
            raise InputError(f"{name}: step {step} came to a number that is not finite on {what}")
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
    device: torch.device = _CPU,
) -> tuple[list[LogEntry], dict[str, npt.NDArray[Any]]]:
    """Take the steps of one segment; the network is left with the best parameters by validation so far.

    After `settings.patience_of_length` segments without a smaller validation error no more steps are taken.

    Args:
        name: Name of the model, for messages.
        network: The network.
        settings: Steps and rate.
        draw: Gives the next batch.
        validate: Figures of the network on validation items, if any; the first says which parameters are best.
        segment: Which segment, from 0.
        state: What the segment before left; empty for the first.
        generator: Draws the first parameters.
        device: Where steps are taken; the network comes back to the CPU, where it is validated.

    Returns:
        Figures, and what the next segment goes on from.

    Raises:
        InputError: A loss is not finite, or the GPU runs out of memory; what the segment before left stands.
    """
    first = segment * settings.segment_steps
    steps = range(first, min(first + settings.segment_steps, settings.num_steps))
    num_worse = int(state["num_worse"][0]) if segment else 0
    if num_worse >= settings.patience_of_length:
        network.load_state_dict(_part(state, "best"))
        return [LogEntry(steps.stop, VALIDATION_FALL, 0.0), *_activities(network, draw, steps.stop)], dict(state)
    optimiser = torch.optim.Adam(network.parameters(), fused=True)
    kept_words = f"; what segment {segment - 1} left is kept" if segment else ""
    try:
        network.to(device)
        if segment:
            network.load_state_dict(_part(state, "now"))
            moments = {moment: _part(state, moment) for moment in _MOMENTS}
            for key, parameter in network.named_parameters():
                kept = {moment: moments[moment][key].to(device) for moment in _MOMENTS}
                optimiser.state[parameter] = {"step": torch.tensor(float(first), device=device), **kept}
        else:
            initialise(network, generator)
        log = [LogEntry(steps.stop, "train_loss", fit(name, network.loss, optimiser, settings, draw, steps, device))]
    except InputError as failure:
        raise InputError(f"{failure}{kept_words}") from None
    except torch.cuda.OutOfMemoryError:
        raise InputError(
            f"{name}: the GPU has too little free memory for training{kept_words}; end what else runs on it, or train "
            "on the CPU: --set training.device=cpu"
        ) from None
    network.cpu()
    figures = validate()
    log += [LogEntry(steps.stop, quantity, value) for quantity, value in figures.items()]
    error, before = next(iter(figures.values()), np.nan), state["best_error"][0] if segment else np.inf
    log += (
        [LogEntry(steps.stop, VALIDATION_FALL, 100.0 * max(1.0 - error / before, 0.0))] if segment and figures else []
    )
    is_best = not before <= error
    now = {key: value.clone() for key, value in network.state_dict().items()}
    best = now if is_best else _part(state, "best")
    left: dict[str, npt.NDArray[Any]] = {
        "best_error": np.array([error if is_best else before]),
        "num_worse": np.array([0.0 if is_best else num_worse + 1.0]),
    }
    for key, parameter in network.named_parameters():
        left |= {f"now/{key}": now[key].numpy(), f"best/{key}": best[key].numpy()}
        left |= {f"{moment}/{key}": optimiser.state[parameter][moment].cpu().numpy() for moment in _MOMENTS}
    network.load_state_dict(best)
    return [*log, *_activities(network, draw, steps.stop)], left


def _activities(network: WindowNetwork, draw: Draw, step: int) -> list[LogEntry]:
    """Return the activity of each rectifier on a batch."""
    activities = activity(network, {key: torch.tensor(values) for key, values in draw()[0].items()})
    return [LogEntry(step, f"{ACTIVITY}{name}", value) for name, value in activities.items()]


def _part(state: Arrays, name: str) -> dict[str, Tensor]:
    prefix = f"{name}/"
    return {key.removeprefix(prefix): torch.tensor(state[key]) for key in state if key.startswith(prefix)}
