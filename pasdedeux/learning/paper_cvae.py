"""`paper_cvae`: the conditional VAE of Li et al. (2024) as printed, as far as it is printed; see `window_vae`.

Its motion is that of z = 0; `generate` draws scales from p(B_s), and z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.paper_settings import PaperCvaeConfig, PaperCvaeSettings
from pasdedeux.learning.window_vae import WindowVae

if TYPE_CHECKING:
    from pasdedeux.learning.interaction_cvae import InteractionCvae

Narrow = npt.NDArray[np.float32]

_SMALLEST_DEVIATION = 0.01
"""Scales that hardly vary are not blown up."""


@dataclass
class PaperCvaeModel(WindowVae):
    """The model; `known_scales` are mean and deviation of each bone's scale in training (2, 22)."""

    name = "paper_cvae"
    settings = PaperCvaeSettings
    config_kind = PaperCvaeConfig
    sizes = ("width", "hidden", "latent_size", "num_blocks", "kernel", "architecture")

    def networks(self) -> InteractionCvae:
        """Return equations 1 to 8."""
        from pasdedeux.learning.interaction_cvae import InteractionCvae

        return InteractionCvae(self.config, self.skeleton)

    @classmethod
    def learned_scales(cls, bone_scale: Narrow) -> Narrow:
        """Return mean and deviation."""
        deviation = np.maximum(bone_scale.std(axis=0), _SMALLEST_DEVIATION)
        return np.stack([bone_scale.mean(axis=0), deviation]).astype(np.float32)

    @classmethod
    def _are_scales(cls, known: npt.NDArray[Any]) -> bool:
        return len(known) == 2 and super()._are_scales(known)

    def condition(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        """Return standardised scales."""
        return ((bone_scale - self.known_scales[0]) / self.known_scales[1]).astype(np.float32)

    def draw_scale(self, generator: np.random.Generator) -> Array:
        """Return scales drawn from p(B_s)."""
        networks = self.networks()
        drawn = networks.scales(self.weights, generator.standard_normal((1, networks.latent_of_scales), np.float32))
        mean, deviation = self.known_scales.astype(np.float64)
        return np.asarray(mean + deviation * drawn[0])

    def figures(self, weights: Mapping[str, Narrow], batch: Mapping[str, Narrow]) -> dict[str, float]:
        """Return figures of generation, scales from p(B_s) and z from the prior: its bones beside those asked for.

        There is no true motion; scales should vary as those of training do.
        """
        networks = self.networks()
        drawn = networks.scales(weights, batch["noise_s"])
        moved = networks.displacement(weights, {**batch, "condition": drawn})
        template = batch["template_m"][:, :, 1].astype(np.float64)
        mean, deviation = self.known_scales
        error = bone_lengths(self.skeleton, template + moved[:, :, 1])
        error -= (mean + deviation * drawn)[:, None] * bone_lengths(self.skeleton, template)
        return {
            "validation_generated_bone_error_mm": 1000.0 * float(np.abs(error).mean()),
            "generated_scale_deviation": float((deviation * drawn.std(axis=0)).mean()),
            "train_scale_deviation": float(deviation.mean()),
        }
