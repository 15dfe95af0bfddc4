"""The protocol of augmentation models: from the source's motion and new proportions to the motion of both people."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation import AugmentationSettings, Source, UserContact, reference_motion
from pasdedeux.augmentation.exact_bones import project_to_bones
from pasdedeux.augmentation.source import complete_scales, points_of, scaled_lengths
from pasdedeux.augmentation.variations import check_bone_scales
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.key_frames import KeyFrames
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22, MODEL_SKELETONS, JointMap, Skeleton

S = TypeVar("S", bound=Settings)
Arrays = Mapping[str, npt.NDArray[Any]]
"""Named arrays, float64 or float32: the parameters of a model, or the state from which its training continues."""
Config = Mapping[str, Any]
"""Configuration of a model's architecture, as JSON values."""


@dataclass(frozen=True)
class VariantRequest:
    """The input of a model: one take with new proportions.

    Args:
        take_id: Name of the take, by which a model may know it from training.
        source: The take's own motion, T frames.
        bone_scale: Scale of each bone (2, 22), the root's being the root height's; J for the 22 of another skeleton.
        solving: How variants of the take are solved, for models that use the solver.
        contacts: Contacts stated for the take, which replace the detected ones.

    Raises:
        InputError: A take of other than two people, scales of the wrong shape, or not positive.
    """

    take_id: str
    source: Source
    bone_scale: Array
    solving: AugmentationSettings = field(default_factory=AugmentationSettings)
    contacts: tuple[UserContact, ...] = ()

    def __post_init__(self) -> None:
        """Check that both are of two people."""
        if self.source.num_people != 2:
            raise InputError(
                f"{self.take_id}: models are of takes of two people, this one has {self.source.num_people}"
            )
        check_bone_scales(self.bone_scale, self.source.num_people, what=self.take_id, skeleton=self.source.skeleton)

    def with_exact_bones(self, motion_m: Array, *, is_nearest: bool = False) -> Array:
        """Return a motion (T, 2, 22, 3), metres, with exactly the requested bones, placed by `project_to_bones`."""
        lengths = scaled_lengths(self.source, complete_scales(self.source, self.bone_scale[None]))
        placed = project_to_bones(points_of(motion_m)[None], lengths, self.source.skeleton, is_nearest=is_nearest)
        return np.asarray(placed[0].reshape(motion_m.shape))


@dataclass(frozen=True)
class TrainingItem:
    """A request with its answer: the variant's motion (T, 2, 22, 3), metres."""

    variant_id: str
    request: VariantRequest
    motion_m: Array

    def __post_init__(self) -> None:
        """Check that source and variant have the same frames."""
        expected = self.request.source.positions_m.shape
        if self.motion_m.shape != expected:
            raise InputError(
                f"{self.request.take_id}, variant {self.variant_id}: its motion has shape {self.motion_m.shape}, "
                f"the source's is {expected}"
            )


Items = Callable[[], Iterator[TrainingItem]]
"""Return the items anew each time, so that they can be read more than once without being held."""


VALIDATION_FALL = "validation_fall"
"""Quantity of the log: reduction of the smallest validation error by a segment, percent."""

ACTIVITY = "activity/"
"""Prefix of activities in the log, before the name of a rectifier: share of its outputs above 0, percent."""
_MIN_ACTIVITY = 1.0
"""Percent; a layer with less activity is dead: it transmits no information."""


@dataclass(frozen=True)
class LogEntry:
    """One figure of training: step (0 for closed-form models), measured quantity, value."""

    step: int
    quantity: str
    value: float

    @property
    def is_dead_layer(self) -> bool:
        """It is the activity of a layer that is dead."""
        return self.quantity.startswith(ACTIVITY) and not self.value >= _MIN_ACTIVITY


class NoSettings(Settings):
    """Settings of a model without any."""


@dataclass(frozen=True)
class Training:
    """One segment of a model's training, with its inputs.

    Args:
        items: Items of the training set.
        validation: Items for choices of the model, such as when to stop; never learned from, never tested on.
        settings: Settings of the model; its defaults where not given.
        generator: Source of all randomness in this segment.
        segment: Number of the segment, from 0.
        state: State after the segment before; empty in the first.
        start: The trained model that this one builds on, where `VariantModel.start` names one.
        device: Where a network is trained: "cpu", "cuda", or "auto", a GPU where there is one.
    """

    items: Items
    validation: Items = lambda: iter(())
    settings: Settings | None = None
    generator: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    segment: int = 0
    state: Arrays = field(default_factory=dict)
    start: VariantModel | None = None
    device: str = "cpu"

    def options(self, kind: type[S]) -> S:
        """Return the settings, which are of this model."""
        if self.settings is None:
            return kind()
        assert isinstance(self.settings, kind)
        return self.settings


@dataclass(frozen=True)
class Trained:
    """Result of a segment: the best model so far, figures, the state for the next segment, the device."""

    model: VariantModel
    log: list[LogEntry] = field(default_factory=list)
    state: Arrays = field(default_factory=dict)
    device: str = "cpu"


class VariantModel(ABC):
    """The protocol of models: trained on items, stored as named arrays, predict motions.

    A model is a class with these members; `MODELS` lists it, and a contract test checks all listed models against these
    rules.  Training twice on the same items gives the same arrays to the last bit, in one go or segment by segment:
    all draws come from the segment's generator.  Positions are metres, float64, axes (frame, person=2, body22
    joint, 3).
    """

    name: ClassVar[str]
    """Name in studies and tables, unique."""
    settings: ClassVar[type[Settings]] = NoSettings
    """Model of its settings."""
    is_trained: ClassVar[bool] = True
    """It learns from the items; a model that does not can be trained without any."""
    has_exact_bones: ClassVar[bool] = False
    """Every motion has the source's bone lengths times the requested scales, to rounding."""
    needs_torch: ClassVar[bool] = False
    """It needs the extra `learning`."""
    takes_key_frames: ClassVar[bool] = False
    """It predicts A's motion from B's, and therefore accepts key frames of B."""
    is_of_any_skeleton: ClassVar[bool] = False
    """It supports all of `MODEL_SKELETONS`, using that of its training takes; otherwise `body22` alone."""

    @property
    def skeleton(self) -> Skeleton | None:
        """The skeleton of its motions; None where it is that of the request."""
        return BODY22

    @property
    def built_on(self) -> VariantModel | None:
        """The trained model that this one builds on, where `start` names one; kept with it."""
        return None

    @classmethod
    def start(cls, settings: Any) -> str | None:
        """Return the name of the model that this one builds on, trained before it on the same items; None without."""
        return None

    @classmethod
    def num_segments(cls, settings: Any) -> int:
        """Return the number of segments of its training; a killed training loses one at most."""
        return 1

    @classmethod
    @abstractmethod
    def train(cls, training: Training) -> Trained:
        """Return the model after one segment of training.

        It may read the items repeatedly and should hold few.

        Raises:
            InputError: There is nothing to train on, for a model that needs it.
        """

    def config(self) -> Config:
        """Return the configuration of the model's architecture."""
        return {}

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the learned parameters as named float64 or float32 arrays.

        Those of the model that it is built on are added by `model_arrays`.
        """
        return {}

    @classmethod
    @abstractmethod
    def restore(cls, config: Config, arrays: Arrays, built_on: VariantModel | None = None) -> VariantModel:
        """Return the model with these arrays: it predicts the same to the last bit.

        Raises:
            InputError: An array is missing or does not fit.
            ValidationError: The configuration is none of this model's.
        """

    @abstractmethod
    def predict(self, request: VariantRequest) -> Array:
        """Return the motion of both people (T, 2, 22, 3), metres, of the request's T frames; always finite.

        It also accepts takes that it was not trained on.

        Raises:
            InputError: A take that it was trained on has another number of frames, or the take another skeleton.
        """

    def generate(
        self,
        source: Source,
        generator: np.random.Generator,
        *,
        scale: Array | None = None,
        key_frames: KeyFrames | None = None,
    ) -> tuple[Array, Array] | None:
        """Return scales (2, 22) and a motion (T, 2, 22, 3) drawn for them; None of a model that draws nothing.

        See `sample_motion`, which checks the arguments: scales of B (22,), drawn if None, and key frames of B.
        """
        return None


def check_arrays(name: str, arrays: Arrays, wanted: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse arrays that are not those of a model.

    Args:
        name: Name of the model.
        arrays: The given arrays; additional ones are allowed.
        wanted: Shape of each required array.

    Raises:
        InputError: Names the array that is missing, or of another shape.
    """
    for key, shape in wanted.items():
        if key not in arrays:
            raise InputError(f"{name}: array '{key}' is missing; found {', '.join(arrays) or 'none'}")
        if arrays[key].shape != shape:
            raise InputError(
                f"{name}: array '{key}' has shape {arrays[key].shape}, not {shape}: weights of another topology or size"
            )


def mapped_source(source: Source, joints: JointMap) -> Source:
    """Return a take of `body22` on another skeleton, without objects."""
    motion_m = joints.positions(source.positions_m, BODY22.joint_names)
    return replace(source, positions_m=motion_m, skeleton=joints.target, objects=None)


def mapped_item(item: TrainingItem, joints: JointMap, source: Source) -> TrainingItem:
    """Return an item of `body22` on another skeleton: its motion, and its scales.

    A bone's scale is the change of its median length by plain forward kinematics on `body22`.  Stated contacts, which
    name bones of `body22`, are dropped.

    Args:
        item: The item.
        joints: Definition of the joints.
        source: What `mapped_source` gives of its take, the same for all of its items.
    """
    request = item.request
    scales = complete_scales(request.source, np.stack([request.bone_scale, np.ones_like(request.bone_scale)]))
    posed = joints.positions(reference_motion(request.source, scales), BODY22.joint_names)
    scaled, plain = np.median(bone_lengths(joints.target, posed), axis=1)
    bone_scale = np.where(plain > 0.0, scaled / np.where(plain > 0.0, plain, 1.0), 1.0)
    asked = replace(request, source=source, bone_scale=bone_scale, contacts=())
    return TrainingItem(item.variant_id, asked, joints.positions(item.motion_m, BODY22.joint_names))


def check_topology(model: VariantModel, source: Source) -> None:
    """Refuse a take of another skeleton than a model's.

    Raises:
        InputError: Names both.
    """
    skeleton = model.skeleton
    if skeleton not in (None, source.skeleton):
        raise InputError(
            f"{model.name}: weights of another topology: it is of {skeleton.name}, {skeleton.num_joints} joints a "
            f"person, and {source.name} of {source.skeleton.name}, {source.skeleton.num_joints}"
        )


def skeleton_of(name: str, num_joints: int) -> Skeleton:
    """Return the skeleton, with this number of joints, of a model's arrays.

    Raises:
        InputError: There is none.
    """
    for skeleton in MODEL_SKELETONS.values():
        if skeleton.num_joints == num_joints:
            return skeleton
    known = ", ".join(f"{skeleton.name} {skeleton.num_joints}" for skeleton in MODEL_SKELETONS.values())
    raise InputError(f"{name}: weights of another topology, {num_joints} joints; known skeletons: {known}")
