"""An S3 server on loopback that can be slow, fail, or hang up in the middle of an answer."""

from __future__ import annotations

import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server

SECRET = "not-for-any-log-4711"
BUCKET = "datasets"
Answer = Callable[..., Iterable[bytes]]


class _Quiet(WSGIRequestHandler):
    def log(self, *_: Any, **__: Any) -> None:
        """Say nothing."""


@dataclass
class S3Server:
    """A server with one bucket; `fault` is asked with method and path before each answer, and names what goes wrong.

    "error" answers 503, and a status such as "403 SignatureDoesNotMatch" that one, with the word as S3's code; "slow"
    waits, "cut" hangs up after half of the answer, "lost" before any of it, "gone" before the work too.
    """

    port: int
    prefix: str = field(default_factory=lambda: uuid.uuid4().hex)  # what the server knows outlives it
    slow_s: float = 3.0
    requests: list[str] = field(default_factory=list)
    fault: Callable[[str, str], str] = lambda method, path: ""
    start: Callable[[], Callable[[], None]] = field(init=False)
    stop: Callable[[], None] = field(init=False)

    @property
    def place(self) -> str:
        return f"s3://{BUCKET}/some/{self.prefix}"

    @contextmanager
    def refusing(self) -> Iterator[None]:
        """Refuse connections in this block; what was stored stays."""
        self.stop()
        try:
            yield
        finally:
            self.stop = self.start()


def _serving(server: S3Server, app: Answer) -> Callable[[], None]:
    """Serve on the server's port, a free one the first time; gives what ends it."""
    listening = make_server("127.0.0.1", server.port, app, threaded=True, request_handler=_Quiet)
    server.port = listening.server_port
    thread = threading.Thread(target=listening.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()

    def stop() -> None:
        listening.shutdown()
        thread.join()
        listening.server_close()

    return stop


def _with_faults(app: Answer, server: S3Server) -> Answer:
    def answer(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        server.requests.append(f"{method} {path}")
        fault = server.fault(method, path)
        if fault == "error" or fault[:1].isdigit():
            status = fault if fault[:1].isdigit() else "503 SlowDown"
            said = f"<Error><Code>{status.partition(' ')[2]}</Code></Error>".encode()
            start_response(status, [("Content-Length", str(len(said)))])
            return [said] if method != "HEAD" else []
        if fault == "gone":
            environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
            return []
        if fault == "slow":
            time.sleep(server.slow_s)
        body = b"".join(app(environ, start_response))
        if fault == "lost":
            environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
            return []
        if fault == "cut":
            return _cut(body, environ["werkzeug.socket"])
        return [body]

    return answer


def _cut(body: bytes, connection: socket.socket) -> Iterator[bytes]:
    yield body[: len(body) // 2]
    connection.shutdown(socket.SHUT_RDWR)


@contextmanager
def s3_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """Start a server; address and credentials are in the environment as a user would say them."""
    server = S3Server(0)
    app = _with_faults(DomainDispatcherApplication(create_backend_app), server)
    server.start = lambda: _serving(server, app)
    server.stop = server.start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.port}")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tester")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    try:
        import boto3

        client = boto3.client("s3", endpoint_url=f"http://127.0.0.1:{server.port}")
        client.create_bucket(Bucket=BUCKET)
        client.close()
        yield server
    finally:
        server.stop()
