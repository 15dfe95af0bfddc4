"""A store in a bucket on loopback: runs end with the bytes of a local one, whatever fails, waits, hangs up or dies."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from obstore.exceptions import GenericError

from flows.collecting import collect
from flows.console.app import run_command_line
from flows.outcomes import Outcome
from flows.planning import StageSelection
from flows.viewing.shelf import Shelf
from flows.viewing.viewer import Viewer
from storage_schema import (
    ArtifactRef,
    StorageError,
    Store,
    create_dataset,
    in_use,
    lease,
    list_datasets,
    list_runs,
    open_table,
    verify,
)
from storage_schema.bucket import RemoteError, RemoteStore
from storage_schema.bucket_store import BucketStore, open_bucket
from storage_schema.errors import NamedByDataset
from tasks.files.curation import Choosing
from tasks.shards import ClusterPool, ClusterSettings, ShardError, connect
from tests.builders.s3_server import SECRET, S3Server, s3_server
from tests.builders.storage_rows import commit_rows, put, random_columns
from tests.builders.toy_runs import Outside, build_here, digests, run_toys, wait_until, write_study
from tests.builders.toys import TOYS

if TYPE_CHECKING:
    from obstore import ObjectMeta

pytestmark = pytest.mark.usefixtures("own_cache")

EVERYTHING = 14
_BUILD = """
import sys
from pathlib import Path
from flows.signals import ended_as_by_ctrl_c
from storage_schema import Store, in_use
from tests.builders.toy_runs import run_toys
with ended_as_by_ctrl_c(), in_use(Store(sys.argv[2])):
    run_toys(Path(sys.argv[1]), Path(sys.argv[2]))
"""
_HOLD_A_LOCK = """
import fcntl, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[S3Server]:
    with s3_server(monkeypatch) as found:
        monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
        yield found


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], None]:
    """Go to another machine: nothing is here of what was there."""
    number = itertools.count()
    return lambda: monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / f"cache-{next(number)}"))


def run_there(folder: Path, place: str, *settings: str, selection: StageSelection | None = None) -> Outcome:
    """Build the toys in a bucket, in this process."""
    with in_use(Store(place)):
        return run_toys(write_study(folder), Path(place), *settings, selection=selection)


def digests_there(place: str) -> dict[str, list[str]]:
    Store(place).refresh()
    return digests(Path(place))


def test_every_command_works_on_a_bucket_and_another_machine_sees_the_same(
    server: S3Server,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    build_here(monkeypatch)
    study = str(write_study(tmp_path))

    def call(*arguments: str) -> str:
        assert run_command_line([*arguments, "--store", server.place], graph=TOYS) == 0
        said = capsys.readouterr()
        assert SECRET not in said.out + said.err
        return said.out

    assert f"--store {server.place}" in call("plan", study)
    assert "done: 14 shards computed" in call("run", study)
    assert digests_there(server.place) == undisturbed
    elsewhere()
    assert "everything is fresh, nothing to do" in call("run", study)
    assert ": finished" in call("status")
    assert "0" in call("show", "scores:toy")
    assert "toys@1 made: 14 artifacts" in call("dataset", "create", "toys", "--study", "toy")
    assert "done: 12 shards computed" in call("run", study, "--set", "grow.scale=2")
    elsewhere()
    assert "toys@1  14 artifacts" in call("dataset", "list")
    assert "26 artifacts, 27 files" in call("verify")
    assert len(open_table("training_log:toy", server.place)) == len(open_table("training_log:toys@1", server.place))
    written = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    remote = RemoteStore(server.place)
    written += [remote.read(one["path"]) for folder in ("records", "manifests") for one in remote.entries(folder)]
    assert not any(SECRET.encode() in data for data in [*written, remote.read("lease")])


def test_what_nothing_needs_goes_from_the_bucket_too(
    server: S3Server, elsewhere: Callable[[], None], tmp_path: Path
) -> None:
    run_there(tmp_path, server.place, "grow.num_takes=3")
    run_there(tmp_path, server.place)
    store, remote = Store(server.place), RemoteStore(server.place)
    assert len(list_runs(store)) == 2
    collect(store, datetime.now(UTC) + timedelta(days=1))
    assert (len(remote.entries("manifests")), len(list_runs(store))) == (EVERYTHING, 1)
    assert len(remote.entries("parts")) > EVERYTHING, "the youngest stay"
    with in_use(store):
        BucketStore(server.place).sweep(younger=timedelta(0))
    named = {file.sha256 for one in store.artifacts() for file in one.data_files.values()}
    assert {one["path"] for one in remote.entries("parts")} == {f"parts/{sha256}" for sha256 in named}
    assert verify(store).is_ok
    elsewhere()
    there = Store(server.place)
    there.refresh()
    assert (len(list(there.artifacts())), len(list_runs(there))) == (EVERYTHING, 1)
    assert verify(there).is_ok


@pytest.mark.parametrize("fault", ["error", "slow", "cut", "lost"])
def test_faults_of_the_server_cost_time_and_nothing_else(
    server: S3Server,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
    fault: str,
) -> None:
    counter, lock = itertools.count(), threading.Lock()

    def now_and_then(method: str, path: str) -> str:
        with lock:
            number = next(counter)
        return fault if number in (5, 60) or (fault != "slow" and number % 7 == 5) else ""

    def patient() -> None:
        BucketStore(server.place).remote = RemoteStore(
            server.place, timeout=timedelta(seconds=2.5 if fault == "slow" else 30.0)
        )

    server.fault, server.slow_s = now_and_then, 3.5
    patient()
    run_there(tmp_path, server.place)
    store = Store(server.place)
    assert create_dataset(store, "toys", [one.ref for one in store.artifacts()]).version == "1"
    elsewhere()
    patient()
    assert run_there(tmp_path, server.place).num_computed == 0
    assert digests_there(server.place) == undisturbed
    assert verify(Store(server.place)).is_ok
    assert next(counter) > 60, "there were faults on both ways"


def test_a_bucket_that_refuses_connections_is_waited_for_and_that_is_said_unless_the_run_is_given_up(
    server: S3Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with ThreadPoolExecutor(1) as threads:
        with server.refusing():
            building = threads.submit(run_there, tmp_path, server.place)
            wait_until(lambda: "the bucket does not answer, waiting up to" in caplog.text or building.done(), "a word")
        assert building.result(timeout=60).num_computed == EVERYTHING
    assert len(caplog.messages) == 1, "one word for all requests"
    caplog.clear()

    def give_up() -> None:
        with in_use(Store(server.place)):
            server.stop()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        give_up()
    server.stop = server.start()
    assert caplog.messages == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_a_run_that_waits_for_a_bucket_ends_at_once_when_it_is_interrupted(
    server: S3Server, tmp_path: Path, number: signal.Signals
) -> None:
    gates, said = tmp_path / "gates", tmp_path / "said.txt"
    gates.mkdir()
    (gates / "hold-grow-t1-s1").touch()
    command = [sys.executable, "-c", _BUILD, str(write_study(tmp_path)), server.place]
    with said.open("w") as errors:
        running = subprocess.Popen(
            command, cwd=Path(__file__).parents[2], env={**os.environ, "TOY_FOLDER": str(gates)}, stderr=errors
        )
    try:
        wait_until(lambda: (gates / "ran.txt").exists() and "grow-t1-s1" in (gates / "ran.txt").read_text(), "a shard")
        with server.refusing():
            (gates / "hold-grow-t1-s1").unlink()
            wait_until(lambda: "the bucket does not answer, waiting up to" in said.read_text(), "a word")
            running.send_signal(number)
            running.wait(timeout=15)
    finally:
        running.kill()
        running.wait()
    assert said.read_text().rstrip().endswith("KeyboardInterrupt")


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


def test_a_second_run_is_refused_and_a_killed_one_is_finished_on_another_machine(
    server: S3Server, elsewhere: Callable[[], None], undisturbed: dict[str, list[str]], tmp_path: Path
) -> None:
    gates = tmp_path / "gates"
    gates.mkdir()
    (gates / "hold-grow-t1-s1").touch()
    command = [sys.executable, "-c", _BUILD, str(write_study(tmp_path)), server.place]
    first = subprocess.Popen(command, cwd=Path(__file__).parents[2], env={**os.environ, "TOY_FOLDER": str(gates)})
    try:
        ran = gates / "ran.txt"
        wait_until(lambda: ran.exists() and "grow-t1-s1" in ran.read_text(), "a shard in work")
        elsewhere()
        with pytest.raises(StorageError, match=rf"^a run plans or builds in the store {server.place} \(process "):
            run_there(tmp_path, server.place)
    finally:
        first.kill()
        first.wait()
    done = len(RemoteStore(server.place).entries("manifests"))
    assert 0 < done < EVERYTHING
    assert run_there(tmp_path, server.place).num_computed == EVERYTHING - done
    assert digests_there(server.place) == undisturbed
    assert verify(Store(server.place)).is_ok


def test_workers_with_an_empty_mirror_fetch_what_they_read_and_push_what_they_make(
    server: S3Server,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
) -> None:
    run_there(tmp_path, server.place, selection=StageSelection(until="grow"))
    elsewhere()
    with Outside(tmp_path) as outside:
        elsewhere()
        with (
            in_use(Store(server.place)),
            connect(ClusterSettings(scheduler=outside.address), store_root=server.place) as client,
        ):
            pool = ClusterPool(client, server.place, is_shared=True)
            outcome = run_toys(write_study(tmp_path), Path(server.place), pool=pool)
    assert outcome.num_computed == EVERYTHING - 6
    assert digests_there(server.place) == undisturbed
    assert outcome.report is not None
    mirrors = [Store(server.place).root, *(tmp_path / "cache-0" / "stores").glob("*/")]
    assert len({path.parent for path in mirrors}) == 2
    assert all(any(root.glob("bend/*/*/models.parquet")) for root in mirrors[1:])


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
    def lose_it() -> None:
        with in_use(Store(server.place)):
            run_toys(write_study(tmp_path), Path(server.place))
            with somebody_builds(server.place):
                pass

    with pytest.raises(StorageError, match=r"another run has taken over the store s3://.*the same command goes on"):
        lose_it()
    remote = RemoteStore(server.place)
    assert not [one for one in remote.entries("records") if "/runs/latest/" in one["path"]]
    assert len(remote.entries("manifests")) == EVERYTHING


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


def test_what_else_is_in_the_bucket_stays_there_and_names_lead_nowhere(
    server: S3Server, elsewhere: Callable[[], None], tmp_path: Path
) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    ref = commit_rows(store, name="one")
    text = store.folder(ref.stage, ref.key).joinpath("manifest.json").read_bytes()
    for place in (
        "manifests/x",
        f"manifests/runs/{ref.key}",
        f"manifests/rows/{ref.key}/b",
        "records/rows/aa/b",
        "datasets/a",
    ):
        remote.write(place, text)
    mine = tmp_path / "mine"
    mine.write_text("whole")
    values = json.loads(text)
    ((name, entry),) = values["tables"].items()
    values["tables"] = {f"../../../../{name}": {**entry, "sha256": str(mine)}}
    remote.write(f"manifests/{ref.stage}/{ref.key}", json.dumps(values).encode())
    elsewhere()
    store = Store(server.place)
    store.refresh()
    here = {path.relative_to(store.root).parts[0] for path in store.root.rglob("*") if path.is_file()}
    assert here == {ref.stage, "store.json"}
    (manifest,) = [store.load(ref.stage, ref.key)]
    with pytest.raises(StorageError, match="that is not in its folder"):
        store.data_file(manifest.ref, *next(iter(manifest.data_files.items())))
    assert not verify(store).is_ok
    assert mine.read_text() == "whole"
    remote.write("datasets/a@1", b"no tar")
    with pytest.raises(StorageError, match=r"/datasets/a@1 is not a dataset"):
        store.refresh()


def test_who_reads_what_was_computed_again_since_takes_nothing_back(
    server: S3Server, elsewhere: Callable[[], None]
) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    ref = commit_rows(store, name="one")
    place = f"manifests/{ref.stage}/{ref.key}"
    elsewhere()
    late = Store(server.place)
    late.refresh()
    values = json.loads(remote.read(place))
    (part,) = [entry["sha256"] for entry in values["tables"].values()]
    for entry in values["tables"].values():
        entry["sha256"] = "f" * 64
    remote.write(place, json.dumps(values).encode())
    remote.delete([f"parts/{part}"])
    with pytest.raises(StorageError, match="is gone or damaged"):
        late.read(ref, next(iter(values["tables"])))
    assert json.loads(remote.read(place)) == values


def test_a_part_that_is_lost_is_named_and_computed_again_by_the_next_run(
    server: S3Server, elsewhere: Callable[[], None], undisturbed: dict[str, list[str]], tmp_path: Path
) -> None:
    run_there(tmp_path, server.place, selection=StageSelection(until="grow"))
    store, remote = Store(server.place), RemoteStore(server.place)
    lost, changed = [one for one in store.artifacts("grow") if one.name == "s2"]
    (part,) = {entry.sha256 for entry in lost.data_files.values()}
    remote.delete([f"parts/{part}"])
    (part,) = {entry.sha256 for entry in changed.data_files.values()}
    remote.write(f"parts/{part}", b"something else")
    assert [problem.kind.value for problem in verify(store).problems] == ["missing", "changed"]
    elsewhere()
    with pytest.raises(ShardError, match=r"is gone or damaged; a run computes its artifact grow@\w{12} again"):
        run_there(tmp_path, server.place)
    run_there(tmp_path, server.place)
    assert digests_there(server.place) == undisturbed
    assert verify(Store(server.place)).is_ok


def test_a_reader_asks_again_after_a_bad_download_and_takes_nothing_from_the_bucket(
    server: S3Server, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    ref = commit_rows(store, name="one")
    (entry,) = store.manifest(ref).data_files.values()
    elsewhere()
    fetch, answers = RemoteStore.fetch, iter(["0" * 64])
    monkeypatch.setattr(RemoteStore, "fetch", lambda *told: (fetch(*told), next(answers, None) or fetch(*told))[1])
    assert len(Store(server.place).read(ref, "scores"))
    elsewhere()
    remote.write(f"parts/{entry.sha256}", b"something else")
    with pytest.raises(StorageError, match="is gone or damaged"):
        Store(server.place).read(ref, "scores")
    assert len(remote.entries("manifests")) == 1


def test_a_damaged_copy_in_a_mirror_is_fetched_again_by_the_same_command(server: S3Server, tmp_path: Path) -> None:
    run_there(tmp_path, server.place)
    path = next(Store(server.place).root.glob("bend/*/*/models.parquet"))
    whole = path.read_bytes()
    path.write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])
    with pytest.raises(ShardError, match=r"bend@\w{12} is damaged and was removed"):
        run_there(tmp_path, server.place, "judge.title=again")
    assert run_there(tmp_path, server.place, "judge.title=again").num_computed == 1
    assert path.read_bytes() == whole


def test_who_asks_whether_it_may_write_leaves_nothing_behind(server: S3Server) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    with in_use(store):
        store.prepare()
        places = ("parts", "records", "manifests")
        before = [remote.entries(place) for place in places]
        assert store.can_write()
        assert [remote.entries(place) for place in places] == before


def test_what_is_taken_from_the_bucket_goes_from_a_mirror_that_has_only_just_seen_it(
    server: S3Server, elsewhere: Callable[[], None]
) -> None:
    refs = [commit_rows(Store(server.place), name=f"row{number}") for number in range(12)]
    elsewhere()
    store = Store(server.place)
    store.refresh()
    assert len(list(store.artifacts())) == len(refs)
    RemoteStore(server.place).delete([f"manifests/{ref.stage}/{ref.key}" for ref in refs])
    store.refresh()
    assert list(store.artifacts()) == []


def another_process(store: BucketStore) -> BucketStore:
    """Return the store as another process of this machine has it, with the same mirror."""
    return open_bucket.__wrapped__(store.place, os.environ["AWS_ENDPOINT_URL"], str(store.root.parents[1]))


def test_what_another_process_brings_while_a_mirror_is_refreshed_stays(
    server: S3Server, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    commit_rows(Store(server.place), name="one")
    elsewhere()
    mirror = BucketStore(server.place)
    entries = mirror.remote.entries

    def overtaken(folder: str) -> Sequence[ObjectMeta]:
        monkeypatch.setattr(mirror.remote, "entries", entries)
        listed = entries(folder)
        elsewhere()
        commit_rows(Store(server.place), name="two")
        another_process(mirror).refresh()
        return listed

    monkeypatch.setattr(mirror.remote, "entries", overtaken)
    mirror.refresh()
    assert len(list(mirror.root.glob("*/??/*/manifest.json"))) == 2


def packed(mode: str, *members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    """Return a tar file of the bucket."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=mode) as file:  # type: ignore[call-overload]
        for member, content in members:
            member.size = len(content)
            file.addfile(member, io.BytesIO(content))
    return data.getvalue()


def member_of(name: str, kind: bytes = tarfile.REGTYPE, target: str = "") -> tarfile.TarInfo:
    member = tarfile.TarInfo(name)
    member.type, member.linkname = kind, target
    return member


def sparse(size: int) -> bytes:
    """Return a tar file of a few bytes that would unpack to this size."""
    member = member_of("card.md")
    member.pax_headers = {
        "GNU.sparse.major": "1",
        "GNU.sparse.minor": "0",
        "GNU.sparse.name": "card.md",
        "GNU.sparse.realsize": str(size),
    }
    return packed("w", (member, b"1\n0\n512\n".ljust(512, b"\0") + b"x" * 512))


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (packed("w:gz", (member_of("card.md"), b"\0" * 50_000_000)), "without compression"),
        (packed("w:xz", (member_of("card.md"), b"\0" * 50_000_000)), "without compression"),
        (sparse(10**12), "no file of a dataset"),
        (packed("w", (member_of("../card.md"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("/tmp/card.md"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("a/card.md"), b"a")), "no file of a dataset"),
        (packed("w", (member_of(".hidden"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("a\x1b]0;b"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("card.md", tarfile.SYMTYPE, "/etc/passwd"), b"")), "no file of a dataset"),
        (packed("w", (member_of("card.md", tarfile.LNKTYPE, "/etc/passwd"), b"")), "no file of a dataset"),
        (packed("w", (member_of("card.md", tarfile.FIFOTYPE), b"")), "no file of a dataset"),
        (packed("w", (member_of("card.md"), b"a"), (member_of("./card.md"), b"b")), "no file of a dataset"),
    ],
    ids=["gz", "xz", "sparse", "above", "root", "folder", "hidden", "escape", "symlink", "link", "pipe", "twice"],
)
def test_a_tar_of_the_bucket_holds_plain_files_and_no_more_than_it_has_bytes(
    data: bytes, why: str, server: S3Server, tmp_path: Path
) -> None:
    RemoteStore(server.place).create("datasets/toys@1", data)
    with pytest.raises(StorageError, match=rf"datasets/toys@1 is not a dataset: .*{why}"):
        Store(server.place).refresh()
    mirror = BucketStore(server.place)
    assert not list((mirror.root / "datasets").glob("*"))


def test_a_tar_of_the_bucket_has_a_limit_of_size(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    data = packed("w", (member_of("card.md"), b"a" * 2000))
    RemoteStore(server.place).create("datasets/toys@1", data)
    monkeypatch.setattr("storage_schema.bucket_layout.MAX_DATASET_BYTES", len(data) - 1)
    with pytest.raises(StorageError, match="is larger than 0 MB"):
        Store(server.place).refresh()
    monkeypatch.setattr("storage_schema.bucket_layout.MAX_DATASET_BYTES", len(data))
    Store(server.place).refresh()


def test_a_commit_that_is_cut_off_shows_nothing(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.bucket._PATIENCE_S", 0.0)
    server.fault = lambda method, path: "error" if method == "PUT" and "/parts/" in path else ""
    with pytest.raises(RemoteError, match="cannot write parts/"):
        commit_rows(Store(server.place), name="one")
    assert RemoteStore(server.place).entries("manifests") == []


def test_what_is_made_again_takes_its_place_in_one_step_unless_a_dataset_needs_the_old_one(
    server: S3Server, elsewhere: Callable[[], None]
) -> None:
    def make(text: bytes) -> ArtifactRef:
        return commit_rows(Store(server.place), name="one", attachments={"note.txt": text}, replaces=True)

    first = make(b"1")
    elsewhere()
    server.requests.clear()
    second = make(b"2")
    assert second != first
    assert {asked.split()[0] for asked in server.requests} <= {"GET", "HEAD", "PUT"}, "nothing was gone in between"
    elsewhere()
    assert Store(server.place).find(first.stage, first.key) == Store(server.place).manifest(second)
    create_dataset(Store(server.place), "toys", [second])
    elsewhere()
    assert make(b"2") == second
    with pytest.raises(NamedByDataset, match="dataset toys@1 needs the old one, which stays"):
        make(b"3")
    assert verify(Store(server.place)).is_ok


def test_a_dataset_in_a_bucket_does_not_tell_who_made_it_where_and_when(server: S3Server) -> None:
    store = Store(server.place)
    create_dataset(store, "toys", [commit_rows(store, name="one")], attachments={"card.md": b"# Card"})
    with tarfile.open(fileobj=io.BytesIO(RemoteStore(server.place).read("datasets/toys@1"))) as file:
        assert {(one.uname, one.uid, one.mtime) for one in file} == {("", 0, 0)}


def test_a_mirror_takes_a_new_dataset_of_another_machine_beside_the_one_that_it_has(
    server: S3Server, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    store = Store(server.place)
    create_dataset(store, "toys", [commit_rows(store, name="one")])
    store.refresh()
    elsewhere()
    other = Store(server.place)
    create_dataset(other, "toys", [commit_rows(other, name="two")])
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    back = Store(server.place)
    back.refresh()
    assert [one.label for one in list_datasets(back)] == ["toys@1", "toys@2"]


def test_a_bucket_that_does_not_answer_or_is_not_there_is_one_sentence_before_any_work(
    server: S3Server, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    build_here(monkeypatch)
    study = str(write_study(tmp_path))
    assert run_command_line(["run", study, "--store", "s3://nowhere/store"], graph=TOYS) == 1
    assert "error: s3://nowhere/store: cannot list manifests" in capsys.readouterr().err
    with (
        pytest.raises(StorageError, match="cannot write lease: there is no such bucket"),
        in_use(Store("s3://nowhere/a")),
    ):
        pass
    assert run_command_line(["run", study, "--store", "s3://"], graph=TOYS) == 2
    assert "s3://BUCKET/PREFIX is meant" in capsys.readouterr().err
    monkeypatch.setattr("storage_schema.bucket._PATIENCE_S", 0.0)
    server.fault = lambda method, path: "gone"
    assert run_command_line(["run", study, "--store", server.place], graph=TOYS) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"error: {server.place}: cannot list manifests")
    assert SECRET not in said


def test_an_artifact_that_is_not_there_is_said_with_the_store(server: S3Server) -> None:
    with pytest.raises(StorageError, match=rf"is not in the store {server.place}"):
        Store(server.place).manifest(ArtifactRef("poses", "0" * 64, "1" * 64))


def test_of_a_store_in_a_bucket_the_viewer_fetches_what_is_looked_at(
    server: S3Server, elsewhere: Callable[[], None], tmp_path: Path
) -> None:
    store = Store(server.place)
    with in_use(store):
        refs = []
        for partition in ("ic-seed0", "ic-seed1"):
            columns = random_columns("draws", 20) | {"density": ["ic"] * 20, "seed_index": [0] * 20, "chain": [0] * 20}
            columns |= {"sequence_id": [None] * 20}
            refs.append(put(store, "chains", partition, {"draws": columns}, {}).ref)
    elsewhere()
    there = Store(server.place)
    there.refresh()
    server.requests.clear()
    viewer = Viewer(Shelf(there, refs), choosing=Choosing(tmp_path / "curation.txt"))
    try:
        fetched = [one for one in server.requests if one.startswith("GET") and "/parts/" in one]
        assert len(fetched) == 1, fetched
        viewer.show_part(viewer.shelf.parts[1])
        viewer.describe_frame()
        assert viewer.shown.facts.value.startswith("frame 0 of 20")
    finally:
        viewer.stop()
    assert {one.split()[0] for one in server.requests} <= {"GET", "HEAD"}, "looking writes nothing there"
