"""The network of `MotionPredictor`, in torch."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch

from pasdedeux.learning.motion_predictor import HISTORY, HORIZON

Narrow = npt.NDArray[np.float32]
Tensors = Mapping[str, torch.Tensor]

_COMPARED = 5
_LENGTH = _COMPARED + HORIZON
_CHANNELS = (2 * _LENGTH, 48, 48, _LENGTH)
_KEYS = 48


def _cosines() -> torch.Tensor:
    """Return the orthonormal DCT-II (15, 15): rows are frequencies."""
    frame = torch.arange(_LENGTH)
    rows = torch.cos(torch.pi * (frame + 0.5) * frame[:, None] / _LENGTH) * (2.0 / _LENGTH) ** 0.5
    rows[0] /= 2.0**0.5
    return rows


_DCT = _cosines()


def first_weights(size: int, generator: np.random.Generator) -> dict[str, Narrow]:
    """Return random weights to begin with; the last layer gives nothing yet: the last pose held still."""

    def normal(*shape: int, scale: float) -> Narrow:
        return (scale * generator.standard_normal(shape)).astype(np.float32)

    inputs = _COMPARED * size
    weights = {name: normal(inputs, _KEYS, scale=inputs**-0.5) for name in ("query", "key")}
    for number, (old, new) in enumerate(pairwise(_CHANNELS)):
        is_last = number == len(_CHANNELS) - 2
        weights[f"link{number}"] = np.eye(size, dtype=np.float32) + normal(size, size, scale=0.1 / size**0.5)
        weights[f"mix{number}"] = normal(old, new, scale=0.0 if is_last else (2.0 / old) ** 0.5)
    return weights


def _forward(weights: Tensors, known: torch.Tensor) -> torch.Tensor:
    """Return the last 5 known frames and the 10 that follow (n, 15, size) of known ones (n, 20, size)."""
    last, to_frequencies = known[:, -1:], _DCT.to(known.device)
    past = known - last
    starts = range(HISTORY - _LENGTH + 1)
    keys = torch.stack([past[:, at : at + _COMPARED].flatten(1) for at in starts], 1)
    values = torch.stack([to_frequencies @ past[:, at : at + _LENGTH] for at in starts], 1)
    query = torch.relu(past[:, -_COMPARED:].flatten(1) @ weights["query"])
    likeness = torch.einsum("nk,nsk->ns", query, torch.relu(keys @ weights["key"])) + 1e-6
    seen = torch.einsum("ns,nsfc->ncf", likeness / likeness.sum(1, keepdim=True), values)
    still = to_frequencies @ torch.cat([past[:, -_COMPARED:], past[:, -1:].expand(-1, HORIZON, -1)], 1)
    found = torch.cat([still.transpose(1, 2), seen], 2)
    for number in range(len(_CHANNELS) - 1):
        found = weights[f"link{number}"] @ found @ weights[f"mix{number}"]
        if number < len(_CHANNELS) - 2:
            found = torch.tanh(found)
    return to_frequencies.T @ (still + found.transpose(1, 2)) + last


def loss(weights: Tensors, batch: Tensors) -> torch.Tensor:
    """Return the mean distance of joints, metres, over clips (n, 30, size), the compared half second included."""
    clips = batch["clips"]
    apart = _forward(weights, clips[:, :HISTORY]) - clips[:, HISTORY - _COMPARED :]
    return apart.unflatten(2, (-1, 3)).norm(dim=-1).mean()


def evaluate(weights: Mapping[str, Narrow], known: Narrow) -> npt.NDArray[np.float64]:
    """Return the 10 frames (n, 10, size) that follow known ones (n, 20, size)."""
    with torch.no_grad():
        tensors = {name: torch.tensor(values) for name, values in weights.items()}
        return _forward(tensors, torch.from_numpy(known))[:, _COMPARED:].numpy().astype(np.float64)
