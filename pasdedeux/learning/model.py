"""What every model of augmentation does: from the source's motion and new proportions to the motion of both people."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation import Source
from pasdedeux.augmentation.variations import check_bone_scales
from pasdedeux.errors import InputError

__all__ = ["Items", "LogEntry", "TrainingItem", "VariantModel", "VariantRequest"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class VariantRequest:
    """What is asked of a model: one take with new proportions.

    Args:
        take_id: Name of the take; a model may know it from training.
        source: The take's own motion, T frames.
        bone_scale: Scale of each bone (2, 22), the root's being the root height's.

    Raises:
        InputError: Scales of the wrong shape, or not positive.
    """

    take_id: str
    source: Source
    bone_scale: Array

    def __post_init__(self) -> None:
        """Check the scales."""
        check_bone_scales(self.bone_scale, what=self.take_id)


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
"""Return the training items anew each time, so that they can be read more than once without being held."""


@dataclass(frozen=True)
class LogEntry:
    """One figure of training: step (0 for closed-form models), what was measured, its value."""

    step: int
    quantity: str
    value: float


class VariantModel(ABC):
    """The protocol of models: trained on items, kept as named arrays, asked for motions.

    A model is a class with these members; `MODELS` lists it, and a contract test holds all that are listed to what is
    said here.  Training twice on the same items gives the same arrays to the last bit: whatever is drawn comes from a
    seed of the model's own.  Positions are metres, float64, axes (frame, person=2, body22 joint, 3).
    """

    name: ClassVar[str]
    """Name in studies and tables, unique."""
    is_trained: ClassVar[bool] = True
    """It learns from the items; models that do not are baselines, which stand beside every result."""
    has_exact_bones: ClassVar[bool] = False
    """Every motion has the source's bone lengths times the scales asked for, to rounding."""

    @classmethod
    @abstractmethod
    def train(cls, items: Items) -> tuple[VariantModel, list[LogEntry]]:
        """Return the model trained on items, and figures of the training.

        Args:
            items: Gives the items anew each time it is called; a model reads them as often as it likes and holds few.

        Raises:
            InputError: There is nothing to train on, for a model that needs it.
        """

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """Return everything the model knows, as named float64 arrays; at least one."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> VariantModel:
        """Return the model that these arrays were taken from: it predicts the same to the last bit.

        Raises:
            InputError: An array is missing or does not fit.
        """

    @abstractmethod
    def predict(self, request: VariantRequest) -> Array:
        """Return the motion of both people (T, 2, 22, 3), metres, of the request's T frames; always finite.

        Takes that it was not trained on are answered too.

        Raises:
            InputError: A take that it was trained on has another number of frames.
        """
