"""The `[ingest]` section of a study: what comes in, and what is known about it better than by its files."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterable
from fnmatch import fnmatchcase
from functools import partial
from glob import escape
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from pasdedeux.choreography.duet import DuetStyle
from pasdedeux.choreography.duets import DEFAULT_DUETS, DUETS, draw_styles
from pasdedeux.figure import complete_limits, limits_of
from pasdedeux.formats.registry import ANNOTATION_FORMATS, MOTION_FORMATS
from pasdedeux.people.resolution import PeopleSettings
from pasdedeux.plausibility.capture import JUDGED
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tasks.stage import Parameters, stream

_ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
BUILT_IN_DUETS = tuple(DUETS)
MappingTable = dict[str, str | dict[str, float]]
Mappings = dict[str, dict[Literal["pair17", "op14", "body22"], MappingTable]]


def _one_of(names: Iterable[str]) -> AfterValidator:
    """Refuse what is none of the names of a registry, nor "auto"; the allowed ones are listed."""
    allowed = ("auto", *names)

    def check(name: str) -> str:
        if name not in allowed:
            raise ValueError(f"should be one of {', '.join(allowed)}")
        return name

    return AfterValidator(check)


MotionFormatName = Annotated[str, _one_of(MOTION_FORMATS)]
AnnotationFormatName = Annotated[str, _one_of(ANNOTATION_FORMATS)]
KeypointLayoutName = Annotated[str, _one_of(KEYPOINT_LAYOUTS)]
UpAxis = Literal["auto", "x", "y", "z"]


class PersonOptions(Parameters):
    """What is known of one person's file; each value wins over the take's."""

    rate_hz: float | None = Field(None, gt=0, le=10_000, description="True frame rate of the file")
    metres_per_unit: float | None = Field(None, gt=0, description="Length of the file's unit in metres")
    up_axis: UpAxis | None = Field(None, description="Axis of the file that points up")
    layout: str | None = Field(None, description="Joint mapping: a known layout or one of `ingest.mappings`")
    skeleton: Path | None = Field(None, description="ASF of an AMC file, or BVH template of rotation rows")
    first_frame: int = Field(0, ge=0, description="Source frame at which the take starts for this person")
    translation_m: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="Shift, after scaling")
    yaw_deg: float = Field(0.0, ge=-360, le=360, description="Turn about the Y axis, before the shift")


class CommonOptions(Parameters):
    """What single takes and families of takes have in common."""

    format: MotionFormatName = Field(
        "auto", description=f"Format of the files: {', '.join(MOTION_FORMATS)}; detected from the content by default"
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
        description="Length of the files' unit; by default what the file states, what is known of CMU's salsa BVH, "
        "or the unit that makes adults",
    )
    up_axis: UpAxis = Field("auto", description="Axis that points up; by default the one along which the bodies stand")
    layout: str = Field("auto", description="Joint mapping: a known layout or one of `ingest.mappings`")
    frames: tuple[int, int] | None = Field(None, description="Source frames taken: first, and one past the last")
    on_unequal: Literal["refuse", "trim"] = Field("refuse", description="What to do with files of unequal length")
    floor: Literal["auto", "keep"] = Field(
        "auto", description="auto: shift a take whose feet do not stand near y = 0; keep: do not shift it"
    )
    persons: tuple[PersonOptions, ...] = Field((), max_length=26, description="Options of each file, in their order")
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

    id: str = Field(pattern=_ID, max_length=100, description="Name of the take, unique in the study")
    files: tuple[Path, ...] = Field(min_length=1, max_length=26, description="A motion file for each person")
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
    subjects: tuple[str, ...] = Field(min_length=1, max_length=26, description="Subjects: person A, then B, ...")
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
        """Names that a file may have."""
        return ("{subject}_{take}.bvh", "{subject}_{take}.amc") if self.pattern == "auto" else (self.pattern,)

    def take_names(self) -> tuple[str, ...]:
        """Return the takes: those that are named, else all of which there is a file of a subject, sorted."""
        if self.takes is not None:
            return self.takes
        found = set()
        for pattern, who in product(self.patterns, self.subjects):
            first, *others = (part.format(subject=who) for part in pattern.split("{take}"))
            name = re.compile(f"{re.escape(first)}(?P<take>[^/]+){'(?P=take)'.join(map(re.escape, others))}")
            paths = self.folder.glob("*".join(map(escape, (first, *others))))
            found |= {
                match["take"] for one in paths if (match := name.fullmatch(one.relative_to(self.folder).as_posix()))
            }
        return tuple(sorted(found))

    def take_id(self, take: str) -> str:
        """Return the name that a take has in the study."""
        return self.id.format(subject=self.subjects[0], take=take)

    def may_bring(self, take_id: str) -> bool:
        """Tell whether a take of this name can come into the folder."""
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
        """Style, speed, length and bodies of the dance, as `make_duet` takes them."""
        return self.model_dump(exclude={"id", "name"})


class DuetEntry(Parameters):
    """A built-in duet, or many takes of it that are drawn."""

    name: str = Field(description="Which dance: " + ", ".join(BUILT_IN_DUETS))
    id: str | None = Field(
        None, pattern=_ID, max_length=100, description="Name of the take; the duet's name by default"
    )
    duration_s: float = Field(10.0, ge=0.5, le=600.0, description="Length, seconds")
    count: int | None = Field(
        None,
        ge=1,
        le=1000,
        description="Draw so many takes: style, speed and everybody's height, no two of the same bodies in one entry; "
        "their names get -001 and so on",
    )

    def takes(self) -> list[DuetOptions]:
        """Return the takes, each with what was drawn."""
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
    """Return the number of people of a duet; 2 where there is none of that name, which planning refuses."""
    return DUETS[duet].num_people if duet in DUETS else DuetStyle.num_people


class CaptureOptions(Parameters):
    """What is asked of the capture of takes."""

    limits: Annotated[dict[str, tuple[float, float]], AfterValidator(partial(complete_limits, JUDGED))] = Field(
        limits_of(JUDGED),
        description="By figure (a column of `take_quality`): past the first a warning, past the second a failure",
    )
    skip_failing: bool = Field(
        False, description="Takes whose capture fails have no poses, and no stage uses them; the report says so"
    )


class VirtualCameras(Parameters):
    """Where virtual cameras stand, and what they see."""

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
    """Virtual cameras: takes seen from drawn views, as the default source of 2D annotations."""

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


class AnnotationCommon(PeopleSettings, Parameters):
    """Description of a source of 2D poses, apart from its path."""

    id: str = Field(
        pattern=_ID, max_length=100, description="Name of the source, and of its sequence if it has one only"
    )
    format: AnnotationFormatName = Field(
        "auto", description=f"Format: {', '.join(ANNOTATION_FORMATS)}; detected from the content by default"
    )
    layout: KeypointLayoutName = Field(
        "auto",
        description=f"Keypoint layout: {', '.join(KEYPOINT_LAYOUTS)}; detected from the file; another is refused",
    )
    image_size_px: tuple[int, int] | None = Field(
        None, description="Width and height of the images; by default the file's, else the video's beside it"
    )
    rate_hz: float | None = Field(
        None,
        gt=0,
        le=10_000,
        description="Frame rate; by default the file's, else the video's that lies beside it, else 30 Hz",
    )
    focal_px: float | None = Field(
        None, gt=0, le=1_000_000, description="Focal length of the camera; by default the file's"
    )
    fov_deg: float | None = Field(
        None, gt=1, lt=179, description="Horizontal field of view, where the focal length is not known"
    )
    camera_height_m: float | None = Field(
        None, ge=0.1, le=100, description="Height of the camera above the floor, which gives people their size"
    )
    statures_m: tuple[tuple[int, Annotated[float, Field(ge=0.5, le=2.5)]], ...] = Field(
        (), description="People whose stature is known, as [[0, 1.80], [1, 1.65]]: number and stature"
    )
    min_confidence: float | None = Field(
        None,
        ge=0,
        le=10,
        description="Keypoints of a lower confidence, in the detector's own units, are missing; by default 0.2, scaled "
        "for detectors whose confidences of visible joints are far from 1",
    )
    on_unreadable: Literal["refuse", "skip"] = Field(
        "refuse", description="A damaged OpenPose file stops the run, or is skipped and counted"
    )
    leave_one_out_every: int = Field(
        10,
        ge=0,
        description="One in so many moments (30 frames of a video, or a still) is kept out of seeds and chains, and "
        "scored by its distance to the nearest draw: evidence without ground truth; 0: none",
    )
    take_id: str | None = Field(
        None, description="Take of this study that the video shows; then it is scored against that"
    )
    licence: str = Field("not stated", description="Licence of the source")
    credit: str = Field("not stated", description="Credit line of the source")


_LAYOUT_FILE = Field(
    None, description="Keypoint layout of your own (TOML): names in the order of the file, and which of them are ours"
)
_PEOPLE_FILE = Field(
    None,
    description="Table of identities that overrides those that ingest resolves (sequence, first_frame, last_frame, "
    "person, is): an edited copy of the attachment people.csv of an earlier run",
)


class AnnotationOptions(AnnotationCommon):
    """2D poses of the user's own: a detector's file or folder of files, or our CSV or npz."""

    layout_file: Path | None = _LAYOUT_FILE
    people_file: Path | None = _PEOPLE_FILE
    path: Path = Field(description="File, folder of files of frames, or folder of several cameras' files or folders")
    is_watched: bool = Field(
        False,
        description="Files will be added to the folder: each file or folder in it is a source `<id>.<its name>`, also "
        "if there is only one; one that cannot be read (yet) is skipped with a warning",
    )


class FilmOptions(AnnotationCommon):
    """Film of people, with key frames that a person annotated, a detector's keypoints, or a detector to be run."""

    layout_file: Path | None = _LAYOUT_FILE
    people_file: Path | None = _PEOPLE_FILE
    path: Path = Field(description="Film, folder of numbered images, or folder of films")
    keys: Path | None = Field(
        None,
        description="Annotated key frames (COCO, CVAT, our CSV, ...): joints are tracked between them; of a folder of "
        "films a folder with a file named like each",
    )
    detections: Path | None = Field(
        None, description="A detector's keypoints of the film; gaps are tracked; of a folder of films as `keys`"
    )
    detect: tuple[str, ...] = Field(
        (),
        max_length=2,
        description="ONNX files of a detector that is run: RTMO, or RTMPose with YOLOX for boxes; a path, or an "
        "address that ends in #sha256=DIGEST",
    )
    detect_every: int = Field(
        1, ge=1, le=1000, description="The detector sees every so many frames; others are tracked"
    )
    has_cuts: bool = Field(True, description="Cuts between shots are found, each shot is a sequence of its own")

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        given = [name for name in ("keys", "detections", "detect") if getattr(self, name)]
        if len(given) != 1:
            found = " and ".join(given) if given else "none"
            raise ValueError(f"one of keys, detections and detect is needed for a film, found {found}")
        if self.image_size_px is not None:
            raise ValueError("image_size_px is that of the film; leave it out")
        return self


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
        description="Only so much from the start of each take and of each sequence of 2D poses, all of it by default; "
        "`run --preview`",
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

    @model_validator(mode="after")
    def _check(self) -> Self:
        # What lies in a folder is looked up when its path is known, while planning.
        if all(family.takes is not None for family in self.pairs.values()):
            self.check_names()
        return self

    def check_names(self) -> None:
        """Refuse names of takes that are used twice, or are none.

        Raises:
            ValueError: Says which, and what is there.
        """
        ids = self.take_ids()
        for kind, names in (
            ("take", ids),
            ("annotation source", [source.id for source in (*self.annotations, *self.videos)]),
        ):
            double = sorted(name for name, count in Counter(names).items() if count > 1)
            if double:
                raise ValueError(f"two {kind}s are named '{double[0]}'; names must be unique")
        named = [
            *self.held_out,
            *self.prior,
            *(source.take_id for source in (*self.annotations, *self.videos) if source.take_id),
        ]
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
        """Return the duets: those named, or the default ones when nothing else comes in."""
        if self.duets is not None:
            return tuple(take for entry in self.duets for take in entry.takes())
        if self.takes or self.pairs or self.annotations or self.videos:
            return ()
        return tuple(DuetOptions(name=name) for name in DEFAULT_DUETS)

    def take_ids(self) -> list[str]:
        """Return the names of all takes, in the order in which they are planned."""
        return [take_id for take_id, _ in self._takes()]

    def awaited(self) -> tuple[str, ...]:
        """Return the takes held out or for priors that are not there yet and can come into a watched folder."""
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
