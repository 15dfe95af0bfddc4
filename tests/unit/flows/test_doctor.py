"""`doctor`: what is enough for a run, what is not, and how both are said."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flows.console import doctor
from flows.console.app import run_command_line
from flows.prefect_server import ServerError
from tasks.shards import ClusterError

GIB = 2**30


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what is found of the machine, which is just enough."""
    found: dict[str, Any] = {"memory": 2 * GIB, "disk": GIB, "cache": ("/kept", ""), "server": None, "dask": None}
    settings = SimpleNamespace(api=SimpleNamespace(url=None))

    def check_server(address: str, note: Any) -> None:
        note("waiting")
        if found["server"] != address:
            raise ServerError(f"{address} does not answer")

    @contextmanager
    def connect(cluster: Any, *, store_root: str) -> Iterator[Any]:
        if found["dask"]:
            raise ClusterError(found["dask"])
        assert cluster.num_workers == 1
        assert Path(store_root).is_dir()
        yield SimpleNamespace(run=lambda _: {"tcp://a": 77})

    monkeypatch.setattr(doctor, "memory_bytes", lambda: found["memory"])
    monkeypatch.setattr(doctor, "free_bytes", lambda _: found["disk"])
    monkeypatch.setattr(doctor, "kernel_cache", lambda: found["cache"])
    monkeypatch.setattr(doctor, "check_server", check_server)
    monkeypatch.setattr(doctor, "connect", connect)
    monkeypatch.setattr("prefect.settings.get_current_settings", lambda: settings)
    return {"found": found, "settings": settings}


@pytest.mark.parametrize(
    ("name", "value", "check", "is_ok", "words"),
    [
        ("memory", 2 * GIB, "memory", True, "2.0 GB; 2 GB per worker are assumed"),
        ("memory", 2 * GIB - 1, "memory", False, "2.0 GB"),
        ("memory", None, "memory", True, "unknown"),
        ("disk", GIB, "store", True, "is writable, 1.0 GB free"),
        ("disk", GIB - 1, "store", False, "1.0 GB free"),
        ("cache", ("/kept", ""), "compiled kernels", True, "kept in /kept"),
        ("cache", ("/kept", "no folder for them"), "compiled kernels", False, "no folder for them"),
        ("dask", None, "dask", True, "a local worker starts and answers (process 77)"),
        ("dask", "no worker came", "dask", False, "no worker came"),
    ],
)
def test_what_is_not_enough_is_bad_and_ends_with_1(
    machine: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    value: Any,
    check: str,
    is_ok: bool,
    words: str,
) -> None:
    machine["found"][name] = value
    assert run_command_line(["doctor", "--store", str(tmp_path / "store"), "--json"]) == (0 if is_ok else 1)
    findings = {one["name"]: one for one in json.loads(capsys.readouterr().out)}
    assert {one for one, finding in findings.items() if not finding["is_ok"]} == (set() if is_ok else {check})
    assert words in findings[check]["found"]
    assert "numpy " in findings["packages"]["found"]
    assert "starts and ends its own" in findings["prefect server"]["found"]


@pytest.mark.parametrize("answering", ["http://here/api", "http://elsewhere/api"])
def test_a_server_that_is_named_must_answer_and_waiting_is_said_aside(
    machine: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], answering: str
) -> None:
    machine["settings"].api.url, machine["found"]["server"] = "http://here/api", answering
    is_ok = answering == "http://here/api"
    assert run_command_line(["doctor", "--store", str(tmp_path)]) == (0 if is_ok else 1)
    said = capsys.readouterr()
    (line,) = (line for line in said.out.splitlines() if "prefect server" in line)
    assert line.split(maxsplit=3)[::3] == (
        ["ok", "http://here/api answers"] if is_ok else ["BAD", "http://here/api does not answer"]
    )
    assert said.err == "waiting\n"


def test_a_store_that_cannot_be_written_is_bad(
    machine: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path)
    assert run_command_line(["doctor", "--store", str(tmp_path / "store")]) == 1
    assert f"BAD  store            {tmp_path / 'store'} is not writable" in capsys.readouterr().out
