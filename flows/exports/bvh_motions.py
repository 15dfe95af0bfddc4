"""Motions as BVH, a file for each person; and pairs of one moment, as a study reads them back (`seeds.files`)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.export_format import Export, ExportFormat, names_pairs, write_text
from flows.exports.json_pairs import named_pairs
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.humanoid import humanoid_motion
from pasdedeux.formats.pair_file import write_pair_bvh
from pasdedeux.formats.positions_as_motion import exact_motion
from pasdedeux.kinematics import Motion
from pasdedeux.people.video import rate_from_times
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.reconstruction.body import body_from_joints
from pasdedeux.reconstruction.people import motions_together
from pasdedeux.skeletons import BODY22, Skeleton
from storage_schema import ArtifactRef, Reference, Store, TableData

_TABLES = ("poses", "variants", "motions")


class BvhMotions(ExportFormat):
    """Centimetres, degrees, Y up, at the true rate."""

    writes = f"whole {', '.join(_TABLES)}, seeds and single draws"

    def can_write(self, reference: Reference) -> bool:
        """Tell whether the reference names whole motions, or pairs."""
        return names_pairs(reference) or (reference.table in _TABLES and reference.row is None)

    def write(self, export: Export, out: Path) -> Iterable[Path]:
        """Write a file for each person."""
        if names_pairs(export.reference):
            return [
                write_text(out / f"{name}_{letter}.bvh", person)
                for name, pair in named_pairs(export)
                for letter, person in zip("AB", write_pair_bvh(pair.pair_m), strict=True)
            ]
        paths, names = [], Counter[str]()
        for name, motion in _motions(export):
            names[name] += 1  # take a_b, variant c and take a, variant b_c join to the same
            again = f".{names[name]}" if names[name] > 1 else ""
            paths.append(write_text(out / f"{name}{again}.bvh", write_bvh(motion)))
        return paths


FORMAT = BvhMotions()


def _motions(export: Export) -> Iterator[tuple[str, Motion]]:
    """Return the motions of one table by the name of their file."""
    store, table = export.store, export.reference.table
    for ref in export.refs:
        if table == "poses":
            yield from _pose_motions(store, ref)
            continue
        rows = store.read(ref, table)
        if table == "variants":
            for (take_id, variant_id), part in _groups(rows, "take_id", "variant_id"):
                for person, letter in enumerate("AB"):
                    positions = rows["body22_m"][part][:, person]
                    yield (
                        f"{take_id}_{variant_id}_{letter}",
                        exact_motion(BODY22, np.asarray(positions, dtype=float), _rate(rows["time_s"][part])),
                    )
            continue
        # From the axes of a camera that looks down to a world in which people stand upright.
        camera = OrthographicCamera(math.radians(store.manifest(ref).facts.get("pitch_deg", 0.0)))
        for (sequence_id, method), part in _groups(rows, "sequence_id", "method"):
            person_ids = np.unique(rows["person_id"][part])
            people = []
            for own in (part[rows["person_id"][part] == person_id] for person_id in person_ids):
                found = body_from_joints(rows["body22_m"][own], rows["body22_unitquat"][own])
                upright = found.turned(camera.camera_from_upright_rotmat.T)
                people.append((int(rows["frame"][own[0]]), upright, rows["is_bridged"][own]))
            rate_hz = rate_from_times(rows["frame"][part], rows["time_s"][part])
            for person_id, one in zip(person_ids, motions_together(people, rate_hz=rate_hz), strict=True):
                yield f"{sequence_id}_{person_id}_{method}", humanoid_motion(one.motion)


def _pose_motions(store: Store, ref: ArtifactRef) -> Iterator[tuple[str, Motion]]:
    """Return a take's motions on the skeleton they came with."""
    takes, poses = store.read(ref, "takes"), store.read(ref, "poses")
    for index in range(takes.num_rows):
        take = takes.row(index)
        part = np.array((poses["take_id"] == take["take_id"]) & (poses["person"] == take["person"]))
        skeleton = Skeleton(
            name=str(take["take_id"]),
            joint_names=tuple(take["joint_names"]),
            parents=tuple(map(int, take["joint_parents"])),
        )
        rotations = [values for values, is_wanted in zip(poses["local_unitquat"], part, strict=True) if is_wanted]
        motion = Motion(
            skeleton=skeleton,
            rest_offsets_m=np.asarray(take["rest_offset_m"], dtype=float).reshape(-1, 3),
            root_translation_m=np.asarray(poses["root_translation_m"][part], dtype=float),
            local_unitquat=np.asarray(np.stack(rotations), dtype=float).reshape(len(rotations), -1, 4),
            rate_hz=float(take["rate_hz"]),
        )
        yield f"{take['take_id']}_{take['person']}", motion


def _rate(time_s: Any) -> float:
    return (len(time_s) - 1) / float(time_s[-1] - time_s[0]) if len(time_s) > 1 else 1.0


def _groups(rows: TableData, *columns: str) -> Iterator[tuple[tuple[Any, ...], np.ndarray]]:
    """Return which rows (n,) have the same values in some columns, by these values, in the order they come."""
    places: dict[tuple[Any, ...], list[int]] = {}
    for place, key in enumerate(zip(*(rows[name] for name in columns), strict=True)):
        places.setdefault(key, []).append(place)
    for key, part in places.items():
        yield key, np.array(part)
