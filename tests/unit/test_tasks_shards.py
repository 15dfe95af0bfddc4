"""Shards on workers: order, bounds, errors that name the shard, and workers that die."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from distributed import Client, Future

from storage_schema import ArtifactRef, Store
from storage_schema.errors import FullDisk
from tasks.shards import (
    ClusterError,
    ClusterSettings,
    ShardDone,
    ShardError,
    Stopped,
    connect,
    run_on_cluster,
    run_serially,
    worker_environment,
)
from tasks.stage import Shard, StageInputs
from tests.builders.toys import GrowParameters, plan_grow, run_grow


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with connect(ClusterSettings(num_workers=2), store_root=str(tmp_path_factory.mktemp("store"))) as client:
        yield client


def shards(num_takes: int = 2, num_segments: int = 3) -> list[Shard]:
    return plan_grow(StageInputs({}, 7), GrowParameters(num_takes=num_takes, num_segments=num_segments))


def fail_with_a_message(shard: Shard, store: Store) -> ArtifactRef:
    raise ValueError("the 3rd joint is missing")


def fail_in_the_middle(shard: Shard, store: Store) -> ArtifactRef:
    if shard.name == "s1" and shard.partition != "t1":
        raise ValueError("broken")
    return run_grow(shard, store)


def find_no_room(shard: Shard, store: Store) -> ArtifactRef:
    raise FullDisk("no room")


class UnpicklableError(Exception):
    def __init__(self) -> None:
        super().__init__("holds a lock")
        self.lock = threading.Lock()


def fail_with_an_unpicklable_error(shard: Shard, store: Store) -> ArtifactRef:
    raise UnpicklableError


def die_once(shard: Shard, store: Store) -> ArtifactRef:
    marker = store.root / f"died-{shard.name}"
    if shard.name == "s0" and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return run_grow(shard, store)


def die_always(shard: Shard, store: Store) -> ArtifactRef:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError("unreachable")


def name_threads(shard: Shard, store: Store) -> ArtifactRef:
    raise ValueError(f"{os.environ['OMP_NUM_THREADS']} {os.environ['NUMBA_NUM_THREADS']}")


def test_the_cluster_and_one_process_give_the_same_artifacts_in_the_order_asked_for(
    client: Client, tmp_path: Path
) -> None:
    asked = list(reversed(shards()))
    here = run_serially(run_grow, asked, str(tmp_path / "here"))
    there = run_on_cluster(client, run_grow, asked, str(tmp_path / "there"), max_in_flight=2)
    assert here == there
    assert [ref.key for ref in here] == [shard.key for shard in asked]


def test_every_shard_is_told_of_once(client: Client, tmp_path: Path) -> None:
    told: list[ShardDone] = []
    run_on_cluster(client, run_grow, shards(4, 2), str(tmp_path), on_done=told.append, max_in_flight=3)
    assert sorted(done.shard.key for done in told) == sorted(shard.key for shard in shards(4, 2))
    assert all(done.seconds > 0 for done in told)


def test_a_failing_shard_is_named_with_its_message(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="stage grow, t0, shard s0: the 3rd joint is missing") as caught:
        run_on_cluster(client, fail_with_a_message, shards(1, 3), str(tmp_path))
    assert caught.value.kind == "ValueError"
    assert "fail_with_a_message" in caught.value.trace


def test_shards_that_need_none_of_those_that_failed_are_committed_and_all_failures_named(
    client: Client, tmp_path: Path
) -> None:
    asked = shards(3, 3)
    for root, run_all in ((tmp_path / "here", run_serially), (tmp_path / "there", partial(run_on_cluster, client))):
        with pytest.raises(ShardError, match=r"t0, shard s1: broken; .*t2, shard s1: broken") as caught:
            run_all(fail_in_the_middle, asked, str(root))
        assert {caught.value.where, *(one.where for one in caught.value.others)} == {
            "stage grow, t0, shard s1",
            "stage grow, t2, shard s1",
        }
        there = [shard for shard in asked if Store(root).find("grow", shard.key) is not None]
        assert {(s.partition, s.name) for s in there} == {("t1", f"s{i}") for i in range(3)} | {
            ("t0", "s0"),
            ("t2", "s0"),
        }


def test_a_full_disk_ends_the_work_at_once(tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="t0, shard s0") as caught:
        run_serially(find_no_room, shards(3, 3), str(tmp_path))
    assert caught.value.others == ()


def test_an_error_that_cannot_be_pickled_keeps_its_message(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="holds a lock"):
        run_on_cluster(client, fail_with_an_unpicklable_error, shards(), str(tmp_path))


def test_a_shard_whose_worker_died_once_is_computed_all_the_same(client: Client, tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    there = run_on_cluster(client, die_once, shards(), str(tmp_path / "store"))
    assert there == run_serially(run_grow, shards(), str(tmp_path / "here"))


def test_a_shard_that_kills_its_workers_is_named(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="stage grow, t0, shard s0: its worker process died 3 times"):
        run_on_cluster(client, die_always, shards(1, 1), str(tmp_path))


def test_workers_use_one_thread(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="1 1"):
        run_on_cluster(client, name_threads, shards(1, 1), str(tmp_path))


def test_work_given_up_elsewhere_stops(client: Client, tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(Stopped):
        run_on_cluster(client, run_grow, shards(), str(tmp_path), stop=stop)
    with pytest.raises(Stopped):
        run_serially(run_grow, shards(), str(tmp_path), stop=stop)


def test_a_result_that_is_lost_on_its_way_is_waited_for_until_the_run_is_given_up(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, *_ = shards()
    stop = threading.Event()
    fetch = Future.result
    asked: list[float | None] = []

    def lose_the_first(self: Future, timeout: float | None = None) -> object:
        asked.append(timeout)
        if len(asked) == 1:
            raise TimeoutError
        return fetch(self, timeout)

    def lose_all(self: Future, timeout: float | None = None) -> object:
        stop.set()
        raise TimeoutError

    monkeypatch.setattr(Future, "result", lose_the_first)
    assert len(run_on_cluster(client, run_grow, [first], str(tmp_path / "first"), stop=stop)) == 1
    assert len(asked) == 2
    assert None not in asked
    monkeypatch.setattr(Future, "result", lose_all)
    with pytest.raises(Stopped):
        run_on_cluster(client, run_grow, [first], str(tmp_path / "all"), stop=stop)


def test_a_given_scheduler_is_used_and_survives(client: Client, tmp_path: Path) -> None:
    address = client.scheduler_info()["address"]
    with connect(ClusterSettings(scheduler=address), store_root=str(tmp_path)) as other:
        assert run_on_cluster(other, run_grow, shards(), str(tmp_path))
    assert client.scheduler_info()["workers"]


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.shards.cluster.CONNECT_TIMEOUT_S", 0.5)
    with (
        pytest.raises(ClusterError, match="no Dask scheduler answers at tcp"),
        connect(ClusterSettings(scheduler="tcp://127.0.0.1:9"), store_root=str(tmp_path)),
    ):
        pass


def test_a_greeting_that_does_not_come_alone_is_asked_for_again(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = client.scheduler_info()["address"]
    greetings = iter([AssertionError(), AssertionError(), None])

    def start(self: Client, *arguments: object, **options: object) -> None:
        if (error := next(greetings)) is not None:
            raise error
        plainly(self, *arguments, **options)

    plainly = Client.start
    monkeypatch.setattr(Client, "start", start)
    with connect(ClusterSettings(scheduler=address), store_root=str(tmp_path)) as other:
        assert other.scheduler_info()["workers"]
    greetings = iter([AssertionError()] * 3)
    with (
        pytest.raises(ClusterError, match="is not a Dask scheduler"),
        connect(ClusterSettings(scheduler=address), store_root=str(tmp_path)),
    ):
        pass


def test_workers_that_do_not_see_the_store_are_refused(client: Client, tmp_path: Path) -> None:
    address = client.scheduler_info()["address"]
    with (
        pytest.raises(ClusterError, match="cannot write to the store"),
        connect(ClusterSettings(scheduler=address), store_root=str(tmp_path / "nowhere")),
    ):
        pass


def test_a_given_kernel_cache_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere")
    assert worker_environment()["NUMBA_CACHE_DIR"] == "/somewhere"
