"""Topic `film`: images of a film and their reconstruction, with faces blurred."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.evaluation.pictures import Picture
from pasdedeux.formats.poses2d.annotated_frames import KeypointStatus
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv
from storage_schema import Store
from tasks.evaluation.topic import Topic, TopicResult
from tasks.ingest.film.run import ANNOTATIONS_NAME, CLIP_NAME, SHEET_NAME
from tasks.stage import Parameters, Shard, StageInputs


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan a shard for each shot of a film."""
    films = [manifest for manifest in inputs.of("annotations") if SHEET_NAME in manifest.attachments]
    return [TOPIC.shard(inputs, film.partition, film=[film]) for film in films]


def _compute(shard: Shard, store: Store) -> TopicResult[Sequence[Picture]]:
    """Show the images drawn when a shot was read; describe the source of its keypoints and the omitted data."""
    ref = shard.ref("film")
    name = store.manifest(ref).partition
    frames = read_annotation_csv(store.attachment(ref, ANNOTATIONS_NAME))
    assert frames.status is not None
    shares = np.bincount(frames.status.reshape(-1), minlength=len(KeypointStatus)) / frames.status.size
    words = ", ".join(
        f"{shares[kind]:.0%} {kind.name.lower()}" for kind in reversed(KeypointStatus) if shares[kind] > 0
    )
    kept = store.read(ref, "annotations", columns=["keypoint_confidence"])["keypoint_confidence"]
    num_kept, num_known = sum(int((np.asarray(row) > 0).sum()) for row in kept), int((frames.confidence > 0).sum())
    note = (
        f"{name}: frames {frames.frame.min()} to {frames.frame.max()}, {len(np.unique(frames.person_id))} "
        f"people; keypoints: {words}; {max(num_known - num_kept, 0)} of {num_known} removed as "
        "implausible."
    )
    captions = {
        SHEET_NAME: "dots are annotated, detected or tracked keypoints, rings are interpolated",
        CLIP_NAME: "a clip",
    }
    pictures = [
        Picture(f"{name}-{file}", f"{name}: {says}.", store.attachment(ref, file)) for file, says in captions.items()
    ]
    return TopicResult(notes=[note], shown=pictures)


TOPIC = Topic(
    name="film",
    heading="Film",
    introduction="Shots of film, with the people that were annotated, detected or tracked. Faces of annotated people "
    "are blurred. A missing keypoint is hidden, or its track was lost.",
    reads=("annotations",),
    plan=_plan,
    compute=_compute,
    draw=lambda pictures: pictures,
)
