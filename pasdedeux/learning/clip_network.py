"""The graph network of `ClipClassifier`, in torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch

from pasdedeux.skeletons import BODY22

Narrow = npt.NDArray[np.float32]
Tensors = Mapping[str, torch.Tensor]

_PART = 64
"""Clips computed at once."""


def _along_bones() -> torch.Tensor:
    """Return the mean over the joints that bones link to each (44, 44)."""
    joints = BODY22.num_joints
    links = torch.zeros(2 * joints, 2 * joints)
    for person in (0, joints):
        for parent, child in BODY22.bones:
            links[person + parent, person + child] = links[person + child, person + parent] = 1.0
    return links / links.sum(1, keepdim=True)


_BONES = _along_bones()
_NUM_LINKS = 3
"""Oneself, along bones, the partner's same joint."""


def first_weights(
    channels: Sequence[int], time: int, num_classes: int, generator: np.random.Generator
) -> dict[str, Narrow]:
    """Return random weights to begin with, of the size that keeps signals as large as they are (He et al. 2015)."""
    weights: dict[str, Narrow] = {}
    for number, (old, new) in enumerate(pairwise(channels)):
        for name, shape, inputs in (
            (f"graph{number}", (_NUM_LINKS, old, new), _NUM_LINKS * old),
            (f"time{number}", (time, new, new), new * time),
        ):
            weights[name] = (np.sqrt(2.0 / inputs) * generator.standard_normal(shape)).astype(np.float32)
        weights[f"shift{number}"] = np.zeros(new, np.float32)
    weights["head"] = (0.1 * generator.standard_normal((channels[-1], num_classes))).astype(np.float32)
    return weights


def _features(weights: Tensors, clips: torch.Tensor) -> torch.Tensor:
    found, number = clips, 0
    while f"graph{number}" in weights:
        linked = (found, _BONES @ found, torch.roll(found, BODY22.num_joints, 2))
        mixed = torch.relu(torch.cat(linked, -1) @ weights[f"graph{number}"].flatten(0, 1))
        kernel = weights[f"time{number}"]
        half = len(kernel) // 2
        padded = torch.nn.functional.pad(mixed, (0, 0, 0, 0, half, half))
        frames = range(0, mixed.shape[1], 2)
        moved = sum(padded[:, [at + lag for at in frames]] @ kernel[lag] for lag in range(len(kernel)))
        found = torch.relu(torch.nn.functional.layer_norm(moved + weights[f"shift{number}"], kernel.shape[2:]))
        number += 1
    return found.mean(dim=(1, 2))


def loss(weights: Tensors, batch: Tensors) -> torch.Tensor:
    """Return the cross entropy of clips (n, T, 44, 6) and their classes (n, C), one of which is 1."""
    logits = _features(weights, batch["clips"]) @ weights["head"]
    return -(torch.log_softmax(logits, 1) * batch["is_class"]).sum(1).mean()


def evaluate(weights: Mapping[str, Narrow], clips: Narrow) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return features (n, F) and logits (n, C) of clips (n, T, 44, 6)."""
    tensors = {name: torch.tensor(values) for name, values in weights.items()}
    with torch.no_grad():
        parts = [_features(tensors, torch.from_numpy(clips[at : at + _PART])) for at in range(0, len(clips), _PART)]
        found = torch.cat(parts) if parts else torch.zeros(0, len(tensors["head"]))
        return found.numpy().astype(np.float64), (found @ tensors["head"]).numpy().astype(np.float64)
