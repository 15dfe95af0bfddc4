"""Requests to a bucket: what passes is waited for, what waiting cannot mend is said at once, nothing is mixed."""

from __future__ import annotations

import hashlib
import itertools
import os
import time
from pathlib import Path

import pytest
from obstore.exceptions import GenericError

from storage_schema.bucket import RemoteError, RemoteStore
from storage_schema.bucket_store import BucketStore
from tests.builders.s3_server import SECRET, S3Server

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.mark.parametrize(
    ("status", "why"),
    [
        ("501 NotImplemented", "501 Not Implemented"),
        ("403 AccessDenied", "access is denied, check the credentials in the environment"),
        ("403 SignatureDoesNotMatch", "refuses the signature, check AWS_SECRET_ACCESS_KEY"),
        ("400 AuthorizationHeaderMalformed", "400 Bad Request"),
        ("unknown.invalid", "the server's host name cannot be resolved, check AWS_ENDPOINT_URL"),
        ("https", "the server does not speak https, check AWS_ENDPOINT_URL"),
    ],
)
def test_a_fault_of_the_bucket_that_waiting_cannot_mend_is_said_after_one_request(
    server: S3Server, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, status: str, why: str
) -> None:
    if status[0].isdigit():
        server.fault = lambda method, path: status
    else:
        address = f"https://127.0.0.1:{server.port}" if status == "https" else f"http://{status}"
        monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    server.requests.clear()
    remote = RemoteStore(server.place)
    with pytest.raises(RemoteError, match=rf"^{server.place}: cannot list records.*{why}") as error:
        remote.entries("records")
    assert len(server.requests) <= 1
    assert caplog.messages == []
    assert SECRET not in str(error.value)


@pytest.mark.parametrize("status", ["500 InternalError", "503 SlowDown", "429 TooManyRequests", "522 Timeout"])
def test_a_fault_of_the_bucket_that_passes_is_ridden_out(server: S3Server, status: str) -> None:
    left = iter([status] * 3)
    server.fault = lambda method, path: next(left, "")
    assert RemoteStore(server.place).entries("records") == []


def test_a_name_server_that_fails_for_now_is_ridden_out(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    remote, message = RemoteStore(server.place), "dns error: Temporary failure in name resolution"
    failures, working = [GenericError(message), GenericError(message)], remote._store

    class Unresolved:
        def list(self, prefix: str) -> object:
            if failures:
                raise failures.pop()
            return working.list(prefix)

    monkeypatch.setattr(remote, "_store", Unresolved())
    assert remote.entries("records") == []
    assert failures == []


@pytest.mark.parametrize("num_conflicts", [1, 3])
def test_a_write_that_conflicts_with_another_is_repeated(server: S3Server, num_conflicts: int) -> None:
    def conflict() -> None:
        left = iter(["409 ConditionalRequestConflict"] * num_conflicts)
        server.fault = lambda method, path: next(left, "") if method == "PUT" else ""

    remote = RemoteStore(server.place)
    conflict()
    assert remote.create("lease", b"1")
    conflict()
    assert not remote.create("lease", b"2")
    conflict()
    tag = remote.replace("lease", b"3", remote.read_tagged("lease")[1])
    assert (remote.read("lease"), remote.read_tagged("lease")[1]) == (b"3", tag)
    conflict()
    assert remote.replace("lease", b"4", '"0"') is None
    conflict()
    remote.write("lease", b"5")
    assert remote.read("lease") == b"5"


@pytest.mark.parametrize("is_fetched", [True, False])
def test_a_download_that_breaks_off_again_and_again_goes_on_where_it_ended(
    server: S3Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_fetched: bool
) -> None:
    remote, data = RemoteStore(server.place), os.urandom(3_000_000)
    remote.write("parts/1", data)
    monkeypatch.setattr("storage_schema.bucket._PATIENCE_S", 0.4)  # of one piece, not of the file
    server.requests.clear()
    left = iter(["cut"] * 4)
    server.fault = lambda method, path: next(left, "")
    if is_fetched:
        assert remote.fetch("parts/1", tmp_path / "part") == hashlib.sha256(data).hexdigest()
        assert (tmp_path / "part").read_bytes() == data
    else:
        assert remote.read("parts/1") == data
    assert len(server.requests) == 5


def test_a_file_that_is_replaced_while_it_is_read_is_not_mixed(server: S3Server) -> None:
    remote = RemoteStore(server.place)
    remote.write("datasets/toys@1", b"1" * 1_000_000)

    left = iter(["cut"])
    server.fault = lambda method, path: next(left, "")
    pieces = remote._pieces("datasets/toys@1")
    assert set(next(pieces)) == {ord("1")}
    remote.write("datasets/toys@1", b"2" * 1_000_000)
    with pytest.raises(RemoteError, match="cannot read datasets/toys@1: it was replaced meanwhile"):
        list(pieces)


def test_the_parts_of_a_file_are_sent_one_after_another(server: S3Server, tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(os.urandom(12_000_000))
    began: list[float] = []

    def slow(method: str, path: str) -> str:
        if method == "PUT":
            began.append(time.monotonic())
        return "slow" if method == "PUT" else ""

    server.fault, server.slow_s = slow, 0.3
    RemoteStore(server.place).write("parts/1", tmp_path / "large")
    assert len(began) == 3
    assert all(later - earlier >= server.slow_s for earlier, later in itertools.pairwise(began))


def test_a_store_that_is_refreshed_after_an_interrupt_waits_for_its_bucket(server: S3Server) -> None:
    store = BucketStore(server.place)

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.remote.at_once(interrupt, [1])
    left = iter(["error"] * 2)
    server.fault = lambda method, path: next(left, "")
    store.refresh()
    assert next(left, None) is None
