"""Settings of the networks, without torch: studies can be read where it is not installed.

Choices that the papers of `paper_cvae` and of the models compared with it leave open are made here.
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Literal

from pydantic import Field, field_validator

from pasdedeux.errors import InputError
from pasdedeux.learning.windows import RATE_HZ
from pasdedeux.settings import Settings

_WARM_UP = 0.05
"""Share of the steps in which the learning rate rises."""


class NetworkSettings(Settings):
    """How long a network is trained, and how fast."""

    num_steps: int = Field(2000, ge=1, description="Steps of training")
    learning_rate: float = Field(1e-3, gt=0, le=1, description="Learning rate of Adam at the start")

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, which falls evenly to a twentieth."""
        return self.learning_rate * max(1.0 - step / self.num_steps, 0.05)


class ClassifierSettings(NetworkSettings):
    """How the classifier of clips is trained."""

    num_steps: int = Field(200, ge=1, description="Steps of training")
    learning_rate: float = Field(0.003, gt=0, le=1, description="Learning rate of Adam at the start")


class PredictorSettings(NetworkSettings):
    """How the predictor of motion is trained."""

    num_steps: int = Field(300, ge=1, description="Steps of training")
    learning_rate: float = Field(0.003, gt=0, le=1, description="Learning rate of Adam at the start")


class SegmentSettings(Settings):
    """How long an autoencoder of windows is trained."""

    num_steps: int = Field(2000, ge=1, description="Steps of training")
    segment_steps: int = Field(200, ge=1, description="Steps of a segment, the unit that is stored and resumed")
    patience: int | None = Field(
        None,
        ge=1,
        description="Segments without a smaller validation error after which training ends early; by default two "
        "fifths of all, at least 4",
    )

    @property
    def num_segments(self) -> int:
        """Number of segments of the training."""
        return -(-self.num_steps // self.segment_steps)

    @property
    def patience_of_length(self) -> int:
        """Patience as set, or as the length of the training asks for: while the rate is high, figures rise and fall."""
        return self.patience or max(4, 2 * self.num_segments // 5)


class WindowSettings(SegmentSettings, NetworkSettings):
    """Rate and windows of a step; no study sets them, but for the rate of `paper_cvae`."""

    learning_rate: float = Field(3e-3, gt=0, le=1, description="Largest learning rate of Adam")
    window_s: float = Field(1.0, gt=0, le=60.0, description="Length of a window, seconds")
    windows_per_step: int = Field(16, ge=1, le=1000, description="Windows of a step, drawn from all takes")

    @property
    def length(self) -> int:
        """Frames of a window."""
        return round(self.window_s * RATE_HZ) + 1

    def rate(self, step: int) -> float:
        """Return the learning rate of a step: a warm-up, then half a cosine down to 0."""
        warm, done = (step + 1) / max(_WARM_UP * self.num_steps, 1.0), step / self.num_steps
        return self.learning_rate * min(warm, 0.5 + 0.5 * math.cos(math.pi * done))


class PaperCvaeSettings(SegmentSettings):
    """What Li et al. (2024) leave to a supplement that is not with the text: all of it is assumed here.

    Printed: equations 1 to 8, the layers of MLP1 (16-32-64-128-256) and MLP2 (256-128-64-32-bones), weights 0.75, 0.1,
    0.05 and 0.1, Kullback-Leibler terms against the unit normal. Assumed beside the fields below: Adam; motion at ten
    frames a second in windows, each in axes of its own (floor between the mid-hips, B along x); scales standardised
    over training; MLP1 ends in another dense layer for mean and variance of z; encoders average over time and keep
    joints; ST-GCN as Yan et al. (2018) with one partition, a residual, every second frame from the second block on,
    layer norm for batch norm; changes in units of 5 cm; G-GRU as Li et al. (2020): a dense layer of the condition
    starts its state, its input is the change so far and the condition, its output is added to the change and is 0 at
    the start of training; all ends and scales (of A: ST-GCN3's features) reach each joint as 64 numbers beside its own
    and which joint it is, since weights are shared over joints and eqs. 2 and 3 give the decoder all of them; G-GRU2 is
    given ST-GCN3's features of B's motion, the true one in training and else the predicted one; velocities are
    differences of frames. The alternatives that section 5.5 names are in that supplement too: the other architectures
    are those that the text gives reasons for (sections 3.1 and 3.2), one choice undone in each.
    """

    learning_rate: float = Field(3e-3, gt=0, le=1, description="Largest learning rate of Adam")
    balance: Literal["summed", "averaged", "free_bits"] = Field(
        "summed",
        description="Norms of eqs. 6 and 8: summed over frames, joints and axes as printed, or their mean; free_bits "
        "takes the divergence as a mean over axes as well, of which each has some for nothing",
    )
    architecture: Literal[
        "published",
        "change_for_a",
        "over_kinematics",
        "st_gcn_decoders",
        "without_ends",
        "whole_motion",
        "scales_for_a",
    ] = Field(
        "published",
        description="As published; change_for_a: ST-GCN3 sees B's change beside its motion; over_kinematics (ours): so "
        "too, and decoders add to plain kinematics and are given template, near joints and kinematics in each frame; "
        "or with ST-GCNs that know the time for G-GRUs, without the template's first and last frame, motion itself in "
        "place of its change, or A given B's scales in place of B's motion",
    )
    exact_bones: bool = Field(False, description="Joints are moved as little as gives exactly the requested bones")


class PaperCvaeConfig(WindowSettings, PaperCvaeSettings):
    """The settings with the sizes of the networks, which no study sets."""

    width: int = Field(32, ge=1, le=1024, description="Features of ST-GCN1, 2 and 3")
    num_blocks: int = Field(3, ge=1, le=12, description="Blocks of each of them")
    kernel: int = Field(5, ge=1, le=99, description="Frames that a block's convolution over time spans; odd")
    hidden: int = Field(64, ge=1, le=1024, description="Size of a joint's state in G-GRU1 and 2")
    latent_size: int = Field(32, ge=1, le=4096, description="Size of z of B and of A")

    @field_validator("kernel")
    @classmethod
    def _kernel_is_odd(cls, kernel: int) -> int:
        if kernel % 2 == 0:
            raise ValueError(f"{kernel} is even: a convolution spans as many frames before as after")
        return kernel


class ActorLikeConfig(WindowSettings):
    """ACTOR (Petrovich et al. 2021) as Li et al. (2024) adapted it in a paragraph: each scale is a class of its own.

    From ACTOR: a transformer whose first two outputs, for tokens of the class, are mean and variance of z; a decoder
    that looks at z with the class's bias from sines of the time; squared errors, divergence times 1e-5. Assumed: a
    class is the scales of one variant, to 1e-4, whatever the take, and scales never seen are those of the nearest
    class; windows as in `paper_cvae`, joints of both people, and the change from the template in place of the motion
    itself, as the take must be known from something; for that its first and last frame are a second thing that the
    decoder looks at; sizes (2 layers of 64 for 8 of 256, no dropout).
    """

    width: int = Field(64, ge=4, le=1024, multiple_of=4, description="Size of tokens and of z; four heads share it")
    num_blocks: int = Field(2, ge=1, le=12, description="Layers of the encoder, and of the decoder")
    divergence_weight: float = Field(1e-5, ge=0, le=1, description="Weight of the divergence from the prior")


class Action2MotionLikeConfig(WindowSettings):
    """Action2motion (Guo et al. 2020) as Li et al. (2024) adapted it in a paragraph: each scale is a class of its own.

    From Action2motion: z of every frame, whose prior is a recurrent network's of the frames so far, gated recurrent
    units of 128, two of them in the decoder, z of 30, squared errors, divergence times 1e-4. Assumed: classes,
    windows and the change from the template as in `actor_like`; class and the template's first and last frame are
    known in every frame; the network always goes on from its own last frame, where theirs is given the true one for
    60 % of the steps; places of joints in place of a Lie algebra.
    """

    hidden: int = Field(128, ge=1, le=1024, description="Size of the states of its gated recurrent units")
    latent_size: int = Field(30, ge=1, le=4096, description="Size of z of a frame")
    divergence_weight: float = Field(1e-4, ge=0, le=1, description="Weight of the divergence from the prior")


def has_torch() -> bool:
    """Tell whether torch is installed, without loading it."""
    return find_spec("torch") is not None


def require_torch(name: str) -> None:
    """Refuse to go on without torch.

    Raises:
        InputError: Names the model that needs it, and how it is installed.
    """
    if not has_torch():
        raise InputError(f"{name} needs torch, which is not installed: pip install 'pasdedeux[learning]'")
