"""`start_net`: a learned interaction mesh of single frames for unseen takes, `ridge_scale` for those trained on.

For an unseen take, a small network says for every tenth of a second how stiff everything between and within the two
bodies is; what follows is linear, and one pass over a take serves every scale (`local_mesh`).  Bones are exact, and at
scale 1 nothing moves.  It is what its name says: alone it is cheap, and a start for `mesh_refine`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.augmentation import Source, reference_motion
from pasdedeux.augmentation.source import complete_scales, scaled_lengths
from pasdedeux.errors import InputError
from pasdedeux.learning.model import (
    Arrays,
    Items,
    Trained,
    Training,
    VariantModel,
    VariantRequest,
    check_arrays,
)
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.torch_settings import TorchSettings, require_torch
from pasdedeux.learning.windows import Spread, frames_looked_at

__all__ = ["StartNetModel", "StartNetSettings"]

Array = npt.NDArray[np.float64]
Narrow = npt.NDArray[np.float32]

_VALIDATED = 48
"""Frames of validation items that training looks at."""


class StartNetSettings(TorchSettings):
    """How it is trained."""

    frames_per_step: int = Field(24, ge=1, le=1000, description="Frames of a step, drawn from all takes")
    variants_per_step: int = Field(8, ge=1, le=1000, description="Variants of each of them")


@dataclass
class StartNetModel(VariantModel):
    """The learned weights, and what knows the takes that were trained on.

    Args:
        seen: `ridge_scale`, for the takes that were trained on.
        weights: Weights of `local_mesh`, by name.
    """

    name = "start_net"
    settings = StartNetSettings
    has_exact_bones = True
    needs_torch = True

    seen: RidgeScaleModel
    weights: dict[str, Narrow]
    _ready: tuple[Source, _Pass] | None = field(default=None, repr=False)

    @property
    def built_on(self) -> VariantModel:
        """`ridge_scale`."""
        return self.seen

    @classmethod
    def start(cls, settings: StartNetSettings) -> str:
        """Return `ridge_scale`, which knows the takes trained on."""
        return RidgeScaleModel.name

    @classmethod
    def num_segments(cls, settings: StartNetSettings) -> int:
        """Return the number of segments, of `segment_steps` each."""
        return settings.num_segments

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Train one segment; all takes are held, ten frames a second in single precision."""
        require_torch(cls.name)
        from pasdedeux.learning import local_mesh
        from pasdedeux.learning.torch_training import Batch, train_segment

        assert isinstance(training.start, RidgeScaleModel)
        settings, generator = training.options(StartNetSettings), training.generator
        samples, validation = _gather(training.items), _gather(training.validation)
        if not samples:
            raise InputError("start_net: there is no variant to train on; check the split and the scales")

        def draw() -> Batch:
            found = [samples[index] for index in generator.integers(len(samples), size=settings.frames_per_step)]
            drawn = [one.draw(generator, settings.variants_per_step) for one in found]
            takes = ", ".join(sorted({one.take_id for one in found}))
            return Batch({name: np.stack([one[name] for one in drawn]) for name in drawn[0]}, f"takes {takes}")

        fixed = np.random.default_rng(0)
        judged = [
            validation[index].draw(fixed, settings.variants_per_step)
            for index in fixed.integers(max(len(validation), 1), size=_VALIDATED if validation else 0)
        ]

        def validate(weights: Mapping[str, Narrow]) -> dict[str, float]:
            errors = [local_mesh.error_m(weights, {name: one[name][None] for name in one}) for one in judged]
            return {"validation_error_cm": 100.0 * float(np.mean(errors))} if errors else {}

        done = train_segment(
            cls.name,
            settings,
            training.segment,
            training.state,
            local_mesh.first_weights,
            draw,
            local_mesh.loss,
            validate,
        )
        return Trained(cls(training.start, done.best), done.log, done.state)

    def arrays(self) -> dict[str, Narrow]:
        """Return the weights."""
        return dict(self.weights)

    @classmethod
    def from_arrays(cls, arrays: Arrays, built_on: VariantModel | None = None) -> VariantModel:
        """Make the model from its weights and `ridge_scale`."""
        require_torch(cls.name)
        from pasdedeux.learning.local_mesh import first_weights

        check_arrays(cls.name, arrays, {name: values.shape for name, values in first_weights().items()})
        if not isinstance(built_on, RidgeScaleModel):
            raise InputError("start_net: the ridge_scale that it builds on is missing")
        return cls(built_on, {name: values.astype(np.float32) for name, values in arrays.items()})

    def predict(self, request: VariantRequest) -> Array:
        """Return the motion: by the take's own quadratic where it was trained on, by the network elsewhere."""
        if request.take_id in self.seen.coefficients:
            return request.with_exact_bones(self.seen.predict(request), is_nearest=True)
        source = request.source
        if self._ready is None or self._ready[0] is not source:
            self._ready = (source, _Pass.over(source, self.weights))
        reference = reference_motion(source, complete_scales(source, request.bone_scale[None]))[0]
        return request.with_exact_bones(reference + self._ready[1].displacement(source.positions_m - reference))


@dataclass(frozen=True)
class _Pass:
    """What one pass over a take gives: the displacement of every scale is linear in what plain kinematics misses.

    Args:
        frames: Frames looked at (F,).
        response: A^-1 B of each of them (F, 132, 132).
        spread: What gives all frames of the take from them.
    """

    frames: npt.NDArray[np.int64]
    response: Narrow
    spread: Spread

    @classmethod
    def over(cls, source: Source, weights: Mapping[str, Narrow]) -> _Pass:
        """Do the pass."""
        from pasdedeux.learning.local_mesh import response

        frames = frames_looked_at(source)
        return cls(frames, response(weights, _known(source, frames)), Spread.over(source, frames))

    def displacement(self, missing_m: Array) -> Array:
        """Return x = p - r (T, 2, 22, 3) of d = q - r of the same shape, metres."""
        at = missing_m[self.frames].reshape(len(self.frames), -1, 1).astype(np.float32)
        moved = np.matmul(self.response, at)[..., 0]
        return self.spread.apply(moved).reshape(missing_m.shape)


@dataclass(frozen=True)
class _Frame:
    """One frame of a take with all its variants, as training sees it; see `local_mesh.loss` for the names."""

    take_id: str
    known: Mapping[str, Narrow]
    variants: Mapping[str, Narrow]

    def draw(self, generator: np.random.Generator, count: int) -> dict[str, Narrow]:
        """Return the frame with some of its variants."""
        chosen = generator.integers(len(self.variants["motion_m"]), size=count)
        return {**self.known, **{name: values[chosen] for name, values in self.variants.items()}}


def _gather(items: Items) -> list[_Frame]:
    """Return the frames of all takes that are looked at."""
    sources: dict[str, Source] = {}
    found: dict[str, dict[str, list[Narrow]]] = {}
    for item in items():
        request, source = item.request, item.request.source
        frames = frames_looked_at(sources.setdefault(request.take_id, source))
        scales = complete_scales(source, request.bone_scale[None])
        lengths = np.broadcast_to(scaled_lengths(source, scales).reshape(2, -1), (len(frames), *scales.shape[1:]))
        one = {
            "motion_m": item.motion_m[frames],
            "reference_m": reference_motion(source, scales)[0][frames],
            "lengths_m": lengths,
        }
        for name, values in one.items():
            found.setdefault(request.take_id, {}).setdefault(name, []).append(values.astype(np.float32))
    gathered = []
    for take_id, source in sources.items():
        frames = frames_looked_at(source)
        known = _known(source, frames)
        stacked = {name: np.stack(values, axis=1) for name, values in found[take_id].items()}
        for index in range(len(frames)):
            of_frame = {name: values[index] for name, values in stacked.items()}
            gathered.append(_Frame(take_id, {name: values[index] for name, values in known.items()}, of_frame))
    return gathered


def _known(source: Source, frames: npt.NDArray[np.int64]) -> dict[str, Narrow]:
    """Return what the network sees of frames: joints, speeds, heights over the floor."""
    joints = source.positions_m
    velocity = np.zeros_like(joints) if len(joints) < 2 else np.gradient(joints, 1.0 / source.rate_hz, axis=0)
    known = {
        "joints_m": joints[frames],
        "speed_m_s": np.linalg.norm(velocity[frames], axis=-1),
        "height_m": joints[frames][..., 1] - source.floor_m,
    }
    return {name: values.astype(np.float32) for name, values in known.items()}
