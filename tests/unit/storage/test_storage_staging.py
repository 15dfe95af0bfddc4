from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from storage_schema import staging
from storage_schema.staging import StagingFolder, clean_leftovers


def test_a_living_owner_keeps_its_folder(tmp_path: Path) -> None:
    assert clean_leftovers(tmp_path / "tmp") == 0, "there is nothing yet"
    folder = StagingFolder(tmp_path / "tmp")
    (folder.path / "file").write_bytes(b"x")
    assert clean_leftovers(tmp_path / "tmp") == 0
    assert (folder.path / "file").exists()
    folder.close()
    assert list((tmp_path / "tmp").iterdir()) == []


def test_a_dead_owner_loses_its_folder(tmp_path: Path) -> None:
    folder = StagingFolder(tmp_path / "tmp")
    (folder.path / "deep").mkdir()
    (folder.path / "deep" / "file").write_bytes(b"x")
    os.close(folder.lock)
    assert clean_leftovers(tmp_path / "tmp") == 1
    assert list((tmp_path / "tmp").iterdir()) == []


def test_another_hosts_folder_stays_until_its_files_are_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = StagingFolder(tmp_path / "tmp")
    (folder.path / "file").write_bytes(b"x")
    os.close(folder.lock)
    monkeypatch.setattr(staging, "host_name", lambda: "elsewhere")
    ahead = time.time() + 30 * 24 * 3600
    with monkeypatch.context() as patch:
        patch.setattr("time.time", lambda: ahead)
        assert clean_leftovers(tmp_path / "tmp") == 0
    assert {path.name for path in (tmp_path / "tmp").iterdir()} == {folder.path.name, f"{folder.path.name}.lock"}
    for path in (folder.path / "file", folder.path, folder.path.with_name(f"{folder.path.name}.lock")):
        os.utime(path, (0, 0))
    assert clean_leftovers(tmp_path / "tmp") == 1
    assert list((tmp_path / "tmp").iterdir()) == []
