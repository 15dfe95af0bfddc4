"""A store in S3-compatible storage, accessed through a local store, its mirror.

The mirror has the usual layout of a store, with manifests and records as of the last refresh, and the data files read
so far. It can be removed when nothing runs. Workers on other machines have their own mirrors. `bucket_layout` describes
the bucket.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from storage_schema.bucket import RemoteStore, has_md5_tag
from storage_schema.bucket_layout import (
    DATASET_PLACE,
    MANIFEST_PLACE,
    RECORD_PLACE,
    is_old_list,
    manifest_place,
    pack_dataset,
    part_place,
    read_dataset,
    unpack_dataset,
)
from storage_schema.durable import cache_folder, lock_file, make_folder, write_errors
from storage_schema.errors import CorruptArtifact, DatasetExists, OlderSchema, StorageError
from storage_schema.folder_store import STORE_TEXT, FolderStore
from storage_schema.keys import file_sha256
from storage_schema.lease import Lease, each_beat
from storage_schema.manifest import MANIFEST_NAME, RESERVED_NAMES, ArtifactRef, FileEntry, Manifest
from storage_schema.staging import StagingFolder, replace_file
from storage_schema.store import STORE_FILE, Store

if TYPE_CHECKING:
    from obstore import ObjectMeta

_DIGEST = re.compile(r"\b[0-9a-f]{64}\b")
_TIMES = 2
"""Number of tries to fetch a part whose bytes do not match its name."""
_YOUNG = timedelta(hours=1)
"""A part younger than this may belong to an artifact whose manifest is not written yet."""


class BucketStore(Store):
    """A store in a bucket with its local mirror; one object in a process.

    Address and credentials of `s3://bucket/prefix` come from the environment.
    """

    remote: RemoteStore
    here: FolderStore
    """The mirror."""

    def __new__(cls, place: str) -> BucketStore:
        """Return the store of this process, whose mirror is in `cache_folder`."""
        return open_bucket(place.rstrip("/"), os.environ.get("AWS_ENDPOINT_URL", ""), str(cache_folder()))

    def _open(self, place: str, root: Path) -> None:
        self.remote, self.here = RemoteStore(place), FolderStore(root)
        self._set_up(root, self.remote.url)
        self._is_current = False  # workers do not refresh, and request each manifest
        self._num_holding = 0
        self._lease = Lease(self.remote)
        self._pushing = threading.Lock()
        self._pushed: dict[Path, tuple[int, int]] = {}

    def refresh(self) -> None:
        """Update manifests and records; beside a run of this machine the mirror is up to date.

        Raises:
            RemoteError: The bucket refuses or does not answer.
        """
        if not self._num_holding:
            self.remote.is_hurried.clear()  # set by an interrupted command of this process
        with self._locked(fcntl.LOCK_SH | fcntl.LOCK_NB) as is_alone:
            if is_alone and not self._num_holding:
                self._refresh()
        self._is_current = True

    def bring(self, stage: str, key: str, *, known: ArtifactRef | None = None) -> None:
        """Fetch the current manifest of an artifact unless `known` is here; remove the local one if there is none.

        After a refresh, it is fetched only if `known` shows that it has changed.
        """
        if known is None and self._is_current:
            return
        self._check_not_lost()
        folder = self.folder(stage, key)
        if known is not None and self._ref_here(folder) == known:
            return
        try:
            self._put_manifest(folder, self.remote.read(f"manifests/{stage}/{key}"))
        except FileNotFoundError:
            with suppress(FileNotFoundError):
                self._forget(folder / MANIFEST_NAME)

    def has_files(self, manifest: Manifest) -> bool:
        """Return true, because the manifest was written last."""
        return True

    def data_file(self, ref: ArtifactRef, name: str, entry: FileEntry) -> Path:
        """Return the local path of a data file of an artifact; fetch it if necessary.

        Raises:
            CorruptArtifact: It is missing or does not match its name, also when it is requested again.
        """
        path = self.here.data_file(ref, name, entry)
        if path.is_file() and path.stat().st_size == entry.bytes:
            return path
        with write_errors(self.root), closing(StagingFolder(self.staging_root)) as staging:
            there = staging.path / path.name
            try:
                if entry.sha256 not in (self.remote.fetch(part_place(entry.sha256), there) for _ in range(_TIMES)):
                    raise FileNotFoundError
            except FileNotFoundError:
                raise CorruptArtifact(
                    f"{self}/{part_place(entry.sha256)} is gone or damaged; a run computes its artifact "
                    f"{ref.stage}@{ref.key[:12]} again"
                ) from None
            make_folder(path.parent)
            there.replace(path)
        return path

    def file_sha256(self, ref: ArtifactRef, name: str, entry: FileEntry) -> str:
        """Return the digest of a part's bytes in the bucket; FileNotFoundError without it."""
        with closing(StagingFolder(self.staging_root)) as staging:
            return self.remote.fetch(part_place(entry.sha256), staging.path / "part")

    def drop_copies(self, manifest: Manifest) -> bool:
        """Remove cached parts whose bytes do not match their digests; return whether there were any."""
        files = {self.folder(*manifest.ref.place) / name: entry for name, entry in manifest.data_files.items()}
        changed = [path for path, entry in files.items() if path.is_file() and file_sha256(path) != entry.sha256]
        for path in changed:
            path.unlink(missing_ok=True)
        return bool(changed)

    def prepare(self) -> None:
        """Create the store if necessary, and remove local leftovers of dead processes."""
        if not (self.root / STORE_FILE).is_file():
            self.remote.create(f"records/{STORE_FILE}", STORE_TEXT)
        self.here.prepare()

    def can_write(self) -> bool:
        """Return whether this process may write to the bucket."""
        with suppress(StorageError, FileNotFoundError):
            self.remote.changed_at("lease")
            self.remote.create(f"records/{STORE_FILE}", STORE_TEXT)  # which exists: tests the permission
            return True
        return False

    def put_in_place(self, staging: StagingFolder, new: Manifest, *, replaces: bool = False) -> ArtifactRef:
        """Put an artifact into the bucket, its manifest last, then here; return the one that is there in the end.

        An existing one that does not stay, or has a damaged manifest, is replaced in one step.

        Raises:
            NamedByDataset: A dataset needs the existing one, and the new one has other bytes.
        """
        self._check_not_lost()
        parts = {entry.sha256: staging.path / name for name, entry in new.data_files.items()}
        self.remote.at_once(lambda sha256: self.remote.write(part_place(sha256), parts[sha256]), parts)
        place, text = manifest_place(new.ref), (staging.path / MANIFEST_NAME).read_bytes()
        while not self.remote.create(place, text):
            with suppress(FileNotFoundError):  # removed since
                data, tag = self.remote.read_tagged(place)
                there: Manifest | None = None
                with suppress(CorruptArtifact, OlderSchema):
                    there = Manifest.from_json(data, where=f"{self}/{place}")
                if there is not None and there.ref != new.ref:
                    self.bring_datasets()
                if there is not None and self.stays(there, new, replaces=replaces, are_files_new=True):
                    if there.ref != new.ref:
                        return there.ref
                    break
                if self.remote.replace(place, text, tag) is not None:
                    break
        return self.here.take_place(staging, new.ref, lambda: None)

    def add_dataset(self, staged: Path, label: str) -> bool:
        """Put a dataset into the bucket; return false if its name is taken, and fetch the one that has it.

        Raises:
            DatasetExists: An earlier release pushed a dataset of this name.
        """
        packed = pack_dataset({path.name: path.read_bytes() for path in staged.iterdir()})
        if not self.remote.create(f"datasets/{label}", packed):
            self.bring_datasets()
            if not (self.root / "datasets" / label).is_dir():
                raise DatasetExists(f"{self} has a dataset {label} of an earlier release; name another version")
            return False
        return self.here.add_dataset(staged, label)

    def remove_folders(self, targets: Iterable[Path]) -> None:
        """Remove folders of artifacts and runs here and in the bucket."""
        targets = list(targets)
        places = []
        for target in targets:
            name = self._name(target)
            if name.startswith("runs/"):
                places += [entry["path"] for entry in self.remote.entries(f"records/{name}")]
            else:
                places.append(f"manifests/{target.parent.parent.name}/{target.name}")
        self.remote.delete(places)
        self.here.remove_folders(targets)

    def sweep(self, *, younger: timedelta = _YOUNG) -> None:
        """Remove parts that no manifest names; the youngest stay, because a lost worker may still be writing."""
        self._lease.check()
        parts = self.remote.entries("parts")
        named: set[str] = set()
        for path in self.root.glob(f"*/??/*/{MANIFEST_NAME}"):
            named.update(_DIGEST.findall(path.read_text("utf-8")))  # also one of an older schema
        before = self.remote.changed_at("lease") - younger
        old = [part["path"] for part in parts if part["last_modified"] <= before]
        self.remote.delete(path for path in old if path.rpartition("/")[2] not in named)

    @contextmanager
    def in_use(self, *, alone: bool = False) -> Iterator[None]:
        """Build alone in the store in this block, which begins with a refresh.

        Records of runs are written to the bucket meanwhile.

        Raises:
            StorageError: Another run has the lease.
            RemoteError: The bucket refuses or does not answer.
        """
        if self._num_holding:
            self._num_holding += 1
            try:
                yield
            finally:
                self._num_holding -= 1
            return
        self.remote.is_hurried.clear()
        self._lease = Lease(self.remote)
        self._lease.take()
        ended = threading.Event()
        for do in (self._lease.renew, self._push_records):
            threading.Thread(target=each_beat, args=(do, ended), name="pasdedeux-lease", daemon=True).start()
        try:
            with self._locked(fcntl.LOCK_EX):
                try:
                    self._refresh()
                    self._is_current, self._num_holding = True, 1
                    yield
                except BaseException:
                    self.remote.is_hurried.set()
                    with suppress(StorageError, FileNotFoundError):
                        self._give_back()
                    raise
                else:
                    self._give_back()
        finally:
            ended.set()
            self.remote.is_hurried.clear()
            self._num_holding = 0

    def _check_not_lost(self) -> None:
        """End a run that has lost its lease, at its next read or commit."""
        if self._num_holding and self._lease.is_over:
            raise self._lease.lost()

    def _give_back(self) -> None:
        self._lease.check()
        self._push_records()
        self._lease.renew(released=True)

    def _push_records(self) -> None:
        """Write new records of runs to the bucket, once the mirror has been refreshed."""

        def push(path: Path) -> None:
            state = _state(path)
            with suppress(FileNotFoundError):  # removed meanwhile
                self.remote.write(f"records/{self._name(path)}", path.read_bytes())
                self._pushed[path] = state

        with self._pushing:
            if self._num_holding and not self._lease.is_over:
                files = (path for path in (self.root / "runs").rglob("[!.]*") if path.is_file())
                changed = [path for path in files if self._pushed.get(path) != _state(path)]
                if changed and self._lease.renew():  # after a long sleep, another run may hold the lease
                    self.remote.at_once(push, changed)

    def _refresh(self) -> None:
        began = time.time()
        manifests = {
            self.folder(place[1], place[2]) / MANIFEST_NAME: entry
            for entry in self.remote.entries("manifests")
            if (place := MANIFEST_PLACE.fullmatch(entry["path"])) and place[1] not in RESERVED_NAMES
        }
        records = {
            self.root / place[1]: entry
            for entry in self.remote.entries("records")
            if (place := RECORD_PLACE.fullmatch(entry["path"]))
        }
        wanted = {**manifests, **records}
        new = [place for place in wanted.items() if not _is_same(*place)]
        self.remote.at_once(lambda place: self._bring_file(*place), new)
        here = [*self.root.glob(f"*/??/*/{MANIFEST_NAME}")]
        here += [path for path in (self.root / "runs").rglob("*") if path.is_file()]
        for path in here:
            with suppress(FileNotFoundError):
                # A file with a later ctime was put here by another process of this machine; mtime is the bucket's.
                if path not in wanted and not path.name.startswith(".") and path.stat().st_ctime < began:
                    self._forget(path)
        self.bring_datasets()
        self._pushed |= {path: _state(path) for path in records}

    def _bring_file(self, path: Path, entry: ObjectMeta) -> None:
        try:
            data = self.remote.read(entry["path"])
        except FileNotFoundError:
            return  # removed since it was listed
        with write_errors(self.root):
            if path.name == MANIFEST_NAME:
                self._put_manifest(path.parent, data)
            else:
                replace_file(path, data, staging_root=self.staging_root)
            with suppress(FileNotFoundError):  # dropped by another process
                os.utime(path, ns=(_mark(entry), _mark(entry)))

    def bring_datasets(self) -> None:
        """Update the local datasets to those of the bucket."""
        entries = [entry for entry in self.remote.entries("datasets") if DATASET_PLACE.fullmatch(entry["path"])]
        names = {entry["path"].rpartition("/")[2] for entry in entries}
        for folder in (self.root / "datasets").glob("*@*"):
            if folder.name not in names:
                shutil.rmtree(folder, ignore_errors=True)
        for entry in entries:
            folder = self.root / entry["path"]
            if _state(folder)[0] == _mark(entry):
                continue
            with write_errors(self.root), closing(StagingFolder(self.staging_root)) as staging:
                try:
                    packed = read_dataset(self.remote, folder.name)
                except FileNotFoundError:
                    continue  # removed since it was listed
                if is_old_list(packed):
                    continue  # its artifacts have other paths, which only `dataset pull` reads
                files = unpack_dataset(packed, f"{self}/{entry['path']}")
                (staging.path / "new").mkdir()
                for name, data in files.items():
                    (staging.path / "new" / name).write_bytes(data)
                os.utime(staging.path / "new", ns=(_mark(entry), _mark(entry)))
                make_folder(folder.parent)
                with suppress(FileNotFoundError):
                    folder.rename(staging.path / "old")
                try:
                    (staging.path / "new").rename(folder)
                except OSError:  # another process of this machine was first
                    if not folder.is_dir():
                        raise

    def _put_manifest(self, folder: Path, data: bytes) -> None:
        path = folder / MANIFEST_NAME
        with suppress(CorruptArtifact, OlderSchema, FileNotFoundError):
            if self._ref_here(folder) not in (None, Manifest.from_json(data, where=self.place).ref):
                self._forget(path)
        replace_file(path, data, staging_root=self.staging_root)

    @staticmethod
    def _ref_here(folder: Path) -> ArtifactRef | None:
        path = folder / MANIFEST_NAME
        with suppress(FileNotFoundError, CorruptArtifact, OlderSchema):
            return Manifest.from_json(path.read_bytes(), where=str(path)).ref
        return None

    def _forget(self, path: Path) -> None:
        """Drop local files that the bucket lacks."""
        if path.name == MANIFEST_NAME:
            with closing(StagingFolder(self.staging_root)) as staging:
                path.parent.rename(staging.path / path.parent.name)
        else:
            path.unlink()
            with suppress(OSError):  # up to the first that is not empty
                for folder in path.parents:
                    folder.rmdir()

    def _name(self, path: Path) -> str:
        return path.relative_to(self.root).as_posix()

    @contextmanager
    def _locked(self, how: int) -> Iterator[bool]:
        """Lock the mirror against other processes of this machine; yield false if it cannot be locked at once."""
        with write_errors(self.root):
            make_folder(self.root.parent)
            handle = os.open(self.root.with_suffix(".lock"), os.O_CREAT | os.O_RDWR, 0o644)
        try:
            try:
                lock_file(handle, how, f"the mirror {self.root} of {self}")
            except BlockingIOError:
                yield False
            else:
                yield True
        finally:
            os.close(handle)


@cache
def open_bucket(place: str, endpoint: str, cache: str) -> BucketStore:
    """Return the store of a bucket, with its mirror in a cache."""
    store: BucketStore = object.__new__(BucketStore)
    name = hashlib.sha256(f"{endpoint}\n{place}".encode()).hexdigest()[:16]
    store._open(place, Path(cache) / "stores" / name)
    return store


def _state(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except FileNotFoundError:
        return 0, 0
    return stat.st_mtime_ns, stat.st_size


def _mark(entry: ObjectMeta) -> int:
    """Return the mtime of a local file that matches the listing: the last change, with the tag in the nanoseconds."""
    tag = int(hashlib.sha256(str(entry["e_tag"]).encode()).hexdigest()[:12], 16) % 10**9
    return int(entry["last_modified"].timestamp()) * 10**9 + tag


def _is_same(path: Path, entry: ObjectMeta) -> bool:
    """Return whether a local file matches the bucket's listing."""
    mtime_ns, size = _state(path)
    if size != entry["size"]:
        return False
    if mtime_ns == _mark(entry):
        return True
    with suppress(FileNotFoundError):
        if is_same := has_md5_tag(entry, path.read_bytes()):
            os.utime(path, ns=(_mark(entry), _mark(entry)))
        return is_same
    return False
