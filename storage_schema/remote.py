"""Datasets in S3-compatible storage: pushes a version there, and pulls it into any store.

They have the layout of a store in a bucket (`bucket_layout`), and may belong to one. Visible datasets are complete,
whoever else pushes, and an interrupted push continues where it ended. The form of earlier releases is read, too:
`files/<sha256>`, `artifacts/<stage>/<key>-<digest>`, and the list as JSON with the sha256 of the other files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path

from storage_schema.ancestry import walk
from storage_schema.bucket import RemoteStore, has_md5_tag
from storage_schema.bucket_layout import (
    is_old_list,
    manifest_place,
    pack_dataset,
    part_place,
    read_dataset,
    unpack_dataset,
)
from storage_schema.columns import is_plain_name
from storage_schema.datasets import DATASET_FILE, Dataset, add_dataset, dataset_digest, dataset_from_json, open_dataset
from storage_schema.durable import sync_folder, write_errors, write_file
from storage_schema.errors import CorruptArtifact, DatasetExists, SchemaError, UnknownReference
from storage_schema.keys import file_sha256
from storage_schema.manifest import MANIFEST_NAME, ArtifactRef, Manifest
from storage_schema.parquet_files import iter_table
from storage_schema.runs import in_use
from storage_schema.staging import StagingFolder
from storage_schema.store import Store
from storage_schema.tables import TABLES


def push_dataset(store: Store, dataset: Dataset, remote: RemoteStore, files: Mapping[str, bytes] | None = None) -> int:
    """Push a dataset with all its ancestors to a bucket; return the number of new artifacts.

    `files`, by name, replace those in its folder.

    Raises:
        DatasetExists: Another dataset has this name and version there.
        CorruptArtifact, MissingArtifact: An artifact is not complete in the store; nothing of it is pushed.
        RemoteError: The bucket refuses or does not answer; the same call goes on.
    """
    manifests = _closure(remote, dataset.refs, store.manifest)
    num_new = _push_artifacts(store, manifests, remote)
    if files is None:
        files = {path.name: path.read_bytes() for path in dataset.path.iterdir() if path.name != DATASET_FILE}
    packed = pack_dataset({**files, DATASET_FILE: dataset.to_json()})
    is_new = remote.create(f"datasets/{dataset.label}", packed)
    if not is_new and _listed(remote, dataset.label, dataset.path)[0].digest != dataset.digest:
        raise DatasetExists(f"{remote.url} has another {dataset.label} already, which never changes")
    _push_artifacts(store, manifests, remote)  # again, for those that a `gc` of the bucket removed meanwhile
    return num_new


def pull_dataset(remote: RemoteStore, label: str, store: Store) -> tuple[Dataset, int]:
    """Pull the dataset `name@version`, or the newest version of `name`, with all its ancestors.

    Returns:
        The dataset in the store, and the number of artifacts that were new there.

    Raises:
        UnknownReference: The repository has no such dataset; the message lists those it has.
        DatasetExists: The store has another dataset of this name and version.
        CorruptArtifact: Received bytes do not match the manifest, or the store has others under a key.
        RemoteError: The bucket refuses or does not answer; the same call goes on.
    """
    label = _chosen(remote, label)
    dataset, attachments, is_old = _listed(remote, label, store.root / "datasets" / label)
    if dataset.label != label or dataset.digest != dataset_digest(dataset.refs, dataset.sources):
        raise CorruptArtifact(f"{remote.url}/datasets/{label} is not the list that was pushed")
    known = open_dataset(store, label) if dataset.path.is_dir() else None
    if known is not None and known.digest != dataset.digest:
        raise DatasetExists(f"the store {store} has another {dataset.label} already, which never changes")
    store.prepare()

    def manifest_of(ref: ArtifactRef) -> Manifest:
        place = f"artifacts/{ref.stage}/{ref.key}-{ref.content_digest}" if is_old else manifest_place(ref)
        manifest = Manifest.from_json(remote.read(place), where=f"{remote.url}/{place}")
        names = {ref.stage, *manifest.data_files}
        is_same = manifest.ref.place == ref.place and not manifest.faults
        leads_elsewhere = any("/" in name or name.startswith(".") for name in names)
        if not is_same or manifest.ref != ref or leads_elsewhere:
            raise CorruptArtifact(f"{remote.url}/{place} is the manifest of something else")
        return manifest

    with in_use(store):  # until the list is written, nothing needs the new artifacts
        manifests = _closure(remote, dataset.refs, manifest_of)
        num_new = sum(remote.at_once(lambda new: _pull_artifact(remote, new, store, is_old=is_old), manifests))
        if known is None:
            add_dataset(store, dataset, attachments)
    return dataset, num_new


def _closure(
    remote: RemoteStore, refs: Iterable[ArtifactRef], manifest_of: Callable[[ArtifactRef], Manifest]
) -> Sequence[Manifest]:
    """Return the manifests of these artifacts and of all their ancestors."""
    steps = walk(refs, lambda level: remote.at_once(manifest_of, level))
    return [step.manifest for step in steps if step.manifest is not None]


def _listed(remote: RemoteStore, label: str, path: Path) -> tuple[Dataset, dict[str, bytes], bool]:
    """Return a dataset of the bucket as one in a folder, its files, and whether an earlier release wrote it."""
    data, where = read_dataset(remote, label), f"{remote.url}/datasets/{label}"
    if not is_old_list(data):
        files = unpack_dataset(data, where)
        listed = files.pop(DATASET_FILE, b"")
        return dataset_from_json(lambda: listed, path), files, False
    dataset = dataset_from_json(lambda: data, path, less=("attachments",))
    digests: dict[str, str] = json.loads(data)["attachments"]
    files = {name: remote.read(_file_place(sha256, is_old=True)) for name, sha256 in digests.items()}
    for name, content in files.items():
        if hashlib.sha256(content).hexdigest() != digests[name]:
            raise CorruptArtifact(f"{where}: its file {name} is not the one that was pushed")
    return dataset, files, True


def _file_place(sha256: str, *, is_old: bool) -> str:
    return f"files/{sha256}" if is_old else part_place(sha256)


def _push_artifacts(store: Store, manifests: Sequence[Manifest], remote: RemoteStore) -> int:
    """Push missing artifacts to the bucket; return their number."""
    there = {entry["path"]: entry for folder in ("parts", "manifests") for entry in remote.entries(folder)}

    def push(manifest: Manifest) -> bool:
        place, text = manifest_place(manifest.ref), manifest.to_json().encode()
        files = {part_place(entry.sha256): (name, entry) for name, entry in manifest.data_files.items()}
        new = [path for path, (_, entry) in files.items() if path not in there or there[path]["size"] != entry.bytes]
        if not new and place in there and has_md5_tag(there[place], text):
            return False
        for path, (name, entry) in files.items():
            source = store.data_file(manifest.ref, name, entry)
            if file_sha256(source) != entry.sha256:
                raise CorruptArtifact(f"{source} is not what its manifest says (`pasdedeux verify`); it is not pushed")
            if path in new:
                remote.write(path, source)
        is_new = remote.create(place, text)
        if not is_new and Manifest.from_json(remote.read(place), where=f"{remote.url}/{place}").ref != manifest.ref:
            raise CorruptArtifact(
                f"{remote.url} has other bytes for artifact {manifest.ref.stage}@{manifest.ref.key[:12]}; push to "
                "another prefix"
            )
        return is_new

    return sum(remote.at_once(push, manifests))


def _pull_artifact(remote: RemoteStore, manifest: Manifest, store: Store, *, is_old: bool) -> bool:
    ref = manifest.ref
    there = store.find(ref.stage, ref.key)
    if there is not None and there.ref == ref:
        return False
    if there is not None:
        raise CorruptArtifact(
            f"the store {store} has other bytes for artifact {ref.stage}@{ref.key[:12]}; pull into another store"
        )
    with write_errors(store.root), closing(StagingFolder(store.staging_root)) as staging:
        for name, entry in manifest.data_files.items():
            place = _file_place(entry.sha256, is_old=is_old)
            if remote.fetch(place, staging.path / name) != entry.sha256:
                raise CorruptArtifact(f"{remote.url}/{place} does not hold what its name says")
        check_ids(manifest, staging.path, f"{remote.url}, artifact {ref.stage}@{ref.key[:12]}")
        write_file(staging.path / MANIFEST_NAME, manifest.to_json().encode())
        sync_folder(staging.path)
        store.put_in_place(staging, manifest)
    return True


def check_ids(manifest: Manifest, folder: Path, where: str) -> None:
    """Refuse ids that are no plain names, because exported files are named by them."""
    identifiers = [(name, value) for name, value in manifest.facts.items() if name.endswith("_id")]
    for table in manifest.tables:
        columns = TABLES[table].id_columns if table in TABLES else ()
        with suppress(SchemaError):  # columns of another version, which are not read here
            for rows in iter_table(folder / f"{table}.parquet", TABLES[table], columns=columns) if columns else ():
                identifiers += [(name, value) for name in columns for value in set(rows[name].tolist())]
    for name, value in identifiers:
        if isinstance(value, str) and not is_plain_name(value):
            raise CorruptArtifact(
                f"{where} has the {name} {json.dumps(value)[:80]}, and only up to 200 letters, digits, '.', '_' and "
                "'-' can name something; it was not made by this program, and is not pulled"
            )


def _chosen(remote: RemoteStore, label: str) -> str:
    there = remote.names("datasets")
    numbered = [name for name in there if name.rpartition("@")[0] == label and name.rpartition("@")[2].isdecimal()]
    if label in there:
        return label
    if numbered:
        return max(numbered, key=lambda name: int(name.rpartition("@")[2]))
    raise UnknownReference(f"there is no dataset '{label}' in {remote.url}; there are: {', '.join(there) or 'none'}")
