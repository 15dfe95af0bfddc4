"""Prediction of a pair's next second: DCT, graph convolutions and attention to motion history (Mao et al. 2020).

The last half second is compared with every half second of the 2 s before. The continuations of these, as DCT
coefficients, are summed by similarity and pass with the coefficients of the last pose, held still, through graph
convolutions, which give the change of the latter.  Ours are the sizes (5 frames compared, 10 predicted at 10 Hz, 48
channels, two hidden layers), the learning rate, and that both people are one graph of 132 coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.learning.clips import HISTORY, HORIZON
from pasdedeux.learning.networks.layers import Batch
from pasdedeux.learning.networks.training import adam, fit
from pasdedeux.learning.settings import PredictorSettings

Narrow = npt.NDArray[np.float32]

_COMPARED = 5
_LENGTH = _COMPARED + HORIZON
_CHANNELS = (2 * _LENGTH, 48, 48, _LENGTH)
_KEYS = 48
_CLIPS_PER_STEP = 32


class MotionPredictor(nn.Module):
    """The predictor of `size` coordinates; before training it gives the last pose held still."""

    cosines: Tensor

    def __init__(self, size: int, generator: np.random.Generator) -> None:
        super().__init__()
        self.register_buffer("cosines", _cosines(), persistent=False)

        def normal(*shape: int, scale: float) -> Narrow:
            return (scale * generator.standard_normal(shape)).astype(np.float32)

        inputs = _COMPARED * size
        self.query, self.key = (_parameter(normal(inputs, _KEYS, scale=inputs**-0.5)) for _ in range(2))
        self.links, self.mixes = nn.ParameterList(), nn.ParameterList()
        for number, (old, new) in enumerate(pairwise(_CHANNELS)):
            is_last = number == len(_CHANNELS) - 2
            link = normal(size, size, scale=0.1 / size**0.5)
            self.links.append(_parameter(np.eye(size, dtype=np.float32) + link))
            self.mixes.append(_parameter(normal(old, new, scale=0.0 if is_last else (2.0 / old) ** 0.5)))

    def forward(self, known: Tensor) -> Tensor:
        """Return the last 5 known frames and the 10 that follow (n, 15, size) of known ones (n, 20, size)."""
        last, past = known[:, -1:], known - known[:, -1:]
        starts = range(HISTORY - _LENGTH + 1)
        keys = torch.stack([past[:, at : at + _COMPARED].flatten(1) for at in starts], 1)
        values = torch.stack([self.cosines @ past[:, at : at + _LENGTH] for at in starts], 1)
        query = torch.relu(past[:, -_COMPARED:].flatten(1) @ self.query)
        likeness = torch.einsum("nk,nsk->ns", query, torch.relu(keys @ self.key)) + 1e-6
        seen = torch.einsum("ns,nsfc->ncf", likeness / likeness.sum(1, keepdim=True), values)
        still = self.cosines @ torch.cat([past[:, -_COMPARED:], past[:, -1:].expand(-1, HORIZON, -1)], 1)
        features = torch.cat([still.transpose(1, 2), seen], 2)
        for number, (link, mix) in enumerate(zip(self.links, self.mixes, strict=True)):
            features = link @ (torch.tanh(features) if number else features) @ mix
        return self.cosines.T @ (still + features.transpose(1, 2)) + last

    def loss(self, batch: Batch) -> Tensor:
        """Return the mean distance of joints, metres, over clips (n, 30, size), the compared half second included."""
        clips = batch["clips"]
        apart = self(clips[:, :HISTORY]) - clips[:, HISTORY - _COMPARED :]
        return apart.unflatten(2, (-1, 3)).norm(dim=-1).mean()

    def predict(self, known: Array) -> Array:
        """Return the next 10 frames (n, 10, 2, 22, 3) of 20 known ones (n, 20, 2, 22, 3), metres."""
        flat = torch.from_numpy(known.reshape(*known.shape[:2], -1).astype(np.float32))
        with torch.no_grad():
            predicted = self(flat)[:, _COMPARED:].numpy().astype(np.float64)
        return predicted.reshape(len(known), HORIZON, *known.shape[2:])


def train_predictor(clips: Array, settings: PredictorSettings, generator: np.random.Generator) -> MotionPredictor:
    """Train on clips (n, 30, 2, 22, 3), metres, in the frame of the pair at the last known frame.

    Raises:
        InputError: There is no clip, or training came to numbers that are not finite.
    """
    if not len(clips):
        raise InputError("the predictor of motion has no clip of 3 s to learn from")
    flat = clips.reshape(*clips.shape[:2], -1).astype(np.float32)
    network = MotionPredictor(flat.shape[2], generator)

    def draw() -> tuple[Mapping[str, Narrow], str]:
        return {"clips": flat[generator.integers(len(flat), size=_CLIPS_PER_STEP)]}, "clips"

    fit("motion_predictor", network.loss, adam(network), settings, draw, range(settings.num_steps))
    return network


def _parameter(values: Narrow) -> nn.Parameter:
    return nn.Parameter(torch.from_numpy(values))


def _cosines() -> Tensor:
    """Return the orthonormal DCT-II (15, 15): rows are frequencies."""
    frame = torch.arange(_LENGTH)
    rows = torch.cos(torch.pi * (frame + 0.5) * frame[:, None] / _LENGTH) * (2.0 / _LENGTH) ** 0.5
    rows[0] /= 2.0**0.5
    return rows
