"""Writes a dataset's folder: Parquet files, each complete or absent, their description, and the manifest last.

Files are written to `.NAME.part` beside the folder, which replaces the folder in one step. An interrupted call leaves
complete files there, and the same command continues. An update links the files that stay.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from flows.dataset_folder.contents import Contents, RowGroup, cut_row_groups, find_contents
from flows.dataset_folder.describing import write_description
from flows.dataset_folder.layout import MANIFEST, FolderFile, FolderManifest, PartKey, read_manifest, read_sides
from flows.dataset_folder.statistics import contact_figures, figures_of_motions
from flows.machine import usable_cores
from flows.planning import PlanError
from pasdedeux.augmentation import Source, UserContact, scaled_rest
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import TABLES, ArtifactRef, Dataset, Manifest, Store, canonical_json
from storage_schema.durable import exchange_folders, locked_file, make_folder, sync_folder, write_errors, write_file
from storage_schema.encoding import encode, with_columns
from storage_schema.keys import file_sha256
from storage_schema.parquet_files import TableWriter, iter_table
from storage_schema.table_data import TableData
from storage_schema.version import SCHEMA_VERSION
from tasks.augmentation import batch_of
from tasks.rows.contacts import ContactRows
from tasks.rows.sides import SPLITS
from tasks.rows.takes import read_rest, read_take, take_of
from tasks.stage.facts import PeopleFacts, TakeFacts
from tasks.stage.judgements import verdict_of

FILE_BYTES = 100_000_000
"""Approximate size of a data file: it ends with the row group that reaches this."""
_CONTACT_BYTES = 400
"""Approximate size of the contacts of a person in a frame."""
_MOTIONS = ("poses", "variants")
_PART = ".part"


@dataclass(frozen=True)
class DataFile:
    """A data file: its name, its row groups, and its previous name if the folder has it already."""

    name: str
    groups: tuple[RowGroup, ...]
    before: str = ""

    @property
    def table(self) -> str:
        """Return its table."""
        return self.groups[0].table


@dataclass(frozen=True)
class Written:
    """A written folder: its manifest, the names of new files, and sentences on omitted data."""

    manifest: FolderManifest
    new: tuple[str, ...]
    left_out: tuple[str, ...]


def write_folder(
    store: Store, dataset: Dataset, out: Path, *, since: str = "", withheld: Collection[str] = ()
) -> Written:
    """Write a version of a dataset as a folder, or update a folder with another version.

    Args:
        store: The store.
        dataset: The version.
        out: The folder: missing, empty, or with the version `since`, which is replaced.
        since: Version in the folder, `name@version`; its data files stay if all their rows do.
        withheld: Names of sources to leave out.

    Raises:
        PlanError: The folder has other contents, or nothing may be shared.
        MissingArtifact, CorruptArtifact: An artifact or a file is not complete in the store or the folder.
        FullDisk: There is no room left.
    """
    out = out.absolute()
    part, aside = out.with_name(f".{out.name}{_PART}"), out.with_name(f".{out.name}.old")
    if aside.is_dir() and not out.exists():
        aside.rename(out)
    there = read_manifest(out)
    if since and there is None:
        raise PlanError(f"{out} has no dataset to update; leave out --since")
    if there is not None and there.label not in (since, dataset.label):
        raise PlanError(f"{out} has {there.label}; `--since {there.label}` updates it, --out names another folder")
    if there is None and out.is_dir() and any(out.iterdir()):
        raise PlanError(f"{out} is not empty and no folder of a dataset; --out names another one")
    staying = set(withheld) | {source.name for source in dataset.sources if there and source.name in there.withheld}
    with _alone(out), write_errors(out.parent):
        contents = find_contents(store, dataset, withheld=staying, known=read_sides(out) if there else None)
        if there is not None and (there.label, there.digest) == (dataset.label, contents.dataset.digest):
            _clear(part, out)
            return Written(there, (), contents.left_out)
        if there is not None and there.label == dataset.label:
            raise PlanError(f"{out} has another {there.label}, which never changes; --out names another folder")
        files = plan_files(contents, there)
        manifest = fill_folder(store, contents, files, part, kept=out if there else None, withheld=sorted(staying))
        for begun in part.glob(f"*{_PART}"):
            begun.unlink()
        if not out.exists():
            part.rename(out)
        elif not exchange_folders(part, out):
            out.rename(aside)
            part.rename(out)
            aside.rename(part)
        sync_folder(out.parent)
        _clear(part, out)
    return Written(manifest, tuple(file.name for file in files if not file.before), contents.left_out)


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Lock this folder against other writers in a block."""
    with locked_file(out, fcntl.LOCK_EX):
        try:
            yield
        finally:
            out.with_name(f".{out.name}.lock").unlink(missing_ok=True)


def plan_files(contents: Contents, before: FolderManifest | None) -> list[DataFile]:
    """Divide row groups into files: earlier files whose groups all remain, then new ones of 100 MB."""
    places = defaultdict[tuple[str, str], dict[PartKey, RowGroup]](dict)
    for group in contents.groups:
        places[group.table, group.split][key_of(group)] = group
        if group.table in _MOTIONS:
            num_bytes = _CONTACT_BYTES * group.num_rows
            rows = () if group.table == "poses" else group.rows
            contacts = RowGroup("contacts", group.split, group.ref, rows, num_bytes, group.clip)
            places["contacts", group.split][key_of(contacts)] = contacts
    files = []
    for (table, split), in_table in sorted(places.items()):
        groups = in_table
        if table == "contacts":  # a take, then its variants, which share its contacts
            order = sorted(groups.values(), key=lambda group: (group.clip.partition("/")[0], "/" in group.clip))
            groups = {key_of(group): group for group in order}
        start = f"data/{table}/{split}-"
        kept = [
            (name, file.parts)
            for name, file in (before.files if before else {}).items()
            if name.startswith(start) and groups.keys() >= set(file.parts)
        ]
        parts = [(name, [groups.pop(key) for key in keys]) for name, keys in kept]
        for group in groups.values():
            if not parts or parts[-1][0] or sum(other.num_bytes for other in parts[-1][1]) >= FILE_BYTES:
                parts.append(("", []))
            parts[-1][1].append(group)
        files += [
            DataFile(f"{start}{number:05}-of-{len(parts):05}.parquet", tuple(in_file), name)
            for number, (name, in_file) in enumerate(parts)
        ]
    return files


def key_of(group: RowGroup) -> PartKey:
    """Return the origin of a row group."""
    return group.ref.stage, group.ref.content_digest, group.rows


def fill_folder(
    store: Store,
    contents: Contents,
    files: Sequence[DataFile],
    part: Path,
    *,
    kept: Path | None = None,
    withheld: Sequence[str] = (),
) -> FolderManifest:
    """Fill a folder with a dataset, the manifest last; complete files of an interrupted call stay.

    Args:
        store: The store.
        contents: The contents.
        files: The data files.
        part: The folder.
        kept: Folder with the existing files, by their names `before`; None to write them, too.
        withheld: Names of sources that are left out, for the record.
    """
    plan = [contents.dataset.label, contents.dataset.digest, SCHEMA_VERSION]
    plan += [[file.name, file.before, [key_of(group) for group in file.groups]] for file in files]
    digest = hashlib.sha256(canonical_json(plan)).hexdigest()
    begun = part / f"{digest}{_PART}"
    if not begun.is_file():
        shutil.rmtree(part, ignore_errors=True)
        make_folder(part)
        write_file(begun, b"")
    if (done := read_manifest(part)) is not None:
        return done
    for path in [*part.iterdir(), part / "data" / "clips"]:  # everything but complete data files is written again
        if path.is_dir() and path.name != "data":
            shutil.rmtree(path)
        elif path.is_file() and path != begun:
            path.unlink()

    def write(file: DataFile) -> str:
        path = part / file.name
        if not path.is_file():
            make_folder(path.parent)
            if file.before and kept is not None:
                try:
                    os.link(kept / file.before, path)
                except OSError:  # no links here, or another file system
                    _copy(kept / file.before, path)
            else:
                _write_whole(path, file, store)
        return file_sha256(path)

    with ThreadPoolExecutor(usable_cores()) as pool:
        digests = dict(zip([file.name for file in files], pool.map(write, files), strict=True))
    described = {
        file.name: FolderFile(
            (part / file.name).stat().st_size,
            digests[file.name],
            pq.read_metadata(part / file.name).num_rows,
            tuple(key_of(group) for group in file.groups),
        )
        for file in files
    }
    described |= _write_clips(store, contents, files, part)
    stats = _statistics(contents, files, part)
    write_description(store, contents, described, stats, part)
    others = (path for path in sorted(part.rglob("*")) if path.is_file() and path != begun)
    named = {str(path.relative_to(part)): path for path in others}
    plain = {name: FolderFile(path.stat().st_size, file_sha256(path)) for name, path in named.items()}
    dataset = contents.dataset
    done = FolderManifest(
        dataset.name, dataset.version, dataset.digest, tuple(withheld), dict(sorted((plain | described).items()))
    )
    for folder in {path.parent for path in named.values()}:
        sync_folder(folder)
    write_file(part / f".{MANIFEST}", done.to_json())
    (part / f".{MANIFEST}").replace(part / MANIFEST)
    return done


def _write_whole(path: Path, file: DataFile, store: Store) -> None:
    """Write a data file, which gets its name when it is complete."""
    growing = path.with_name(f".{path.name}")
    growing.unlink(missing_ok=True)
    writer = TableWriter(growing, TABLES[file.table])
    try:
        for ref, of_artifact in groupby(file.groups, key=lambda group: group.ref):
            groups = list(of_artifact)
            if file.table == "contacts":
                for rows in _contacts_of(store, ref, groups):
                    if rows.num_rows:  # some readers stop at a row group without rows
                        writer.write_group(rows)
                continue
            batches = (batch.rows for batch in store.iter_batches(ref, file.table))
            for rows in cut_row_groups(batches, groups):
                writer.write_group(rows)
        writer.finish()
    except BaseException:
        writer.abandon()
        raise
    growing.replace(path)
    sync_folder(path.parent)


def _contacts_of(store: Store, ref: ArtifactRef, groups: Sequence[RowGroup]) -> Iterator[Any]:
    """Yield the contacts of a take as rows, or for each variant those of its take, measured in the variant."""
    manifest = store.manifest(ref)
    if "variants" not in manifest.tables:
        yield _found_in(store, ref, TakeFacts.of(manifest).contacts)[2]
        return
    source, contact_rows, known = _found_in(store, take_of(store, ref), batch_of(manifest).contacts)
    count, table = len(contact_rows.frame), TABLES["variants"]
    batches = (batch.rows for batch in store.iter_batches(ref, "variants", columns=["body22_m"]))
    for group, part in zip(groups, cut_row_groups(batches, groups), strict=True):
        positions_m = TableData(table, part)["body22_m"].reshape(source.positions_m.shape)
        held = contact_rows.held_in(replace(source, positions_m=positions_m))
        columns: dict[str, Any] = {"origin": ["variants"] * count, "variant_id": [group.clip.partition("/")[2]] * count}
        columns |= {"distance_m": held.distance_m}
        columns |= {"point_m": held.points_m[:, 0], "partner_point_m": held.points_m[:, 1], "gap_m": held.gap_m}
        yield with_columns(TABLES["contacts"], known, columns)


@lru_cache(maxsize=4)
def _found_in(store: Store, take: ArtifactRef, stated: tuple[UserContact, ...]) -> tuple[Source, ContactRows, Any]:
    """Return a take, its contacts, and these as rows; cached, because batches of variants of one take follow it."""
    facts, source = TakeFacts.of(store.manifest(take)), read_take(store, take).source
    contact_rows = ContactRows.of(source, stated)
    count = len(contact_rows.frame)
    rows = {
        "origin": ["poses"] * count,
        "take_id": [facts.take_id] * count,
        "time_s": contact_rows.frame / facts.rate_hz,
    }
    return source, contact_rows, encode(TABLES["contacts"], rows | contact_rows.columns())


def _write_clips(store: Store, contents: Contents, files: Sequence[DataFile], part: Path) -> dict[str, FolderFile]:
    """Write the table of clips, and return its files."""
    manifests = {manifest.ref: manifest for manifest in contents.manifests}
    rates = {take: len(np.unique(frames)) for take, frames, _ in _held_contacts(files, part)}
    rows: dict[str, list[dict[str, Any]]] = {}
    for file in files:
        numbered = groupby(enumerate(file.groups), key=lambda item: item[1].ref) if file.table in _MOTIONS else ()
        for ref, groups in numbered:
            facts, bodies = PeopleFacts.of(manifests[ref]), _bodies_of(store, manifests[ref])
            for number, group in groups:
                row: dict[str, Any] = {
                    "clip_id": group.clip,
                    "split": group.split,
                    "file": file.name,
                    "row_group": number,
                }
                row |= {"num_frames": facts.num_frames, "num_people": facts.num_persons, "rate_hz": facts.rate_hz}
                row |= bodies[group.clip]
                row["contact_rate"] = rates.get(row["take_id"], 0) / max(facts.num_frames, 1)
                rows.setdefault(group.split, []).append(row)
    described = {}
    for split, in_split in rows.items():
        in_split.sort(key=lambda row: (row["take_id"], row["variant_id"] or ""))
        name = f"data/clips/{split}-00000-of-00001.parquet"
        make_folder((part / name).parent)
        writer = TableWriter(part / name, TABLES["clips"])
        writer.append({column: [row[column] for row in in_split] for column in in_split[0]})
        table = writer.finish()
        described[name] = FolderFile(table.bytes, table.sha256, table.rows)
    return described


def _bodies_of(store: Store, manifest: Manifest) -> dict[str, dict[str, Any]]:
    """Return take, variant, bone lengths and verdict of each clip of an artifact."""
    if "variants" not in manifest.tables:
        take_id, rest, verdict = TakeFacts.of(manifest).take_id, read_rest(store, manifest.ref), verdict_of(manifest)
        said = (Level.NOT_JUDGED.value, "") if verdict is None else (verdict.level.value, verdict.reason)
        scales = [(take_id, None, np.ones(rest.shape[:2]), *said)]
    else:
        rest = read_rest(store, take_of(store, manifest.ref))
        quality = store.read(manifest.ref, "variant_quality")
        columns = (quality[name] for name in ("take_id", "variant_id", "bone_scale", "verdict", "reason"))
        scales = list(zip(*columns, strict=True))
    return {
        "/".join(filter(None, (take_id, variant_id))): {
            "take_id": take_id,
            "variant_id": variant_id,
            "verdict": verdict,
            "reason": reason,
            "bone_scale": np.ravel(scale),
            "rest_m": scaled_rest(rest, np.reshape(scale, rest.shape[:2])).ravel(),
        }
        for take_id, variant_id, scale, verdict, reason in scales
    }


def _held_contacts(files: Sequence[DataFile], part: Path) -> Iterator[tuple[str, Any, Any]]:
    """Yield for each take the frames with contacts and the bones of body22 in contact (n,), of both sides."""
    names = {name: at for at, name in enumerate(BODY22.joint_names)}
    for file in files:
        takes = iter_table(part / file.name, TABLES[file.table], only={"origin": "poses"})
        for rows in takes if file.table == "contacts" else ():
            held = np.asarray(rows["is_held"])
            frame = np.tile(np.asarray(rows["frame"])[held], 2)
            bones = np.concatenate([rows["bone"][held], rows["partner_bone"][held]])
            bone = np.array([names.get(name, -1) for name in bones], dtype=np.int64)
            yield str(rows["take_id"][0]), frame, bone


def _statistics(contents: Contents, files: Sequence[DataFile], part: Path) -> dict[str, Any]:
    """Return the content of `stats.json`: figures by split, table and column."""
    manifests = {manifest.ref: manifest for manifest in contents.manifests}
    statistics: dict[str, Any] = {}

    def motions(motion_files: Sequence[DataFile]) -> Iterator[tuple[Any, float]]:
        for file in motion_files:
            row_groups = iter_table(part / file.name, TABLES[file.table], columns=["body22_m"])
            for group, rows in zip(file.groups, row_groups, strict=True):
                facts = PeopleFacts.of(manifests[group.ref])
                shape = (facts.num_frames, facts.num_persons)
                positions = np.asarray(rows["body22_m"], dtype=np.float64)
                if file.table == "poses":  # rows are sorted by person
                    positions = positions.reshape(*shape[::-1], *positions.shape[1:]).swapaxes(0, 1)
                yield positions.reshape(*shape, *positions.shape[-2:]), facts.rate_hz

    for split in SPLITS:
        for table in _MOTIONS:
            split_files = [file for file in files if (file.table, file.groups[0].split) == (table, split)]
            num_rows = sum(group.num_rows for file in split_files for group in file.groups)
            if split_files:
                statistics.setdefault(split, {})[table] = figures_of_motions(motions(split_files), num_rows)
        touched = [file for file in files if (file.table, file.groups[0].split) == ("contacts", split)]
        held = {}
        for take, frame, bone in _held_contacts(touched, part):
            pairs = np.unique(np.stack([frame, bone]), axis=1)[1]
            held[take] = np.bincount(pairs[pairs >= 0], minlength=BODY22.num_joints).astype(np.float64)
        if touched:
            takes = [manifests[group.ref] for file in touched for group in file.groups if not group.rows]
            num_frames = {TakeFacts.of(manifest).take_id: TakeFacts.of(manifest).num_frames for manifest in takes}
            statistics[split]["poses"]["contact_rate"] = contact_figures(held, num_frames)
    return statistics


def _copy(source: Path, target: Path) -> None:
    """Copy a file, which gets its name when it is complete."""
    growing = target.with_name(f".{target.name}")
    shutil.copyfile(source, growing)
    growing.replace(target)


def _clear(part: Path, out: Path) -> None:
    """Remove the previous folder; foreign files in it move to the new one."""
    if (old := read_manifest(part)) is not None:
        ours = {Path(name).parts[0] for name in old.files} | {MANIFEST}
        for path in part.iterdir():
            if path.name not in ours and not (out / path.name).exists():
                path.rename(out / path.name)
    shutil.rmtree(part, ignore_errors=True)
