"""Settings of the stage `lifting`, and the parameters of its shards."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pasdedeux.completion.fit import FitOptions
from pasdedeux.completion.retrieval import RetrievalOptions
from pasdedeux.sampling.density import PRIOR_ONLY
from tasks.stage import Parameters

__all__ = ["VERSION", "LiftingParameters", "LiftingShard"]

VERSION = 7


class LiftingShard(RetrievalOptions, FitOptions, Parameters):
    """Which annotations of a source are lifted, and how."""

    max_frames: int = Field(40, ge=1, description="Annotated pairs lifted of each source of annotations, evenly spread")
    num_hypotheses: int = Field(8, ge=1, description="Likeliest view hypotheses of an annotation that draws compete in")
    num_completing: int = Field(100, ge=1, description="Draws nearest in D_I that joints not seen are taken from")
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
    num_naive: int = Field(1000, ge=1, description="Samples round each pair of the baseline naive_sampling")


class LiftingParameters(LiftingShard):
    """Which annotations are lifted, from which draws, and how."""

    left_out: tuple[str, ...] = Field((PRIOR_ONLY,), description="Densities whose draws are left out")
