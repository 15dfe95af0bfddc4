"""Temporary folders of a store: hold unfinished files, and are removed after a crash.

The owner of a folder holds a lock on a file beside it; the system frees the lock when the process dies, however it
dies. So a folder whose lock can be taken has no owner. Locks are trusted on the owner's host only; leftovers of another
host on a shared file system are removed when nothing in them has changed for a week, by the clock of that file system.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import uuid
from pathlib import Path

from storage_schema.durable import exchange_folders, make_folder, sync_folder, write_file

_FOREIGN_AGE_S = 7 * 24 * 3600.0
_ASIDE = ".aside."


class StagingFolder:
    """A new folder under `root`, owned by this process until `close`."""

    def __init__(self, root: Path) -> None:
        make_folder(root)
        self.lock, name = _new_lock(root)
        self._lock_path = root / f"{name}.lock"
        self.path = root / name
        try:
            self.path.mkdir()
        except BaseException:
            self.close()
            raise

    def take_place(self, target: Path) -> None:
        """Exchange the folder with another one of the store.

        This is one step if the file system supports it; else a process that dies in between leaves the other folder
        aside, and the next clean-up restores it.
        """
        if not target.is_dir():
            target.unlink(missing_ok=True)
        elif exchange_folders(self.path, target):
            return
        else:
            aside = self.path.with_name(f"{self.path.name}{_ASIDE}{'.'.join(target.parts[-3:])}")
            shutil.rmtree(aside, ignore_errors=True)
            with contextlib.suppress(FileNotFoundError):  # moved away by another
                target.rename(aside)
        self.path.rename(target)

    def close(self) -> None:
        """Remove the rest of the folder and release its lock."""
        _clear(self.path)
        self._lock_path.unlink(missing_ok=True)
        os.close(self.lock)


def replace_file(path: Path, data: bytes, *, staging_root: Path) -> None:
    """Replace a file in one step: readers see the old or the new one."""
    make_folder(path.parent)
    with contextlib.closing(StagingFolder(staging_root)) as staging:
        write_file(staging.path / path.name, data)
        (staging.path / path.name).replace(path)
        sync_folder(path.parent)


def clean_leftovers(root: Path) -> int:
    """Remove the folders under `root` whose owners are dead; return their number."""
    if not root.is_dir():
        return 0
    return sum(_clean(lock_path) for lock_path in sorted(root.glob("*.lock")))


def _new_lock(root: Path) -> tuple[int, str]:
    """Create and lock a new lock file; if a cleaner takes it in between, create another."""
    while True:
        name = f"{host_name()}.{os.getpid()}.{uuid.uuid4().hex[:12]}"
        path = root / f"{name}.lock"
        handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            continue
        except OSError:
            # A file system without locks: leftovers stay until they are old.
            return handle, name
        if path.exists():
            return handle, name
        os.close(handle)


def _clean(lock_path: Path) -> bool:
    """Remove one folder if its owner is dead."""
    try:
        handle = os.open(lock_path, os.O_RDWR)
    except OSError:
        return False
    try:
        if lock_path.name.split(".")[0] != host_name():
            if not _is_untouched(lock_path.with_suffix("")):
                return False
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _clear(lock_path.with_suffix(""))
        lock_path.unlink(missing_ok=True)
    except OSError:
        return False
    else:
        return True
    finally:
        os.close(handle)


def _is_untouched(folder: Path) -> bool:
    newest, clock = 0.0, folder.with_name(f".{uuid.uuid4().hex}")
    for path in (folder, folder.with_name(f"{folder.name}.lock"), *folder.glob("*")):
        with contextlib.suppress(OSError):
            newest = max(newest, path.stat().st_mtime)
    clock.touch(exist_ok=False)  # times of files come from the file server, whose clock may differ
    now = clock.stat().st_mtime
    clock.unlink()
    return now - newest > _FOREIGN_AGE_S


def _clear(folder: Path) -> None:
    """Remove a folder, and restore the one that it was about to replace if its place is empty."""
    for aside in folder.parent.glob(f"{folder.name}{_ASIDE}*"):
        with contextlib.suppress(OSError):
            aside.rename(folder.parents[1].joinpath(*aside.name.partition(_ASIDE)[2].split(".")))
        shutil.rmtree(aside, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)


def host_name() -> str:
    """Return the name of this machine in a form for file names."""
    return socket.gethostname().replace(".", "-").replace("/", "-") or "host"
