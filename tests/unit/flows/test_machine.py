"""What workers may take of this machine: its cores, its memory, and a folder for compiled kernels."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from flows.machine import GIB, cluster_settings, kernel_cache, memory_bytes, usable_cores, why_few
from storage_schema import Store
from storage_schema.durable import cache_folder
from tasks.ingest.film.detector_files import NetworkAddress
from tasks.shards import ClusterSettings, worker_environment


def test_a_given_kernel_cache_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere")
    assert worker_environment()["NUMBA_CACHE_DIR"] == "/somewhere"


@pytest.mark.parametrize("home", ["unknown", "read-only", "a file"])
def test_a_user_without_a_home_has_a_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, home: str) -> None:
    for name in ("NUMBA_CACHE_DIR", "PASDEDEUX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("os.access", lambda path, mode: mode != os.W_OK or str(path).startswith(str(tmp_path)))
    if home == "unknown":
        monkeypatch.delenv("HOME", raising=False)
        monkeypatch.setattr("os.path.expanduser", lambda path: path)
    else:
        (tmp_path / "a file").touch()
        monkeypatch.setenv("HOME", str(tmp_path / "a file") if home == "a file" else "/proc")
    cache = tmp_path / f"pasdedeux-{os.getuid()}"
    assert cache_folder() == cache
    assert worker_environment()["NUMBA_CACHE_DIR"] == str(cache / "numba")
    assert Store("s3://bucket/store").root.parent == cache / "stores"
    assert NetworkAddress("https://a", "b").kept.parent == cache / "detectors"


def test_kernels_are_kept_where_there_is_a_folder_with_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "new"))
    assert kernel_cache() == (tmp_path / "new", "")
    with monkeypatch.context() as full:
        full.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1e6))
        assert kernel_cache()[1] == f"the disk of {tmp_path / 'new'} has 1 MB left"
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    assert kernel_cache()[1] == f"{tmp_path / 'file'} cannot be written to: Not a directory"


@pytest.mark.parametrize(
    ("groups", "limits"),
    [
        ("0::/a/b\n", {"a/memory.max": "3221225472", "a/b/memory.max": "max", "a/b/cpu.max": "150000 100000"}),
        ("\n0\n0::/\xff\n", {"memory.max": "3221225472", "cpu.max": "150000 100000"}),
        (
            "5:memory:/a/b\n4:cpu,cpuacct:/a\n0::/\n",
            {
                "memory/memory.limit_in_bytes": "3221225472",
                "cpu,cpuacct/a/cpu.cfs_quota_us": "150000",
                "cpu,cpuacct/a/cpu.cfs_period_us": "100000",
                "cpu,cpuacct/cpu.cfs_quota_us": "-1",
                "cpu,cpuacct/cpu.cfs_period_us": "100000",
            },
        ),
    ],
)
def test_workers_keep_to_the_limits_of_a_container(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: str, limits: dict[str, str]
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(8))
    monkeypatch.setattr("os.sysconf", lambda _: 1024**3)
    monkeypatch.setattr("flows.machine._GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr("flows.machine._GROUP_LIMITS", tmp_path)
    assert (usable_cores(), cluster_settings(None).num_workers, why_few(cluster_settings(None))) == (8, 8, "")
    (tmp_path / "cgroup").write_text(groups, encoding="latin-1")
    for name, limit in limits.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(limit + "\n")
    assert (usable_cores(), memory_bytes()) == (2, 3 * GIB)
    assert cluster_settings(None).num_workers == 1
    said = why_few(cluster_settings(None))
    assert said == "; there is memory for no more: 3.0 GB, and 2 GB for each worker (--worker-memory)"
    assert why_few(cluster_settings(None, 1.5)) == ""


def test_unknown_memory_gives_a_worker_to_each_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> int:
        raise ValueError(f"unrecognized configuration name: {name}")

    monkeypatch.setattr("flows.machine._GROUPS", tmp_path / "cgroup")
    assert memory_bytes() == pytest.approx(psutil.virtual_memory().total, rel=0.01)
    monkeypatch.setattr("os.sysconf", refuse)
    monkeypatch.setattr("flows.machine.usable_cores", lambda: 8)
    assert (memory_bytes(), cluster_settings(None).num_workers, why_few(ClusterSettings(3))) == (None, 8, "")
