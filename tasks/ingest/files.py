"""Source files: reading and digesting them, and reading them again after planning."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pasdedeux.errors import InputError
from pasdedeux.formats.file_format import LOOKED_AT_BYTES
from pasdedeux.formats.npz import is_npz
from tasks.files.user_files import open_file, read_file, user_file_digest
from tasks.stage import SourceFile


@dataclass(frozen=True)
class LoadedFile:
    """The bytes of a file with its path and digest."""

    file: SourceFile
    data: bytes


def load_file(path: Path) -> LoadedFile:
    """Read and hash a file; raises an InputError as `read_file`."""
    data = read_file(path)
    return LoadedFile(file=SourceFile(path=str(path), sha256=user_file_digest(path, data)), data=data)


def find_file(path: Path) -> SourceFile:
    """Hash a file without loading it into memory; raises an InputError as `open_file`."""
    return SourceFile(path=str(path), sha256=user_file_digest(path))


def read_start(path: Path) -> bytes:
    """Return the part of a file that format recognition needs: all of an archive; raises as `read_file`."""
    with open_file(path) as file:
        start = file.read(LOOKED_AT_BYTES)
    return read_file(path) if is_npz(start) else start


def read_again(file: SourceFile) -> bytes:
    """Return the bytes of a file with which the run was planned.

    Raises:
        InputError: It has changed since.
    """
    loaded = load_file(Path(file.path))
    if loaded.file.sha256 != file.sha256:
        raise InputError(f"file {file.path} changed since the run was planned; run again")
    return loaded.data
