"""`doctor`: what is enough for a run, what is not, and how both are said."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flows.console import doctor
from flows.prefect_server import ServerError
from storage_schema import Store
from tasks.shards import ClusterError
from tests.builders.command_line import CommandLine

GIB = 2**30


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what is found of the machine, which is just enough."""
    facts: dict[str, Any] = {"memory": 2 * GIB, "disk": GIB, "cache": ("/kept", ""), "server": None, "dask": None}
    settings = SimpleNamespace(api=SimpleNamespace(url=None))

    def check_server(address: str, note: Any) -> None:
        note("waiting")
        if facts["server"] != address:
            raise ServerError(f"{address} does not answer")

    @contextmanager
    def connect(cluster: Any, *, store_root: str) -> Iterator[Any]:
        if facts["dask"]:
            raise ClusterError(facts["dask"])
        assert cluster.num_workers == 1
        assert Path(store_root).is_dir()
        yield SimpleNamespace(run=lambda _: {"tcp://a": 77})

    monkeypatch.setattr(doctor, "memory_bytes", lambda: facts["memory"])
    monkeypatch.setattr(doctor, "free_bytes", lambda _: facts["disk"])
    monkeypatch.setattr(doctor, "kernel_cache", lambda: facts["cache"])
    monkeypatch.setattr(doctor, "check_server", check_server)
    monkeypatch.setattr(doctor, "connect", connect)
    monkeypatch.setattr("prefect.settings.get_current_settings", lambda: settings)
    return {"found": facts, "settings": settings}


@pytest.mark.parametrize(
    ("name", "value", "check", "code", "words"),
    [
        ("memory", 2 * GIB, "memory", 0, "2.0 GB; 2 GB per worker are assumed"),
        ("memory", 2 * GIB - 1, "memory", 1, "2.0 GB"),
        ("memory", None, "memory", 0, "unknown"),
        ("disk", GIB, "store", 0, "is writable, 1.0 GB free"),
        ("disk", GIB - 1, "store", 1, "1.0 GB free"),
        ("cache", ("/kept", ""), "compiled kernels", 0, "kept in /kept"),
        ("cache", ("/kept", "no folder for them"), "compiled kernels", 1, "no folder for them"),
        ("dask", None, "dask", 0, "a local worker starts and answers (process 77)"),
        ("dask", "no worker came", "dask", 1, "no worker came"),
    ],
)
def test_what_is_not_enough_is_bad_and_ends_with_1(
    machine: dict[str, Any], store: Store, invoke: CommandLine, name: str, value: Any, check: str, code: int, words: str
) -> None:
    machine["found"][name] = value
    answer = invoke("doctor", "--store", store, "--json", code=code)
    findings = {finding["name"]: finding for finding in answer.json}
    assert {name for name, finding in findings.items() if not finding["is_ok"]} == ({check} if code else set())
    assert words in findings[check]["found"]
    assert "numpy " in findings["packages"]["found"]
    assert "starts and ends its own" in findings["prefect server"]["found"]


@pytest.mark.parametrize(
    ("answering", "code", "line"),
    [("http://here/api", 0, "ok http://here/api answers"), ("http://a/api", 1, "BAD http://here/api does not answer")],
)
def test_a_server_that_is_named_must_answer_and_waiting_is_said_aside(
    machine: dict[str, Any], tmp_path: Path, invoke: CommandLine, answering: str, code: int, line: str
) -> None:
    machine["settings"].api.url, machine["found"]["server"] = "http://here/api", answering
    said = invoke("doctor", "--store", tmp_path, code=code)
    (finding,) = (line for line in said.out.splitlines() if "prefect server" in line)
    assert " ".join(finding.split(maxsplit=3)[::3]) == line
    assert said.err == "waiting\n"


def test_a_store_that_cannot_be_written_is_bad(
    machine: dict[str, Any], monkeypatch: pytest.MonkeyPatch, store: Store, invoke: CommandLine
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: path != store.root.parent)
    said = invoke("doctor", "--store", store, code=1).out
    assert f"BAD  store            {store} is not writable" in said
