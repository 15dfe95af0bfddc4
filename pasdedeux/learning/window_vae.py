"""Variational autoencoders of windows: one loop, one way to ask, whatever the networks are.

They condition on one body, so the scaled person is B, with roles swapped where it is A; variants of both are not
learned from, and where both are scaled what is said of either is added.  The motion asked for is that of the mean of
the prior.  What the encoders know, z of the answer itself, is for comparison alone and stands in the log of training
beside z drawn from the prior.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self, get_args

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError
from pasdedeux.learning.model import (
    Arrays,
    Trained,
    Training,
    VariantModel,
    VariantRequest,
    check_arrays,
)
from pasdedeux.learning.paper_settings import WindowSizes, WindowVaeSettings
from pasdedeux.learning.topology import check_topology, skeleton_of
from pasdedeux.learning.torch_settings import require_torch
from pasdedeux.learning.windows import Window, blend, cut, gather_windows, scaled_persons
from pasdedeux.settings import Settings
from pasdedeux.skeletons import Skeleton

if TYPE_CHECKING:
    import torch

Narrow = npt.NDArray[np.float32]

_VALIDATED = 48
"""Windows of validation variants that training looks at."""


class WindowNetworks(ABC):
    """The networks of one autoencoder, for sizes that its settings say.

    Batches hold `template_m`, `motion_m` (W, T, 2, J, 3), metres, `condition` (W, n), and unit noise `noise_...`.
    """

    @abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of all weights."""

    @abstractmethod
    def noise_shapes(self, num_frames: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the unit noise that a window takes, by name."""

    @abstractmethod
    def loss(self, weights: Mapping[str, torch.Tensor], batch: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the loss of a batch."""

    @abstractmethod
    def move(
        self, weights: Mapping[str, torch.Tensor], batch: Mapping[str, torch.Tensor], *, is_known: bool
    ) -> torch.Tensor:
        """Return how far both move from the template (W, T, 2, J, 3), metres: z by the batch's noise, or the answer's.

        Noise of 0 is the mean of the prior.
        """

    def displacement(
        self, weights: Mapping[str, Narrow], batch: Mapping[str, Narrow], *, is_known: bool = False
    ) -> Narrow:
        """Return `move` of arrays, on one thread."""
        import torch

        from pasdedeux.learning.torch_layers import tensors

        torch.set_num_threads(1)
        with torch.no_grad():
            return np.asarray(self.move(tensors(weights), tensors(batch), is_known=is_known).numpy())


@dataclass
class WindowVae(VariantModel):
    """The learned weights, the sizes they are of, and the scales that were trained on.

    Args:
        config: Sizes of the networks.
        length: Frames of a window.
        known_scales: What is kept of the scales of training (n, 22), see `learned_scales`.
        weights: Weights of the networks, by name.
    """

    needs_torch = True
    is_of_any_skeleton = True
    settings = WindowVaeSettings
    config_kind: ClassVar[type[Any]]
    """Its settings with the sizes of the networks."""
    sizes: ClassVar[tuple[str, ...]]
    """What the networks' shapes depend on: whole numbers and choices."""

    config: Any
    length: int
    known_scales: Narrow
    weights: dict[str, Narrow]

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton that its scales are of."""
        return skeleton_of(self.name, self.known_scales.shape[1])

    @abstractmethod
    def networks(self) -> WindowNetworks:
        """Return the networks for the sizes of this model."""

    @classmethod
    @abstractmethod
    def learned_scales(cls, bone_scale: Narrow) -> Narrow:
        """Return what is kept (n, 22) of the scales of training (V, 22)."""

    @abstractmethod
    def condition(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        """Return what the networks are told (W, m) of scales (W, 22)."""

    def figures(self, weights: Mapping[str, Narrow], batch: Mapping[str, Narrow]) -> dict[str, float]:
        """Return more figures of a batch of validation windows, for the log."""
        return {}

    @classmethod
    def num_segments(cls, settings: WindowVaeSettings) -> int:
        """Return the number of segments, of `segment_steps` each."""
        return settings.num_segments

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Train one segment; the windows of all takes are held, ten frames a second in single precision."""
        require_torch(cls.name)
        from pasdedeux.learning.torch_layers import first_values
        from pasdedeux.learning.torch_training import Batch, train_segment

        settings = training.settings or cls.settings()
        assert isinstance(settings, WindowVaeSettings)
        config = cls.config_kind.model_validate(settings.model_dump())
        generator = training.generator
        windows = gather_windows(training.items, config.length)
        if not windows:
            raise InputError(
                f"{cls.name}: there is no variant of one scaled person to train on; check split and scales"
            )
        # Windows of a take shorter than the others would not stack; a batch is of one length.
        longest = max(len(window.frames) for window in windows)
        whole = [window for window in windows if len(window.frames) == longest]
        scales = np.concatenate([window.bone_scale for window in whole])
        model = cls(config, config.length, cls.learned_scales(scales), {})
        network = model.networks()

        def draw() -> Batch:
            found = [whole[index] for index in generator.integers(len(whole), size=config.windows_per_step)]
            batch = model.batch(found, [int(generator.integers(len(window.variants_m))) for window in found])
            batch |= model._noise(len(found), longest, generator)
            takes = ", ".join(sorted({window.take_id for window in found}))
            return Batch(batch, f"takes {takes}")

        fixed = np.random.default_rng(0)
        seen = [one for one in gather_windows(training.validation, config.length) if len(one.frames) == longest]
        judged = [seen[index] for index in fixed.integers(max(len(seen), 1), size=_VALIDATED if seen else 0)]
        chosen = [int(fixed.integers(len(window.variants_m))) for window in judged]

        def validate(weights: Mapping[str, Narrow]) -> dict[str, float]:
            if not judged:
                return {}
            batch = model.batch(judged, chosen)
            wanted = batch["motion_m"] - batch["template_m"]
            mean, drawn = (model._noise(len(judged), longest, one) for one in (None, np.random.default_rng(1)))
            found = {}
            for kind, noise in {"": mean, "prior_": drawn, "posterior_": mean}.items():
                moved = network.displacement(weights, batch | noise, is_known=kind == "posterior_")
                found[f"validation_{kind}error_cm"] = 100.0 * float(np.linalg.norm(moved - wanted, axis=-1).mean())
            found["validation_copy_error_cm"] = 100.0 * float(np.linalg.norm(wanted, axis=-1).mean())
            return found | model.figures(weights, batch | drawn)

        done = train_segment(
            cls.name,
            config,
            training.segment,
            training.state,
            lambda: first_values(network.shapes(), generator),
            draw,
            network.loss,
            validate,
        )
        model.weights = done.best
        return Trained(model, done.log, done.state)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return weights, sizes and scales."""
        numbers = [self.length, *(_as_number(self.config, name) for name in self.sizes)]
        return {"sizes": np.array(numbers, np.float64), "known_scales": self.known_scales, **self.weights}

    @classmethod
    def from_arrays(cls, arrays: Arrays, built_on: VariantModel | None = None) -> Self:
        """Make the model from its arrays."""
        require_torch(cls.name)
        count, joints = (*np.shape(arrays.get("known_scales", ())), 0, 0)[:2]
        check_arrays(cls.name, arrays, {"sizes": (1 + len(cls.sizes),), "known_scales": (count, joints)})
        skeleton_of(cls.name, joints)
        length, *numbers = (int(size) for size in arrays["sizes"])
        try:
            told = {
                name: _from_number(cls.config_kind, name, number)
                for name, number in zip(cls.sizes, numbers, strict=True)
            }
            config = cls.config_kind.model_validate(told)
        except (ValueError, IndexError):
            raise InputError(f"{cls.name}: sizes {numbers} are out of range") from None
        if not (1 <= length <= WindowSizes.longest() and count and cls._are_scales(arrays["known_scales"])):
            raise InputError(f"{cls.name}: a window of {length} frames, or scales that are not positive")
        model = cls(config, length, arrays["known_scales"].astype(np.float32), {})
        shapes = model.networks().shapes()
        check_arrays(cls.name, arrays, shapes)
        model.weights = {name: arrays[name].astype(np.float32) for name in shapes}
        return model

    @classmethod
    def _are_scales(cls, known: npt.NDArray[Any]) -> bool:
        return bool(known.min() > 0.0)

    def predict(self, request: VariantRequest) -> Array:
        """Return the motion of the prior's mean; a take shorter than a window is one window of its own length."""
        moved = np.zeros_like(request.source.positions_m)
        for person in scaled_persons(request):
            moved += self.moved(request.source, person, request.bone_scale[person], None)
        return request.source.positions_m + moved

    @abstractmethod
    def draw_scale(self, generator: np.random.Generator) -> Array:
        """Return scales of a body (22,), drawn from what the model knows of them."""

    def generate(self, source: Source, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return scales (2, 22), those of B drawn, and a motion (T, 2, 22, 3), metres, drawn for them."""
        scale = self.draw_scale(generator)
        return np.stack([np.ones_like(scale), scale]), source.positions_m + self.moved(source, 1, scale, generator)

    def batch(self, windows: list[Window], variants: list[int]) -> dict[str, Narrow]:
        """Return windows of one length with one of their variants each, as the networks see them."""
        pairs = list(zip(windows, variants, strict=True))
        return {
            "template_m": np.stack([window.template_m for window in windows]),
            "motion_m": np.stack([window.variants_m[variant] for window, variant in pairs]),
            "condition": self.condition(np.stack([window.bone_scale[variant] for window, variant in pairs])),
        }

    def moved(self, source: Source, person: int, scale: Array, generator: np.random.Generator | None) -> Array:
        """Return how far both move (T, 2, 22, 3), metres, where one is scaled; noise is the same for all windows."""
        check_topology(self, source)
        windows = cut(source, "", person, self.length)
        count, num_frames = len(windows), len(windows[0].frames)
        noise = self._noise(1, num_frames, generator)
        batch = {
            "template_m": np.stack([window.template_m for window in windows]),
            "condition": np.repeat(self.condition(scale[None]), count, axis=0),
            **{name: np.repeat(values, count, axis=0) for name, values in noise.items()},
        }
        return blend(source, windows, iter(self.networks().displacement(self.weights, batch)))

    def _noise(self, count: int, num_frames: int, generator: np.random.Generator | None) -> dict[str, Narrow]:
        """Return unit noise for so many windows, or 0."""
        return {
            f"noise_{name}": np.zeros((count, *shape), np.float32)
            if generator is None
            else generator.standard_normal((count, *shape), np.float32)
            for name, shape in self.networks().noise_shapes(num_frames).items()
        }


def _choices(settings: type[Settings], name: str) -> tuple[Any, ...]:
    """Return what a setting can be where that is a choice of words; nothing for a number."""
    return get_args(settings.model_fields[name].annotation)


def _as_number(config: Settings, name: str) -> int:
    value, choices = getattr(config, name), _choices(type(config), name)
    return choices.index(value) if choices else int(value)


def _from_number(settings: type[Settings], name: str, number: int) -> Any:
    choices = _choices(settings, name)
    if choices and number < 0:
        raise IndexError
    return choices[number] if choices else number
