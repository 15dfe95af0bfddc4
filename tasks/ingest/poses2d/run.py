"""The work of a shard of 2D poses: reading, resolving identities, deriving the working skeletons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.people.resolution import ResolvedPeople, SequencePeople
from pasdedeux.sampling.annotations import is_left_out
from pasdedeux.skeletons import COUNTED17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.files.user_files import user_file_digest
from tasks.ingest.poses2d.parameters import AnnotationParameters
from tasks.ingest.poses2d.resolution import DEFAULT_RATE_HZ, MAX_NAMED_FILES, FoundAnnotations
from tasks.rows.camera_motions import motion_table
from tasks.stage import Shard
from tasks.stage.committing import commit
from tasks.stage.facts import CoupleFact, SequenceFacts

GOOD_SHARE_SEEN, POOR_SHARE_SEEN = 0.8, 0.4
"""Share of seen joints below which a source gets a warning, and below which it fails."""


def run_annotations(shard: Shard, store: Store, parameters: AnnotationParameters) -> ArtifactRef:
    """Read a source of 2D poses, resolve identities, and derive the working skeletons."""
    return commit_poses2d(shard, store, FoundAnnotations(parameters, shard.files, None))


def commit_poses2d(shard: Shard, store: Store, source: FoundAnnotations) -> ArtifactRef:
    """Commit the annotations of a source with identities resolved.

    Raises:
        InputError: A file has changed since planning, or as `FoundAnnotations.resolve`.
    """
    parameters = source.parameters
    for file in shard.files:
        if user_file_digest(Path(file.path)) != file.sha256:
            raise InputError(f"file {file.path} changed since the run was planned; run again")
    resolved = source.resolve()
    frames = resolved.frames
    rate_hz = frames.rate_hz or DEFAULT_RATE_HZ
    pair17 = KEYPOINT_LAYOUTS[frames.layout].derive("pair17", frames.keypoints_px, frames.confidence)
    count = frames.num_rows
    reasons = {sequence.sequence_id: sequence.why_not_followed for sequence in resolved.sequences}
    stills = {sequence_id: reason for sequence_id, reason in reasons.items() if reason}
    people = Counter(zip(frames.sequence_id, frames.frame.tolist(), strict=True))
    return commit(
        shard,
        store,
        tables={
            "annotations": {
                **track_columns(resolved),
                "source_person_id": resolved.source_person_id,
                "is_key": np.ones(count, dtype=bool),
                "is_virtual": np.zeros(count, dtype=bool),
                "is_held_out": parameters.is_held_out
                | is_left_out(frames.sequence_id, frames.frame, parameters.leave_one_out_every, stills),
                "take_id": [parameters.take_id] * count,
                "take_frame": [None] * count,
                "layout": [frames.layout] * count,
                "keypoints_px": [row.reshape(-1) for row in frames.keypoints_px],
                "keypoint_confidence": list(frames.confidence),
                "pair17_px": pair17.positions,
                "pair17_confidence": pair17.confidence,
            }
        }
        | motion_table(frames.camera_motion),
        facts=SequenceFacts(
            takes=(parameters.take_id,) if parameters.take_id else (),
            sequence_ids=tuple(sorted(set(frames.sequence_id))),
            is_held_out=parameters.is_held_out,
            is_virtual=False,
            num_frames=len(people),
            num_persons=max(people.values()),
            rate_hz=rate_hz,
            purpose="given",
            format=parameters.format,
            layout=frames.layout,
            num_skipped_frames=len(frames.skipped),
            skipped_files=tuple(frames.skipped[:MAX_NAMED_FILES]),
            camera_height_m=parameters.camera_height_m,
            statures_m=dict(parameters.statures_m),
            **({"camera_of": parameters.camera_of} if parameters.camera_of else {}),
            **({"calibration": parameters.calibration} if parameters.calibration else {}),
            couples=tuple(
                CoupleFact(
                    sequence_id=sequence.sequence_id,
                    person_ids=(pair.first, pair.second),
                    num_near_frames=pair.num_near,
                )
                for sequence in resolved.sequences
                for pair in sequence.pairs
            )[:MAX_NAMED_FILES],
            why_no_video=stills,
            num_merged_rows=sum(sequence.num_merged_rows for sequence in resolved.sequences),
            num_ghost_rows=sum(sequence.num_ghost_rows for sequence in resolved.sequences),
            num_repaired_joints=sum(sequence.num_repaired_joints for sequence in resolved.sequences),
            num_renamed_rows=sum(sequence.num_renamed_rows for sequence in resolved.sequences),
        ),
        attachments=source.attachments(resolved),
        sources=[SourceCredit(name=parameters.id, licence=parameters.licence, credit=parameters.credit)],
        verdict=_verdict(
            pair17.confidence[:, COUNTED17] > 0,
            len(frames.skipped),
            len(shard.files),
            resolved.sequences,
            [*stated_of_nobody(dict(parameters.statures_m), frames.person_id.tolist()), *frames.doubts],
        ),
    )


def track_columns(resolved: ResolvedPeople) -> dict[str, Any]:
    """Return the columns of the table of annotations from which tracks are made."""
    frames = resolved.frames
    sizes = [frames.image_size_px.get(name) or (None, None) for name in frames.sequence_id]
    return {
        "sequence_id": list(frames.sequence_id),
        "frame": frames.frame,
        "person_id": frames.person_id,
        "partner_id": [None if partner < 0 else int(partner) for partner in resolved.partner_id],
        "time_s": frames.frame / (frames.rate_hz or DEFAULT_RATE_HZ),
        "op14_px": resolved.op14.positions,
        "op14_confidence": resolved.op14.confidence,
        "focal_px": [frames.focal_px.get(name) for name in frames.sequence_id],
        "image_width_px": [width for width, _ in sizes],
        "image_height_px": [height for _, height in sizes],
    }


def stated_of_nobody(person_ids: Iterable[int], known: Iterable[int]) -> list[str]:
    """Return a doubt if a stature is stated for absent people, else nothing."""
    absent, people = sorted(set(person_ids) - set(known)), ", ".join(map(str, sorted(set(known)))) or "none"
    whom = ", ".join(map(str, absent))
    return [f"a stature is stated for person {whom}, who is not there; people: {people}"] * bool(absent)


def _verdict(
    is_seen: np.ndarray, num_skipped: int, num_files: int, sequences: Sequence[SequencePeople], doubts: Sequence[str]
) -> Verdict:
    """Judge a source by the share of seen joints (person in a frame, joint) and the number of skipped frames.

    The reason also lists joined tracks, which are no fault.
    """
    reasons, share_seen = [], float(is_seen.mean())
    if share_seen < GOOD_SHARE_SEEN:
        reasons.append(f"{share_seen:.0%} of the joints are seen")
    if num_skipped:
        reasons.append(f"{num_skipped} of {num_files} frames could not be read and were skipped")
    reasons += doubts
    is_poor = share_seen < POOR_SHARE_SEEN or 2 * num_skipped > num_files
    level = Level.PASS if not reasons else Level.FAIL if is_poor else Level.WARN
    reasons += [row.as_joined() for sequence in sequences for row in sequence.joined]
    figure = ("joints seen", 100 * share_seen, "%")
    return Verdict(level, "; ".join(reasons), *figure, count=len(is_seen), thing="people in frames")
