"""The `[ingest]` section of a study: sources, and facts that their files lack."""

from __future__ import annotations

import difflib
from collections import Counter
from typing import Self

from pydantic import Field, model_validator

from pasdedeux.choreography.duets import DEFAULT_DUETS
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.takes.parameters import (
    CaptureOptions,
    DuetEntry,
    DuetOptions,
    Mappings,
    PairOptions,
    TakeOptions,
    num_people_of,
)
from tasks.ingest.virtual_video.parameters import VirtualVideoOptions
from tasks.stage import Parameters


class SkippedParameters(Parameters):
    """Files of a folder that cannot be read (yet): the reason by name of the take or file."""

    skipped: dict[str, str]


class IngestParameters(Parameters):
    """What comes in.  A study that names no source at all gets the four built-in duets."""

    rate_hz: float = Field(30.0, gt=0, le=1000, description="Frame rate of all poses of the study")
    duets: tuple[DuetEntry, ...] | None = Field(None, description="Built-in duets")
    takes: tuple[TakeOptions, ...] = Field((), description="Takes of one person or more, file by file")
    pairs: dict[str, PairOptions] = Field({}, description="Families of takes in a folder")
    obtain: str = Field("", description="How to get the files of `pairs`, printed if some are missing")
    take_seconds: float | None = Field(
        None,
        gt=0,
        description="Only so much from the start of each take and of each sequence of 2D poses, all of it by default, "
        "of built-in duets 0.5 s at least; `run --preview` takes those of most contact",
    )
    annotations: tuple[AnnotationOptions, ...] = Field((), description="2D poses of your own")
    videos: tuple[FilmOptions, ...] = Field((), description="Film of your own, with key frames or a detector")
    mappings: Mappings = Field(
        {},
        description="Joint mappings by layout: changes to a known layout, or a layout of your own; each working joint "
        "is a source joint or weights of source joints",
    )
    capture: CaptureOptions = Field(CaptureOptions(), description="Checks of the capture of takes")
    held_out: tuple[str, ...] = Field(
        (), description="Takes kept for evaluation: never learned from or matched against"
    )
    prior: tuple[str, ...] = Field(
        (),
        description="Takes that priors learn torsos and joint limits from; by default none, so that nothing that is "
        "evaluated is learned from: published ranges of motion serve. A take that is held out cannot be one, and "
        "coverage is not measured on those named",
    )
    virtual_video: VirtualVideoOptions = Field(VirtualVideoOptions(), description="Virtual cameras over the takes")

    @property
    def sources_2d(self) -> tuple[AnnotationOptions | FilmOptions, ...]:
        """Sources of 2D poses: annotations, then film."""
        return (*self.annotations, *self.videos)

    @model_validator(mode="after")
    def _check(self) -> Self:
        # Folders are listed in planning, when their paths are known.
        if all(family.takes is not None for family in self.pairs.values()):
            self.check_names()
        return self

    def check_names(self) -> None:
        """Refuse names that are used twice, or refer to nothing.

        Raises:
            ValueError: The message has the name and the known ones.
        """
        ids = self.take_ids()
        for kind, names in (("take", ids), ("annotation source", [source.id for source in self.sources_2d])):
            double = sorted(name for name, count in Counter(names).items() if count > 1)
            if double:
                raise ValueError(f"two {kind}s are named '{double[0]}'; names must be unique")
        sources = {source.id: source for source in self.sources_2d}
        for source in sources.values():
            if source.camera_of and (source.camera_of not in sources or sources[source.camera_of].camera_of):
                firsts = ", ".join(
                    other.id for other in sources.values() if not other.camera_of and other is not source
                )
                raise ValueError(
                    f"camera_of of '{source.id}' must name another source without camera_of, found "
                    f"'{source.camera_of}'; there are: {firsts or 'none'}"
                )
        firsts_named = {source.camera_of for source in sources.values()}
        for source in sources.values():
            if source.calibration and source.id not in firsts_named:
                raise ValueError(
                    f"calibration of '{source.id}' is of several cameras, and no other source has "
                    f"camera_of = '{source.id}'; state it for the source that camera_of names"
                )
        named = [*self.held_out, *self.prior, *(source.take_id for source in self.sources_2d if source.take_id)]
        awaited = self.awaited()
        for name in named:
            if name not in ids and name not in awaited:
                near = difflib.get_close_matches(name, ids, n=1)
                hint = f"; did you mean '{near[0]}'?" if near else f"; takes: {', '.join(ids) or 'none'}"
                raise ValueError(f"'{name}' is not a take of this study{hint}")
        both = sorted(set(self.held_out) & set(self.prior))
        if both:
            raise ValueError(f"take '{both[0]}' is held out and cannot be a prior take")

    def resolved_duets(self) -> tuple[DuetOptions, ...]:
        """Return the named duets, or the default ones if there is no other source."""
        if self.duets is not None:
            return tuple(take for entry in self.duets for take in entry.takes())
        if self.takes or self.pairs or self.sources_2d:
            return ()
        return tuple(DuetOptions(name=name) for name in DEFAULT_DUETS)

    def take_ids(self) -> list[str]:
        """Return the names of all takes in the order of planning."""
        return [take_id for take_id, _ in self._takes()]

    def awaited(self) -> tuple[str, ...]:
        """Return held-out and prior takes that are missing but may be added to a watched folder."""
        ids, named = set(self.take_ids()), dict.fromkeys([*self.held_out, *self.prior])
        return tuple(
            name for name in named if name not in ids and any(pair.may_bring(name) for pair in self.pairs.values())
        )

    def num_people(self) -> dict[str, int]:
        """Return the number of people of every take."""
        return dict(self._takes())

    def _takes(self) -> list[tuple[str, int]]:
        return [
            *((duet.take_id, num_people_of(duet.name)) for duet in self.resolved_duets()),
            *((take.id, len(take.files)) for take in self.takes),
            *(
                (family.take_id(take), len(family.subjects))
                for family in self.pairs.values()
                for take in family.take_names()
            ),
        ]
