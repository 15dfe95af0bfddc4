"""A two-person ST-GCN that classifies interactions: extractor of features, and recogniser of the downstream task.

Yan et al. (2018), small and with links to the partner: a clip's joints pass graph convolutions over themselves, their
bones and the partner's same joints, each followed by a convolution over time; means over everything are the features.
Ours are the sizes (blocks of 24, 32 and 32 channels, 5 frames), the layer norm in place of batch norm, which needs no
running figures, and the links.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, pad

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.learning.clips import CLIP_FRAMES, CLIP_HZ, exchange_people
from pasdedeux.learning.networks.layers import Batch
from pasdedeux.learning.networks.training import adam, fit
from pasdedeux.learning.settings import ClassifierSettings
from pasdedeux.skeletons import BODY22

Narrow = npt.NDArray[np.float32]

_CHANNELS = (6, 24, 32, 32)
_KERNEL = 5
_NUM_LINKS = 3
"""Oneself, along bones, the partner's same joint."""
_CLIPS_PER_STEP = 24
"""Clips of a step of training, drawn from all classes equally often."""
_CLIPS_AT_ONCE = 64


class ClipClassifier(nn.Module):
    """The classifier.

    Args:
        labels: Names of the classes.
        generator: Draws the first parameters, of the size that preserves the variance of signals (He et al. 2015).
    """

    def __init__(self, labels: Sequence[str], generator: np.random.Generator) -> None:
        super().__init__()
        self.labels = tuple(labels)
        self.blocks = nn.Sequential(*(_Block(old, new, generator) for old, new in pairwise(_CHANNELS)))
        self.head = _normal(generator, 0.1, _CHANNELS[-1], len(self.labels))

    def forward(self, clips: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (n, 32) and logits (n, C) of clips (n, T, 44, 6)."""
        features = self.blocks(clips).mean(dim=(1, 2))
        return features, features @ self.head

    def loss(self, batch: Batch) -> Tensor:
        """Return the cross entropy of clips (n, T, 44, 6) and their classes (n, C), one of which is 1."""
        logits = self(batch["clips"])[1]
        return -(torch.log_softmax(logits, 1) * batch["is_class"]).sum(1).mean()

    @property
    def digest(self) -> str:
        """Sha256 of labels and parameters, the first 12 digits."""
        digest = hashlib.sha256("\n".join(self.labels).encode())
        for _, values in sorted(self.state_dict().items()):
            digest.update(values.numpy().tobytes())
        return digest.hexdigest()[:12]

    def features(self, clips: Array) -> Array:
        """Return the features (n, 32) of clips (n, 20, 2, 22, 3), metres."""
        return self._evaluate(clips)[0]

    def accuracy(self, clips: Mapping[str, Array]) -> float:
        """Return the share of clips whose class is found, in percent; NaN of none."""
        hits = [
            self.labels[index] == label
            for label, some in clips.items()
            for index in self._evaluate(some)[1].argmax(axis=1)
        ]
        return 100.0 * float(np.mean(hits)) if hits else float("nan")

    def _evaluate(self, clips: Array) -> tuple[Array, Array]:
        parts = torch.from_numpy(_channels(clips)).split(_CLIPS_AT_ONCE)
        with torch.no_grad():
            features, logits = (torch.cat(outputs) for outputs in zip(*map(self, parts), strict=True))
        return features.numpy().astype(np.float64), logits.numpy().astype(np.float64)


class _Block(nn.Module):
    """A graph convolution, and one over time that keeps every second frame."""

    bones: Tensor

    def __init__(self, inputs: int, outputs: int, generator: np.random.Generator) -> None:
        super().__init__()
        self.register_buffer("bones", _along_bones(), persistent=False)
        size = _NUM_LINKS * inputs
        self.graph = _normal(generator, np.sqrt(2.0 / size), size, outputs)
        self.time = _normal(generator, np.sqrt(2.0 / (outputs * _KERNEL)), _KERNEL, outputs, outputs)
        self.shift = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        linked = (x, self.bones @ x, torch.roll(x, BODY22.num_joints, 2))
        mixed = torch.relu(torch.cat(linked, -1) @ self.graph)
        padded = pad(mixed, (0, 0, 0, 0, _KERNEL // 2, _KERNEL // 2))
        moved = sum(padded[:, lag : lag + x.shape[1] : 2] @ self.time[lag] for lag in range(_KERNEL))
        return torch.relu(layer_norm(moved + self.shift, self.shift.shape))


def train_classifier(
    clips: Mapping[str, Array],
    settings: ClassifierSettings,
    generator: np.random.Generator,
    *,
    tells_roles: bool = False,
) -> ClipClassifier:
    """Train on clips (n, 20, 2, 22, 3), metres, by class.

    A and B are exchanged at random, unless classes depend on their roles.

    Raises:
        InputError: Fewer than two classes, a class without clips, or training came to numbers that are not finite.
    """
    labels = tuple(sorted(clips))
    if len(labels) < 2 or not all(len(clips[label]) for label in labels):
        raise InputError(
            f"a classifier of clips needs two classes with clips of {CLIP_FRAMES / CLIP_HZ:g} s; found "
            + (", ".join(f"{label} {len(clips[label])}" for label in labels) or "none")
        )
    network = ClipClassifier(labels, generator)

    def draw() -> tuple[Mapping[str, Narrow], str]:
        which = generator.integers(len(labels), size=_CLIPS_PER_STEP)
        chosen = np.stack([clips[labels[label]][generator.integers(len(clips[labels[label]]))] for label in which])
        if not tells_roles:
            swapped = generator.random(len(chosen)) < 0.5
            chosen[swapped] = exchange_people(chosen[swapped])
        known = np.eye(len(labels), dtype=np.float32)[which]
        return {"clips": _channels(chosen), "is_class": known}, f"clips of {', '.join(labels)}"

    fit("clip_classifier", network.loss, adam(network), settings, draw, range(settings.num_steps))
    return network


def _channels(clips: Array) -> Narrow:
    """Return positions about 1 m of height and velocities of clips (n, 20, 44, 6), metres and metres per second."""
    points = clips.reshape(*clips.shape[:2], 2 * BODY22.num_joints, 3)
    moved = CLIP_HZ * np.diff(points, axis=1, prepend=points[:, :1])
    return np.concatenate([points - [0.0, 1.0, 0.0], moved], axis=-1).astype(np.float32)


def _along_bones() -> Tensor:
    """Return the mean over the joints that bones link to each (44, 44)."""
    joints = BODY22.num_joints
    links = torch.zeros(2 * joints, 2 * joints)
    for person in (0, joints):
        for parent, child in BODY22.bones:
            links[person + parent, person + child] = links[person + child, person + parent] = 1.0
    return links / links.sum(1, keepdim=True)


def _normal(generator: np.random.Generator, scale: float, *shape: int) -> nn.Parameter:
    return nn.Parameter(torch.from_numpy((scale * generator.standard_normal(shape)).astype(np.float32)))
