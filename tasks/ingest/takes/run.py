"""The work of a take's shard: motions at the study's rate, their working skeletons, `takes` and `poses`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import compress
from typing import Any, Literal

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.duets import make_duet
from pasdedeux.errors import named
from pasdedeux.formats.registry import MOTION_FORMATS
from pasdedeux.formats.rigs.guess import AxisGuess, MirrorGuess, guess_mirrored
from pasdedeux.formats.rigs.own_skeleton import body_map
from pasdedeux.formats.rigs.placement import floor_shift, place_motion, place_points
from pasdedeux.formats.rigs.resolution import SURE, mend_of_mirror, resolve_up_axes
from pasdedeux.formats.rigs.working_poses import WorkingPoses, derive_working_poses
from pasdedeux.formats.source_motion import SourceMotion, mirror_signs, upright_from_file
from pasdedeux.interaction.known_contacts import read_contacts
from pasdedeux.interaction.objects import MovingObjects, read_objects
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.plausibility.capture import JudgedCapture, PersonCapture, check_capture, judge_capture
from pasdedeux.projections.sources import resample_positions
from pasdedeux.skeletons.layouts import LAYOUTS, Layout, resolve_layout
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.ingest.files import read_again
from tasks.ingest.takes.parameters import DuetParameters, PersonParameters, TakeParameters
from tasks.stage import Shard
from tasks.stage.committing import commit
from tasks.stage.facts import TakeFacts

AWAY_M = 1.0
"""Distance of joints from an object within which it may be touched."""


_HAS_POSITIONS_ONLY = {name for name, kind in MOTION_FORMATS.items() if not kind.has_rotations}


_WITH_BETAS = "smpl"
"""Format whose files state the body; equal bodies of two people are an error there."""
NO_LIMIT = (-1.0, -1.0)
"""Limits of a length, which is too small beyond them, so that none fails."""


@dataclass(frozen=True)
class _CapturedPerson:
    """One person of a take: motion as captured and at the study's rate, layout and source."""

    captured: Motion
    motion: Motion
    layout: Layout
    source: PersonParameters


def run_duet(shard: Shard, store: Store, parameters: DuetParameters) -> ArtifactRef:
    """Make a built-in duet and commit its poses."""
    duet, layout = parameters.duet, LAYOUTS["body22"]
    built = make_duet(duet.name, **duet.settings)
    options = json.dumps(duet.model_dump(mode="json", exclude={"id"}), sort_keys=True)
    source = PersonParameters(
        source_name=duet.name,
        motion_sha256=hashlib.sha256(options.encode()).hexdigest(),
        format="duet",
        layout=layout.name,
        rate_hz=built.motions[0].rate_hz,
    )
    people = [_CapturedPerson(motion, motion.resample(parameters.rate_hz), layout, source) for motion in built.motions]
    frames = people[0].motion.num_frames
    known = (contact.within(0, frames) for contact in built.known_contacts(parameters.rate_hz))
    contacts = [contact.model_dump() for contact in known if contact is not None]
    return _commit(shard, store, parameters, people, "keep", Verdict(Level.PASS), contacts)


def run_take(shard: Shard, store: Store, parameters: TakeParameters) -> ArtifactRef:
    """Read the people of a take from their files and commit their poses."""
    data = _files(shard)
    people, verdict = _read_people(parameters, data)
    contacts, objects, num_frames = None, None, people[0].motion.num_frames
    if parameters.contacts_sha256:
        contacts = _known_contacts(parameters, num_frames, data[parameters.contacts_sha256])
    if parameters.objects_sha256:
        objects = _objects(parameters, data[parameters.objects_sha256], people[0].source.up_axis, num_frames)
    return _commit(shard, store, parameters, people, parameters.floor, verdict, contacts, objects)


@dataclass(frozen=True)
class CapturedTake:
    """A take as it was captured, without a store.

    Args:
        people_m: body22 (frame, person, 22, 3), metres, y up, at the positions in the files.
        rate_hz: Frames per second of the fastest file.
        people: Parameters with which each person's file was read.
        figures: Measurements of each person.
        guessed: Verdict on the guessed properties of the files.
        judged: Verdicts on the capture.
    """

    people_m: Array
    rate_hz: float
    people: tuple[PersonParameters, ...]
    figures: tuple[PersonCapture, ...]
    guessed: Verdict
    judged: JudgedCapture


def capture_take(shard: Shard) -> CapturedTake:
    """Read the people of a take from their files, and measure and judge their capture as the stage does."""
    parameters = shard.parameters
    assert isinstance(parameters, TakeParameters)
    own_hz = max(person.rate_hz for person in parameters.persons)
    people, guessed = _read_people(parameters.model_copy(update={"rate_hz": own_hz}), _files(shard))
    captured_m, rate_hz = _captured_together(people)
    captures, judged = _check(parameters, people, captured_m, rate_hz)
    sources = tuple(person.source for person in people)
    return CapturedTake(captured_m, rate_hz, sources, tuple(captures), guessed, judged)


def _files(shard: Shard) -> dict[str, bytes]:
    """Return the content of a shard's files by its digest."""
    return {file.sha256: read_again(file) for file in {file.sha256: file for file in shard.files}.values()}


def _read_people(parameters: TakeParameters, data: dict[str, bytes]) -> tuple[list[_CapturedPerson], Verdict]:
    """Return the people of a take, with equal numbers of frames, and the verdict on guesses about their files."""
    digests = [person.motion_sha256 for person in parameters.persons]
    motions = [_read(parameters, person, data) for person in parameters.persons]
    layouts = [
        resolve_layout(person.layout, motion.skeleton, motion.rest_offsets, parameters.mappings)
        for person, motion in zip(parameters.persons, motions, strict=True)
    ]
    axes = resolve_up_axes(
        motions,
        layouts,
        [person.up_axis for person in parameters.persons],
        [
            digests.count(person.motion_sha256) == 1 and person.format not in _HAS_POSITIONS_ONLY
            for person in parameters.persons
        ],
    )
    people, is_mirrored = [], []
    for person, motion, layout, axis in zip(parameters.persons, motions, layouts, axes, strict=True):
        source = person.model_copy(update={"up_axis": axis.axis})
        if source.mirrored is True:
            motion = motion.mirrored(axis.axis)
        is_mirrored.append(guess_mirrored(motion, layout))
        captured = place_motion(
            motion.to_motion(metres_per_unit=source.metres_per_unit, rate_hz=source.rate_hz, up_axis=source.up_axis),
            translation_m=source.translation_m,
            yaw_rad=float(np.deg2rad(source.yaw_deg)),
        )
        layout = resolve_layout(source.layout, captured.skeleton, captured.rest_offsets_m, parameters.mappings)
        moved = captured.resample(parameters.rate_hz, start_s=source.start_s)
        people.append(_CapturedPerson(captured, moved, layout, source))
    num_frames = min(person.motion.num_frames for person in people)
    people = [replace(person, motion=person.motion.first_frames(num_frames)) for person in people]
    return people, _verdict(parameters.persons, axes, is_mirrored, motions)


def _known_contacts(take: TakeParameters, num_frames: int, data: bytes) -> list[dict[str, Any]]:
    """Return the contacts in the read frames, converted to the study's rate, which gives `num_frames` frames."""
    first = take.persons[0]
    known = (contact.within(first.first_frame, first.first_frame + first.num_frames) for contact in read_contacts(data))
    stated = []
    for contact in filter(None, known):
        # The last frame at the study's rate may be before the end of the last frame that is read.
        start, stop = (
            int(np.clip(np.ceil((frame / first.rate_hz - first.start_s) * take.rate_hz - 1e-6), 0, num_frames))
            for frame in (contact.start_frame, contact.stop_frame)
        )
        if start < stop:
            stated.append(contact.model_copy(update={"start_frame": start, "stop_frame": stop}).model_dump())
    return stated


def _objects(take: TakeParameters, data: bytes, up_axis: str, num_frames: int) -> MovingObjects:
    """Return the objects in the world at the rate of the study, before the take is shifted to the floor."""
    first, objects = take.persons[0], read_objects(data)
    ends = objects.ends_m[first.first_frame : first.first_frame + first.num_frames]
    ends = ends * mirror_signs(up_axis) if first.mirrored is True else ends
    upright = rotate(np.broadcast_to(upright_from_file(up_axis), (*ends.shape[:-1], 4)), ends)
    placed = place_points(upright, translation_m=first.translation_m, yaw_rad=float(np.deg2rad(first.yaw_deg)))
    moved = resample_positions(placed, from_hz=first.rate_hz, to_hz=take.rate_hz, start_s=first.start_s)
    return replace(objects, ends_m=moved[:num_frames])


def _read(take: TakeParameters, person: PersonParameters, files: dict[str, bytes]) -> SourceMotion:
    """Return the wanted frames of one person's file, or of one person in a file of several."""
    data, companion = files[person.motion_sha256], files.get(person.companion_sha256, b"")
    with named(f"take {take.take_id}: {person.source_name}"):
        source = MOTION_FORMATS[person.format].read_person(person.number, data, companion)
    taken = source.frames(person.first_frame, person.first_frame + person.num_frames)
    return taken.with_sides_exchanged() if person.mirrored == "names" else taken


def _verdict(
    persons: tuple[PersonParameters, ...],
    axes: Sequence[AxisGuess],
    mirrors: Sequence[MirrorGuess],
    motions: Sequence[SourceMotion],
) -> Verdict:
    """Return the verdict on a take's guessed properties, and whether stages for pairs skip it."""
    unit = min(person.unit_confidence for person in persons)
    up = min(axes, key=lambda axis: axis.confidence)
    reasons = []
    if unit < SURE:
        reasons.append(f"its length unit is a guess (confidence {unit:.1f}); set metres_per_unit")
    if up.confidence < SURE:
        reasons.append(f"its up axis {up.axis} is a guess (confidence {up.confidence:.1f}); set up_axis")
    exchanged = [mirror.is_mirrored and mirror.confidence >= SURE for mirror in mirrors]
    for person in compress(persons, exchanged):
        words = "are exchanged still" if person.mirrored else f"seem exchanged; look, and {mend_of_mirror(exchanged)}"
        reasons.append(f"left and right of {person.source_name} {words}")
    if len(persons) != 2:
        who = "one person only" if len(persons) == 1 else f"{len(persons)} people"
        reasons.append(f"it has {who}: what needs pairs passes it over")
    level = Level.WARN if reasons else Level.PASS
    for person, motion in zip(persons, motions, strict=True):
        reasons += [f"{person.source_name}: {note.rstrip('.')}" for note in motion.notes]
    return Verdict(level, "; ".join(reasons), figure="confidence of unit and up axis", value=min(unit, up.confidence))


def _commit(
    shard: Shard,
    store: Store,
    parameters: DuetParameters | TakeParameters,
    people: list[_CapturedPerson],
    floor: Literal["auto", "keep"],
    verdict: Verdict,
    contacts: Sequence[dict[str, Any]] | None = None,
    objects: MovingObjects | None = None,
) -> ArtifactRef:
    """Check the capture, shift the take to the floor if wanted, derive the working skeletons and commit.

    A take that fails the check is committed without its motion if the study skips such takes.
    """
    captures, judged = _check(parameters, people, *_captured_together(people))
    take_id = parameters.take_id
    facts = TakeFacts(
        take_id=take_id,
        takes=(take_id,),
        num_persons=len(people),
        num_frames=people[0].motion.num_frames,
        rate_hz=parameters.rate_hz,
        is_held_out=parameters.is_held_out,
        is_prior=parameters.is_prior,
        is_built_in=isinstance(parameters, DuetParameters),
        **({} if contacts is None else {"contacts": contacts}),
    )
    tables = {"take_quality": _quality(take_id, captures, judged)}
    if judged.take.level is Level.FAIL and parameters.capture.skip_failing:
        skipped = f"Take {take_id} was skipped, its capture fails: {judged.take.reason}."
        return commit(
            shard,
            store,
            tables=tables,
            facts=facts.model_copy(update={"skipped": (skipped,)}),
            sources=[parameters.source],
            verdict=Verdict(Level.FAIL, skipped),
        )
    poses = [derive_working_poses(person.motion, person.layout) for person in people]
    shift = floor_shift(np.stack([pose.body22_m for pose in poses], axis=1)) if floor == "auto" else 0.0
    if shift:
        up = (0.0, shift, 0.0)
        people = [
            replace(person, motion=place_motion(person.motion, translation_m=up, yaw_rad=0.0)) for person in people
        ]
        poses = [derive_working_poses(person.motion, person.layout) for person in people]
        objects = objects and replace(objects, ends_m=objects.ends_m + up)
    verdict = _joined(verdict, judged.take)
    if objects is not None:
        verdict = _joined(verdict, _far_from(objects, np.stack([pose.body22_m for pose in poses], axis=1)))
    return commit(
        shard,
        store,
        tables={
            **tables,
            "takes": _takes(parameters, people, poses),
            "poses": _poses(take_id, parameters.rate_hz, people, poses),
            **({"objects": _object_rows(take_id, objects)} if objects is not None else {}),
        },
        facts=facts,
        sources=[parameters.source],
        verdict=verdict,
    )


def _check(
    parameters: DuetParameters | TakeParameters, people: Sequence[_CapturedPerson], captured_m: Array, rate_hz: float
) -> tuple[list[PersonCapture], JudgedCapture]:
    """Measure the capture of people (frame, person, 22, 3), and judge it by the limits of the study."""
    captures = check_capture(captured_m, rate_hz=rate_hz)
    names = [person.source.source_name for person in people] if isinstance(parameters, TakeParameters) else []
    limits = dict(parameters.capture.limits)
    if not all(person.source.format == _WITH_BETAS for person in people):
        limits["body_difference_m"] = NO_LIMIT  # two people may well be captured on one rig
    return captures, judge_capture(captures, limits, names)


def _captured_together(people: Sequence[_CapturedPerson]) -> tuple[Array, float]:
    """Return body22 as captured (frame, person, 22, 3), at the rate of the fastest file, and that rate."""
    rate_hz = max(person.captured.rate_hz for person in people)
    motions = [person.captured.resample(rate_hz, start_s=person.source.start_s) for person in people]
    num_frames = min(motion.num_frames for motion in motions)
    places = [
        derive_working_poses(motion.first_frames(num_frames), person.layout).body22_m
        for motion, person in zip(motions, people, strict=True)
    ]
    return np.stack(places, axis=1), rate_hz


def _object_rows(take_id: str, objects: MovingObjects) -> dict[str, Any]:
    frames, count = objects.ends_m.shape[:2]
    order = np.argsort(objects.names)
    return {
        "take_id": [take_id] * frames * count,
        "object": np.repeat(np.array(objects.names)[order], frames).tolist(),
        "frame": np.tile(np.arange(frames), count),
        "ends_m": np.swapaxes(objects.ends_m[:, order], 0, 1).reshape(-1, 2, 3),
        "radius_m": np.repeat(objects.radii_m[order], frames),
    }


def _far_from(objects: MovingObjects, body22_m: np.ndarray) -> Verdict:
    """Warn of objects that nobody comes near: their unit or axes may differ from those of the people."""
    far = [
        f"nobody comes nearer than {distance_m - radius_m:.1f} m to '{name}': are these metres, in A's file's axes?"
        for name, radius_m, distance_m in zip(objects.names, objects.radii_m, objects.closest_m(body22_m), strict=True)
        if distance_m - radius_m > AWAY_M
    ]
    return Verdict(Level.WARN if far else Level.PASS, "; ".join(far))


def _joined(guessed: Verdict, captured: Verdict) -> Verdict:
    """Return the worse of two verdicts with the reasons of both, those of the capture first."""
    level = max((guessed.level, captured.level), key=lambda level: level.rank)
    return replace(guessed, level=level, reason="; ".join(filter(None, (captured.reason, guessed.reason))))


def _quality(take_id: str, people: list[PersonCapture], judged: JudgedCapture) -> dict[str, Any]:
    count = len(people)
    return {
        "take_id": [take_id] * count,
        "person": list(range(count)),
        **{name: [getattr(person, name) for person in people] for name in asdict(people[0])},
        "verdict": [verdict.level.value for verdict in judged.people],
        "reason": [verdict.reason for verdict in judged.people],
    }


def _takes(
    parameters: DuetParameters | TakeParameters, people: list[_CapturedPerson], poses: list[WorkingPoses]
) -> dict[str, Any]:
    count = len(people)
    maps = [body_map(person.layout, person.motion.skeleton, person.motion.rest_offsets_m) for person in people]
    return {
        "take_id": [parameters.take_id] * count,
        "person": list(range(count)),
        "source_name": [person.source.source_name for person in people],
        "source_sha256": [person.source.motion_sha256 for person in people],
        "source_format": [person.source.format for person in people],
        "num_persons": [count] * count,
        "num_frames": [person.motion.num_frames for person in people],
        "rate_hz": [parameters.rate_hz] * count,
        "source_rate_hz": [person.source.rate_hz for person in people],
        "metres_per_unit": [person.source.metres_per_unit for person in people],
        "up_axis": [person.source.up_axis for person in people],
        "layout": [person.layout.name for person in people],
        "is_position_only": [person.source.format in _HAS_POSITIONS_ONLY for person in people],
        "is_held_out": [parameters.is_held_out] * count,
        "joint_names": [list(person.motion.skeleton.joint_names) for person in people],
        "joint_parents": [np.array(person.motion.skeleton.parents, dtype=np.int32) for person in people],
        "rest_offset_m": [person.motion.rest_offsets_m.reshape(-1) for person in people],
        "body22_weight": [joint_map.weight.reshape(-1) for joint_map in maps],
        "body22_offset_m": [joint_map.offset_m.reshape(-1) for joint_map in maps],
        "body22_rest_m": np.stack([pose.body22_rest_m for pose in poses]),
    }


def _poses(take_id: str, rate_hz: float, people: list[_CapturedPerson], poses: list[WorkingPoses]) -> dict[str, Any]:
    lengths = [person.motion.num_frames for person in people]
    frames = np.concatenate([np.arange(length) for length in lengths])
    return {
        "take_id": [take_id] * sum(lengths),
        "person": np.repeat(np.arange(len(people)), lengths),
        "frame": frames,
        "time_s": frames / rate_hz,
        "root_translation_m": np.concatenate([person.motion.root_translation_m for person in people]),
        "local_unitquat": [row.reshape(-1) for person in people for row in person.motion.local_unitquat],
        "pair17_m": np.concatenate([pose.pair17_m for pose in poses]),
        "op14_m": np.concatenate([pose.op14_m for pose in poses]),
        "body22_m": np.concatenate([pose.body22_m for pose in poses]),
        "body22_world_unitquat": np.concatenate([pose.body22_world_unitquat for pose in poses]),
    }
