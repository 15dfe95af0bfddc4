"""Takes in a study, and parameters of their shards, with all choices made and digests of files."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from functools import partial
from glob import escape
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, field_validator

from pasdedeux.choreography.duet import MIN_DURATION_S, DuetStyle
from pasdedeux.choreography.duets import DUETS, draw_styles
from pasdedeux.figure import complete_limits, limits_of
from pasdedeux.formats.registry import MOTION_FORMATS
from pasdedeux.plausibility.capture import JUDGED
from storage_schema import SourceCredit
from tasks.ingest.common import ID, one_of
from tasks.stage import Parameters
from tasks.stage.streams import stream

BUILT_IN_DUETS = tuple(DUETS)
MappingTable = dict[str, str | dict[str, float]]
Mappings = dict[str, dict[Literal["parts", "pair17", "op14", "body22"], MappingTable]]
MotionFormatName = Annotated[str, one_of(MOTION_FORMATS)]
Mirrored = bool | Literal["names"]
UpAxis = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]


class PersonOptions(Parameters):
    """Facts about a motion file: for all files of a take, or for the file of one person, which take precedence."""

    format: MotionFormatName | None = Field(
        None, description=f"Format of the file: {', '.join(MOTION_FORMATS)}; detected from the content by default"
    )
    rate_hz: float | None = Field(
        None,
        gt=0,
        le=10_000,
        description="True frame rate; by default what the file states, and what is known of CMU's files: 120 Hz for "
        "AMC, 60 Hz for subjects 60 and 61, whose BVH headers say 120",
    )
    metres_per_unit: float | None = Field(
        None,
        gt=0,
        description="Length of the file's unit in metres; by default what the file states, what is known of CMU's "
        "salsa BVH, or the unit that makes adults",
    )
    up_axis: UpAxis | None = Field(
        None, description="Axis of the file that points up; by default the one along which the bodies stand"
    )
    mirrored: Mirrored | None = Field(
        None,
        description="Left and right are exchanged in the file: true where it shows a mirrored scene, as a left-handed "
        'export does, "names" where only the names of joints are exchanged; put right',
    )
    layout: str | None = Field(
        None, description="Joint mapping: a known layout or one of `ingest.mappings`; by default told by the joints"
    )
    skeleton: Path | None = Field(None, description="ASF of an AMC file, or BVH template of rotation rows")
    first_frame: int | None = Field(None, ge=0, description="Frame of the file at which the take starts; 0 by default")
    offset_s: float | None = Field(
        None,
        ge=-86_400,
        le=86_400,
        description="Time by which a person's file runs ahead of the others', after `first_frame`: so much of it is "
        "left out, of the others if negative; 0 by default",
    )
    translation_m: tuple[float, float, float] | None = Field(None, description="Shift, after scaling")
    yaw_deg: float | None = Field(None, ge=-360, le=360, description="Turn about the Y axis, before the shift")

    def over(self, take: PersonOptions) -> PersonOptions:
        """Return the options of the take, overridden by these."""
        stated = {name: value for name in PersonOptions.model_fields if (value := getattr(self, name)) is not None}
        return take.part(PersonOptions).model_copy(update=stated)


class CommonOptions(PersonOptions):
    """Common keys of single takes and families of takes."""

    frames: tuple[int, int] | None = Field(None, description="Source frames taken: first, and one past the last")
    on_unequal: Literal["refuse", "trim"] = Field("refuse", description="What to do with files of unequal length")
    floor: Literal["auto", "keep"] = Field(
        "auto", description="auto: shift a take whose feet do not stand near y = 0; keep: do not shift it"
    )
    persons: tuple[PersonOptions, ...] = Field(
        (),
        description="Keys of the take that differ for a person, in the order of the files",
    )
    licence: str | None = Field(
        None, description="Licence of the source; that of CMU for what `fetch` brought, else 'not stated'"
    )
    credit: str | None = Field(
        None, description="Credit line of the source; that of CMU for what `fetch` brought, else 'not stated'"
    )

    @field_validator("frames")
    @classmethod
    def _check_frames(cls, frames: tuple[int, int] | None) -> tuple[int, int] | None:
        if frames is not None and not 0 <= frames[0] < frames[1]:
            raise ValueError("frames are [first, one past the last], both at least 0 and growing")
        return frames


class TakeOptions(CommonOptions):
    """One take: a file per person."""

    id: str = Field(pattern=ID, max_length=100, description="Name of the take, unique in the study")
    files: tuple[Path, ...] = Field(min_length=1, description="A motion file for each person")
    objects: Path | None = Field(
        None, description="What the people handle: capsules that move, in the axes and frames of A's file (CSV, npz)"
    )
    contacts: Path | None = Field(
        None,
        description="Contacts that are known, a row each with the columns of `augmentation.contacts`, frames those of "
        "A's file (CSV)",
    )


class PairOptions(CommonOptions):
    """Takes in a folder whose files are named by subject and take, such as 60_03.bvh and 61_03.bvh."""

    folder: Path = Field(description="Folder of the files; what `fetch` filled, for instance")
    pattern: str = Field(
        "auto",
        description="File name with {subject} and {take}; auto takes {subject}_{take}.bvh, else {subject}_{take}.amc",
    )
    subjects: tuple[str, ...] = Field(min_length=1, description="Subjects: person A, then B, ...")
    takes: tuple[str, ...] | None = Field(
        None,
        description="Takes, as named in the file names; by default every take in the folder, also those that are added "
        "later; one that cannot be read (yet) is skipped with a warning; [] for none, where a study inherits a family",
    )
    id: str = Field("{subject}_{take}", description="Name of each take; {subject} is the first subject")
    is_watched: bool = Field(
        False, description="Takes named in `held_out` or `prior` may be added later; until then a warning names them"
    )

    @field_validator("pattern", "id")
    @classmethod
    def _check_pattern(cls, text: str) -> str:
        if text != "auto" and "{take}" not in text:
            raise ValueError("it must contain {take}")
        try:
            text.format(subject="", take="")
        except (LookupError, ValueError, AttributeError):
            raise ValueError("only {subject} and {take} may stand in braces") from None
        return text

    @property
    def patterns(self) -> tuple[str, ...]:
        """Possible names of a file."""
        return ("{subject}_{take}.bvh", "{subject}_{take}.amc") if self.pattern == "auto" else (self.pattern,)

    def take_names(self) -> tuple[str, ...]:
        """Return the named takes, else all with a file of any subject, sorted."""
        if self.takes is not None:
            return self.takes
        names = set()
        for pattern, who in product(self.patterns, self.subjects):
            first, *others = (part.format(subject=who) for part in pattern.split("{take}"))
            name = re.compile(f"{re.escape(first)}(?P<take>[^/]+){'(?P=take)'.join(map(re.escape, others))}")
            paths = self.folder.glob("*".join(map(escape, (first, *others))))
            names |= {
                match["take"] for path in paths if (match := name.fullmatch(path.relative_to(self.folder).as_posix()))
            }
        return tuple(sorted(names))

    def take_id(self, take: str) -> str:
        """Return the name of a take in the study."""
        return self.id.format(subject=self.subjects[0], take=take)

    def may_bring(self, take_id: str) -> bool:
        """Return whether a take of this name may be added to the folder."""
        return self.is_watched and fnmatchcase(take_id, self.id.format(subject=escape(self.subjects[0]), take="?*"))


class DuetOptions(DuetStyle, Parameters):
    """A take of a built-in duet."""

    num_people: ClassVar[int] = max(dance.num_people for dance in DUETS.values())

    name: str
    id: str | None = None

    @property
    def take_id(self) -> str:
        """Name of the take."""
        return self.id or self.name

    @property
    def settings(self) -> dict[str, Any]:
        """Style, speed, length and bodies of the dance, for `make_duet`."""
        return self.model_dump(exclude={"id", "name"})


class DuetEntry(Parameters):
    """A built-in duet, or many drawn takes of it."""

    name: str = Field(description="Which dance: " + ", ".join(BUILT_IN_DUETS))
    id: str | None = Field(None, pattern=ID, max_length=100, description="Name of the take; the duet's name by default")
    duration_s: float = Field(10.0, ge=MIN_DURATION_S, le=600.0, description="Length, seconds")
    count: int | None = Field(
        None,
        ge=1,
        le=1000,
        description="Draw so many takes: style, speed and everybody's height, no two of the same bodies in one entry; "
        "their names get -001 and so on",
    )

    def takes(self) -> list[DuetOptions]:
        """Return the takes, each with its drawn style."""
        plain = DuetOptions(name=self.name, id=self.id, duration_s=self.duration_s)
        if self.count is None:
            return [plain]
        generator = stream(0, "duets", plain.take_id)
        drawn = draw_styles(num_people_of(self.name), self.count, generator)
        return [
            plain.model_copy(update={**style, "id": f"{plain.take_id}-{number:03d}"})
            for number, style in enumerate(drawn, start=1)
        ]


def num_people_of(duet: str) -> int:
    """Return the number of people of a duet; 2 for unknown names, which planning refuses."""
    return DUETS[duet].num_people if duet in DUETS else DuetStyle.num_people


class CaptureOptions(Parameters):
    """Requirements on the capture of takes."""

    limits: Annotated[dict[str, tuple[float, float]], AfterValidator(partial(complete_limits, JUDGED))] = Field(
        limits_of(JUDGED),
        description="By figure (a column of `take_quality`): past the first a warning, past the second a failure",
    )
    skip_failing: bool = Field(
        False, description="Takes whose capture fails have no poses, and no stage uses them; the report says so"
    )


class _OfTake(Parameters):
    """Common parameters of the shards of all takes."""

    take_id: str
    rate_hz: float
    is_held_out: bool
    is_prior: bool
    source: SourceCredit
    capture: CaptureOptions


class DuetParameters(_OfTake):
    """The shard of a built-in duet."""

    duet: DuetOptions


class PersonParameters(Parameters):
    """The file of one person in the shard of a take, with all choices made.

    Attributes:
        motion_sha256: Digest of the motion file, by which it is found among the shard's files.
        companion_sha256: Digest of its companion; empty if it needs none.
        unit_confidence: Confidence of the length unit, 1 if the study or the file states it.
        number: Number of the person in the file, from 0.
        first_frame: First frame of the file that is read.
        num_frames: Number of frames that are read.
        start_s: Time of the take's first frame after the first one that is read; less than a frame.
    """

    source_name: str
    motion_sha256: str
    companion_sha256: str = ""
    format: str
    layout: str
    rate_hz: float
    metres_per_unit: float = 1.0
    unit_confidence: float = 1.0
    up_axis: UpAxis = "y"
    mirrored: Mirrored = False
    number: int = 0
    first_frame: int = 0
    num_frames: int = 0
    start_s: float = 0.0
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0


class TakeParameters(_OfTake):
    """The shard of a take from files."""

    floor: Literal["auto", "keep"]
    persons: tuple[PersonParameters, ...]
    mappings: Mappings
    objects_sha256: str = ""
    contacts_sha256: str = ""
