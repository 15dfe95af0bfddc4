"""Atomic and durable files: complete or absent, also after a power cut; a full disk is one clear error."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import hashlib
import io
import logging
import os
import platform
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Timer
from typing import Any

from storage_schema.errors import FullDisk, StorageError

_FULL = {errno.ENOSPC, errno.EDQUOT}
_REFUSED = {errno.EROFS, errno.EACCES, errno.EPERM}
_CANNOT_EXCHANGE = {errno.EINVAL, errno.ENOSYS, errno.ENOENT, errno.EOPNOTSUPP, errno.EXDEV}
_SAY_AFTER_S = 4.0
"""Time after which waiting for a lock is logged."""
_log = logging.getLogger(__name__)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


def cache_folder() -> Path:
    """Return the folder of caches: `$PASDEDEUX_CACHE`, else the user's cache.

    Without a writable home, as in containers, it is a temporary folder.
    """
    if stated := os.environ.get("PASDEDEUX_CACHE"):
        return Path(stated).absolute()
    with suppress(OSError, RuntimeError):
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pasdedeux"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    folder = Path(tempfile.gettempdir()) / f"pasdedeux-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder if folder.stat().st_uid == os.getuid() else Path(tempfile.mkdtemp(prefix="pasdedeux-"))


@contextmanager
def write_errors(where: Path) -> Iterator[None]:
    """Convert errors of the file system in this block to the store's errors.

    Raises:
        FullDisk: There is no room left, or the quota is used up.
        StorageError: The place cannot be written to.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise FullDisk(
                f"the disk is full: no room left in {where}; nothing half-written was kept, "
                "free some space and run the same command again"
            ) from error
        if error.errno in _REFUSED:
            raise StorageError(f"cannot write to {where}: {error.strerror}") from error
        raise


def lock_file(handle: int, how: int, what: str) -> None:
    """Lock a file; if that takes long, log once which process holds it, as a stopped one holds it forever.

    Args:
        handle: The open file.
        how: `fcntl.LOCK_SH` or `LOCK_EX`, with `LOCK_NB` to raise BlockingIOError at once.
        what: The locked thing, in words.
    """
    try:
        fcntl.flock(handle, how | fcntl.LOCK_NB)
    except BlockingIOError:
        if how & fcntl.LOCK_NB:
            raise
        saying = Timer(_SAY_AFTER_S, _say_holders, (handle, what))
        saying.daemon = True
        saying.start()
        try:
            fcntl.flock(handle, how)
        finally:
            saying.cancel()
            saying.join()  # it may use the file, which is closed soon


def _say_holders(handle: int, what: str) -> None:
    holders = []
    with suppress(OSError, ValueError):  # only Linux lists holders
        inode = os.fstat(handle).st_ino
        rows = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
        holders = [row[4] for row in rows if row[1] == "FLOCK" and int(row[5].rpartition(":")[2]) == inode]
    name, number = f"process {holders[0]}" if holders else "another process", holders[0] if holders else "PID"
    _log.warning(
        "waiting for %s, which %s on %s uses, until that has ended; if it is stopped, continue it (`kill -CONT %s`) or "
        "end it",
        *(what, name, platform.node(), number),
    )


@contextmanager
def locked_file(path: Path, how: int, what: str = "") -> Iterator[None]:
    """Lock `.NAME.lock` beside a present or future file in this block; arguments and errors as in `lock_file`."""
    make_folder(path.parent)
    handle = os.open(path.with_name(f".{path.name}.lock"), os.O_CREAT | os.O_RDWR, 0o644)
    try:
        lock_file(handle, how, what or str(path))
        yield
    finally:
        os.close(handle)


class HashingFile(io.RawIOBase):
    """A new file, open for writing, that computes its digest and is synced to the disk when closed.

    `num_bytes` and `sha256` are those of the bytes written so far.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = path.open("xb")
        self._digest = hashlib.sha256()
        self.num_bytes = 0

    @property
    def sha256(self) -> str:
        """Digest of the bytes written so far."""
        return self._digest.hexdigest()

    def writable(self) -> bool:
        """Return true."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes at the end, and return their number."""
        num_bytes = self._file.write(data)
        self._digest.update(data)
        self.num_bytes += num_bytes
        return num_bytes

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self.num_bytes

    def close(self) -> None:
        """Sync the bytes to the disk and close the file."""
        if not self.closed:
            try:
                with self._file:
                    self._file.flush()
                    os.fsync(self._file.fileno())
            finally:
                super().close()


def write_file(path: Path, data: bytes) -> HashingFile:
    """Write a new file and sync it to the disk; the returned object has size and digest."""
    with HashingFile(path) as file:
        file.write(data)
    return file


def make_folder(folder: Path) -> None:
    """Create a folder and its parents so that they survive a power cut."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


def exchange_folders(first: Path, other: Path) -> bool:
    """Exchange two folders in one step; return false if the system cannot, or one is missing."""
    rename = _renameat2()
    if rename is None:
        return False
    if rename(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    if (number := ctypes.get_errno()) in _CANNOT_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(first), None, str(other))


@cache
def _renameat2() -> Any:
    """Return the function of the C library; None without one."""
    return getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
