"""Settings of the stage `chains`, and the parameters of its shards."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from pasdedeux.sampling.densities import DENSITIES
from pasdedeux.sampling.densities.annotated import AnnotationSettings
from pasdedeux.sampling.densities.density import PRIOR_ONLY, TargetSettings
from pasdedeux.sampling.proposals import PROPOSALS
from pasdedeux.sampling.repair import RepairSettings
from pasdedeux.settings import Settings
from tasks.rows.draw_sets import REPAIRED
from tasks.stage import Parameters
from tasks.stage.sweep import SweptParameters


def _one_of(names: Iterable[str], what: str) -> Callable[[str], str]:
    known = tuple(names)

    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"there is no {what} '{name}'; there are: {', '.join(known)}")
        return name

    return check


DensityName = Annotated[str, AfterValidator(_one_of(DENSITIES, "density"))]
ProposalName = Annotated[str, AfterValidator(_one_of(PROPOSALS, "proposal"))]


class RunSettings(Settings):
    """How a chain is run."""

    thin: int = Field(default=10, ge=1, description="Steps per kept draw")
    segment_draws: int = Field(default=250, ge=4, description="Draws of a segment, the unit that is stored and resumed")
    num_dispersing: int = Field(
        default=40,
        ge=0,
        description="Draws' worth of steps, on a density wider than the target, that give each chain a start of its "
        "own; 0 starts all chains at the seed",
    )
    num_warm_up: int = Field(
        default=50,
        ge=0,
        description="Draws before the first kept one, in which step sizes are learned; they are dropped",
    )


class ChainsParameters(SweptParameters, RunSettings, RepairSettings, TargetSettings, AnnotationSettings):
    """Densities to sample, the number of draws, and the steps.

    A sweep samples the first of its densities and keeps the draws under its own name.
    """

    densities: tuple[DensityName, ...] = Field(
        ("ic", PRIOR_ONLY),
        min_length=1,
        description="Densities: " + ", ".join(f"{kind.name} ({kind.meaning})" for kind in DENSITIES.values()),
    )
    starts: Literal["all", "seeds", "grown", "every"] = Field(
        "all",
        description="Where chains start: the seeds and chosen grown ones, or only either of them; every: a short chain "
        "from every grown and filled pair, of which the end is kept, under the density's name and "
        f"`{REPAIRED}`",
    )
    num_chains: int = Field(default=2, ge=1, le=1000, description="Chains of each seed and density")
    num_draws: int = Field(default=500, ge=1, description="Draws kept of each chain; rounded up to whole segments")
    proposal: ProposalName = Field(
        next(iter(PROPOSALS)),
        description="Steps: unbiased, or velocity, wider where nearby annotations move (eq. 12); the latter for "
        "densities that read annotations",
    )

    @model_validator(mode="after")
    def _has_one_name_each(self) -> ChainsParameters:
        if len(set(self.densities)) != len(self.densities):
            raise ValueError("chains.densities names a density twice")
        names = {f"{name}{self._end}" for name in self.densities}
        if taken := sorted((DENSITIES.keys() | names) & self.sweep.keys()):
            raise ValueError(f"chains.sweep: '{taken[0]}' is the name of a density")
        return self

    @property
    def _end(self) -> str:
        return REPAIRED if self.starts == "every" else ""

    def named(self) -> dict[str, ChainsParameters]:
        """Return the settings of all chains, each with one density, by the name under which their draws are stored."""
        base = {f"{name}{self._end}": self.model_copy(update={"densities": (name,)}) for name in self.densities}
        swept = {
            name: settings.model_copy(update={"densities": settings.densities[:1]})
            for name, settings in self.swept().items()
        }
        return base | swept


class ChainSegmentParameters(Parameters):
    """Exactly what determines the draws of one segment, so that a request for more draws extends the chain."""

    name: str = Field(description="Name that draws are kept under: that of the density, or of the sweep")
    density: str
    seed_index: int
    chain: int
    segment: int
    run: RunSettings
    target: TargetSettings
    annotations: AnnotationSettings | None
    proposal: str


class RepairParameters(Parameters):
    """Parameters of a shard that repairs some rows of an artifact with grown or filled pairs."""

    name: str
    density: str
    first_row: int
    num_rows: int
    repair: RepairSettings
    target: TargetSettings
    annotations: AnnotationSettings | None


class SummaryParameters(Parameters):
    """Parameters that determine the summary of the chains of one density and seed."""

    name: str
    seed_index: int
    num_chains: int
    num_segments: int
    thin: int
