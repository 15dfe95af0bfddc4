"""Models that learn nothing: the unchanged source, and plain forward kinematics with the new lengths."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import reference_motion
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.learning.model import Arrays, Config, Trained, Training, VariantModel, VariantRequest


class _Untrained(VariantModel):
    """A model without anything to learn."""

    is_trained = False
    is_of_any_skeleton = True
    skeleton = None

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Learn nothing; the items are not read."""
        return Trained(cls())

    @classmethod
    def restore(cls, config: Config, arrays: Arrays, built_on: VariantModel | None = None) -> VariantModel:
        """Make the model; it knows nothing."""
        return cls()


class CopyModel(_Untrained):
    """Return the source, whatever the proportions."""

    name = "copy"

    def predict(self, request: VariantRequest) -> Array:
        """Return the source's motion."""
        return np.array(request.source.positions_m)


class NaiveFkModel(_Untrained):
    """Return the source's bone directions with the new lengths, each person alone."""

    name = "naive_fk"
    has_exact_bones = True

    def predict(self, request: VariantRequest) -> Array:
        """Return plain forward kinematics."""
        scales = complete_scales(request.source, request.bone_scale[None])
        return np.asarray(reference_motion(request.source, scales)[0])
