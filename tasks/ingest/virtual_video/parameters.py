"""Virtual video in a study, and parameters of its shards."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tasks.stage import Parameters
from tasks.stage.facts import Purpose

UNIFORM_PITCH_DEG = 1e9
"""Deviations of the pitch from this one on mean uniform, because JSON has no infinity."""


class VirtualCameras(Parameters):
    """Positions and views of virtual cameras."""

    distance_m: float = Field(
        4.0,
        gt=0.5,
        le=100,
        description="Distance from the camera to the middle of the pair; change views.distance_m with it",
    )
    pitch_mean_deg: float = Field(
        10.0, ge=-89, le=89, description="Mean elevation of the cameras, which stays in [-15, 60]"
    )
    pitch_deviation_deg: float = Field(10.0, ge=0, description="Standard deviation of the elevation; inf for uniform")
    noise_px: float = Field(1.0, ge=0, le=200, description="Noise of each coordinate for a person 600 px tall")
    occlusion: float = Field(0.0, ge=0, lt=1, description="Share of the joints hidden, each on its own")


class VirtualVideoOptions(VirtualCameras):
    """Virtual cameras: views of takes, drawn at random, as the default source of 2D annotations."""

    takes: tuple[str, ...] | None = Field(None, description="Takes that are seen; all by default")
    num_videos: int = Field(1, ge=0, le=100, description="Cameras that see each whole take")
    num_random_views: int = Field(
        100,
        ge=0,
        le=100_000,
        description="Annotated pairs from random views, for each take of two people that is not held out",
    )
    leave_one_out_every: int = Field(
        0,
        ge=0,
        description="One in so many of the random views is kept out of seeds and chains, and scored by its distance to "
        "the nearest draw; 0: none",
    )
    has_detector: bool = Field(
        False,
        description="Each whole video once more as a detector sees it, `<take>.video00.detector`: 10 % of the "
        "joints missing, 3 of everybody anywhere, people in any order, a third one walking through for a quarter of it",
    )


class VideoParameters(VirtualCameras):
    """A shard of virtual video over a take: `count` whole videos, perhaps by a detector, or pairs from random views."""

    purpose: Purpose
    count: int
    take_id: str
    is_held_out: bool
    rate_hz: float
    leave_one_out_every: int = 0
    detector: Literal[True] | None = None
