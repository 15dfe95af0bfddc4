"""Prediction of a pair's next second: DCT, graph convolutions and attention to motion history (Mao et al. 2020).

The last half second is compared with every half second of the 2 s before; what followed those, as DCT coefficients, is
added up by likeness and goes with the coefficients of the last pose, held still, through graph convolutions, which give
the change of these.  Ours are the sizes (5 frames compared, 10 predicted at 10 Hz, 48 channels, two hidden layers), the
learning rate, and that both people are one graph of 132 coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.learning.torch_settings import TorchSettings, require_torch

Narrow = npt.NDArray[np.float32]

HISTORY, HORIZON = 20, 10
"""Frames known and predicted, at 10 Hz."""
_CLIPS_PER_STEP = 32


class PredictorSettings(TorchSettings):
    """How the predictor of motion is trained."""

    num_steps: int = Field(300, ge=1, description="Steps of training")
    learning_rate: float = Field(0.003, gt=0, le=1, description="Learning rate of Adam at the start")


@dataclass(frozen=True)
class MotionPredictor:
    """A trained predictor: its weights by name."""

    weights: Mapping[str, Narrow]

    @classmethod
    def train(cls, clips: Array, settings: PredictorSettings, generator: np.random.Generator) -> MotionPredictor:
        """Train on clips (n, 30, 2, 22, 3), metres, in the frame of the pair at the last known frame.

        Raises:
            InputError: There is no clip, or training came to numbers that are not finite.
        """
        require_torch("the predictor of motion")
        from pasdedeux.learning import predictor_network
        from pasdedeux.learning.torch_training import Batch, train_whole

        if not len(clips):
            raise InputError("the predictor of motion has no clip of 3 s to learn from")
        flat = clips.reshape(*clips.shape[:2], -1).astype(np.float32)

        def draw() -> Batch:
            return Batch({"clips": flat[generator.integers(len(flat), size=_CLIPS_PER_STEP)]}, "clips")

        weights = train_whole(
            "motion_predictor",
            settings,
            lambda: predictor_network.first_weights(flat.shape[2], generator),
            draw,
            predictor_network.loss,
        )
        return cls(weights)

    def predict(self, known: Array) -> Array:
        """Return the next 10 frames (n, 10, 2, 22, 3) of 20 known ones (n, 20, 2, 22, 3), metres."""
        from pasdedeux.learning import predictor_network

        flat = known.reshape(*known.shape[:2], -1).astype(np.float32)
        return predictor_network.evaluate(self.weights, flat).reshape(len(known), HORIZON, *known.shape[2:])


def joint_errors(predicted: Array, true: Array) -> tuple[Array, Array]:
    """Return JME and AME (n, T), centimetres, of motions (n, T, 2, 22, 3), metres (Guo et al. 2022).

    JME is the mean distance of joints in the frame of the pair.  AME is that after each person's pose is laid onto the
    true one by the rigid motion that fits best (Kabsch 1976), so it is of poses alone, not of where people are.
    """
    jme = np.linalg.norm(predicted - true, axis=-1).mean(axis=(-2, -1))
    one, other = (motion - motion.mean(axis=-2, keepdims=True) for motion in (predicted, true))
    left, _, right = np.linalg.svd(np.swapaxes(one, -1, -2) @ other)
    sign = np.sign(np.linalg.det(left @ right))
    left[..., :, -1] *= sign[..., None]
    ame = np.linalg.norm(one @ (left @ right) - other, axis=-1).mean(axis=(-2, -1))
    return 100.0 * jme, 100.0 * ame
