"""Takes rows out of the store as files of other people's formats, with licence and credits beside them."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flows.console.context import ExportFormat
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.pair_file import write_pair_bvh, write_pair_json
from pasdedeux.formats.positions_as_motion import exact_motion
from pasdedeux.kinematics import Motion
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton
from storage_schema import (
    TABLES,
    ArtifactRef,
    Column,
    Reference,
    Store,
    TableData,
    iter_rows,
    open_table,
    parse_reference,
    resolve,
)
from tasks.seeds.files import pair_of_draw, pairs_of_seeds

__all__ = ["export_reference"]

_SKELETONS = {"pair17": PAIR17, "op14": OP14, "body22": BODY22}
_BVH_TABLES = ("poses", "variants", "motions")


def export_reference(store: Store, text: str, file_format: ExportFormat, out: Path) -> list[Path]:
    """Write what a reference names into a folder; gives the files, the credits last.

    Raises:
        InputError: The table has no motion that BVH can hold.
        UnknownReference: The reference names nothing.
    """
    reference = parse_reference(text)
    refs = resolve(reference, store)
    is_pair = reference.table == "seeds" or (reference.table == "draws" and reference.row is not None)
    is_motion = reference.table in _BVH_TABLES and reference.row is None
    if file_format is ExportFormat.BVH and not (is_motion or is_pair):
        allowed = f"whole {', '.join(_BVH_TABLES)}, seeds and single draws"
        raise InputError(f"'{text}' cannot be written as BVH; allowed are {allowed}")
    if file_format is ExportFormat.JSON and not is_pair:
        raise InputError(f"'{text}' cannot be written as JSON; allowed are seeds and single draws (draws@key#row)")
    out.mkdir(parents=True, exist_ok=True)
    if is_pair and file_format in (ExportFormat.BVH, ExportFormat.JSON):
        written = _write_pairs(store, text, reference, file_format, out)
    elif file_format is ExportFormat.BVH:
        written = [_write(out / f"{name}.bvh", write_bvh(motion)) for name, motion in _motions(store, reference, refs)]
    elif file_format is ExportFormat.NPZ:
        written = [_write_npz(out / f"{reference.table}.npz", open_table(text, store))]
    else:
        written = [_write_csv(out / f"{reference.table}.csv", store, text)]
    return [*written, _write(out / "CREDITS.txt", _credits(store, text, refs))]


def _write_pairs(store: Store, text: str, reference: Reference, file_format: ExportFormat, out: Path) -> list[Path]:
    """Write pairs for editing, as a study reads them back (`seeds.files`): JSON for both people, or a BVH for each."""
    if reference.table == "seeds":
        pairs = [(f"seed{index}", pair) for index, pair in pairs_of_seeds(store, text)]
    else:
        draw = pair_of_draw(store, text)
        pairs = [(f"draw-{draw.key[:12]}-{draw.row}", draw.pair)]
    written = []
    for name, pair in pairs:
        if file_format is ExportFormat.JSON:
            written.append(_write(out / f"{name}.json", write_pair_json(pair)))
        else:
            for letter, person in zip("AB", write_pair_bvh(pair.pair_m), strict=True):
                written.append(_write(out / f"{name}_{letter}.bvh", person))
    return written


def _motions(store: Store, reference: Reference, refs: list[ArtifactRef]) -> Iterator[tuple[str, Motion]]:
    """Return the motions of one table by the name of their file."""
    for ref in refs:
        if reference.table == "poses":
            yield from _pose_motions(store, ref)
        else:
            rows = store.read(ref, reference.table)
            if reference.table == "variants":
                for take, variant in _groups(rows, "take_id", "variant_id"):
                    part = np.array((rows["take_id"] == take) & (rows["variant_id"] == variant))
                    for person, letter in enumerate("AB"):
                        positions = rows["body22_m"][part][:, person]
                        yield f"{take}_{variant}_{letter}", _from_positions(BODY22, positions, rows["time_s"][part])
            else:
                camera = OrthographicCamera(math.radians(store.manifest(ref).facts.get("pitch_deg", 0.0)))
                for sequence, person, method in _groups(rows, "sequence_id", "person_id", "method"):
                    part = np.array(
                        (rows["sequence_id"] == sequence) & (rows["person_id"] == person) & (rows["method"] == method)
                    )
                    name = f"{sequence}_{person}_{method}"
                    # From the axes of a camera that looks down to a world in which people stand upright.
                    upright_m = rows["op14_m"][part] @ camera.camera_from_upright_rotmat
                    yield name, _from_positions(OP14, upright_m, rows["time_s"][part])


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


def _from_positions(skeleton: Skeleton, positions_m: Any, time_s: Any) -> Motion:
    rate_hz = (len(time_s) - 1) / float(time_s[-1] - time_s[0]) if len(time_s) > 1 else 1.0
    return exact_motion(skeleton, np.asarray(positions_m, dtype=float), rate_hz)


def _groups(rows: TableData, *columns: str) -> list[tuple[Any, ...]]:
    """Return the distinct values of some columns, in the order in which they come."""
    return list(dict.fromkeys(zip(*(rows[name].tolist() for name in columns), strict=True)))


def _write_npz(path: Path, rows: TableData) -> Path:
    """Write every column as an array; one of varying length as its values end to end and the rows' offsets."""
    arrays: dict[str, Any] = {}
    for name in rows.column_names:
        values = rows[name]
        if isinstance(values, list):
            lengths = [len(value) for value in values]
            parts = [np.asarray(value) for value in values if len(value)]
            arrays[name] = np.concatenate(parts) if parts else np.empty(0)
            arrays[f"{name}_offsets"] = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64)
        elif values.dtype == object:
            arrays[name] = np.array(["" if value is None else value for value in values], dtype=np.str_)
        else:
            arrays[name] = values
    np.savez_compressed(path, **arrays)
    return path


def _write_csv(path: Path, store: Store, text: str) -> Path:
    """Write a line per row; a fixed array takes a column per number, named by its axes, a varying one is JSON."""
    columns = TABLES[parse_reference(text).table].columns
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name for column in columns for name in _csv_names(column)])
        for batch in iter_rows(text, store):
            cells = [_csv_cells(column, batch) for column in columns]
            for index in range(batch.num_rows):
                writer.writerow([cell for column in cells for cell in column[index]])
    return path


def _csv_names(column: Column) -> list[str]:
    names = [column.name]
    for axis, length in zip(column.axes, column.shape, strict=True):
        if axis == "joint" and column.joints in _SKELETONS:
            labels: tuple[str, ...] = _SKELETONS[column.joints].joint_names
        elif len(axis) == length:
            labels = tuple(axis)
        else:
            labels = tuple(map(str, range(length)))
        names = [f"{name}.{label}" for name in names for label in labels]
    return names


def _csv_cells(column: Column, batch: TableData) -> list[list[Any]]:
    values = batch[column.name]
    if isinstance(values, list):
        return [[json.dumps(np.asarray(value).tolist())] for value in values]
    if column.shape:
        return values.reshape(batch.num_rows, -1).tolist()
    return [[value] for value in values.tolist()]


def _credits(store: Store, text: str, refs: list[ArtifactRef]) -> str:
    """Return the licence and credit lines of every source, as text to keep with the files."""
    sources = sorted({source for ref in refs for source in store.manifest(ref).sources}, key=lambda s: s.name)
    lines = [f"Exported from {text} by pasdedeux.", "", "Sources, their licences and credits:", ""]
    lines.extend(f"{source.name}\n  licence: {source.licence}\n  credit:  {source.credit}\n" for source in sources)
    lines.append("Artifacts (stage, key, content digest):")
    lines.extend(f"  {ref.stage} {ref.key} {ref.content_digest}" for ref in refs)
    return "\n".join(lines) + "\n"


def _write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path
