"""`paper_cvae`: the conditional VAE of Li et al. (2024) as printed, as far as it is printed.

It conditions on one body, so the scaled person is B, with roles swapped where it is A; variants of both are not learned
from, and where both are scaled what it says of either is added.  The motion asked for is that of z = 0, the mean of the
prior; `generate` draws scales and z.  What the encoders know, z of the answer itself, is for comparison alone and
stands in the log of training beside both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.model import (
    Arrays,
    Trained,
    Training,
    VariantModel,
    VariantRequest,
    check_arrays,
)
from pasdedeux.learning.paper_settings import PaperCvaeSettings
from pasdedeux.learning.torch_settings import require_torch
from pasdedeux.learning.windows import Window, blend, cut, gather_windows, scaled_persons
from pasdedeux.skeletons import BODY22

__all__ = ["PaperCvaeModel"]

Array = npt.NDArray[np.float64]
Narrow = npt.NDArray[np.float32]

_LATENT_OF_SCALES = 256
_SMALLEST_DEVIATION = 0.01
"""Scales that hardly vary are not blown up."""
_VALIDATED = 48
"""Windows of validation variants that training looks at."""
_SIZES = ("width", "hidden", "latent_size", "num_blocks", "kernel")


@dataclass
class PaperCvaeModel(VariantModel):
    """The learned weights, the sizes they are of, and how scales are standardised.

    Args:
        config: Sizes of the networks.
        length: Frames of a window.
        standard: Mean and deviation of each bone's scale in training (2, 22).
        weights: Weights of `InteractionCvae`, by name.
    """

    name = "paper_cvae"
    settings = PaperCvaeSettings
    needs_torch = True

    config: PaperCvaeSettings
    length: int
    standard: Narrow
    weights: dict[str, Narrow]

    @classmethod
    def num_segments(cls, settings: PaperCvaeSettings) -> int:
        """Return the number of segments, of `segment_steps` each."""
        return settings.num_segments

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Train one segment; the windows of all takes are held, ten frames a second in single precision."""
        require_torch(cls.name)
        from pasdedeux.learning.interaction_cvae import InteractionCvae
        from pasdedeux.learning.torch_layers import first_values
        from pasdedeux.learning.torch_training import Batch, train_segment

        settings, generator = training.options(PaperCvaeSettings), training.generator
        windows = gather_windows(training.items, settings.length)
        if not windows:
            raise InputError("paper_cvae: there is no variant of one scaled person to train on; check split and scales")
        # Windows of a take shorter than the others would not stack; a batch is of one length.
        longest = max(len(window.frames) for window in windows)
        whole = [window for window in windows if len(window.frames) == longest]
        scales = np.concatenate([window.bone_scale for window in whole])
        deviation = np.maximum(scales.std(axis=0), _SMALLEST_DEVIATION)
        model = cls(settings, settings.length, np.stack([scales.mean(axis=0), deviation]).astype(np.float32), {})
        network = InteractionCvae(settings)

        def draw() -> Batch:
            found = [whole[index] for index in generator.integers(len(whole), size=settings.windows_per_step)]
            batch = model.batch(found, [int(generator.integers(len(window.variants_m))) for window in found])
            for name, size in (("s", _LATENT_OF_SCALES), ("b", settings.latent_size), ("a", settings.latent_size)):
                batch[f"noise_{name}"] = generator.standard_normal((len(found), size), np.float32)
            takes = ", ".join(sorted({window.take_id for window in found}))
            return Batch(batch, f"takes {takes}")

        fixed = np.random.default_rng(0)
        seen = [one for one in gather_windows(training.validation, settings.length) if len(one.frames) == longest]
        judged = [seen[index] for index in fixed.integers(max(len(seen), 1), size=_VALIDATED if seen else 0)]
        chosen = [int(fixed.integers(len(window.variants_m))) for window in judged]

        def validate(weights: Mapping[str, Narrow]) -> dict[str, float]:
            if not judged:
                return {}
            batch = model.batch(judged, chosen)
            wanted = batch["motion_m"] - batch["template_m"]
            noise = np.random.default_rng(1).standard_normal((2, len(judged), settings.latent_size), np.float32)
            known = np.stack(network.posterior(weights, batch))
            latents = {"": np.zeros_like(noise), "prior_": noise, "posterior_": known}
            found = {}
            for kind, (z_b, z_a) in latents.items():
                moved = network.displacement(weights, batch | {"z_b": z_b, "z_a": z_a})
                found[f"validation_{kind}error_cm"] = 100.0 * float(np.linalg.norm(moved - wanted, axis=-1).mean())
            found["validation_copy_error_cm"] = 100.0 * float(np.linalg.norm(wanted, axis=-1).mean())
            # Generation: scales from p(B_s), z from the prior; there is no true motion, but the bones asked for.
            drawn = network.scales(
                weights, np.random.default_rng(2).standard_normal((len(judged), _LATENT_OF_SCALES), np.float32)
            )
            moved = network.displacement(weights, batch | {"scale": drawn, "z_b": noise[0], "z_a": noise[1]})
            template = batch["template_m"][:, :, 1].astype(np.float64)
            scale = (model.standard[0] + model.standard[1] * drawn)[:, None]
            error = bone_lengths(BODY22, template + moved[:, :, 1]) - scale * bone_lengths(BODY22, template)
            return found | {
                "validation_generated_bone_error_mm": 1000.0 * float(np.abs(error).mean()),
                "generated_scale_deviation": float((model.standard[1] * drawn.std(axis=0)).mean()),
                "train_scale_deviation": float(scales.std(axis=0).mean()),
            }

        done = train_segment(
            cls.name,
            settings,
            training.segment,
            training.state,
            lambda: first_values(network.shapes(), generator),
            draw,
            network.loss,
            validate,
        )
        model.weights = done.best
        return Trained(model, done.log, done.state)

    def arrays(self) -> dict[str, Narrow]:
        """Return the weights, the sizes, and how scales are standardised."""
        sizes = [self.length, *(getattr(self.config, name) for name in _SIZES)]
        return {**self.weights, "sizes": np.array(sizes, np.float32), "standard": self.standard}

    @classmethod
    def from_arrays(cls, arrays: Arrays, built_on: VariantModel | None = None) -> VariantModel:
        """Make the model from its arrays."""
        require_torch(cls.name)
        from pasdedeux.learning.interaction_cvae import InteractionCvae

        check_arrays(cls.name, arrays, {"sizes": (1 + len(_SIZES),), "standard": (2, BODY22.num_joints)})
        length, *sizes = (int(size) for size in arrays["sizes"])
        try:
            config = PaperCvaeSettings.model_validate(dict(zip(_SIZES, sizes, strict=True)))
        except ValueError:
            raise InputError(f"paper_cvae: sizes {sizes} are out of range") from None
        if not 1 <= length <= PaperCvaeSettings.longest() or arrays["standard"][1].min() <= 0.0:
            raise InputError(f"paper_cvae: a window of {length} frames, or a deviation of scales that is not positive")
        shapes = InteractionCvae(config).shapes()
        check_arrays(cls.name, arrays, shapes)
        weights = {name: arrays[name].astype(np.float32) for name in shapes}
        return cls(config, length, arrays["standard"].astype(np.float32), weights)

    def predict(self, request: VariantRequest) -> Array:
        """Return the motion of z = 0; a take shorter than a window is one window of its own length."""
        moved = np.zeros_like(request.source.positions_m)
        for person in scaled_persons(request.bone_scale):
            moved += self._moved(request.source, person, request.bone_scale[person], None)
        return request.source.positions_m + moved

    def generate(self, source: Source, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return scales of B (22,) drawn from p(B_s), and a motion (T, 2, 22, 3), metres, drawn for them."""
        from pasdedeux.learning.interaction_cvae import InteractionCvae

        z = generator.standard_normal((1, _LATENT_OF_SCALES), np.float32)
        mean, deviation = self.standard.astype(np.float64)
        scale = mean + deviation * InteractionCvae(self.config).scales(self.weights, z)[0]
        return scale, source.positions_m + self._moved(source, 1, scale, generator)

    def batch(self, windows: list[Window], variants: list[int]) -> dict[str, Narrow]:
        """Return windows of one length with one of their variants each, as the networks see them."""
        pairs = list(zip(windows, variants, strict=True))
        return {
            "template_m": np.stack([window.template_m for window in windows]),
            "motion_m": np.stack([window.variants_m[variant] for window, variant in pairs]),
            "scale": self._standardised(np.stack([window.bone_scale[variant] for window, variant in pairs])),
        }

    def _standardised(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        return ((bone_scale - self.standard[0]) / self.standard[1]).astype(np.float32)

    def _moved(self, source: Source, person: int, scale: Array, generator: np.random.Generator | None) -> Array:
        """Return how far both move where one is scaled; z is drawn once for all windows, or 0."""
        from pasdedeux.learning.interaction_cvae import InteractionCvae

        windows = cut(source, "", person, self.length)
        size = self.config.latent_size
        z = np.zeros((2, size), np.float32) if generator is None else generator.standard_normal((2, size), np.float32)
        count = len(windows)
        batch = {
            "template_m": np.stack([window.template_m for window in windows]),
            "scale": np.repeat(self._standardised(scale[None]), count, axis=0),
            "z_b": np.repeat(z[:1], count, axis=0),
            "z_a": np.repeat(z[1:], count, axis=0),
        }
        return blend(source, windows, iter(InteractionCvae(self.config).displacement(self.weights, batch)))
