"""Settings of the stage `lifting`, and the parameters of its shards."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tasks.stage import Parameters

VERSION = 7


class LiftingParameters(Parameters):
    """Which annotations of a source are lifted, and how."""

    max_frames: int = Field(40, ge=1, description="Annotated pairs lifted of each source of annotations, evenly spread")
    between_frames: int = Field(
        15,
        ge=0,
        description="Frames from one lifted pair of a video to the next; where only key frames are annotated these, up "
        "to twice as far apart; 0: none",
    )
    num_spans: int = Field(2, ge=0, description="Places of each video where the pairs between are filled in")
    baselines: tuple[Literal["lifting", "lifting_ik", "naive_sampling"], ...] = Field(
        (), description="Direct lifting and what is built on it, to compare with (a second for each pair)"
    )
