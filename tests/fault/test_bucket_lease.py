"""The lease of a store in a bucket: one run at a time, and the lease of a dead one is taken over."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from storage_schema import StorageError, Store, in_use, lease
from storage_schema.bucket import RemoteStore
from storage_schema.bucket_store import BucketStore
from tests.builders.s3_server import S3Server
from tests.builders.storage_rows import commit_rows
from tests.builders.toy_runs import run_toys, wait_until, write_study

pytestmark = pytest.mark.usefixtures("own_cache")

_HOLD_A_LOCK = """
import fcntl, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def somebody_builds(place: str, *, renewed: bool = False, host: str = "elsewhere") -> Iterator[None]:
    """Leave the lease of a run on another machine, which may be alive."""
    remote, number, ended = RemoteStore(place), itertools.count(), threading.Event()

    def say() -> None:
        values = {"holder": "somebody", "host": host, "pid": 1, "renewed": next(number)}
        remote.write("lease", json.dumps(values).encode())

    def renew() -> None:
        while not ended.wait(0.2):
            say()

    say()
    thread = threading.Thread(target=renew)
    if renewed:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if renewed:
            thread.join()


def test_a_lease_is_taken_over_only_when_it_is_not_renewed(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.lease.LEASE_S", 1.2)
    with (
        somebody_builds(server.place, renewed=True),
        pytest.raises(StorageError, match=r"\(process 1 on elsewhere\); try again when it has ended$"),
        in_use(Store(server.place)),
    ):
        pass
    with somebody_builds(server.place), in_use(Store(server.place)):
        there = json.loads(RemoteStore(server.place).read("lease"))
    assert (there["holder"] != "somebody", there["pid"]) == (True, os.getpid())


def test_a_lease_that_is_waited_for_is_said_with_whose_it_is_and_until_when(
    server: S3Server, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("storage_schema.lease.LEASE_S", 1.2)
    monkeypatch.setattr("storage_schema.lease._SAY_AFTER_S", 0.1)
    with somebody_builds(server.place, host="else\x1b]0;where"), in_use(Store(server.place)):
        pass
    (said,) = caplog.messages
    assert re.fullmatch(
        rf"{server.place}: process 1 on else\\u001b\]0;where has the lease and does not renew it; waiting until "
        r"\d\d:\d\d:\d\d, then this run takes it over",
        said,
    )


def test_a_stopped_process_that_has_a_mirror_is_named_while_it_is_waited_for(
    server: S3Server, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("storage_schema.durable._SAY_AFTER_S", 0.1)
    mirror = BucketStore(server.place)
    mirror.root.parent.mkdir(parents=True)
    holder = subprocess.Popen(
        [sys.executable, "-c", _HOLD_A_LOCK, str(mirror.root.with_suffix(".lock"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with holder, ThreadPoolExecutor(1) as threads:
        assert holder.stdout is not None
        holder.stdout.readline()
        holder.send_signal(signal.SIGSTOP)

        def build() -> None:
            with in_use(Store(server.place)):
                pass

        waiting = threads.submit(build)
        try:
            wait_until(lambda: caplog.messages != [] or waiting.done(), "a word", limit_s=20.0)
        finally:
            holder.kill()
        waiting.result(timeout=60)
    (said,) = caplog.messages
    assert said.startswith(f"waiting for the mirror {mirror.root} of {server.place}, which process {holder.pid} on ")
    assert f"if it is stopped, continue it (`kill -CONT {holder.pid}`) or end it" in said


def test_a_lease_is_free_at_once_only_where_its_process_of_this_very_system_is_dead() -> None:
    boot, container = lease._system().split()
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()

    def is_free(system: str, pid: int) -> bool:
        return lease._is_dead_here({"system": system, "pid": pid})

    assert is_free(f"{boot} {container}", ended.pid)
    assert not is_free(f"{boot} {container}", os.getpid())
    assert not is_free(f"{boot} pid:[1]", ended.pid), "another container of this machine"
    assert not is_free(f"another-boot {container}", ended.pid), "another machine with the same number"
    assert not is_free("", ended.pid), "a system that does not say"


def test_a_run_whose_lease_was_taken_says_so_and_leaves_the_records_of_the_other(
    server: S3Server, tmp_path: Path
) -> None:
    made: list[int] = []

    def lose_it() -> None:
        with in_use(Store(server.place)):
            made.append(run_toys(write_study(tmp_path), Path(server.place)).num_computed)
            with somebody_builds(server.place):
                pass

    with pytest.raises(StorageError, match=r"another run has taken over the store s3://.*the same command goes on"):
        lose_it()
    remote = RemoteStore(server.place)
    assert not [file for file in remote.entries("records") if "/runs/latest/" in file["path"]]
    assert [len(remote.entries("manifests"))] == made


def test_a_run_whose_lease_was_taken_ends_before_it_commits_again(
    server: S3Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage_schema.lease._BEAT_S", 0.05)
    store, remote = Store(server.place), RemoteStore(server.place)

    def go_on() -> None:
        with in_use(store):
            commit_rows(store, name="one")
            with somebody_builds(server.place):
                mirror = BucketStore(server.place)
                wait_until(lambda: mirror._lease.is_over, "the lease to be missed")
            commit_rows(store, name="two")

    with pytest.raises(StorageError, match="another run has taken over the store"):
        go_on()
    assert len(remote.entries("manifests")) == 1
    remote.delete(["lease"])
    with pytest.raises(StorageError, match="another run has taken over the store"), in_use(store):
        remote.delete(["lease"])


def test_a_lease_is_renewed_as_long_as_its_holder_lives(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.lease._BEAT_S", 0.05)
    remote = RemoteStore(server.place)
    with in_use(Store(server.place)):
        first = remote.read("lease")
        wait_until(lambda: remote.read("lease") != first, "the lease to be renewed", limit_s=20.0)


def test_a_lease_that_cannot_be_read_is_somebodys_until_it_does_not_change(
    server: S3Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage_schema.lease.LEASE_S", 0.6)
    remote = RemoteStore(server.place)
    remote.write("lease", b"[")
    with in_use(Store(server.place)):
        assert json.loads(remote.read("lease"))["pid"] == os.getpid()
