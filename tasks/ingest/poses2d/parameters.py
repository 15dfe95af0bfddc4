"""Sources of 2D poses in a study, and parameters of their shards."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from pasdedeux.formats.poses2d.own_layout import read_layout
from pasdedeux.formats.registry import ANNOTATION_FORMATS
from pasdedeux.people.resolution import PeopleSettings
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, KeypointLayout
from tasks.ingest.common import ID, one_of
from tasks.stage import Parameters

AnnotationFormatName = Annotated[
    str, one_of(ANNOTATION_FORMATS), BeforeValidator(lambda name: "points" if name == "mediapipe" else name)
]
KeypointLayoutName = Annotated[str, one_of(KEYPOINT_LAYOUTS)]


class AnnotationCommon(PeopleSettings, Parameters):
    """Description of a source of 2D poses, apart from its path."""

    id: str = Field(
        pattern=ID, max_length=100, description="Name of the source, and of its sequence if it has one only"
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
    frame_offset: int = Field(
        0, ge=-1_000_000, le=1_000_000, description="Added to the frames of the files: -1 where a tool counts from 1"
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
    camera_of: str | None = Field(
        None,
        description="Source of the same take before another camera: both are reconstructed together, in the frames of "
        "that one",
    )
    licence: str = Field("not stated", description="Licence of the source")
    credit: str = Field("not stated", description="Credit line of the source")


class SourceOptions(AnnotationCommon):
    """Common keys of sources of 2D poses and of film."""

    layout_file: Path | None = Field(
        None,
        description="Keypoint layout of your own (TOML): names in the order of the file, and which of them are ours",
    )
    people_file: Path | None = Field(
        None,
        description="Table of identities that overrides those that ingest resolves (sequence, first_frame, last_frame, "
        "person, is): an edited copy of the attachment people.csv of an earlier run",
    )
    calibration: Path | None = Field(
        None,
        description="`calib.toml` of Pose2Sim, Anipose or freemocap, of this camera and those whose `camera_of` names "
        "it; they are matched by name; without it, cameras follow from the people",
    )


SOURCE_FILES = SourceOptions.model_fields.keys() - AnnotationCommon.model_fields.keys()
"""Keys of files whose content is in the parameters of a shard."""


class AnnotationOptions(SourceOptions):
    """2D poses of the user: a detector's file or folder of files, or our CSV or npz."""

    path: Path = Field(description="File, folder of files of frames, or folder of several cameras' files or folders")
    is_watched: bool = Field(
        False,
        description="Files will be added to the folder: each file or folder in it is a source `<id>.<its name>`, also "
        "if there is only one; one that cannot be read (yet) is skipped with a warning",
    )


class AnnotationParameters(AnnotationCommon):
    """The shard of a source of 2D poses; its format is found.

    Attributes:
        frames: Frame of each file, if it is in the name, which the digest does not cover.
        video_rate_hz: Rate in the header of the video beside the files; None without a video.
        video_size_px: Its width and height.
        people: Rows of the table of people about its sequences.
        take_seconds: Seconds from the start of each sequence; None for all.
        own_layout: TOML of a keypoint layout of the user; None if there is none.
        calibration: TOML of a calibration, and the table of this camera in it; None if there is none.
    """

    is_held_out: bool
    frames: tuple[int, ...]
    video_rate_hz: float | None
    video_size_px: tuple[int, int] | None
    people: tuple[str, ...]
    take_seconds: float | None = None
    own_layout: str | None = None
    calibration: tuple[str, str] | None = None

    def keypoint_layout(self) -> str | KeypointLayout:
        """Return the layout of the files: a name, "auto", or the user's layout."""
        return self.layout if self.own_layout is None else read_layout(self.own_layout)
