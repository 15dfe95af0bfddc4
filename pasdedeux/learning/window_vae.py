"""Variational autoencoders of windows: `paper_cvae` of Li et al. (2024), and the two models that it was compared with.

They condition on one body, so the scaled person is B, with roles swapped where it is A; variants of both are not
learned from, and where both are scaled the displacements for either are added.  The motion predicted is that of the
mean of the prior; `generate` draws scales, and z.  The z that encoders make of the answer itself is for comparison
alone; the training log has its errors beside those of z drawn from the prior.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.key_frames import KeyFrames
from pasdedeux.learning.model import (
    Arrays,
    Config,
    Trained,
    Training,
    VariantModel,
    VariantRequest,
    check_arrays,
    check_topology,
    skeleton_of,
)
from pasdedeux.learning.settings import (
    Action2MotionLikeConfig,
    ActorLikeConfig,
    PaperCvaeConfig,
    PaperCvaeSettings,
    SegmentSettings,
    WindowSettings,
    require_torch,
)
from pasdedeux.learning.windows import (
    Window,
    blend_windows,
    cut_windows,
    gather_windows,
    sampled_frames,
    scaled_persons,
)
from pasdedeux.skeletons import Skeleton

if TYPE_CHECKING:
    from pasdedeux.learning.networks.interaction_cvae import InteractionCvae
    from pasdedeux.learning.networks.layers import WindowNetwork

Narrow = npt.NDArray[np.float32]

_VALIDATED = 48
"""Number of windows of validation variants used in training."""
_SMALLEST_DEVIATION = 0.01
"""Smallest deviation by which scales are divided, so that nearly constant ones are not amplified."""
_SAME_SCALE = 1e-4


@dataclass
class WindowVae(VariantModel):
    """A network, its settings, and the scales that it was trained on.

    Args:
        options: Settings, with the sizes of the network.
        known_scales: Statistics of the training scales (n, J), see `learned_scales`.
        network: The network.
    """

    needs_torch = True
    is_of_any_skeleton = True
    settings = SegmentSettings
    config_kind: ClassVar[type[WindowSettings]]
    """Its settings with the sizes of the network."""

    options: Any
    known_scales: Narrow
    network: WindowNetwork

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton that its scales are of."""
        return skeleton_of(self.name, self.known_scales.shape[1])

    @classmethod
    @abstractmethod
    def build(cls, options: Any, known_scales: Narrow) -> WindowNetwork:
        """Return the network, its parameters not yet set."""

    @classmethod
    @abstractmethod
    def learned_scales(cls, bone_scale: Narrow) -> Narrow:
        """Return the statistics (n, J) that are stored of the training scales (V, J)."""

    @abstractmethod
    def condition(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        """Return the network's condition (W, m) for scales (W, J)."""

    @abstractmethod
    def draw_scale(self, generator: np.random.Generator) -> Array:
        """Return scales of a body (J,), drawn from what the model knows of them."""

    def figures(self, batch: Mapping[str, Narrow]) -> dict[str, float]:
        """Return more figures of a batch of validation windows, for the log."""
        return {}

    @classmethod
    def num_segments(cls, settings: SegmentSettings) -> int:
        """Return the number of segments, of `segment_steps` each."""
        return settings.num_segments

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Train one segment; the windows of all takes are held, ten frames a second in single precision."""
        require_torch(cls.name)
        from pasdedeux.learning.networks.training import find_device, train_segment

        options = cls.config_kind.model_validate(training.options(cls.settings).model_dump())
        generator = training.generator
        device = find_device(cls.name, training.device)
        windows = gather_windows(training.items, options.length)
        if not windows:
            raise InputError(
                f"{cls.name}: there is no variant of one scaled person to train on; check split and scales"
            )
        # Windows of shorter takes cannot be stacked with others, so a batch has one length.
        longest = max(len(window.frames) for window in windows)
        whole = [window for window in windows if len(window.frames) == longest]
        known = cls.learned_scales(np.concatenate([window.bone_scale for window in whole]))
        model = cls(options, known, cls.build(options, known))

        def draw() -> tuple[Mapping[str, Narrow], str]:
            chosen = [whole[index] for index in generator.integers(len(whole), size=options.windows_per_step)]
            batch = model.batch(chosen, [int(generator.integers(len(window.variants_m))) for window in chosen])
            batch |= model._noise(len(chosen), longest, generator)
            return batch, "takes " + ", ".join(sorted({window.take_id for window in chosen}))

        fixed = np.random.default_rng(0)
        seen = [
            window for window in gather_windows(training.validation, options.length) if len(window.frames) == longest
        ]
        judged = [seen[index] for index in fixed.integers(max(len(seen), 1), size=_VALIDATED if seen else 0)]
        chosen = [int(fixed.integers(len(window.variants_m))) for window in judged]

        log, state = train_segment(
            cls.name,
            model.network,
            options,
            draw,
            lambda: model._validate(model.batch(judged, chosen)) if judged else {},
            segment=training.segment,
            state=training.state,
            generator=generator,
            device=device,
        )
        return Trained(model, log, state, device.type)

    def _validate(self, batch: Mapping[str, Narrow]) -> dict[str, float]:
        """Return errors of z = 0, drawn from the prior and of the answer, beside the copy's."""
        wanted = batch["motion_m"] - batch["template_m"]
        count, num_frames = wanted.shape[:2]
        mean, drawn = (self._noise(count, num_frames, source) for source in (None, np.random.default_rng(1)))
        losses = {}
        for kind, noise in {"": mean, "prior_": drawn, "posterior_": mean}.items():
            moved = self.network.displacement({**batch, **noise}, is_posterior=kind == "posterior_")
            losses[f"validation_{kind}error_cm"] = 100.0 * float(np.linalg.norm(moved - wanted, axis=-1).mean())
        losses["validation_copy_error_cm"] = 100.0 * float(np.linalg.norm(wanted, axis=-1).mean())
        return losses | self.figures({**batch, **drawn})

    def config(self) -> Config:
        """Return the settings."""
        return self.options.model_dump(mode="json")

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the state of the network, and the scales."""
        state = {name: values.numpy() for name, values in self.network.state_dict().items()}
        return {"known_scales": self.known_scales, **state}

    @classmethod
    def restore(cls, config: Config, arrays: Arrays, built_on: VariantModel | None = None) -> Self:
        """Make the model from its settings and arrays."""
        require_torch(cls.name)
        from pasdedeux.learning.networks.layers import restore_network

        options = cls.config_kind.model_validate(config)
        count, joints = (*np.shape(arrays.get("known_scales", ())), 0, 0)[:2]
        check_arrays(cls.name, arrays, {"known_scales": (count, joints)})
        skeleton_of(cls.name, joints)
        known = arrays["known_scales"].astype(np.float32)
        if not cls._are_scales(known):
            raise InputError(f"{cls.name}: there are no scales, or some that are not positive")
        return cls(options, known, restore_network(cls.name, lambda: cls.build(options, known), arrays))

    @classmethod
    def _are_scales(cls, known: Narrow) -> bool:
        return len(known) > 0 and bool(known.min() > 0.0)

    def predict(self, request: VariantRequest) -> Array:
        """Return the motion of the prior's mean; a take shorter than a window is one window of its own length."""
        moved = np.zeros_like(request.source.positions_m)
        for person in scaled_persons(request):
            moved += self.moved(request.source, person, request.bone_scale[person], None)
        return self._finish(request, request.source.positions_m + moved)

    def generate(
        self,
        source: Source,
        generator: np.random.Generator,
        *,
        scale: Array | None = None,
        key_frames: KeyFrames | None = None,
    ) -> tuple[Array, Array]:
        """Return scales (2, J), those of B drawn or given, and a motion (T, 2, J, 3), metres, drawn for them."""
        scale = self.draw_scale(generator) if scale is None else scale
        moved = self.moved(source, 1, scale, generator, key_frames)
        request = VariantRequest(source.name, source, np.stack([np.ones_like(scale), scale]))
        return request.bone_scale, self._finish(request, source.positions_m + moved)

    def _finish(self, request: VariantRequest, motion_m: Array) -> Array:
        """Return the motion that an output of the network represents."""
        return motion_m

    def batch(self, windows: list[Window], variants: list[int]) -> dict[str, Narrow]:
        """Return windows of one length with one of their variants each, as the network sees them."""
        pairs = list(zip(windows, variants, strict=True))
        scale = np.stack([window.bone_scale[variant] for window, variant in pairs])
        return {
            "template_m": np.stack([window.template_m for window in windows]),
            "motion_m": np.stack([window.variants_m[variant] for window, variant in pairs]),
            "condition": self.condition(scale),
            "scale": scale,
        }

    def moved(
        self,
        source: Source,
        person: int,
        scale: Array,
        generator: np.random.Generator | None,
        key_frames: KeyFrames | None = None,
    ) -> Array:
        """Return how far both move (T, 2, J, 3), metres, where one is scaled; noise is the same for all windows.

        With key frames of that one, its motion is bent through them, and the other's is decoded for it.
        """
        check_topology(self, source)
        windows = cut_windows(source, "", person, self.options.length)
        count, num_frames = len(windows), len(windows[0].frames)
        batch = {
            "template_m": np.stack([window.template_m for window in windows]),
            "condition": np.repeat(self.condition(scale[None]), count, axis=0),
            "scale": np.repeat(scale[None].astype(np.float32), count, axis=0),
        }
        batch |= {key: np.repeat(noise, count, axis=0) for key, noise in self._noise(1, num_frames, generator).items()}
        moved = blend_windows(source, windows, iter(self.network.displacement(batch)))
        if key_frames is None:
            return moved
        person_m = source.positions_m[:, person]
        bent = key_frames.bend(person_m + moved[:, person], source.rate_hz) - person_m
        seen = bent[sampled_frames(source)]
        batch["moved_b"] = np.stack([seen[window.frames] @ window.axes for window in windows]).astype(np.float32)
        moved = blend_windows(source, windows, iter(self.network.displacement(batch)))
        moved[:, person] = bent
        return moved

    def _noise(self, count: int, num_frames: int, generator: np.random.Generator | None) -> dict[str, Narrow]:
        """Return unit noise for so many windows, or 0."""
        return {
            f"noise_{name}": np.zeros((count, *shape), np.float32)
            if generator is None
            else generator.standard_normal((count, *shape), np.float32)
            for name, shape in self.network.noise_shapes(num_frames).items()
        }


@dataclass
class PaperCvaeModel(WindowVae):
    """The published model, where described; `known_scales` are mean and deviation of each bone's scale (2, J).

    Its scales are drawn from p(B_s).
    """

    name = "paper_cvae"
    takes_key_frames = True
    settings = PaperCvaeSettings
    config_kind = PaperCvaeConfig

    network: InteractionCvae

    @classmethod
    def build(cls, options: PaperCvaeConfig, known_scales: Narrow) -> WindowNetwork:
        """Return equations 1 to 8."""
        from pasdedeux.learning.networks.interaction_cvae import InteractionCvae

        return InteractionCvae(options, skeleton_of(cls.name, known_scales.shape[1]))

    @classmethod
    def learned_scales(cls, bone_scale: Narrow) -> Narrow:
        """Return mean and deviation."""
        deviation = np.maximum(bone_scale.std(axis=0), _SMALLEST_DEVIATION)
        return np.stack([bone_scale.mean(axis=0), deviation]).astype(np.float32)

    @classmethod
    def _are_scales(cls, known: Narrow) -> bool:
        return len(known) == 2 and super()._are_scales(known)

    def condition(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        """Return standardised scales."""
        return ((bone_scale - self.known_scales[0]) / self.known_scales[1]).astype(np.float32)

    def _finish(self, request: VariantRequest, motion_m: Array) -> Array:
        exact = self.options.exact_bones
        return request.with_exact_bones(motion_m, is_nearest=True) if exact else motion_m

    def draw_scale(self, generator: np.random.Generator) -> Array:
        """Return scales drawn from p(B_s)."""
        z = generator.standard_normal((1, *self.network.noise_shapes(1)["s"]), np.float32)
        mean, deviation = self.known_scales.astype(np.float64)
        return np.asarray(mean + deviation * self.network.scales(z)[0])

    def figures(self, batch: Mapping[str, Narrow]) -> dict[str, float]:
        """Return figures of generation, scales from p(B_s) and z from the prior: bones compared with the requested.

        There is no true motion; scales should vary like those of training.
        """
        drawn = self.network.scales(batch["noise_s"])
        mean, deviation = self.known_scales
        moved = self.network.displacement({**batch, "condition": drawn, "scale": mean + deviation * drawn})
        template = batch["template_m"][:, :, 1].astype(np.float64)
        error = bone_lengths(self.skeleton, template + moved[:, :, 1])
        error -= (mean + deviation * drawn)[:, None] * bone_lengths(self.skeleton, template)
        return {
            "validation_generated_bone_error_mm": 1000.0 * float(np.abs(error).mean()),
            "generated_scale_deviation": float((deviation * drawn.std(axis=0)).mean()),
            "train_scale_deviation": float(deviation.mean()),
        }


@dataclass
class _ClassVae(WindowVae):
    """A model of motion from a class, as Li et al. (2024, section 5.3) adapted them; `known_scales` are the classes'.

    It knows scales only as labels: each scale of training is a class, and others take the nearest class.
    """

    @classmethod
    def learned_scales(cls, bone_scale: Narrow) -> Narrow:
        """Return scales that differ."""
        return np.unique(np.round(bone_scale / _SAME_SCALE), axis=0).astype(np.float32) * np.float32(_SAME_SCALE)

    def condition(self, bone_scale: npt.NDArray[np.floating]) -> Narrow:
        """Return which class each is of (W, C), as 0 and 1."""
        apart = np.linalg.norm(bone_scale[:, None] - self.known_scales, axis=-1)
        return np.eye(len(self.known_scales), dtype=np.float32)[apart.argmin(axis=1)]

    def draw_scale(self, generator: np.random.Generator) -> Array:
        """Return the scales of a class; all are equally likely."""
        return self.known_scales[generator.integers(len(self.known_scales))].astype(np.float64)


@dataclass
class ActorLikeModel(_ClassVae):
    """A transformer whose z is of a whole window."""

    name = "actor_like"
    config_kind = ActorLikeConfig

    @classmethod
    def build(cls, options: ActorLikeConfig, known_scales: Narrow) -> WindowNetwork:
        """Return its transformers."""
        from pasdedeux.learning.networks.class_vaes import ActorNetwork

        return ActorNetwork(options, *known_scales.shape)


@dataclass
class Action2MotionLikeModel(_ClassVae):
    """A recurrent network whose z is of a frame."""

    name = "action2motion_like"
    config_kind = Action2MotionLikeConfig

    @classmethod
    def build(cls, options: Action2MotionLikeConfig, known_scales: Narrow) -> WindowNetwork:
        """Return its recurrent networks."""
        from pasdedeux.learning.networks.class_vaes import Action2MotionNetwork

        return Action2MotionNetwork(options, *known_scales.shape)
