"""Settings of the stage `seeds`, and the parameters of each kind of its shards."""

from __future__ import annotations

from pydantic import Field, model_validator

from pasdedeux.sampling.prior import PriorSettings
from tasks.seeds.files import SeedFile
from tasks.stage import Parameters, StageName

SEEDS = StageName("seeds", 16)

NUM_CHOSEN, LIFTED_OF_2D_ALONE, GROWN_OF_2D_ALONE = 2, 20, 1000
"""Seeds of each kind where a study does not say how many."""


class SeedFrame(Parameters):
    """A frame of a take that becomes a seed."""

    take: str = Field(description="Name of the take")
    frame: int = Field(ge=0, description="Frame at the study's rate")


class SeedsParameters(PriorSettings, Parameters):
    """Number and origins of the seeds."""

    num_seeds: int | None = Field(
        None,
        ge=0,
        le=10_000,
        description="Frames of takes chosen automatically when none are named; when not given "
        f"{NUM_CHOSEN} where there are takes",
    )
    frames: tuple[SeedFrame, ...] = Field((), description="Frames that become seeds, in this order")
    files: tuple[SeedFile, ...] = Field((), description="Files that become seeds too: pairs edited or restarted from")
    num_lifted: int | None = Field(
        None,
        ge=0,
        le=10_000,
        description="Seeds lifted from 2D alone: annotations that stand for all (k-medoids under d_I); when not given "
        f"{LIFTED_OF_2D_ALONE} where no other seed is known, else none",
    )
    num_grown: int | None = Field(
        None,
        ge=0,
        le=1_000_000,
        description="Annotations lifted from the seeds by frontier growth; 0: no growth; when not given "
        f"{GROWN_OF_2D_ALONE} where the seeds are lifted from 2D alone, else none",
    )
    num_over_time: int = Field(
        60,
        ge=0,
        le=10_000,
        description="Frames of each video lifted together by poses of other takes, from which others grow too; none "
        "where there are no other takes, or nothing grows",
    )
    num_filled: int = Field(
        0, ge=0, le=1_000_000, description="Pairs drawn between grown ones that are alike, at most; see `pairs_between`"
    )
    num_starts: int = Field(0, ge=0, le=10_000, description="Grown pairs, drawn from all, from which chains start too")

    @model_validator(mode="after")
    def _there_are_seeds(self) -> SeedsParameters:
        if self.num_seeds == 0 and self.num_lifted == 0 and not (self.frames or self.files):
            raise ValueError("chains need at least one seed: set num_seeds, frames, files or num_lifted")
        return self

    @model_validator(mode="after")
    def _starts_are_grown(self) -> SeedsParameters:
        if self.num_grown is not None and self.num_starts > self.num_grown:
            raise ValueError(f"seeds.num_starts is {self.num_starts}, but only {self.num_grown} are grown (num_grown)")
        return self


class FrameSeed(PriorSettings, SeedFrame):
    """A seed that is a named frame."""

    seed_index: int


class ChosenSeed(PriorSettings, Parameters):
    """A seed that is the best frame after those that the seeds before it chose."""

    seed_index: int


class LiftedSeedsShard(PriorSettings, Parameters):
    """All seeds lifted from 2D alone."""

    first_index: int
    num_lifted: int


class GrownSeeds(PriorSettings, Parameters):
    """All seeds grown from the others."""

    first_index: int
    num_grown: int
    num_starts: int


class OverTimeSeeds(PriorSettings, Parameters):
    """Seeds lifted from the frames of a video together."""

    first_index: int
    num_over_time: int


class FilledSeeds(PriorSettings, Parameters):
    """All seeds drawn between grown ones."""

    first_index: int
    num_filled: int
