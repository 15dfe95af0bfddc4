"""Prefect's server of one run: it answers, it ends with the run, and one that does not answer is named."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from signal import SIGKILL
from threading import Thread
from urllib.parse import urlsplit

import pytest

from flows import prefect_server
from flows.console import run as run_module
from flows.outcomes import Run
from flows.prefect_server import LocalServer, ServerError, check_server, starting_server, writable_home
from flows.progress import Listener
from flows.study import load_study
from storage_schema import Store
from tasks.shards import ClusterSettings
from tests.builders.toy_runs import ROOT, write_study
from tests.builders.toys import TOYS


@pytest.fixture(autouse=True)
def _home(prefect_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_HOME", str(prefect_home))
    monkeypatch.setenv("DO_NOT_TRACK", "1")
    monkeypatch.setenv("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
    monkeypatch.setenv("PREFECT_LOGGING_LEVEL", "CRITICAL")
    monkeypatch.setenv("PREFECT_SERVER_UI_ENABLED", "false")
    monkeypatch.setenv("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "120")


@pytest.mark.slow
def test_the_server_of_a_run_answers_sends_no_telemetry_and_is_gone_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DO_NOT_TRACK", "PREFECT_SERVER_ANALYTICS_ENABLED"):
        monkeypatch.delenv(name)
    with starting_server() as server:
        address = server.wait()
        check_server(address, print)
        with urllib.request.urlopen(f"{address}/health", timeout=10) as answer:
            assert answer.read() == b"true"
        with urllib.request.urlopen(f"{address}/admin/settings", timeout=30) as answer:
            assert json.loads(answer.read())["server"]["analytics_enabled"] is False
        assert os.environ["DO_NOT_TRACK"] == "1"
        assert b"DO_NOT_TRACK=1" in Path(f"/proc/{server.process.pid}/environ").read_bytes().split(b"\0")
    monkeypatch.setattr(prefect_server, "_REFUSED_S", 0.0)
    with pytest.raises(ServerError, match="does not answer"):
        check_server(address, print)


def test_the_server_ends_when_the_process_that_started_it_is_gone() -> None:
    server = LocalServer()
    process = server.process
    address = urlsplit(process.stdout.readline().strip())
    assert (address.scheme, address.hostname, address.path) == ("http", "127.0.0.1", "/api")
    assert address.port is not None
    assert address.port >= 1024, "a free port, whatever the user may open"
    process.stdin.close()  # what the system does to the pipe of a killed process
    assert process.wait(timeout=60) == 0
    server.end()


@pytest.mark.parametrize("said", ["echo the reason", "echo Traceback; echo ' the reason '; echo"])
def test_a_failed_start_quotes_the_last_words(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, said: str) -> None:
    broken = tmp_path / "python"
    broken.write_text(f"#!/bin/sh\n{{ {said}; }} >&2\nexit 7\n")
    broken.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(broken))
    with starting_server() as server, pytest.raises(ServerError, match=r"code 7 instead of starting: the reason$"):
        server.wait()


def test_a_server_that_does_not_answer_in_time_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "0")
    said = "did not answer within 0 s; set PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS to wait longer"
    with starting_server() as server, pytest.raises(ServerError, match=said):
        server.wait()
    assert server.process.returncode == -SIGKILL


@contextmanager
def answering(health: int, rest: int) -> Iterator[str]:
    """Serve the status `health` to who asks whether the server is well, and `rest` to all else; gives the address."""

    class Answer(BaseHTTPRequestHandler):
        def _answer(self) -> None:
            self.send_response(health if self.path.endswith("/health") else rest)
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_GET = do_POST = _answer  # noqa: N815 - so they are called

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = HTTPServer(("127.0.0.1", 0), Answer)
    thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/api"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_server_that_starts_is_waited_for_and_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with answering(200, 200) as address:
        pass
    said: list[str] = []
    with answering(200, 200) as started:
        # It starts while it is waited for: the second question reaches one that answers.
        state = prefect_server._state
        monkeypatch.setattr(prefect_server, "_state", lambda asked: state(started if said else asked))
        monkeypatch.setattr(prefect_server, "_ASK_AGAIN_S", 0.0)
        check_server(address, said.append)
    assert said == [f"Prefect's server at {address} refuses connections, waiting up to 60 s for it to start"]


@pytest.mark.parametrize(
    ("words", "health", "said"),
    [
        (("run",), 500, "does not answer; start it, or unset PREFECT_API_URL"),
        (("deploy", "--every", "60"), 200, "refuses the password (401 Unauthorized): set PREFECT_API_AUTH_STRING here"),
    ],
)
def test_an_ill_server_is_one_sentence(tmp_path: Path, words: tuple[str, ...], health: int, said: str) -> None:
    arguments = [words[0], str(write_study(tmp_path)), "--store", str(tmp_path / "store"), "--workers", "0", *words[1:]]
    with answering(health, 401) as address:
        ended = subprocess.run(
            [sys.executable, "-m", "tests.builders.toys", *arguments],
            cwd=ROOT,
            env={**os.environ, "PREFECT_API_URL": address},
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.returncode == 1
    assert f"error: Prefect's server at {address} {said}" in ended.stderr.splitlines()[-1]
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    "kind", ["a file is in its place", "nothing can be made there", "nobody's home", "its database is closed"]
)
def test_an_unwritable_home_is_replaced_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    home = tmp_path / "home"
    if kind == "a file is in its place":
        home.touch()
    elif kind == "nobody's home":
        home = Path("~nobody-of-this-name/prefect")
    elif kind == "nothing can be made there":
        home = Path("/proc/nobody/home")
    else:
        (home / "prefect.db").mkdir(parents=True)
        (home / "profiles.toml").touch()
    monkeypatch.setenv("PREFECT_HOME", str(home))
    said: list[str] = []
    with writable_home(said.append):
        used = Path(os.environ["PREFECT_HOME"])
        assert used.is_dir()
        has_profiles = os.environ.get("PREFECT_PROFILES_PATH") == str(home / "profiles.toml")
        assert has_profiles == (kind == "its database is closed"), "the user's settings stay"
    assert not used.exists()
    assert (os.environ["PREFECT_HOME"], "PREFECT_PROFILES_PATH" in os.environ) == (str(home), False)
    assert len(said) == 1
    assert said[0].startswith(f"Prefect's folder {home} cannot be written (")
    assert f"in {used}" in said[0]


@pytest.mark.slow
def test_a_run_builds_where_prefects_folder_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_HOME", "/proc/nobody")
    chosen, stages = load_study(str(write_study(tmp_path)), TOYS)
    outcome, _ = run_module.build(
        Run(chosen, stages, Store(tmp_path / "store")), ClusterSettings(num_workers=0), is_quiet=True
    )
    assert outcome.num_computed


def test_the_terminal_is_given_back_after_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []

    class Closing(Listener):
        def close(self) -> None:
            closed.append(self)

    monkeypatch.setattr(run_module, "make_listener", lambda **_: Closing())
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    monkeypatch.setattr(prefect_server, "_REFUSED_S", 0.0)
    chosen, stages = load_study(str(write_study(tmp_path)), TOYS)
    run = Run(chosen, stages, Store(tmp_path / "store"))
    with pytest.raises(ServerError, match="does not answer"):
        run_module.build(run, ClusterSettings(num_workers=0), is_quiet=False)
    assert len(closed) == 1
