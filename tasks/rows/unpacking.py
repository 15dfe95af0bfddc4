"""Takes and variants of a store, or of a dataset's folder (`docs/datasets.md`), unpacked for windows to train on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pasdedeux.augmentation import scaled_rest, variant_rotations
from pasdedeux.errors import InputError
from pasdedeux.people.names import person_names
from pasdedeux.skeletons import BODY22
from storage_schema import ArtifactRef, Manifest, Store, canonical_json
from storage_schema.parquet_files import groups_with
from storage_schema.unpacked import CONTACT, ClipWriter, UnpackedClips, unpacked
from tasks.rows.contacts import find_contact_rows
from tasks.rows.takes import read_take, take_of
from tasks.stage.facts import TakeFacts
from tasks.training.items import interaction_of

J = BODY22.num_joints
_VERSION = 1
"""Version of unpacked files: if it changes, they are unpacked anew."""
_MANIFEST = "manifest.json"
_CONTACT_COLUMNS = ("take_id", "frame", "person", "bone", "partner", "partner_bone", "weight")
Array = npt.NDArray[Any]


def unpack_artifacts(store: Store, refs: Sequence[ArtifactRef]) -> UnpackedClips:
    """Return takes, or the takes of batches of variants with these, unpacked: failed and rejected ones, too."""
    manifests = [store.manifest(ref) for ref in refs]
    batches = {ref: store.manifest(take_of(store, ref)) for ref in refs if "variants" in store.manifest(ref).tables}
    takes = [manifest for manifest in manifests if "poses" in manifest.tables] + list(batches.values())
    contents = [[manifest.ref.content_digest, interaction_of(manifest)] for manifest in takes]
    digest = hashlib.sha256(canonical_json([_VERSION, contents, [ref.content_digest for ref in batches]])).hexdigest()

    def write(writer: ClipWriter) -> None:
        known: dict[ArtifactRef, tuple[dict[str, Any], Array]] = {}
        for take in takes:
            if take.ref not in known:
                known[take.ref] = _write_stored_take(store, take, writer)
        for ref, take in batches.items():
            _write_stored_variants(store, ref, *known[take.ref], writer)

    return unpacked(digest, write)


def unpack_folder(folder: Path) -> UnpackedClips:
    """Return the takes and variants of a dataset's folder unpacked.

    Raises:
        InputError: There is no such folder, or it is not whole.
    """
    if not (folder / _MANIFEST).is_file():
        raise InputError(f"{folder} is no folder that `pasdedeux dataset write` finished: it has no {_MANIFEST}")
    digest = hashlib.sha256(canonical_json(_VERSION) + (folder / _MANIFEST).read_bytes()).hexdigest()
    return unpacked(digest, lambda writer: _write_folder(folder, writer))


def _write_take(
    writer: ClipWriter, said: Mapping[str, Any], positions_m: Array, world: Array, rest_m: Array, first_frame: int
) -> dict[str, Any]:
    """Write a take (T, P, 22, 3), its world rotations and rest poses; return the columns shared with its variants."""
    scales = np.ones(rest_m.shape[:2])
    rotations = variant_rotations(rest_m, scales, positions_m.astype(np.float64), world.astype(np.float64))
    first, is_whole = _write_rows(writer, positions_m.reshape(-1, J, 3), rotations.reshape(-1, J, 4))
    frames, people = positions_m.shape[:2]
    shared = {**said, "num_frames": frames, "num_people": people, "first_source": first, "first_frame": first_frame}
    clip_columns = {"name": said["take_id"], "is_variant": False, "is_whole": is_whole, "first_row": first}
    writer.add_clip(**shared, **clip_columns, first_person=_write_people(writer, scales, rest_m))
    return shared


def _write_rows(writer: ClipWriter, positions_m: Array, unitquats: Array) -> tuple[int, bool]:
    """Write rows of frames and people; returns the number of the first, and whether all joints are there (finite)."""
    is_there = np.asarray(np.isfinite(positions_m).all(axis=-1))
    is_known = np.asarray(np.isfinite(unitquats).all(axis=-1))
    writer.append("mask", is_there)
    writer.append("rotations", np.where((is_there & is_known)[..., None], unitquats, 0.0))
    return writer.append("positions", np.where(is_there[..., None], positions_m, 0.0)), bool(is_there.all())


def _write_people(writer: ClipWriter, scales: Array, rest_m: Array) -> int:
    return writer.append("people", np.concatenate([scales[..., None], rest_m], axis=-1))


def _write_contacts(writer: ClipWriter, person: Array, bone: Array, frame: Array, weight: Array, frames: int) -> int:
    """Write the contacts of two people in a take; of several between the same bones, the one of greatest weight.

    Args:
        writer: Where to.
        person: Person of both points (n, 2); -1 for an object.
        bone: Their bones (n, 2).
        frame: Frames (n,).
        weight: Weights (n,).
        frames: Frames of the take.

    Returns:
        The row of `first_contacts` of the first frame.
    """
    order = np.argsort(person, axis=1)
    person, bone = (np.take_along_axis(giver, order, axis=1) for giver in (person, bone))
    is_between = (person[:, 0] >= 0) & (person[:, 0] < person[:, 1])
    rows = np.zeros(int(is_between.sum()), CONTACT)
    (giver, other), (a, b) = person[is_between].T, bone[is_between].T
    rows["frame"], rows["pair"], rows["bones"] = frame[is_between], other * (other - 1) // 2 + giver, a * J + b
    rows["weight"] = weight[is_between]
    rows.sort(order=["frame", "pair", "bones", "weight"])
    places = rows[["frame", "pair", "bones"]]
    rows = rows[np.append(places[1:] != places[:-1], True)[: len(rows)]]
    first = writer.append("contacts", rows)
    return writer.append("first_contacts", first + np.searchsorted(rows["frame"], np.arange(frames + 1)))


def _write_stored_take(store: Store, take: Manifest, writer: ClipWriter) -> tuple[dict[str, Any], Array]:
    facts, motion = TakeFacts.of(take), read_take(store, take.ref)
    positions_m = motion.source.positions_m
    rows = find_contact_rows(store, take.ref, positions_m, facts.take_id)
    said = {
        "take_id": facts.take_id,
        "interaction": interaction_of(take),
        "is_held_out": facts.is_held_out,
        "rate_hz": facts.rate_hz,
        "split": "",
        "verdict": "pass",  # those that fail have no poses
    }
    first = _write_contacts(writer, rows.person, rows.bone, rows.frame, rows.weight, len(positions_m))
    return _write_take(writer, said, positions_m, motion.world_unitquat, motion.rest_m, first), motion.rest_m


def _write_stored_variants(
    store: Store, ref: ArtifactRef, of_take: Mapping[str, Any], rest_m: Array, writer: ClipWriter
) -> None:
    quality = store.read(ref, "variant_quality", columns=["variant_id", "bone_scale", "verdict"])
    size, first, num_rows, is_whole = of_take["num_frames"] * of_take["num_people"], 0, 0, True
    for rows in store.iter_batches(ref, "variants", columns=["body22_m", "body22_unitquat"]):
        row, has_all = _write_rows(writer, rows["body22_m"], rows["body22_unitquat"])
        first, is_whole = row if not num_rows else first, is_whole and has_all
        num_rows += rows.num_rows
    if num_rows != size * len(quality):
        raise InputError(
            f"the variants of take {of_take['take_id']} do not have its {of_take['num_frames']} frames; "
            "build them again with --force"
        )
    for at, (variant_id, verdict) in enumerate(zip(quality["variant_id"], quality["verdict"], strict=True)):
        scales = quality["bone_scale"][at].reshape(-1, J)
        person = _write_people(writer, scales, scaled_rest(rest_m, scales))
        clip_columns = {"name": f"{of_take['take_id']}, {variant_id}", "is_variant": True, "is_whole": is_whole}
        place = {"first_row": first + at * size, "first_person": person}
        writer.add_clip(**{**of_take, **clip_columns, **place, "verdict": str(verdict)})


def _write_folder(folder: Path, writer: ClipWriter) -> None:
    files = sorted((folder / "data" / "clips").glob("*.parquet"))
    of_takes = _clips_of(files, ["take_id", "variant_id", "num_frames"], are_variants=False)
    contacts = _write_folder_contacts(folder, {clip["take_id"]: clip["num_frames"] for clip in of_takes}, writer)
    takes, motions = dict[str, dict[str, Any]](), _RowGroups(folder)
    for clip in _clips_of(files, are_variants=False):
        positions_m, world = motions.read(clip, "body22_world_unitquat")
        rest_m = np.array(clip["rest_m"], dtype=np.float64).reshape(-1, J, 3)
        said = {name: clip[name] for name in ("take_id", "rate_hz", "split", "verdict")}
        said |= {"interaction": clip["take_id"], "is_held_out": clip["split"] == "test"}
        shape = (clip["num_frames"], clip["num_people"], J, -1)
        first = contacts[clip["take_id"]]
        takes[clip["take_id"]] = _write_take(
            writer, said, positions_m.reshape(shape), world.reshape(shape), rest_m, first
        )
    for clip in _clips_of(files, are_variants=True):
        first, is_whole = _write_rows(writer, *motions.read(clip, "body22_unitquat"))
        scales, rest_m = (
            np.array(clip[name]).reshape(-1, J, size) for name, size in (("bone_scale", 1), ("rest_m", 3))
        )
        clip_columns = {"name": f"{clip['take_id']}, {clip['variant_id']}", "is_variant": True, "is_whole": is_whole}
        place = {"first_row": first, "first_person": _write_people(writer, scales[..., 0], rest_m)}
        writer.add_clip(**{**takes[clip["take_id"]], **clip_columns, **place, "verdict": clip["verdict"]})


class _RowGroups:
    """The motions of the clips of a folder, with one file open at a time."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._name = folder, ""

    def read(self, clip: Mapping[str, Any], rotations: str) -> tuple[Array, Array]:
        """Return positions (frame x person, 22, 3) and rotations (frame x person, 22, 4), frame by frame."""
        if self._name != clip["file"]:
            self._name, self._file = clip["file"], pq.ParquetFile(self._folder / clip["file"])
        columns = ["frame", "person", "body22_m", rotations]
        rows = self._file.read_row_group(clip["row_group"], columns=columns, use_threads=False)
        order = np.lexsort((rows["person"].to_numpy(), rows["frame"].to_numpy()))
        positions_m, unitquats = (_values(rows[name])[order] for name in columns[2:])
        return positions_m, unitquats


def _write_folder_contacts(folder: Path, frames: Mapping[str, int], writer: ClipWriter) -> dict[str, int]:
    """Write the contacts of takes of so many frames; returns the row of `first_contacts` of each."""
    person_numbers, names = dict[str, int](), pa.array(person_names(64))
    bones = pa.array(BODY22.joint_names)
    for take_id, rows in _contacts_by_take(sorted((folder / "data" / "contacts").glob("*.parquet"))):
        who, where = (
            np.stack([pc.index_in(rows[name], known).fill_null(-1).to_numpy() for name in columns], axis=1)
            for columns, known in ((("person", "partner"), names), (("bone", "partner_bone"), bones))
        )
        frame, weight = rows["frame"].to_numpy(), rows["weight"].to_numpy()
        person_numbers[take_id] = _write_contacts(writer, who, where, frame, weight, frames[take_id])
    none = np.zeros((0, 2), dtype=np.int64)
    for take_id in sorted(frames.keys() - person_numbers.keys()):
        person_numbers[take_id] = _write_contacts(writer, none, none, none[:, 0], none[:, 0], frames[take_id])
    return person_numbers


def _contacts_by_take(files: Sequence[Path]) -> Iterator[tuple[str, pa.Table]]:
    """Yield the contacts of each take, whose rows follow each other; those of one take are in memory."""
    held: list[pa.Table] = []
    for path in files:
        file = pq.ParquetFile(path)
        takes = groups_with(file, {"origin": "poses"})
        for group in file.iter_batches(columns=list(_CONTACT_COLUMNS), row_groups=takes):
            rows = pa.Table.from_batches([group])
            ends = np.flatnonzero(pc.not_equal(rows["take_id"][1:], rows["take_id"][:-1]).to_numpy()) + 1
            for start, stop in zip([0, *ends.tolist()], [*ends.tolist(), rows.num_rows], strict=True):
                part = rows.slice(start, stop - start)
                if held and held[0]["take_id"][0] != part["take_id"][0]:
                    yield held[0]["take_id"][0].as_py(), pa.concat_tables(held)
                    held = []
                held.append(part)
    if held:
        yield held[0]["take_id"][0].as_py(), pa.concat_tables(held)


def _clips_of(
    files: Sequence[Path], columns: list[str] | None = None, *, are_variants: bool
) -> Iterator[dict[str, Any]]:
    """Yield the rows of takes or of variants of the table `clips`."""
    for path in files:
        for batch in pq.ParquetFile(path).iter_batches(batch_size=1_000, columns=columns):
            is_take = pc.is_null(batch["variant_id"])
            yield from batch.filter(pc.invert(is_take) if are_variants else is_take).to_pylist()


def _values(column: pa.ChunkedArray) -> Array:
    """Return an array column (n, joint, axis)."""
    return column.combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(len(column), J, -1)
