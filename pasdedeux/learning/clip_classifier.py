"""A two-person ST-GCN that tells interactions apart: extractor of features, and the recognition of the downstream task.

Yan et al. (2018), small and with links to the partner: a clip's joints pass graph convolutions over themselves, their
bones and the partner's same joints, each followed by a convolution over time; means over everything are the features.
Ours are the sizes (blocks of 24, 32 and 32 channels, 5 frames), the layer norm in place of batch norm, which needs no
running figures, and the links.  Clips are of 2 s at 10 Hz, in the frame of the pair.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.learning.torch_settings import TorchSettings, require_torch
from pasdedeux.skeletons import BODY22

Narrow = npt.NDArray[np.float32]

CLIP_HZ = 10.0
CLIP_FRAMES = 20
_STRIDE = 5
"""A clip begins every half second."""
_CLIPS_PER_STEP = 24
"""Clips of a step of training, drawn from all classes alike."""
_NUM_FEATURES = 32
_CHANNELS = (6, 24, 32, _NUM_FEATURES)
_TIME = 5


class ClassifierSettings(TorchSettings):
    """How the classifier of clips is trained."""

    num_steps: int = Field(200, ge=1, description="Steps of training")
    learning_rate: float = Field(0.003, gt=0, le=1, description="Learning rate of Adam at the start")


def pair_frame(motion_m: Array, frame: int) -> Array:
    """Return motions (*batch, T, 2, 22, 3) about the middle of both pelvises in a frame, A facing B along x there."""
    pelvises = motion_m[..., frame, :, BODY22.root, :]
    middle = pelvises.mean(axis=-2)
    across = pelvises[..., 1, :] - pelvises[..., 0, :]
    yaw = np.arctan2(across[..., 2], across[..., 0])
    cos, sin = (turn[..., None, None, None] for turn in (np.cos(yaw), np.sin(yaw)))
    moved = motion_m - (middle * [1.0, 0.0, 1.0])[..., None, None, None, :]
    x, y, z = (moved[..., axis] for axis in range(3))
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=-1)


def clips_of(
    motion_m: Array, rate_hz: float, *, num_frames: int = CLIP_FRAMES, frame: int | None = None, is_held: bool = True
) -> Array:
    """Cut a motion (T, 2, 22, 3), metres, into clips (n, num_frames, 2, 22, 3) at 10 Hz, each in its pair's frame.

    A motion that is shorter is held still at its end, or has no clip (n = 0).  Between frames of the motion, places are
    interpolated.

    Args:
        motion_m: The motion.
        rate_hz: Its frames per second.
        num_frames: Frames of a clip.
        frame: Frame of the clip that gives its pair's frame; the middle one if not told.
        is_held: A shorter motion is held.
    """
    times = np.arange(0.0, (len(motion_m) - 1) / rate_hz + 1e-9, 1.0 / CLIP_HZ) * rate_hz
    below = np.minimum(times.astype(int), max(len(motion_m) - 2, 0))
    share = (times - below)[:, None, None, None]
    above = np.minimum(below + 1, len(motion_m) - 1)
    slow = (1.0 - share) * motion_m[below] + share * motion_m[above]
    if is_held:
        slow = np.concatenate([slow, np.repeat(slow[-1:], max(num_frames - len(slow), 0), axis=0)])
    starts = np.arange(0, max(len(slow) - num_frames + 1, 0), _STRIDE)
    return pair_frame(slow[starts[:, None] + np.arange(num_frames)], num_frames // 2 if frame is None else frame)


@dataclass(frozen=True)
class ClipClassifier:
    """A trained classifier.

    Args:
        labels: Names of the classes.
        weights: What it learned, by name.
    """

    labels: tuple[str, ...]
    weights: Mapping[str, Narrow]

    @property
    def digest(self) -> str:
        """Sha256 of labels and weights, the first 12 digits."""
        found = hashlib.sha256("\n".join(self.labels).encode())
        for name in sorted(self.weights):
            found.update(np.ascontiguousarray(self.weights[name]).tobytes())
        return found.hexdigest()[:12]

    @classmethod
    def train(
        cls, clips: Mapping[str, Array], settings: ClassifierSettings, generator: np.random.Generator
    ) -> ClipClassifier:
        """Train on clips (n, 20, 2, 22, 3) by class; who is A and who is B changes places by chance.

        Raises:
            InputError: Fewer than two classes, a class without clips, or training came to numbers that are not finite.
        """
        require_torch("the classifier of clips")
        from pasdedeux.learning import clip_network
        from pasdedeux.learning.torch_training import Batch, train_whole

        labels = tuple(sorted(clips))
        if len(labels) < 2 or not all(len(clips[label]) for label in labels):
            raise InputError(
                f"a classifier of clips needs two classes with clips of {CLIP_FRAMES / CLIP_HZ:g} s; found "
                + (", ".join(f"{label} {len(clips[label])}" for label in labels) or "none")
            )

        def draw() -> Batch:
            which = generator.integers(len(labels), size=_CLIPS_PER_STEP)
            found = np.stack([clips[labels[one]][generator.integers(len(clips[labels[one]]))] for one in which])
            swapped = generator.random(len(found)) < 0.5
            found[swapped] = pair_frame(found[swapped][:, :, ::-1], CLIP_FRAMES // 2)
            known = np.eye(len(labels), dtype=np.float32)[which]
            return Batch({"clips": _channels(found), "is_class": known}, f"clips of {', '.join(labels)}")

        weights = train_whole(
            "clip_classifier",
            settings,
            lambda: clip_network.first_weights(_CHANNELS, _TIME, len(labels), generator),
            draw,
            clip_network.loss,
        )
        return cls(labels, weights)

    def features(self, clips: Array) -> Array:
        """Return the features (n, 32) of clips (n, 20, 2, 22, 3)."""
        from pasdedeux.learning import clip_network

        return clip_network.evaluate(self.weights, _channels(clips))[0]

    def accuracy(self, clips: Mapping[str, Array]) -> float:
        """Return the share of clips whose class is found, in percent; NaN of none."""
        from pasdedeux.learning import clip_network

        hits: list[Sequence[bool]] = []
        for label, some in clips.items():
            found = clip_network.evaluate(self.weights, _channels(some))[1].argmax(axis=1) if len(some) else []
            hits.append([self.labels[one] == label for one in found])
        flat = [hit for some in hits for hit in some]
        return 100.0 * float(np.mean(flat)) if flat else float("nan")


def _channels(clips: Array) -> Narrow:
    """Return places about 1 m of height and velocities of clips (n, 20, 44, 6), metres and metres per second."""
    points = clips.reshape(*clips.shape[:2], -1, 3)
    moved = CLIP_HZ * np.diff(points, axis=1, prepend=points[:, :1])
    return np.concatenate([points - [0.0, 1.0, 0.0], moved], axis=-1).astype(np.float32)
