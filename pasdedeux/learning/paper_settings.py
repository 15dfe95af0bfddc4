"""Settings of `paper_cvae`: every size and choice that the paper's text leaves open, ours, in one place."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from pasdedeux.learning.torch_settings import TorchSettings
from pasdedeux.learning.windows import RATE_HZ

__all__ = ["PaperCvaeSettings"]

_LONGEST_S = 60.0


class PaperCvaeSettings(TorchSettings):
    """What Li et al. (2024) leave to a supplement that is not with the text: all of it is assumed here.

    Printed: equations 1 to 8, the layers of MLP1 (16-32-64-128-256) and MLP2 (256-128-64-32-bones), weights 0.75,
    0.1, 0.05 and 0.1, Kullback-Leibler terms against the unit normal. Assumed beside the fields below: Adam; motion
    at ten frames a second in windows, each in axes of its own (floor between the mid-hips, B along x); scales
    standardised over training; MLP1 ends in another dense layer for mean and variance of z; encoders average over
    time and keep joints; ST-GCN as Yan et al. (2018) with one partition, a residual, every second frame from the
    second block on, no batch normalisation; G-GRU as Li et al. (2020), its state begun by a dense layer from what
    it is given, its input the change so far and what it is given, its output added to it and 0 at the beginning of
    training; G-GRU2 is given ST-GCN3's features of B's motion, the true one in training and the predicted one when
    asked; velocities are differences of frames.
    """

    num_steps: int = Field(2000, ge=1, description="Steps of training")
    learning_rate: float = Field(1e-3, gt=0, le=1, description="Learning rate of Adam at the start")
    norm: Literal["summed", "averaged"] = Field(
        "averaged", description="Norms of eqs. 6 and 8: summed over frames, joints and axes as printed, or their mean"
    )
    window_s: float = Field(2.0, gt=0, le=_LONGEST_S, description="Length of a window, seconds")
    windows_per_step: int = Field(16, ge=1, le=1000, description="Windows of a step, drawn from all takes")
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

    @property
    def length(self) -> int:
        """Frames of a window."""
        return round(self.window_s * RATE_HZ) + 1

    @classmethod
    def longest(cls) -> int:
        """Return the most frames that a window may have."""
        return round(_LONGEST_S * RATE_HZ) + 1
