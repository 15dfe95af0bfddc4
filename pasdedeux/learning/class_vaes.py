"""`actor_like` and `action2motion_like`: models of motion from a class, as Li et al. (2024, section 5.3) adapted them.

They know scales only as names: each that was trained on is a class, and one that was not is taken for the nearest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.learning.paper_settings import Action2MotionLikeConfig, ActorLikeConfig
from pasdedeux.learning.window_vae import WindowNetworks, WindowVae

Narrow = npt.NDArray[np.float32]

_SAME_SCALE = 1e-4


@dataclass
class _ClassVae(WindowVae):
    """A model of classes; `known_scales` are the scales of each (C, 22)."""

    @classmethod
    def learned_scales(cls, bone_scale: Narrow) -> Narrow:
        """Return scales that differ."""
        return np.unique(np.round(bone_scale / _SAME_SCALE), axis=0).astype(np.float32) * np.float32(_SAME_SCALE)

    def condition(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        """Return which class each is of (W, C), as 0 and 1."""
        apart = np.linalg.norm(bone_scale[:, None] - self.known_scales, axis=-1)
        return np.eye(len(self.known_scales), dtype=np.float32)[apart.argmin(axis=1)]

    def draw_scale(self, generator: np.random.Generator) -> npt.NDArray[np.float64]:
        """Return the scales of a class, each as likely as any other."""
        return self.known_scales[generator.integers(len(self.known_scales))].astype(np.float64)


@dataclass
class ActorLikeModel(_ClassVae):
    """A transformer whose z is of a whole window."""

    name = "actor_like"
    config_kind = ActorLikeConfig
    sizes = ("width", "num_blocks")

    def networks(self) -> WindowNetworks:
        """Return its transformers."""
        from pasdedeux.learning.class_networks import ActorNetworks

        return ActorNetworks(self.config, *self.known_scales.shape)


@dataclass
class Action2MotionLikeModel(_ClassVae):
    """A recurrent network whose z is of a frame."""

    name = "action2motion_like"
    config_kind = Action2MotionLikeConfig
    sizes = ("hidden", "latent_size")

    def networks(self) -> WindowNetworks:
        """Return its recurrent networks."""
        from pasdedeux.learning.class_networks import Action2MotionNetworks

        return Action2MotionNetworks(self.config, *self.known_scales.shape)
