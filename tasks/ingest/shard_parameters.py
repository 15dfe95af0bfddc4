"""Parameters of the shards of `ingest`: all choices are made, and files are named by their digests."""

from __future__ import annotations

from typing import Literal

from pasdedeux.formats.own_layout import read_layout
from pasdedeux.skeletons.layouts import KeypointLayout
from storage_schema import SourceCredit
from tasks.ingest.parameters import (
    AnnotationCommon,
    CaptureOptions,
    DuetOptions,
    Mappings,
    UpAxis,
    VirtualCameras,
)
from tasks.stage import Parameters

Purpose = Literal["video", "random_views"]


class _OfTake(Parameters):
    """Parameters of the shard of every take, whatever it is made from."""

    take_id: str
    rate_hz: float
    is_held_out: bool
    is_prior: bool
    source: SourceCredit
    capture: CaptureOptions


class DuetParameters(_OfTake):
    """The shard of a take that is a built-in duet."""

    duet: DuetOptions


class SkippedParameters(Parameters):
    """What of a folder cannot be read, or not yet: why, by the name of the take or of the file."""

    skipped: dict[str, str]


class PersonParameters(Parameters):
    """One person's file in the shard of a take; all choices are made.

    Attributes:
        motion_sha256: Digest of the motion file, by which it is found among the shard's files.
        companion_sha256: Digest of the file that must lie beside it; empty where none must.
        unit_confidence: How sure the length unit is, 1 where the study or the file says it.
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
    first_frame: int = 0
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0


class TakeParameters(_OfTake):
    """The shard of a take from files; `num_frames` are frames of the files."""

    num_frames: int
    floor: Literal["auto", "keep"]
    persons: tuple[PersonParameters, ...]
    mappings: Mappings
    objects_sha256: str = ""
    contacts_sha256: str = ""


class VideoParameters(VirtualCameras):
    """A shard of virtual video over a take: `count` whole videos, perhaps by a detector, or pairs from random views."""

    purpose: Purpose
    count: int
    take_id: str
    is_held_out: bool
    rate_hz: float
    leave_one_out_every: int = 0
    detector: Literal[True] | None = None


class AnnotationParameters(AnnotationCommon):
    """The shard of a source of 2D poses; its format is found.

    Attributes:
        frames: The frame of each file, where its name tells it: no digest of the content knows.
        video_rate_hz: What the header of the video beside the files says; None without.
        video_size_px: Its width and height.
        people: Rows of the table of who is who that are about its sequences.
        take_seconds: Only so much from the start of each sequence; None: all of it.
        own_layout: TOML of a keypoint layout of the user's own, None without.
    """

    is_held_out: bool
    frames: tuple[int, ...]
    video_rate_hz: float | None
    video_size_px: tuple[int, int] | None
    people: tuple[str, ...]
    take_seconds: float | None = None
    own_layout: str | None = None

    def keypoint_layout(self) -> str | KeypointLayout:
        """Return the layout of the files: its name, "auto", or the user's own."""
        return self.layout if self.own_layout is None else read_layout(self.own_layout)


class FilmParameters(AnnotationParameters):
    """The shard of a shot of a film.

    Attributes:
        num_given: Of its files the first are these, of key frames or detections; the film comes last.
        num_networks: Then come these, of a detector.
        is_key: The given files are key frames.
        detect_every: The detector sees every so many frames.
        first_number: Number of the film's first image.
        first_frame: First frame of the shot, counted from the beginning of the film.
        num_frames: Its length.
        after_s: Time stamp of the frame before it, by which it is found; None at the beginning, or where none is told.
        is_constant_rate: Whether the time stamps of the film are those of a constant rate.
    """

    num_given: int
    num_networks: int
    is_key: bool
    detect_every: int
    first_number: int
    first_frame: int
    num_frames: int
    after_s: float | None
    is_constant_rate: bool
