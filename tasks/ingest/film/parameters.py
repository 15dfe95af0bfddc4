"""Film in a study, and parameters of the shards of its shots."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from tasks.ingest.film.detector_files import KNOWN_DETECTORS
from tasks.ingest.poses2d.parameters import AnnotationParameters, SourceOptions


class FilmOptions(SourceOptions):
    """Film of people, with annotated key frames, a detector's keypoints, or a detector to run."""

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
        description="A detector that is run: the name of one that was fetched (rtmo-m), or ONNX files of RTMO, "
        "MoveNet MultiPose, or RTMPose with YOLOX for boxes; a path, or an address that ends in #sha256=DIGEST",
    )
    detect_every: int = Field(
        1, ge=1, le=1000, description="The detector sees every so many frames; others are tracked"
    )
    has_cuts: bool = Field(True, description="Cuts between shots are found, each shot is a sequence of its own")

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        given = [name for name in ("keys", "detections", "detect") if getattr(self, name)]
        if len(given) != 1:
            stated = " and ".join(given) or f"none; `pasdedeux fetch detector {next(iter(KNOWN_DETECTORS))}` brings one"
            raise ValueError(f"one of keys, detections and detect is needed for a film, found {stated}")
        if self.image_size_px is not None:
            raise ValueError("image_size_px is that of the film; leave it out")
        return self


class FilmParameters(AnnotationParameters):
    """The shard of a shot of a film.

    Attributes:
        num_given: Number of files of key frames or detections, which come first.
        num_networks: Number of files of a detector, which come next; the film comes last.
        is_key: Whether the given files are key frames.
        detect_every: Interval of frames for the detector.
        first_number: Number of the film's first image.
        first_frame: First frame of the shot, counted from the beginning of the film.
        num_frames: Its length.
        after_s: Time stamp of the frame before it, for seeking; None at the beginning, or if times are unknown.
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
