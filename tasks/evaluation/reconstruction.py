"""Topic `reconstruction`: reconstructed motions, against the truth where there is one: of virtual video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.reconstruction import (
    Reconstructed,
    pair_scores,
    reconstruction_items,
    reconstruction_player,
    reconstruction_scores,
    turn_to_camera,
)
from pasdedeux.evaluation.verdicts import Criterion
from storage_schema import ArtifactRef, Store, TableData
from tasks.evaluation.ground_truth import rate_of, read_cameras, read_rates, read_take_frames, read_takes
from tasks.evaluation.topic import Topic, TopicResult, refuse_overlap
from tasks.facts import MotionFacts, SequenceFacts, TakeFacts
from tasks.stage import Parameters, Shard, StageInputs


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per sequence that was reconstructed."""
    found = []
    for motions in inputs.of("motions"):
        if not motions.tables["motions"].rows:
            continue
        annotations = [
            m for m in inputs.of("annotations") if m.ref in motions.inputs and SequenceFacts.of(m).is_virtual
        ]
        shown = MotionFacts.of(motions).sequence_takes
        takes = [m for m in inputs.of("poses") if TakeFacts.of(m).take_id in shown]
        found.append(TOPIC.shard(inputs, motions.partition, motions=[motions], annotations=annotations, takes=takes))
    return found


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score one sequence."""
    motions, annotations = shard.ref("motions"), shard.refs("annotations")
    facts = MotionFacts.of(store.manifest(motions))
    refuse_overlap(f"the projection database of sequence {shard.name}", facts.database_takes, facts.sequence_takes)
    if not annotations:
        return _show(store, motions, f"{shard.name}: a video whose truth nobody knows; no scores.")
    cameras = read_cameras(store, annotations)
    split = "held_out" if any(one.is_held_out for one in SequenceFacts.read(store, annotations)) else "annotated"
    table = _read_motions(store, motions)
    sequence_id = str(table["sequence_id"][0])
    scores = []
    people = read_reconstructed(store, motions, annotations, shard.refs("takes"))
    for result in people:
        scores += reconstruction_scores(result, split=split)
    keypoints = _read_keypoints(store, annotations, shard.name)
    camera = cameras[sequence_id]
    camera_m = camera.camera_from_world_rotmat @ camera.position_m
    name = _picture_name(shard.name)
    pictures = {name: _shown(people, keypoints, camera_m=camera_m, rate_hz=rate_of(table["time_s"]))}
    captions = {
        name: f"{shard.name}: the image, and what was made of it ({in_words(list(people[0].found_m)[-1])}), first as "
        "the camera sees it. Turn it: one camera does not see depth; better is what lies on the grey truth then too. "
        "Beside the time: the mean error of that frame."
    }
    for one, other in combinations(people, 2):
        scores += pair_scores(one, other, split=split, item=f"{one.item} with {other.item.split()[-1]}")
    # The database has not seen the take, or this would have been refused: all of it is held out.
    items = {"": reconstruction_items(people)}
    return TopicResult(scores, pictures, captions, items=items)


def read_reconstructed(
    store: Store, motions: ArtifactRef, annotations: Sequence[ArtifactRef], takes: Sequence[ArtifactRef]
) -> list[Reconstructed]:
    """Return the people of a sequence of virtual video who are in its take, with the truth in camera axes."""
    poses, frames, cameras = (
        read_takes(store, takes, "op14_m"),
        read_take_frames(store, annotations),
        read_cameras(store, annotations),
    )
    table, rates = _read_motions(store, motions), read_rates(store, takes)
    sequence_id = str(table["sequence_id"][0])
    people = []
    for person in np.unique(table["person_id"]):
        is_person = table["person_id"] == person
        found = {
            str(method): table["op14_m"][is_person & (table["method"] == method)].astype(np.float64)
            for method in dict.fromkeys(table["method"])
        }
        at = table["frame"][is_person & (table["method"] == next(iter(found)))]
        seen = [frames[sequence_id, int(frame)] for frame in at]
        if person >= min(poses[take].shape[1] for take, _ in seen):
            continue  # a passer-by of a simulated detector, or somebody whom it made up
        truth = np.stack([poses[take][frame, person] for take, frame in seen])
        truth = truth @ cameras[sequence_id].camera_from_world_rotmat.T
        names, times_s = [take for take, _ in seen], [frame / rates[take] for take, frame in seen]
        people.append(Reconstructed(f"{sequence_id} person {person}", truth, found, at, int(person), names, times_s))
    return people


def _read_motions(store: Store, motions: ArtifactRef) -> TableData:
    return store.read(motions, "motions", columns=["sequence_id", "person_id", "frame", "time_s", "method", "op14_m"])


def _read_keypoints(store: Store, annotations: Sequence[ArtifactRef], sequence_id: str) -> dict[tuple[int, int], Any]:
    """Return the keypoints (14, 2) of a sequence by person and frame."""
    keypoints = {}
    for ref in annotations:
        table = store.read(ref, "annotations", columns=["sequence_id", "person_id", "frame", "op14_px"])
        for row in np.flatnonzero(table["sequence_id"] == sequence_id):
            keypoints[int(table["person_id"][row]), int(table["frame"][row])] = table["op14_px"][row]
    return keypoints


def _picture_name(sequence_id: str) -> str:
    return f"reconstruction-{sequence_id.replace('/', '-')}.player.json"


def _shown(
    people: Sequence[Reconstructed],
    keypoints: Mapping[tuple[int, int], Any],
    *,
    camera_m: np.ndarray,
    rate_hz: float,
) -> bytes:
    """Show what the last method made of everybody beside the image; the truth's camera is at (3,)."""
    frames = np.unique(np.concatenate([person.frames for person in people]))
    px = np.full((len(frames), len(people), 14, 2), np.nan)
    found, truth = np.full((2, len(frames), len(people), 14, 3), np.nan)
    for number, person in enumerate(people):
        at = np.searchsorted(frames, person.frames)
        found[at, number] = list(person.found_m.values())[-1]
        truth[at, number] = person.truth_m
        for index in at:
            px[index, number] = keypoints.get((person.person_id, int(frames[index])), np.nan)
    shown, true = (turn_to_camera(motion, truth - camera_m) for motion in (found, truth))
    return reconstruction_player(shown, rate_hz=rate_hz, keypoints_px=px, truth_m=true)


def _show(store: Store, motions: ArtifactRef, note: str) -> TopicResult:
    """Show what the last method made of a sequence that cannot be scored."""
    table = _read_motions(store, motions)
    method, sequence_id = str(table["method"][-1]), str(table["sequence_id"][0])
    is_shown = table["method"] == method
    frames, rows = np.unique(table["frame"][is_shown], return_inverse=True)
    persons, columns = np.unique(table["person_id"][is_shown], return_inverse=True)
    found = np.full((len(frames), len(persons), 14, 3), np.nan)
    found[rows, columns] = table["op14_m"][is_shown]
    name = _picture_name(sequence_id)
    return TopicResult(
        pictures={name: reconstruction_player(found, rate_hz=rate_of(table["time_s"]))},
        captions={
            name: f"{sequence_id}: reconstructed ({in_words(method)}), a colour for each person. Turn it: limbs "
            "that are too short or bent wrongly show from the side."
        },
        notes=[note],
    )


TOPIC = Topic(
    name="reconstruction",
    heading="Reconstruction",
    introduction="3D motion made of 2D poses, against the truth where it is known. The trivial way takes, frame by "
    "frame, the pose of the database whose image is nearest. Errors are mean distances of 14 joints about the middle "
    "of the hips; of two people also how far their distance, depth and place to each other are off. The table of names "
    "says what each figure and method is.",
    reads=("motions", "annotations", "cameras", "poses"),
    plan=_plan,
    run=_run,
    criteria=(
        Criterion(
            "error_root_kept",
            "mean joint error",
            "m",
            "poses",
            ("fit_clean", "fit", "viterbi_clean", "viterbi", "window_clean", "window"),
        ),
    ),
    has_means_first=True,
)
