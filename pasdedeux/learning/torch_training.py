"""The one training loop of models that torch trains: segments of Adam, the same bits wherever it was interrupted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from pasdedeux.errors import InputError
from pasdedeux.learning.model import Arrays, LogEntry
from pasdedeux.learning.torch_settings import TorchSettings

Narrow = npt.NDArray[np.float32]
Tensors = dict[str, torch.Tensor]

_LEAST_RATE = 0.05
"""Learning rate at the end, as a share of that at the start, to which it falls evenly."""
_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Batch:
    """What one step learns from: arrays by name, and where they are from in words, for when a step goes wrong."""

    arrays: Mapping[str, Narrow]
    what: str


@dataclass(frozen=True)
class TrainedSegment:
    """Weights after a segment, the best ones by validation so far, figures, and what the next segment goes on from."""

    best: dict[str, Narrow]
    log: list[LogEntry]
    state: dict[str, npt.NDArray[Any]]


def train_segment(
    name: str,
    settings: TorchSettings,
    segment: int,
    state: Arrays,
    first: Callable[[], Mapping[str, Narrow]],
    draw: Callable[[], Batch],
    loss: Callable[[Tensors, Tensors], torch.Tensor],
    validate: Callable[[Mapping[str, Narrow]], Mapping[str, float]],
) -> TrainedSegment:
    """Do the steps of one segment on one thread; a number that is not finite ends it, and the last segment stands.

    Args:
        name: Name of the model, for messages.
        settings: Steps and rate.
        segment: Which segment, from 0.
        state: What the segment before left; empty for the first.
        first: Gives the weights to begin with.
        draw: Gives the next batch.
        loss: Loss of weights on a batch.
        validate: Figures of weights on validation items, if there are any; the best weights by the first are kept.

    Raises:
        InputError: A loss is not finite.
    """
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    stored = {key.removeprefix("weights/"): state[key] for key in state if key.startswith("weights/")} or first()
    weights: Tensors = {
        key: torch.tensor(values, dtype=torch.float32).requires_grad_(True) for key, values in sorted(stored.items())
    }
    optimiser = torch.optim.Adam(weights.values(), lr=settings.learning_rate, foreach=False)
    begin = segment * settings.segment_steps
    if begin:
        for key, tensor in weights.items():
            moments = {moment: torch.tensor(state[f"{moment}/{key}"]) for moment in _MOMENTS}
            optimiser.state[tensor] = {"step": torch.tensor(float(begin)), **moments}
    end = min(begin + settings.segment_steps, settings.num_steps)
    total = 0.0
    for step in range(begin, end):
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * max(1.0 - step / settings.num_steps, _LEAST_RATE)
        batch = draw()
        value = loss(weights, {key: torch.tensor(values) for key, values in batch.arrays.items()})
        optimiser.zero_grad()
        value.backward()
        is_finite = all(tensor.grad is None or bool(torch.isfinite(tensor.grad).all()) for tensor in weights.values())
        if not (bool(torch.isfinite(value)) and is_finite):
            kept = f"; what segment {segment - 1} left is kept" if segment else ""
            raise InputError(f"{name}: step {step} came to a number that is not finite on {batch.what}{kept}")
        optimiser.step()
        total += float(value.detach())
    now: dict[str, Narrow] = {key: tensor.detach().numpy() for key, tensor in weights.items()}
    figures = validate(now)
    error = next(iter(figures.values()), np.nan)
    before = float(state["best_error"][0]) if begin else np.inf
    is_best = not before <= error
    best = now if is_best else {key: state[f"best/{key}"].astype(np.float32) for key in now}
    log = [LogEntry(end, "train_loss", total / max(end - begin, 1))]
    log += [LogEntry(end, quantity, value) for quantity, value in figures.items()]
    left: dict[str, npt.NDArray[Any]] = {"best_error": np.array([error if is_best else before])}
    for key, tensor in weights.items():
        left |= {f"weights/{key}": now[key], f"best/{key}": best[key]}
        left |= {f"{moment}/{key}": optimiser.state[tensor][moment].numpy() for moment in _MOMENTS}
    return TrainedSegment(best, log, left)


def train_whole(
    name: str,
    settings: TorchSettings,
    first: Callable[[], Mapping[str, Narrow]],
    draw: Callable[[], Batch],
    loss: Callable[[Tensors, Tensors], torch.Tensor],
) -> dict[str, Narrow]:
    """Return the weights after all segments, for what is not stored in between; see `train_segment`."""
    state: Arrays = {}
    for segment in range(settings.num_segments):
        done = train_segment(name, settings, segment, state, first, draw, loss, lambda weights: {})
        state = done.state
    return done.best
