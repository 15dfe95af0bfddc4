"""Source files: read, digested, and read again as they were planned with."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from pasdedeux.errors import InputError
from tasks.stage import SourceFile
from tasks.user_files import read_file


@dataclass(frozen=True)
class LoadedFile:
    """A file's bytes with its path and digest."""

    file: SourceFile
    data: bytes


def load_file(path: Path) -> LoadedFile:
    """Read and hash a file; an InputError as of `read_file`."""
    data = read_file(path)
    return LoadedFile(file=SourceFile(path=str(path), sha256=hashlib.sha256(data).hexdigest()), data=data)


def read_again(file: SourceFile) -> bytes:
    """Return the bytes of a file that was planned with.

    Raises:
        InputError: It changed since.
    """
    loaded = load_file(Path(file.path))
    if loaded.file.sha256 != file.sha256:
        raise InputError(f"file {file.path} changed since the run was planned; run again")
    return loaded.data
