"""A Prefect server for one run: a separate process that ends with the run, however the run ends.

Run as a module, this is the server: it prints its address and serves until its standard input is closed, which happens
when the parent process dies, also by `kill -9`. (Prefect's own temporary server outlives that.)
"""

from __future__ import annotations

import http
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Literal

_STARTUP_TIMEOUT_VARIABLE = "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS"
_STARTUP_TIMEOUT_S = 120.0
_REFUSED_S = 60.0
"""Time during which a server may refuse connections, as it does while it starts."""
_ASK_AGAIN_S = 0.5
_SAY_AGAIN_S = 10.0
_QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_ENABLED": "false",
    _STARTUP_TIMEOUT_VARIABLE: str(int(_STARTUP_TIMEOUT_S)),
}


class ServerError(Exception):
    """Prefect's server did not start or does not answer; the message names the case and the remedy."""


def telemetry_off() -> None:
    """Set Prefect's environment before its import: no telemetry, time for a cold start; set variables stay."""
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    os.environ.setdefault("PREFECT_LOGGING_LEVEL", "CRITICAL")
    # Its services complain at the end if the server is gone: at their own level, and under names
    # outside Prefect's ("EventsWorker: still processing items").
    os.environ.setdefault("PREFECT_INTERNAL_LOGGING_LEVEL", "CRITICAL")
    for service in ("EventsWorker", "APILogWorker"):
        logging.getLogger(service).setLevel(logging.CRITICAL)


class LocalServer:
    """A starting server; `wait` returns the address of its API once it answers."""

    def __init__(self) -> None:
        telemetry_off()
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - `end` closes it
        self._timeout_s = float(os.environ[_STARTUP_TIMEOUT_VARIABLE])
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flows.prefect_server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            start_new_session=True,
        )

    def wait(self) -> str:
        """Wait until the server answers.

        Raises:
            ServerError: It ended, or did not answer in time.
        """
        assert self.process.stdout is not None
        deadline = time.monotonic() + self._timeout_s
        address = self.process.stdout.readline().strip()
        while not (address and _state(address) == "answers"):
            if not address or self.process.poll() is not None:
                code, words = self.process.wait(), self._last_words()
                raise ServerError(f"Prefect's local server ended with code {code} instead of starting{words}")
            if time.monotonic() > deadline:
                raise ServerError(
                    f"Prefect's local server did not answer within {self._timeout_s:.0f} s; "
                    f"set {_STARTUP_TIMEOUT_VARIABLE} to wait longer"
                )
            time.sleep(0.1)
        return address

    def end(self) -> None:
        """End the server; its records stay in the user's Prefect database."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()
        self._errors.close()

    def _last_words(self) -> str:
        """Return the server's last line on standard error, after a colon; empty without one."""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        return next((f": {line.strip()}" for line in reversed(lines) if line.strip()), "")


@contextmanager
def writable_home(note: Callable[[str], None]) -> Iterator[None]:
    """Let Prefect use a temporary folder in this block if its own cannot be written; `note` receives a message."""
    home = Path(os.environ.get("PREFECT_HOME") or "~/.prefect")
    if not (reason := _why_not_writable(home)):
        yield
        return
    changed = {"PREFECT_HOME": ""}
    with suppress(OSError, RuntimeError):
        home = home.expanduser()
        if (home / "profiles.toml").is_file() and "PREFECT_PROFILES_PATH" not in os.environ:
            changed["PREFECT_PROFILES_PATH"] = str(home / "profiles.toml")
    before = {name: os.environ.get(name) for name in changed}
    with tempfile.TemporaryDirectory(prefix="pasdedeux-prefect-", ignore_cleanup_errors=True) as folder:
        note(f"Prefect's folder {home} cannot be written ({reason}): its record of this run is temporary, in {folder}")
        os.environ.update(changed, PREFECT_HOME=folder)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _why_not_writable(home: Path) -> str:
    """Return why Prefect cannot keep its database in a folder, which is created; empty if it can."""
    try:
        home = home.expanduser()
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=home):
            pass
        with suppress(FileNotFoundError), (home / "prefect.db").open("r+b"):
            pass
    except OSError as error:
        return error.strerror or type(error).__name__
    except RuntimeError:
        return "this user has no home"
    return ""


@contextmanager
def starting_server() -> Iterator[LocalServer]:
    """Start a server on a free local port, without waiting for it; it ends with this block."""
    server = LocalServer()
    try:
        yield server
    finally:
        server.end()


def check_server(address: str, note: Callable[[str], None]) -> None:
    """Wait while a server refuses connections because it is starting; `note` receives messages.

    Raises:
        ServerError: It refuses for too long, or does not answer.
    """
    began = said = time.monotonic()
    while (state := _state(address)) == "refuses" and time.monotonic() - began < _REFUSED_S:
        if said == began or time.monotonic() - said > _SAY_AGAIN_S:
            said = time.monotonic()
            note(f"Prefect's server at {address} refuses connections, waiting up to {_REFUSED_S:g} s for it to start")
        time.sleep(_ASK_AGAIN_S)
    if state != "answers":
        raise ServerError(f"Prefect's server at {address} does not answer; start it, or unset PREFECT_API_URL")


@contextmanager
def signed_in(address: str) -> Iterator[None]:
    """Turn a server's request for a password in this block into a ServerError that says what to do."""
    try:
        yield
    except Exception as error:
        if getattr(getattr(error, "response", None), "status_code", None) != http.HTTPStatus.UNAUTHORIZED:
            raise
        raise ServerError(
            f"Prefect's server at {address} refuses the password (401 Unauthorized): set PREFECT_API_AUTH_STRING here "
            "to the name:password with which the server was started"
        ) from None


def _state(address: str) -> Literal["answers", "refuses", "fails"]:
    try:
        with urllib.request.urlopen(f"{address}/health", timeout=5) as answer:
            return "answers" if answer.status == http.HTTPStatus.OK else "fails"
    except urllib.error.URLError as error:
        return "refuses" if isinstance(error.reason, ConnectionRefusedError) else "fails"
    except (OSError, ValueError):
        return "fails"


def _serve() -> None:
    """Run as the server."""
    telemetry_off()
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.stdout.write(f"http://127.0.0.1:{listening.getsockname()[1]}/api\n")
    sys.stdout.flush()

    import uvicorn
    from prefect.server.api.server import create_app

    config = uvicorn.Config(create_app(ephemeral=True, final=True), log_level="critical", lifespan="on")
    uvicorn.Server(config).run(sockets=[listening])


def _end_with_parent() -> None:
    """Exit at once when standard input is closed, because the parent process has ended."""
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    _serve()
