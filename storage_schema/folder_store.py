"""A store in a folder, shared by many processes, also of several machines."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from storage_schema.durable import locked_file, make_folder, sync_folder, write_errors
from storage_schema.errors import CorruptArtifact, MissingArtifact, StorageError
from storage_schema.keys import file_sha256
from storage_schema.manifest import ArtifactRef, FileEntry, Manifest
from storage_schema.staging import StagingFolder, replace_file
from storage_schema.store import STORE_FILE, Store
from storage_schema.version import SCHEMA_VERSION

STORE_TEXT = f"{json.dumps({'schema_version': SCHEMA_VERSION})}\n".encode()


class FolderStore(Store):
    """A store in a folder."""

    def __init__(self, place: str | Path) -> None:
        root = Path(place).absolute()
        self._set_up(root, str(root))

    @contextmanager
    def in_use(self, *, alone: bool = False) -> Iterator[None]:
        """Protect the store from garbage collection in this block; `alone`: nobody else may plan or build meanwhile.

        A user waits until a process that has the store alone is done; to get it alone, nothing waits. A store that does
        not exist yet, or cannot be locked (read-only, or on a file system without locks), is used without a lock.

        Raises:
            StorageError: Another process uses the store, and `alone` was requested.
        """
        with ExitStack() as held:
            try:
                if (self.root / STORE_FILE).is_file():
                    how = fcntl.LOCK_EX | fcntl.LOCK_NB if alone else fcntl.LOCK_SH
                    held.enter_context(locked_file(self.root / "runs" / "in_use", how))
            except BlockingIOError:
                raise StorageError(f"a run plans or builds in the store {self}; try again when it has ended") from None
            except OSError:
                if alone:
                    raise
            yield

    def has_files(self, manifest: Manifest) -> bool:
        """Return whether every file of an artifact is there with the right size."""
        folder = f"{self._prefix}{manifest.ref.stage}/{manifest.ref.key[:2]}/{manifest.ref.key}"
        sizes = {f"{name}.parquet": part.bytes for name, part in manifest.tables.items()}
        sizes |= {name: entry.bytes for name, entry in manifest.attachments.items()}
        try:
            return all(os.stat(f"{folder}/{name}").st_size == size for name, size in sizes.items())  # noqa: PTH116
        except OSError:
            return False

    def data_file(self, ref: ArtifactRef, name: str, entry: FileEntry) -> Path:
        """Return the path of a data file; CorruptArtifact if its name would lead out of the artifact's folder."""
        if "/" in name or name.startswith("."):
            raise CorruptArtifact(
                f"artifact {ref.stage}@{ref.key[:12]} names a file '{name}' that is not in its folder"
            )
        return self.folder(ref.stage, ref.key) / name

    def file_sha256(self, ref: ArtifactRef, name: str, entry: FileEntry) -> str:
        """Return the sha256 of the bytes of a data file; OSError if they cannot be read."""
        return file_sha256(self.folder(ref.stage, ref.key) / name)

    def prepare(self) -> None:
        """Create the store's folder if necessary, and remove leftovers of dead processes; once per object."""
        if self._is_checked and (self.root / STORE_FILE).is_file():
            return
        with write_errors(self.root):
            make_folder(self.root)
            if not (self.root / STORE_FILE).is_file():
                replace_file(self.root / STORE_FILE, STORE_TEXT, staging_root=self.staging_root)
        self.check_version()
        self.clear_leftovers()

    def can_write(self) -> bool:
        """Return whether the folder can be written."""
        return os.access(self.root, os.W_OK)

    def put_in_place(self, staging: StagingFolder, new: Manifest, *, replaces: bool = False) -> ArtifactRef:
        """Rename the staged folder to its place; return the artifact that is there in the end.

        Raises:
            NamedByDataset: A dataset needs the existing one, and the new one has other bytes.
        """

        def kept() -> ArtifactRef | None:
            there = self._there(new.ref)
            return there.ref if there is not None and self.stays(there, new, replaces=replaces) else None

        return self.take_place(staging, new.ref, kept)

    def take_place(
        self, staging: StagingFolder, ref: ArtifactRef, kept: Callable[[], ArtifactRef | None]
    ) -> ArtifactRef:
        """Rename the staged folder of an artifact to its place, unless `kept` returns an existing one to keep."""
        target = self.folder(ref.stage, ref.key)
        make_folder(target.parent)
        go_there: Callable[[Path], object] = staging.path.rename
        while True:
            try:
                go_there(target)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                    raise
            else:
                sync_folder(target.parent)
                return ref
            # There is a folder: replace it only after seeing that it does not stay.
            if (taken := kept()) is not None:
                return taken
            go_there = staging.take_place

    def add_dataset(self, staged: Path, label: str) -> bool:
        """Rename the staged folder of a dataset to its name; return false if the name is taken."""
        target = self.root / "datasets" / label
        make_folder(target.parent)
        try:
            staged.rename(target)
        except OSError:
            if target.is_dir():
                return False
            raise
        sync_folder(target.parent)
        return True

    def remove_folders(self, targets: Iterable[Path]) -> None:
        """Remove folders of the store in this order, each in one rename; missing ones are skipped."""
        targets = list(targets)
        if not any(target.exists() for target in targets):
            return
        parents = set()
        with closing(StagingFolder(self.staging_root)) as staging:
            for target in targets:
                with suppress(FileNotFoundError):  # moved by another process
                    target.rename(staging.path / uuid.uuid4().hex)
                    parents.add(target.parent)
            for parent in parents:
                sync_folder(parent)

    def _there(self, ref: ArtifactRef) -> Manifest | None:
        """Return the manifest under a key, with any columns, if its files exist; else None."""
        with suppress(MissingArtifact, CorruptArtifact):
            manifest = self.load(ref.stage, ref.key)
            return manifest if self.has_files(manifest) else None
        return None
