"""A disk that fills up at any moment is said in one sentence and leaves nothing half-written."""

from __future__ import annotations

import errno
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flows.records import copy_report, shown_page
from storage_schema import StorageError, Store, create_dataset, new_run, record_latest, verify
from storage_schema.durable import HashingFile
from storage_schema.errors import FullDisk
from tests.builders.storage_rows import commit_rows


def commit(store: Store) -> Any:
    return commit_rows(store, "poses", 300, stage="ingest", attachments={"note.txt": b"n" * 9000})


@dataclass
class Disk:
    """A disk that takes so many more writes of bytes, then every one fails with this error number."""

    num_left: float = math.inf
    number: int = errno.ENOSPC
    num_written: int = 0


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """Return the disk of all stores."""
    disk, write = Disk(), HashingFile.write

    def limited(file: HashingFile, data: Any) -> int:
        if disk.num_left <= 0:
            raise OSError(disk.number, os.strerror(disk.number))
        disk.num_left -= 1
        disk.num_written += 1
        return write(file, data)

    monkeypatch.setattr(HashingFile, "write", limited)
    return disk


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_while_writing_leaves_no_artifact(tmp_path: Path, disk: Disk, share: float, number: int) -> None:
    commit(Store(tmp_path / "undisturbed"))
    # The first commit also writes the store's own file, so this is one more than the second does.
    num_writes = disk.num_written - 1
    store = Store(tmp_path / "store")
    before = commit_rows(store)
    disk.num_left, disk.number = int(share * num_writes), number
    with pytest.raises(
        FullDisk, match=f"the disk is full: no room left in {store.root}; nothing half-written was kept"
    ):
        commit(store)
    assert [manifest.ref for manifest in store.artifacts()] == [before]
    assert list((store.root / "tmp").iterdir()) == []
    disk.num_left = math.inf
    ref = commit(store)
    assert store.find("ingest", ref.key) is not None
    assert verify(store).is_ok


@pytest.mark.parametrize("call", ["fsync", "mkdir", "rename"])
def test_a_full_disk_at_any_other_call_leaves_no_artifact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    store = Store(tmp_path)
    commit_rows(store)

    def full(*arguments: Any, **more: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        with pytest.raises(FullDisk):
            commit(store)
    assert len(list(store.artifacts())) == 1
    assert list((tmp_path / "tmp").iterdir()) == []
    assert verify(store).is_ok


def test_a_full_disk_keeps_the_last_record_and_makes_no_dataset(tmp_path: Path, disk: Disk) -> None:
    store = Store(tmp_path)
    ref = commit_rows(store)
    record = record_latest(store, "duets", "one", {})
    disk.num_left = 0
    with pytest.raises(FullDisk):
        record_latest(store, "duets", "two", {})
    with pytest.raises(FullDisk):
        create_dataset(store, "released", [ref])
    disk.num_left = math.inf
    assert record_latest(store, "duets", "one", {}) == record
    assert create_dataset(store, "released", [ref]).version == "1"


def test_a_report_is_copied_whole_or_not_at_all(tmp_path: Path, disk: Disk) -> None:
    store = Store(tmp_path)
    ref = commit_rows(store, attachments={"a.html": b"a", "b.html": b"b"})
    run = new_run(store, "duets")
    disk.num_left = 1
    with pytest.raises(FullDisk):
        copy_report(store, run, [ref])
    assert [path.name for path in (run.path / "report").iterdir()] == ["a.html"]
    disk.num_left = math.inf
    assert copy_report(store, run, [ref]) == run.path / "report"
    assert (run.path / "report" / "b.html").read_bytes() == b"b"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_run_names_its_own_page_where_that_cannot_be_copied(tmp_path: Path, disk: Disk, code: int) -> None:
    store = Store(tmp_path)
    report = new_run(store, "duets").path / "report"
    report.mkdir()
    assert shown_page(store, "duets", report) == report, "a report without a page"
    (report / "report.html").write_bytes(b"page")
    disk.num_left, disk.number = 0, code
    assert shown_page(store, "duets", report) == report / "report.html"
    disk.num_left = math.inf
    assert shown_page(store, "duets", report) == tmp_path / "runs" / "latest" / "duets.html"


def test_a_store_that_may_not_be_written_to_is_said(tmp_path: Path, disk: Disk) -> None:
    disk.num_left, disk.number = 0, errno.EROFS
    with pytest.raises(StorageError, match=f"cannot write to {tmp_path}: Read-only file system"):
        commit(Store(tmp_path))


def test_another_error_of_the_file_system_is_not_renamed(tmp_path: Path, disk: Disk) -> None:
    store = Store(tmp_path)
    commit_rows(store)
    disk.num_left, disk.number = 3, errno.EIO
    with pytest.raises(OSError, match="Input/output error"):
        commit(store)
    assert list((tmp_path / "tmp").iterdir()) == []
