"""Sources of 2D poses: found and checked before any work, read, and made into working skeletons."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.formats import ANNOTATION_FORMATS, AnnotatedFrames, find_format, read_annotations
from pasdedeux.people.settle import PeopleSettings, SettledPeople, settle_people
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.ingest.parameters import AnnotationOptions, AnnotationParameters
from tasks.ingest.sources import load_file, read_again
from tasks.stage import Shard, SourceFile, commit

__all__ = ["find_annotations", "run_annotations"]

DEFAULT_RATE_HZ = 30.0
MAX_NAMED_FILES = 20
"""Skipped files that are named, of any number."""
GOOD_SHARE_SEEN, POOR_SHARE_SEEN = 0.8, 0.4
"""Share of the joints of pair17 that are seen: below the first a source is doubted, below the second useless."""


def find_annotations(options: AnnotationOptions, *, is_held_out: bool) -> tuple[AnnotationParameters, list[SourceFile]]:
    """Find a source's files and read them once, so that bad input is refused before any work.

    Raises:
        InputError: The path does not exist, a file is mangled, or the layout is not the one asked for.
    """
    try:
        if options.path.is_dir():
            paths = sorted(path for path in options.path.iterdir() if path.suffix.lower() == ".json")
            if not paths:
                raise InputError(f"folder {options.path} holds no .json files")
            per_frame = [name for name, kind in ANNOTATION_FORMATS.items() if kind.is_file_per_frame]
            if options.format not in {"auto", *per_frame}:
                raise InputError(
                    f"'{options.format}' is one file, not a folder; formats of folders: {', '.join(per_frame)}"
                )
            name = per_frame[0] if options.format == "auto" else options.format
        else:
            paths = [options.path]
            data = load_file(options.path).data
            try:
                name = find_format(ANNOTATION_FORMATS, options.format, data).name
            except InputError as error:
                raise type(error)(f"{options.path.name}: {error}") from None
        files = tuple(load_file(path).file for path in paths)
        parameters = AnnotationParameters(
            **options.model_dump(exclude={"path", "format"}),
            format=name,
            is_held_out=is_held_out,
            frames=tuple(ANNOTATION_FORMATS[name].frame_numbers([path.name for path in paths])),
        )
        _read(parameters, files)
    except InputError as error:
        raise type(error)(f"annotations {options.id}: {error}") from None
    return parameters, list(files)


@lru_cache(maxsize=4)
def _read(parameters: AnnotationParameters, files: tuple[SourceFile, ...]) -> AnnotatedFrames:
    """Read a source; the last few are remembered, because a study is planned several times in a run."""
    return read_annotations(
        ANNOTATION_FORMATS[parameters.format],
        {Path(file.path).name: read_again(file) for file in files},
        source_id=parameters.id,
        layout=parameters.layout,
        image_size_px=parameters.image_size_px,
        skip_unreadable=parameters.on_unreadable == "skip",
    )


def run_annotations(shard: Shard, store: Store, parameters: AnnotationParameters) -> ArtifactRef:
    """Read a source of 2D poses, settle who is who, and derive the working skeletons."""
    for file in shard.files:
        read_again(file)
    given = _read(parameters, shard.files)
    rate = parameters.rate_hz or given.rate_hz or DEFAULT_RATE_HZ
    try:
        settled = settle_people(replace(given, rate_hz=rate), parameters.part(PeopleSettings))
    except InputError as error:
        raise type(error)(f"annotations {parameters.id}: {error}") from None
    frames, op14 = settled.frames, settled.op14
    pair17 = KEYPOINT_LAYOUTS[frames.layout].derive("pair17", frames.keypoints_px, frames.confidence)
    sizes = [parameters.image_size_px or frames.image_size_px.get(name) for name in frames.sequence_id]
    count = frames.num_rows
    people = Counter(zip(frames.sequence_id, frames.frame.tolist(), strict=True))
    return commit(
        shard,
        store,
        tables={
            "annotations": {
                "sequence_id": list(frames.sequence_id),
                "frame": frames.frame,
                "person_id": frames.person_id,
                "partner_id": [None if one < 0 else int(one) for one in settled.partner_id],
                "source_person_id": settled.source_person_id,
                "time_s": frames.frame / rate,
                "is_key": np.ones(count, dtype=bool),
                "is_virtual": np.zeros(count, dtype=bool),
                "is_held_out": np.full(count, parameters.is_held_out),
                "take_id": [parameters.take_id] * count,
                "take_frame": [None] * count,
                "layout": [frames.layout] * count,
                "keypoints_px": [row.reshape(-1) for row in frames.keypoints_px],
                "keypoint_confidence": list(frames.confidence),
                "pair17_px": pair17.positions,
                "pair17_confidence": pair17.confidence,
                "op14_px": op14.positions,
                "op14_confidence": op14.confidence,
                "image_width_px": [size[0] if size else None for size in sizes],
                "image_height_px": [size[1] if size else None for size in sizes],
            }
        },
        facts={
            "kind": "sequences",
            "takes": [parameters.take_id] if parameters.take_id else [],
            "sequence_ids": sorted(set(frames.sequence_id)),
            "is_held_out": parameters.is_held_out,
            "is_virtual": False,
            "num_frames": len(people),
            "num_persons": max(people.values()),
            "rate_hz": rate,
            "purpose": "given",
            "format": parameters.format,
            "layout": frames.layout,
            "num_skipped_frames": len(frames.skipped),
            "skipped_files": list(frames.skipped[:MAX_NAMED_FILES]),
            **_decisions(settled),
        },
        sources=[SourceCredit(name=parameters.id, licence=parameters.licence, credit=parameters.credit)],
        verdict=_verdict(float((pair17.confidence > 0).mean()), len(frames.skipped), len(shard.files)),
    )


def _decisions(settled: SettledPeople) -> dict[str, Any]:
    """Return what was decided of who is who, as facts."""
    return {
        "couples": [
            {"sequence_id": one.sequence_id, "person_ids": [pair.first, pair.second], "num_near_frames": pair.num_near}
            for one in settled.sequences
            for pair in one.pairs
        ][:MAX_NAMED_FILES],
        "num_merged_rows": sum(one.num_merged_rows for one in settled.sequences),
        "num_ghost_rows": sum(one.num_ghost_rows for one in settled.sequences),
        "num_repaired_joints": sum(one.num_repaired_joints for one in settled.sequences),
    }


def _verdict(share_seen: float, num_skipped: int, num_files: int) -> Verdict:
    """Say whether enough is seen: the share of the joints, and the frames that were left out."""
    reasons = []
    if share_seen < GOOD_SHARE_SEEN:
        reasons.append(f"{share_seen:.0%} of the joints are seen")
    if num_skipped:
        reasons.append(f"{num_skipped} of {num_files} frames could not be read and were left out")
    is_poor = share_seen < POOR_SHARE_SEEN or 2 * num_skipped > num_files
    level = Level.PASS if not reasons else Level.FAIL if is_poor else Level.WARN
    return Verdict(level, "; ".join(reasons), figure="joints seen", value=100 * share_seen, unit="%")
