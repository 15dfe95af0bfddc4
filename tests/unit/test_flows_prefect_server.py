"""Prefect's server of one run: it answers, it ends with the run, and one that does not answer is named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from flows.console import run as run_module
from flows.outcomes import Run
from flows.prefect_server import LocalServer, ServerError, check_server, starting_server
from flows.progress import Listener
from flows.study import load_study
from storage_schema import Store
from tasks.shards import ClusterSettings
from tests.builders.toy_runs import ROOT, write_study
from tests.builders.toys import TOYS


@pytest.fixture(autouse=True)
def _home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path_factory.getbasetemp() / "prefect_home"))
    monkeypatch.setenv("DO_NOT_TRACK", "1")
    monkeypatch.setenv("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
    monkeypatch.setenv("PREFECT_LOGGING_LEVEL", "CRITICAL")
    monkeypatch.setenv("PREFECT_SERVER_UI_ENABLED", "false")
    monkeypatch.setenv("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "120")


@pytest.mark.slow
def test_the_server_answers_inside_the_block_and_is_gone_after_it() -> None:
    with starting_server() as server:
        address = server.wait()
        check_server(address)
        with urllib.request.urlopen(f"{address}/health", timeout=10) as answer:
            assert answer.read() == b"true"
    with pytest.raises(ServerError, match="does not answer"):
        check_server(address)


@pytest.mark.slow
def test_the_server_of_a_run_sends_no_telemetry_and_neither_does_what_talks_to_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("DO_NOT_TRACK", "PREFECT_SERVER_ANALYTICS_ENABLED"):
        monkeypatch.delenv(name)
    with starting_server() as server:
        with urllib.request.urlopen(f"{server.wait()}/admin/settings", timeout=30) as answer:
            assert json.loads(answer.read())["server"]["analytics_enabled"] is False
        assert os.environ["DO_NOT_TRACK"] == "1"
        assert b"DO_NOT_TRACK=1" in Path(f"/proc/{server.process.pid}/environ").read_bytes().split(b"\0")


def test_the_server_ends_when_the_process_that_started_it_is_gone() -> None:
    server = LocalServer()
    process = server.process
    assert process.stdin is not None
    process.stdin.close()  # what the system does to the pipe of a killed process
    assert process.wait(timeout=60) == 0
    server.end()


def test_a_server_that_cannot_start_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\nexit 7\n")
    broken.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(broken))
    with starting_server() as server, pytest.raises(ServerError, match="ended with code 7 instead of starting"):
        server.wait()


def test_a_users_server_that_does_not_answer_fails_the_run_before_any_work(tmp_path: Path) -> None:
    environment = {**os.environ, "PREFECT_API_URL": "http://127.0.0.1:9/api"}
    arguments = ["run", str(write_study(tmp_path)), "--store", str(tmp_path / "store"), "--workers", "0"]
    found = subprocess.run(
        [sys.executable, "-m", "tests.builders.toys", *arguments],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 1
    assert "error: Prefect's server at http://127.0.0.1:9/api does not answer" in found.stderr
    assert "Traceback" not in found.stderr


def test_the_terminal_is_given_back_where_a_users_server_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []

    class Closing(Listener):
        def close(self) -> None:
            closed.append(self)

    monkeypatch.setattr(run_module, "make_listener", lambda **_: Closing())
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    chosen, stages = load_study(str(write_study(tmp_path)), TOYS)
    run = Run(chosen, stages, Store(tmp_path / "store"))
    with pytest.raises(ServerError, match="does not answer"):
        run_module.build(run, ClusterSettings(num_workers=0), is_quiet=False)
    assert len(closed) == 1
