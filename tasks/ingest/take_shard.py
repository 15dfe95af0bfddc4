"""The work of a take's shard: motions at the study's rate, their working skeletons, `takes` and `poses`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pasdedeux.choreography import make_duet
from pasdedeux.errors import InputError
from pasdedeux.formats import SourceMotion, WorkingPoses, derive_working_poses, guess_common_up_axis
from pasdedeux.formats.placement import floor_shift, place_motion
from pasdedeux.kinematics import Motion
from pasdedeux.skeletons.layouts import LAYOUTS, Layout
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.ingest.sources import layout_named, read_person
from tasks.stage import Shard, commit

__all__ = ["run_take"]


@dataclass(frozen=True)
class _Person:
    """One person of a take, with what its row of `takes` says about the source."""

    motion: Motion
    layout: Layout
    source_name: str
    source_sha256: str
    source_format: str
    source_rate_hz: float
    metres_per_unit: float
    up_axis: str


@dataclass(frozen=True)
class _Read:
    """One person's motion as its file says it, with what the plan knows of the file."""

    options: Mapping[str, Any]
    source: SourceMotion
    layout: Layout
    sha256: str


def run_take(shard: Shard, store: Store) -> ArtifactRef:
    """Compute a take's poses and commit them."""
    parameters = shard.parameters
    people = _duet(parameters) if parameters["kind"] == "duet" else _files(shard)
    poses = [derive_working_poses(person.motion, person.layout) for person in people]
    if parameters.get("floor", "keep") == "auto":
        shift = floor_shift(np.stack([pose.body22_m for pose in poses], axis=1))
        if shift:
            up = (0.0, shift, 0.0)
            people = [_shifted(person, up) for person in people]
            poses = [derive_working_poses(person.motion, person.layout) for person in people]
    num_frames = people[0].motion.num_frames
    take_id = parameters["take_id"]
    source = SourceCredit(**parameters["source"])
    return commit(
        shard,
        store,
        tables={
            "takes": _takes(parameters, people, poses, source),
            "poses": _poses(take_id, float(parameters["rate_hz"]), people, poses),
        },
        facts={
            "kind": "take",
            "take_id": take_id,
            "takes": [take_id],
            "num_persons": len(people),
            "num_frames": num_frames,
            "rate_hz": parameters["rate_hz"],
            "is_held_out": parameters["is_held_out"],
            "is_prior": parameters["is_prior"],
        },
        sources=[source],
    )


def _duet(parameters: Any) -> list[_Person]:
    options = dict(parameters["duet"])
    style = options.pop("style")
    name = options.pop("name")
    options["heights_m"] = tuple(options["heights_m"])
    duet = make_duet(name, **options, **style)
    digest = hashlib.sha256(json.dumps(parameters["duet"], sort_keys=True).encode()).hexdigest()
    return [
        _Person(
            motion=motion.resample(float(parameters["rate_hz"])),
            layout=LAYOUTS["body22"],
            source_name=name,
            source_sha256=digest,
            source_format="duet",
            source_rate_hz=motion.rate_hz,
            metres_per_unit=1.0,
            up_axis="y",
        )
        for motion in duet.motions
    ]


def _files(shard: Shard) -> list[_Person]:
    files = list(shard.files)
    num_frames = int(shard.parameters["num_frames"])
    read: list[_Read] = []
    for options in shard.parameters["persons"]:
        own = [files.pop(0) for _ in range(options["num_files"])]
        data = [Path(file.path).read_bytes() for file in own]
        for file, content in zip(own, data, strict=True):
            if hashlib.sha256(content).hexdigest() != file.sha256:
                raise InputError(f"file {file.path} changed since the run was planned; run again")
        try:
            source = read_person(options["format"], data[0], data[1] if len(data) > 1 else None)
            source = source.frames(options["first_frame"], options["first_frame"] + num_frames)
            layout = layout_named(options["layout"], source.skeleton.joint_names, shard.parameters["mappings"])
        except InputError as error:
            raise type(error)(f"take {shard.parameters['take_id']}: {options['source_name']}: {error}") from None
        read.append(_Read(options, source, layout, own[0].sha256))
    guessed = [one.source for one in read if one.options["up_axis"] == "auto"]
    common_up_axis = guess_common_up_axis(guessed) if guessed else ""
    people = []
    for one in read:
        options = one.options
        up_axis = common_up_axis if options["up_axis"] == "auto" else options["up_axis"]
        motion = one.source.to_motion(
            metres_per_unit=options["metres_per_unit"], rate_hz=options["rate_hz"], up_axis=up_axis
        ).resample(float(shard.parameters["rate_hz"]))
        people.append(
            _Person(
                motion=place_motion(
                    motion, translation_m=options["translation_m"], yaw_rad=float(np.deg2rad(options["yaw_deg"]))
                ),
                layout=one.layout,
                source_name=options["source_name"],
                source_sha256=one.sha256,
                source_format=options["format"],
                source_rate_hz=options["rate_hz"],
                metres_per_unit=options["metres_per_unit"],
                up_axis=up_axis,
            )
        )
    return people


def _shifted(person: _Person, translation_m: tuple[float, float, float]) -> _Person:
    motion = place_motion(person.motion, translation_m=translation_m, yaw_rad=0.0)
    return _Person(**{**person.__dict__, "motion": motion})


def _takes(parameters: Any, people: list[_Person], poses: list[WorkingPoses], source: SourceCredit) -> dict[str, Any]:
    count = len(people)
    return {
        "take_id": [parameters["take_id"]] * count,
        "person": list(range(count)),
        "source_name": [person.source_name for person in people],
        "source_sha256": [person.source_sha256 for person in people],
        "source_format": [person.source_format for person in people],
        "num_persons": [count] * count,
        "num_frames": [person.motion.num_frames for person in people],
        "rate_hz": [float(parameters["rate_hz"])] * count,
        "source_rate_hz": [person.source_rate_hz for person in people],
        "metres_per_unit": [person.metres_per_unit for person in people],
        "up_axis": [person.up_axis for person in people],
        "layout": [person.layout.name for person in people],
        "is_position_only": [person.source_format == "positions_npz" for person in people],
        "is_held_out": [bool(parameters["is_held_out"])] * count,
        "joint_names": [list(person.motion.skeleton.joint_names) for person in people],
        "joint_parents": [np.array(person.motion.skeleton.parents, dtype=np.int32) for person in people],
        "rest_offset_m": [person.motion.rest_offsets_m.reshape(-1) for person in people],
        "body22_rest_m": np.stack([pose.body22_rest_m for pose in poses]),
        "licence": [source.licence] * count,
        "credit": [source.credit] * count,
    }


def _poses(take_id: str, rate_hz: float, people: list[_Person], poses: list[WorkingPoses]) -> dict[str, Any]:
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
