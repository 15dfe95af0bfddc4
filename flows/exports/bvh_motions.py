"""Motions as BVH, a file for each person; and pairs of one moment, as a study reads them back (`seeds.files`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.export_format import Export, ExportFormat, FileNames, names_pairs, write_text
from flows.exports.json_pairs import named_pairs
from flows.exports.own_skeletons import RigFiles, people_of_take, take_of
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.humanoid import humanoid_motion
from pasdedeux.formats.pair_file import write_pair_bvh
from pasdedeux.kinematics import Motion
from pasdedeux.people.video import rate_from_times
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.reconstruction.body import body_from_joints
from pasdedeux.reconstruction.people import motions_together
from storage_schema import ArtifactRef, Reference, TableData
from tasks.facts import MotionFacts

_TABLES = ("poses", "variants", "motions")


def _can_write(reference: Reference) -> bool:
    return names_pairs(reference) or (reference.table in _TABLES and reference.row is None)


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each person, of takes and variants an npz too: degrees, Y up, at the true rate, centimetres."""
    names = FileNames(out)
    if names_pairs(export.reference):
        return [
            write_text(names.path(name, letter, suffix=".bvh"), person)
            for name, pair in named_pairs(export)
            for letter, person in zip("AB", write_pair_bvh(pair.pair_m), strict=True)
        ]
    if export.reference.table == "motions":
        return [write_text(names.path(*parts, suffix=".bvh"), write_bvh(motion)) for parts, motion in _motions(export)]
    files = RigFiles(out, rest_pose=export.rest_pose, units=export.units)
    for ref in export.refs:
        if export.reference.table == "poses":
            for person in (one for one in people_of_take(export.store, ref) if one.take_id not in export.left_out):
                files.write((person.take_id, person.letter), person, person.own)
        else:
            _write_variants(export, ref, files)
    return files.close()


FORMAT = ExportFormat(_write, _can_write, f"whole {', '.join(_TABLES)}, seeds and single draws", has_rest_pose=True)


def _write_variants(export: Export, ref: ArtifactRef, files: RigFiles) -> None:
    """Write the variants of one artifact but those that somebody rejected."""
    store = export.store
    people = people_of_take(store, take_of(store, ref))
    quality = store.read(ref, "variant_quality", columns=["take_id", "variant_id", "bone_scale"])
    rows = store.read(ref, "variants", columns=["take_id", "variant_id", "person", "body22_m"])
    scales = {key: quality["bone_scale"][part[0]] for key, part in _groups(quality, "take_id", "variant_id")}
    for (take_id, variant_id), part in _groups(rows, "take_id", "variant_id"):
        if f"{take_id}/{variant_id}" in export.left_out:
            continue
        each = [rows["body22_m"][part[rows["person"][part] == person]] for person in range(len(people))]
        scale = scales[take_id, variant_id].reshape(len(people), -1)
        files.write_variant(variant_id, people, np.stack(each, axis=1).astype(np.float64), scale)


def _motions(export: Export) -> Iterator[tuple[tuple[str | int, ...], Motion]]:
    """Return reconstructed motions by the parts of their file's name."""
    for ref in export.refs:
        rows = export.store.read(ref, "motions")
        # From the axes of a camera that looks down to a world in which people stand upright.
        pitch_deg = MotionFacts.of(export.store.manifest(ref)).pitch_deg
        camera = DatabaseCamera(math.radians(pitch_deg))
        for (sequence_id, method), part in _groups(rows, "sequence_id", "method"):
            if f"{sequence_id}/{method}" in export.left_out:
                continue
            person_ids = np.unique(rows["person_id"][part])
            people = []
            for own in (part[rows["person_id"][part] == person_id] for person_id in person_ids):
                found = body_from_joints(rows["body22_m"][own], rows["body22_unitquat"][own])
                upright = found.turned(camera.camera_from_upright_rotmat.T)
                people.append((int(rows["frame"][own[0]]), upright, rows["is_bridged"][own]))
            rate_hz = rate_from_times(rows["frame"][part], rows["time_s"][part])
            for person_id, one in zip(person_ids, motions_together(people, rate_hz=rate_hz), strict=True):
                yield (sequence_id, int(person_id), method), humanoid_motion(one.motion)


def _groups(rows: TableData, *columns: str) -> Iterator[tuple[tuple[Any, ...], np.ndarray]]:
    """Return which rows (n,) have the same values in some columns, by these values, in the order they come."""
    places: dict[tuple[Any, ...], list[int]] = {}
    for place, key in enumerate(zip(*(rows[name] for name in columns), strict=True)):
        places.setdefault(key, []).append(place)
    for key, part in places.items():
        yield key, np.array(part)
