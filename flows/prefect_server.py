"""A Prefect server for the length of one run: a process of its own that ends with the run, however that ends.

Run as a module it is the server; it prints its address and serves until its standard input is closed, which the
system does when the process that started it dies, also by `kill -9`. (Prefect's own temporary server outlives that.)
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

_STARTUP_TIMEOUT_VARIABLE = "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS"
_STARTUP_TIMEOUT_S = 120.0
_QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_ENABLED": "false",
    _STARTUP_TIMEOUT_VARIABLE: str(int(_STARTUP_TIMEOUT_S)),
}


class ServerError(Exception):
    """Prefect's server did not start or does not answer; the message names the case and the remedy."""


def telemetry_off() -> None:
    """Set Prefect's environment before it is imported: no telemetry, and time for a cold start; what is set stays."""
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    os.environ.setdefault("PREFECT_LOGGING_LEVEL", "CRITICAL")
    # Its services say at the end what a server that is gone did not take: under a level of their own, and under names
    # outside of Prefect's ("EventsWorker: still processing items").
    os.environ.setdefault("PREFECT_INTERNAL_LOGGING_LEVEL", "CRITICAL")
    for service in ("EventsWorker", "APILogWorker"):
        logging.getLogger(service).setLevel(logging.CRITICAL)


class LocalServer:
    """A server that is starting; `wait` gives the address of its API once it answers."""

    def __init__(self) -> None:
        telemetry_off()
        self._timeout_s = float(os.environ[_STARTUP_TIMEOUT_VARIABLE])
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flows.prefect_server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
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
        while not (address and _answers(address)):
            if not address or self.process.poll() is not None:
                raise ServerError(f"Prefect's local server ended with code {self.process.wait()} instead of starting")
            if time.monotonic() > deadline:
                raise ServerError(
                    f"Prefect's local server did not answer within {self._timeout_s:.0f} s; "
                    f"set {_STARTUP_TIMEOUT_VARIABLE} to wait longer"
                )
            time.sleep(0.1)
        return address

    def end(self) -> None:
        """End the server; what it has recorded stays in the user's Prefect database."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()


@contextmanager
def starting_server() -> Iterator[LocalServer]:
    """Start a server on a free local port, without waiting for it; it ends with this block."""
    server = LocalServer()
    try:
        yield server
    finally:
        server.end()


def check_server(address: str) -> None:
    """Refuse the address of a server that does not answer."""
    if not _answers(address):
        raise ServerError(f"Prefect's server at {address} does not answer; start it, or unset PREFECT_API_URL")


def _answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(f"{address}/health", timeout=5) as answer:
            return bool(answer.status == 200)
    except (urllib.error.URLError, OSError, ValueError):
        return False


def _serve() -> None:
    """Be the server."""
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
    """Leave at once when standard input is closed: the process that started this one has ended."""
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    _serve()
