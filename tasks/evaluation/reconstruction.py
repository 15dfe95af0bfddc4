"""Topic `reconstruction`: reconstructed motions, against the ground truth of virtual video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.evaluation.motion_players import turn_to_camera
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.errors import (
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
    scale_free_error_m,
)
from pasdedeux.reconstruction.film_alignment import FilmAlignment, align_film
from storage_schema import ArtifactRef, Store, TableData
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.topic import Topic, TopicResult, refuse_overlap
from tasks.reconstruction import LEVEL, read_tracks
from tasks.rows import products
from tasks.rows.shown_motions import ShownMotion, read_motion_rows, read_shown_motion
from tasks.rows.takes import rate_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import MotionFacts, SequenceFacts, TakeFacts

BASELINES = (*products.BASELINES["motions"], LEVEL, "standing_still", "truth", "equal_depth")
"""Methods that others are compared with, bounds among them."""


@dataclass(frozen=True)
class Reconstructed:
    """One person's motion as reconstructed by several methods, and the ground truth, all in camera axes.

    Args:
        item: Sequence and person, for the table.
        truth_m: True op14 positions (frame, 14, 3), metres.
        found_m: By method, positions (frame, 14, 3) of the same frames.
        frames: Frames of the sequence (frame,), rising.
        person_id: Id of the person in the sequence.
        takes: Take of each frame.
        times_s: Its time within the take, seconds.
    """

    item: str
    truth_m: Array
    found_m: Mapping[str, Array]
    frames: Integers
    person_id: int = 0
    takes: Sequence[str] = ()
    times_s: Sequence[float] = ()


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per sequence that was reconstructed."""
    shards = []
    for motions in inputs.of("motions"):
        if not motions.tables["motions"].rows:
            continue
        shown, names = MotionFacts.of(motions).sequence_takes, set(MotionFacts.of(motions).sequence_ids)
        annotations = [
            # If several cameras saw the take, use the first: the motion is in its frames and axes.
            m
            for m in inputs.of("annotations")
            if m.ref in motions.inputs
            and names & set(SequenceFacts.of(m).sequence_ids)
            and (SequenceFacts.of(m).is_virtual or SequenceFacts.of(m).takes)
        ]
        takes = [m for m in inputs.of("poses") if TakeFacts.of(m).take_id in shown]
        shards.append(TOPIC.shard(inputs, motions.partition, motions=[motions], annotations=annotations, takes=takes))
    return shards


def _compute(shard: Shard, store: Store) -> TopicResult[ShownMotion]:
    """Score one sequence; one without ground truth is only shown."""
    motions, annotations = shard.ref("motions"), shard.refs("annotations")
    facts = MotionFacts.of(store.manifest(motions))
    notes = [f"{shard.name}: {words}." for words in facts.cameras]
    refuse_overlap(f"the projection database of sequence {shard.name}", facts.database_takes, facts.sequence_takes)
    try:
        if not annotations:
            raise InputError("a video without ground truth")
        people, truth, film = read_reconstructed(store, motions, annotations, shard.refs("takes"))
    except InputError as error:
        notes.append(f"{shard.name}: {error}; no scores.")
        return TopicResult(notes=notes, shown=read_shown_motion(store, motions))
    split = (
        "held_out" if any(sequence.is_held_out for sequence in SequenceFacts.read(store, annotations)) else "annotated"
    )
    scores = [score for person in people for score in reconstruction_scores(person, split=split)]
    for first, second in combinations(people, 2):
        scores += pair_scores(first, second, split=split, item=f"{first.item} with {second.item.split()[-1]}")
    camera = truth.cameras[shard.name]
    scores += _camera_scores(facts, camera, people, film, split=split, item=shard.name)
    # The database has not seen the take (otherwise this is refused), so all of it is held out.
    items = {"": reconstruction_items(people)}
    rate_hz = rate_of(read_motion_rows(store, motions)["time_s"])
    shown = _shown(shard.name, people, _read_keypoints(store, annotations, shard.name), camera, rate_hz=rate_hz)
    notes += [] if film is None else [film.in_words()]
    return TopicResult(scores, notes, items, BASELINES, shown)


def read_reconstructed(
    store: Store, motions: ArtifactRef, annotations: Sequence[ArtifactRef], takes: Sequence[ArtifactRef]
) -> tuple[list[Reconstructed], GroundTruth, FilmAlignment | None]:
    """Return the people of a sequence that its take contains, the ground truth, and a film's alignment with the take.

    Raises:
        InputError: A film does not show what its take is said to be.
    """
    truth = GroundTruth.read(store, takes, annotations, column="op14_m")
    table = read_motion_rows(store, motions)
    sequence_id = str(table["sequence_id"][0])
    if sequence_id not in truth.cameras:
        return _read_film(store, annotations, table, truth)
    people = []
    for person in np.unique(table["person_id"]):
        is_person = table["person_id"] == person
        reconstructed = {
            str(method): table["op14_m"][is_person & (table["method"] == method)].astype(np.float64)
            for method in dict.fromkeys(table["method"])
        }
        at = table["frame"][is_person & (table["method"] == next(iter(reconstructed)))]
        seen = [truth.frames[sequence_id, int(frame)] for frame in at]
        if person >= min(truth.takes[take].shape[1] for take, _ in seen):
            continue  # a passer-by of a simulated detector, or a false detection
        true = np.stack([truth.takes[take][frame, person] for take, frame in seen])
        true = true @ truth.cameras[sequence_id].camera_from_world_rotmat.T
        times_s = [truth.time_s(*place) for place in seen]
        item, names = f"{sequence_id} person {person}", [take for take, _ in seen]
        people.append(Reconstructed(item, true, reconstructed, at, int(person), names, times_s))
    return people, truth, None


def _read_film(
    store: Store, annotations: Sequence[ArtifactRef], table: TableData, truth: GroundTruth
) -> tuple[list[Reconstructed], GroundTruth, FilmAlignment]:
    """Return the people of a film at the times of its take, the truth in the film's camera, and the clocks.

    Raises:
        InputError: The film does not show the take, or there is no such take.
    """
    sequence_id = str(table["sequence_id"][0])
    if not truth.takes:
        raise InputError("the take that it shows (take_id) has no poses")
    (take_id, motion_m), rate_hz = next(iter(truth.takes.items())), next(iter(truth.rates_hz.values()))
    tracks, _ = read_tracks(store, annotations[0], sequence_id)
    film = align_film(tracks, np.asarray(motion_m, dtype=np.float64), rate_hz)
    people = []
    for person, number in sorted(zip(film.person_ids, range(len(film.person_ids)), strict=True)):
        is_person = table["person_id"] == person
        rows = {method: is_person & (table["method"] == method) for method in dict.fromkeys(table["method"])}
        first = next(iter(rows.values()))
        times_s = np.asarray(table["time_s"], dtype=np.float64)[first]
        true = film.truth_at(motion_m[:, number], rate_hz, times_s) @ film.camera.camera_from_world_rotmat.T
        known = np.isfinite(true).all(axis=(1, 2))
        if known.any():
            positions_m = {
                str(name): table["op14_m"][method_rows].astype(np.float64)[known] for name, method_rows in rows.items()
            }
            item, names = f"{sequence_id} person {person}", [take_id] * int(known.sum())
            at_s = (film.offset_s + film.rate * times_s[known]).tolist()
            people.append(
                Reconstructed(item, true[known], positions_m, table["frame"][first][known], person, names, at_s)
            )
    if not people:
        raise InputError("nobody of its take was reconstructed")
    return people, replace(truth, cameras={sequence_id: film.camera}), film


def _camera_scores(
    facts: MotionFacts,
    camera: PinholeCamera,
    people: Sequence[Reconstructed],
    film: FilmAlignment | None,
    *,
    split: str,
    item: str,
) -> list[Score]:
    """Score the camera's pitch, and describe how a film was aligned with its take."""
    pitch_deg = float(np.rad2deg(camera.pitch_rad))
    pitches = {list(people[0].found_m)[-1]: facts.pitch_deg, LEVEL: 0.0}
    scores = [
        Score("camera_pitch_error", method, abs(pitch - pitch_deg), "deg", split=split, item=item)
        for method, pitch in pitches.items()
    ]
    if film is not None:
        figures = {
            "clock_offset": (film.offset_s, "s"),
            "clock_rate": (film.rate, ""),
            "image_residual": (film.residual, ""),
        }
        scores += [Score(name, "truth", value, unit, split=split, item=item) for name, (value, unit) in figures.items()]
    return scores


def _read_keypoints(store: Store, annotations: Sequence[ArtifactRef], sequence_id: str) -> dict[tuple[int, int], Any]:
    """Return the keypoints (14, 2) of a sequence by person and frame."""
    keypoints = {}
    for ref in annotations:
        table = store.read(ref, "annotations", columns=["sequence_id", "person_id", "frame", "op14_px"])
        for row in np.flatnonzero(table["sequence_id"] == sequence_id):
            keypoints[int(table["person_id"][row]), int(table["frame"][row])] = table["op14_px"][row]
    return keypoints


def reconstruction_scores(person: Reconstructed, *, split: str) -> list[Score]:
    """Score every method: mean errors over op14 with root rotation kept, removed, and free of scale; and jitter.

    `standing_still` is the mean true pose of the motion in every frame, a bound that shows how much the person moves.
    """
    truth = person.truth_m
    still = np.broadcast_to((truth - mid_hip(truth)[:, None]).mean(axis=0), truth.shape)
    scores = [Score("jitter", "truth", jitter_m(truth), "m", split=split, item=person.item)]
    for method, motion_m in {**person.found_m, "standing_still": still}.items():
        figures = {
            "error_root_kept": float(root_centred_error_m(motion_m, truth).mean()),
            "error_root_removed": float(root_removed_error_m(motion_m, truth).mean()),
            "error_scale_free": float(scale_free_error_m(motion_m, truth).mean()),
            "jitter": jitter_m(motion_m),
        }
        scores += scores_of(figures, method, "m", split=split, item=person.item, count=len(truth))
    return scores


def reconstruction_items(people: Sequence[Reconstructed]) -> Items:
    """Return the error of every pose with root rotation kept, by method."""
    parts = []
    for person in people:
        errors = {method: root_centred_error_m(motion_m, person.truth_m) for method, motion_m in person.found_m.items()}
        parts.append(Items(errors, person.takes, person.times_s))
    return Items.joined(parts)


def pair_scores(first: Reconstructed, second: Reconstructed, *, split: str, item: str) -> list[Score]:
    """Score the places of two people relative to each other, over the frames that have both.

    `pair_distance_error` is how far the distance of their mid-hips is off, `pair_place_error` how far the vector
    between them is, `pair_depth_error` its part along the camera's axis.  The baseline
    `equal_depth` takes both people to be equally far from the camera (of the last method).
    """
    common = np.intersect1d(first.frames, second.frames)
    if not len(common):
        return []
    at = [np.searchsorted(person.frames, common) for person in (first, second)]
    true = mid_hip(second.truth_m[at[1]]) - mid_hip(first.truth_m[at[0]])
    between = {
        method: mid_hip(second.found_m[method][at[1]]) - mid_hip(first.found_m[method][at[0]])
        for method in first.found_m
        if method in second.found_m
    }
    if between:
        between["equal_depth"] = list(between.values())[-1] * [1.0, 1.0, 0.0]
    scores = []
    for method, offsets_m in between.items():
        figures = {
            "pair_distance_error": np.abs(np.linalg.norm(offsets_m, axis=-1) - np.linalg.norm(true, axis=-1)).mean(),
            "pair_place_error": np.linalg.norm(offsets_m - true, axis=-1).mean(),
            "pair_depth_error": np.abs(offsets_m[:, 2] - true[:, 2]).mean(),
        }
        scores += scores_of(figures, method, "m", split=split, item=item, count=len(common))
    return scores


def _shown(
    sequence_id: str,
    people: Sequence[Reconstructed],
    keypoints: Mapping[tuple[int, int], Any],
    camera: PinholeCamera,
    *,
    rate_hz: float,
) -> ShownMotion:
    """Return the player of the last method's result for everybody, beside the image."""
    frames = np.unique(np.concatenate([person.frames for person in people]))
    px = np.full((len(frames), len(people), 14, 2), np.nan)
    made, true = np.full((2, len(frames), len(people), 14, 3), np.nan)
    for number, person in enumerate(people):
        at = np.searchsorted(frames, person.frames)
        made[at, number] = list(person.found_m.values())[-1]
        true[at, number] = person.truth_m
        for index in at:
            px[index, number] = keypoints.get((person.person_id, int(frames[index])), np.nan)
    places = true - camera.camera_from_world_rotmat @ camera.position_m
    made, true = (turn_to_camera(motion, places) for motion in (made, true))
    caption = (
        f"{sequence_id}: 2D poses and their reconstruction ({in_words(list(people[0].found_m)[-1])}; "
        "Yiannakides et al. 2019, figs. 6b and 7), seen by the camera. Turn it: one camera does not show "
        "depth. Good: it lies on the grey ground truth. The figure beside the time is the mean error of "
        "the frame."
    )
    return ShownMotion(sequence_id, caption, made, rate_hz, px, true)


TOPIC = Topic(
    name="reconstruction",
    heading="Reconstruction",
    introduction="3D motion reconstructed from 2D poses, compared with ground truth where it exists. The published "
    "search and the window rule are those of Yiannakides et al. 2019, figs. 2 to 5. The baseline is the "
    "nearest pose of the database in each frame; for a film with captured motion (take_id), also the "
    "reconstruction with a level camera. Errors are mean distances of 14 joints with the mid-hips "
    "aligned; for two people, also errors of their distance, depth and relative position. The table of "
    "names explains each figure and method.",
    reads=("motions", "annotations", "cameras", "poses"),
    plan=_plan,
    compute=_compute,
    draw=lambda shown: [shown.picture],
    criteria=(
        Criterion(
            "error_root_kept",
            "mean joint error",
            "m",
            "poses",
            products.PRODUCTS["motions"],
        ),
    ),
    has_means_first=True,
)
