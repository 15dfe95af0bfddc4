"""Shards on workers: order, bounds, errors that name the shard, and workers that die."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import replace
from graphlib import TopologicalSorter
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import dask
import numpy as np
import pytest
from distributed import CancelledError, Client, Future, LocalCluster
from distributed.comm.core import CommClosedError
from distributed.utils import LoopRunner, sync
from pydantic import ValidationError

from flows.machine import cluster_settings
from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Store
from storage_schema.provenance import package_versions
from tasks.shards import (
    ClusterError,
    ClusterPool,
    ClusterSettings,
    HerePool,
    Pool,
    ShardDone,
    ShardError,
    connect,
    join_failures,
    run,
)
from tasks.shards.profiles import ClusterProfile, cluster_class, read_profile, started
from tasks.shards.running import _scheduler_is_there
from tasks.stage import Shard, StageInputs
from tasks.stage.kept import kept
from tests.builders.toy_runs import ROOT
from tests.builders.toys import GrowParameters, plan_grow, run_grow

MEMORY_BYTES = 700 * 1024**2
"""Of a worker: three times what it needs for nothing."""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with connect(
        ClusterSettings(num_workers=2, memory_bytes=MEMORY_BYTES), store_root=str(tmp_path_factory.mktemp("store"))
    ) as client:
        yield client


def shards(num_takes: int = 2, num_segments: int = 3) -> list[Shard]:
    return plan_grow(StageInputs({}, 7), GrowParameters(num_takes=num_takes, num_segments=num_segments))


def compute(
    run_shard: Callable[[Shard, Store], ArtifactRef], asked: Sequence[Shard], pool: Pool
) -> dict[str, ShardDone]:
    """Run shards in a pool, each after those it comes after; gives what came of them by key."""
    arrived: SimpleQueue[Shard] = SimpleQueue()
    left = {shard.key: shard for shard in asked}
    order = list(TopologicalSorter({key: shard.after for key, shard in left.items()}).static_order())
    for at, key in enumerate(order):
        pool.submit(run_shard, left[key], -at, arrived.put)
    computed: dict[str, ShardDone] = {}
    errors: list[ShardError] = []
    while left:
        pool.work()
        shard = arrived.get(timeout=120)
        if (ended := pool.ended(shard)) is None:
            arrived.put(shard)
            continue
        del left[shard.key]
        if isinstance(ended, ShardDone):
            computed[shard.key] = ended
        elif not ended.is_behind:
            errors.append(ended.error)
    if errors:
        raise join_failures(sorted(errors, key=lambda error: error.where))
    return computed


def on(client: Client, store: Path) -> ClusterPool:
    store.mkdir(exist_ok=True)
    return ClusterPool(client, str(store))


@pytest.fixture
def given(client: Client) -> ClusterSettings:
    """Return settings that name the scheduler of the cluster."""
    return ClusterSettings(scheduler=client.scheduler_info()["address"])


def assert_refused(where: ClusterSettings, store: Path, words: str) -> None:
    """Assert that nobody computes there, as these words say."""
    with pytest.raises((ClusterError, InputError), match=words), connect(where, store_root=str(store)):
        pass


def here(store: Path) -> HerePool:
    return HerePool(str(store))


def fail_with_a_message(shard: Shard, store: Store) -> ArtifactRef:
    raise ValueError("the 3rd joint is missing")


def fail_in_the_middle(shard: Shard, store: Store) -> ArtifactRef:
    if shard.name == "s1" and shard.partition != "t1":
        raise ValueError("broken")
    return run_grow(shard, store)


def wait_for_the_gate(shard: Shard, store: Store) -> ArtifactRef:
    while not (store.root / "gate").exists():
        time.sleep(0.01)
    return run_grow(shard, store)


class UnpicklableError(Exception):
    def __init__(self) -> None:
        super().__init__("holds a lock")
        self.lock = threading.Lock()


def fail_with_an_unpicklable_error(shard: Shard, store: Store) -> ArtifactRef:
    raise UnpicklableError


def eat_memory(shard: Shard, store: Store) -> ArtifactRef:
    eaten = []
    while shard.partition == "t0":
        eaten.append(np.ones(4 * 1024**2))
        time.sleep(0.1)  # what waits behind it is stolen by the other worker, also on a busy machine
    return run_grow(shard, store)


def always_die(shard: Shard, store: Store) -> ArtifactRef:
    if shard.partition == "t0":
        os.kill(os.getpid(), signal.SIGKILL)
    return run_grow(shard, store)


def name_threads(shard: Shard, store: Store) -> ArtifactRef:
    raise ValueError(f"{os.environ['OMP_NUM_THREADS']} {os.environ['NUMBA_NUM_THREADS']}")


def test_the_cluster_and_one_process_give_the_same_artifacts_whatever_the_order(client: Client, tmp_path: Path) -> None:
    alone = compute(run_grow, shards(), here(tmp_path / "here"))
    there = compute(run_grow, list(reversed(shards())), on(client, tmp_path / "there"))
    assert {key: done.ref for key, done in alone.items()} == {key: done.ref for key, done in there.items()}
    assert set(there) == {shard.key for shard in shards()}
    assert all(done.seconds > 0 for done in there.values())


def test_a_failing_shard_is_named_with_its_message(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="stage grow, t0, shard s0: the 3rd joint is missing") as caught:
        compute(fail_with_a_message, shards(1, 3), on(client, tmp_path))
    assert caught.value.kind == "ValueError"
    assert "fail_with_a_message" in caught.value.trace


def test_all_failures_are_named_and_other_shards_committed(client: Client, tmp_path: Path) -> None:
    asked, kept = shards(3, 3), {"t0": 1, "t1": 3, "t2": 1}
    for pool, root in ((here(tmp_path / "a"), tmp_path / "a"), (on(client, tmp_path / "b"), tmp_path / "b")):
        with pytest.raises(ShardError, match=r"t0, shard s1: broken; .*t2, shard s1: broken") as caught:
            compute(fail_in_the_middle, asked, pool)
        failed = {caught.value.where, *(error.where for error in caught.value.others)}
        assert failed == {f"stage grow, {take}, shard s1" for take in ("t0", "t2")}
        there = {(m.partition, m.name) for m in Store(root).artifacts("grow")}
        assert there == {(take, f"s{at}") for take, count in kept.items() for at in range(count)}


def test_an_error_that_cannot_be_pickled_keeps_its_message(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="holds a lock"):
        compute(fail_with_an_unpicklable_error, shards(), on(client, tmp_path))


@pytest.mark.slow
def test_a_shard_that_eats_all_memory_is_named_and_others_computed(client: Client, tmp_path: Path) -> None:
    asked = shards(3, 1)
    with pytest.raises(ShardError, match="stage grow, t0, shard s0: its worker process died 3 times") as caught:
        compute(eat_memory, asked, on(client, tmp_path))
    assert caught.value.others == ()
    assert [Store(tmp_path).find("grow", shard.key) is not None for shard in asked] == [False, True, True]


@pytest.mark.slow
def test_a_shard_that_waits_for_the_same_worker_is_not_blamed_for_its_deaths(tmp_path: Path) -> None:
    asked = shards(4, 1)
    with (
        connect(ClusterSettings(num_workers=1), store_root=str(tmp_path)) as alone,
        pytest.raises(ShardError, match="stage grow, t0, shard s0: its worker process died 3 times") as caught,
    ):
        compute(always_die, asked, on(alone, tmp_path))
    assert caught.value.others == ()
    assert [Store(tmp_path).find("grow", shard.key) is not None for shard in asked] == [False, True, True, True]


def test_workers_use_one_thread(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="1 1"):
        compute(name_threads, shards(1, 1), on(client, tmp_path))


def test_a_lost_result_is_fetched_again(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fetch = Future.result
    asked: list[float | None] = []

    def lose_the_first(self: Future, timeout: float | None = None) -> object:
        asked.append(timeout)
        if len(asked) == 1:
            raise TimeoutError
        return fetch(self, timeout)

    monkeypatch.setattr(Future, "result", lose_the_first)
    assert len(compute(run_grow, shards(2, 1), on(client, tmp_path))) == 2
    assert len(asked) == 3
    assert None not in asked


def test_what_was_given_up_is_cancelled(client: Client, tmp_path: Path) -> None:
    pool, asked, arrived = on(client, tmp_path), shards(4, 1), SimpleQueue[Shard]()
    for shard in asked:
        pool.submit(wait_for_the_gate, shard, 0, arrived.put)
    pool.give_up()
    assert {arrived.get(timeout=30).key for _ in asked} == {shard.key for shard in asked}, "all have an end"
    (tmp_path / "gate").touch()
    assert len(compute(run_grow, shards(5, 1)[4:], pool)) == 1, "workers go on"
    begun = [shard for shard in asked if Store(tmp_path).find("grow", shard.key) is not None]
    assert len(begun) <= 2, "what no worker had begun never is"


def test_a_given_scheduler_is_used_and_survives(client: Client, given: ClusterSettings, tmp_path: Path) -> None:
    with connect(given, store_root=str(tmp_path)) as second:
        assert compute(run_grow, shards(), ClusterPool(second, str(tmp_path), is_shared=True))
    assert client.scheduler_info()["workers"]


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.shards.cluster.CONNECT_TIMEOUT_S", 0.5)
    where = ClusterSettings(scheduler="tcp://127.0.0.1:9")
    assert_refused(where, tmp_path, "no Dask scheduler answers at tcp")


@pytest.mark.parametrize("ca_file", [None, "nowhere.pem"])
def test_tls_without_certificates_of_a_client_is_one_sentence(tmp_path: Path, ca_file: str | None) -> None:
    words = r"certificates .*DASK_DISTRIBUTED__COMM__TLS__CA_FILE.*_TLS__CLIENT__KEY"
    with dask.config.set({"distributed.comm.tls.ca-file": ca_file}):
        assert_refused(ClusterSettings(scheduler="tls://127.0.0.1:9"), tmp_path, words)


@pytest.mark.parametrize("gone", [CancelledError, CommClosedError])
def test_a_scheduler_that_dies_while_a_result_is_fetched_is_one_sentence(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: type[Exception]
) -> None:
    def result(self: Future[object], timeout: float) -> None:
        raise gone("in <TCP (closed)>: Stream is closed")

    monkeypatch.setattr(Future, "result", result)
    with pytest.raises(ClusterError, match=r"^the Dask scheduler is gone; the same command continues the work$"):
        compute(run_grow, shards(), on(client, tmp_path / "store"))


def test_a_greeting_is_asked_for_again(given: ClusterSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    greetings = iter([AssertionError(), AssertionError(), None])
    plainly = Client.start

    def start(self: Client, *arguments: object, **options: object) -> None:
        if (error := next(greetings)) is not None:
            raise error
        plainly(self, *arguments, **options)

    monkeypatch.setattr(Client, "start", start)
    with connect(given, store_root=str(tmp_path)) as second:
        assert second.scheduler_info()["workers"]
    greetings = iter([AssertionError()] * 3)
    assert_refused(given, tmp_path, "is not a Dask scheduler")


def test_workers_that_do_not_see_the_store_are_refused(given: ClusterSettings, tmp_path: Path) -> None:
    assert_refused(given, tmp_path / "nowhere", "cannot write to the store")


def test_jobs_of_the_profile_for_this_machine_compute_the_same_with_its_threads_and_memory(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    where = cluster_settings(None, cluster=ROOT / "deploy" / "clusters" / "here.toml")
    with connect(where, store_root=str(tmp_path / "far")) as client:
        address, worker = next(iter(client.scheduler_info()["workers"].items()))
        assert address.startswith("tcp://127.0.0.1:")
        assert worker["memory_limit"] == 2 * 1024**3
        assert set(client.run(os.getenv, "OPENCV_FOR_THREADS_NUM").values()) == {"1"}
        far = compute(run_grow, shards(), ClusterPool(client, str(tmp_path / "far"), is_shared=True))
    near = compute(run_grow, shards(), here(tmp_path / "near"))
    assert {key: done.ref for key, done in far.items()} == {key: done.ref for key, done in near.items()}


def test_keys_of_a_clusters_jobs_are_gone_from_the_shared_folder_when_it_has_ended(tmp_path: Path) -> None:
    profile = read_profile(ROOT / "deploy" / "clusters" / "here.toml")
    options = {**profile.options, "security": True, "shared_temp_directory": str(tmp_path)}
    with started(profile.model_copy(update={"options": options})) as cluster:
        assert len(list(tmp_path.iterdir())) == 3, "authority, certificate and key"
    assert list(tmp_path.iterdir()) == []
    assert cluster is not None, "it is not collected, as where a process ends"


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("tasks.shards.jobs_here.JobsHere", "ended with code 3; it said: no such module"),
        ("dask_jobqueue.SLURMCluster", "cannot start its jobs: .*invalid partition"),
    ],
)
def test_a_failed_job_is_quoted_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, words: str) -> None:
    (tmp_path / "sbatch").write_text("#!/bin/sh\necho invalid partition >&2; exit 1\n")
    (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    path = tmp_path / "jobs.toml"
    path.write_text(f"""
cluster = "{kind}"
[options]
cores = 1
processes = 1
memory = "1GiB"
interface = "lo"
scheduler_options = {{ dashboard_address = "127.0.0.1:0" }}
job_script_prologue = ["echo no such module >&2; exit 3"]
""")
    began = time.monotonic()
    assert_refused(cluster_settings(None, cluster=path), tmp_path, words)
    assert time.monotonic() - began < 60


def test_a_library_of_clusters_does_not_take_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "taking.py").write_text("""
import signal
from distributed.deploy.cluster import Cluster
signal.signal(signal.SIGINT, lambda *_: exit())
""")
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    assert cluster_class("taking.Cluster").__name__ == "Cluster"
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('cluster = "dask_jobqueue.SLURM"', "dask_jobqueue.SLURM is not there"),
        ('cluster = "nowhere.Cluster"', "install nowhere here"),
        ('cluster = "pathlib.Path"', "pathlib.Path is no Dask cluster"),
        ("workers = 3", "cluster: Field required; keys: cluster, options, min_workers"),
        ("cluster = ", "is not valid TOML"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "jobs.toml"
    path.write_text(text)
    with pytest.raises((ClusterError, InputError), match=words):
        connect(cluster_settings(None, cluster=path), store_root=str(tmp_path)).__enter__()


def test_another_package_is_refused(given: ClusterSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.shards.cluster.package_versions", lambda: {**package_versions(), "numpy": "1.0"})
    words = r"worker tcp://.* has numpy [2-9].*, here it is 1\.0: results would differ"
    assert_refused(given, tmp_path, words)


def test_other_processors_are_refused(given: ClusterSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CPU_NAME", "haswell")
    assert_refused(given, tmp_path, r"has NUMBA_CPU_NAME not set, here it is haswell: results would differ")


def test_workers_with_several_threads_are_refused(tmp_path: Path) -> None:
    words = r"has 2 threads, but a process computes one shard at a time; .*--nthreads 1"
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0") as cluster:
        assert_refused(ClusterSettings(scheduler=cluster.scheduler_address), tmp_path, words)


def test_threads_of_a_process_compute_one_shard_after_the_other(tmp_path: Path) -> None:
    """What shards share - evidence of annotations, the one thread of BLAS - has room for one."""
    both = threading.Barrier(2)
    are_alone = []

    def run_alone(shard: Shard, store: Store) -> ArtifactRef:
        with suppress(threading.BrokenBarrierError):
            both.wait(timeout=0.3)
        are_alone.append(both.broken)
        return run_grow(shard, store)

    with ThreadPoolExecutor(2) as threads:
        for _ in threads.map(lambda shard: run(run_alone, shard, str(tmp_path)), shards(num_takes=2, num_segments=1)):
            pass
    assert are_alone == [True, True]


def test_what_shards_keep_lasts_until_the_process_begins_with_another_stage(tmp_path: Path) -> None:
    calls = []

    @kept()
    def make_ready(name: str) -> str:
        calls.append(name)
        return name

    def run_with_it(shard: Shard, store: Store) -> ArtifactRef:
        make_ready("poses")
        return run_grow(shard, store)

    stages = ("keeps", "keeps", "keeps_too", "keeps")
    for shard, stage in zip(shards(num_takes=4, num_segments=1), stages, strict=True):
        run(run_with_it, replace(shard, stage=stage), str(tmp_path))
    assert calls == ["poses", "poses"]


def test_a_call_that_is_cancelled_on_its_way_says_that_the_scheduler_is_gone() -> None:
    async def cancelled() -> None:
        raise asyncio.CancelledError

    runner = LoopRunner()
    runner.start()
    try:
        with pytest.raises(ClusterError, match="the same command continues the work"), _scheduler_is_there():
            sync(runner.loop, cancelled)
    finally:
        runner.stop()


def test_of_a_job_that_ends_without_a_worker_the_last_words_are_quoted(tmp_path: Path) -> None:
    script = tmp_path / "job.sh"
    script.write_text("head -c 3000 /dev/zero | tr '\\0' x\necho the end >&2\nexit 3\n")
    job = cluster_class("tasks.shards.jobs_here.JobsHere").job_cls  # its module takes over Ctrl-C where it is imported
    with pytest.raises(RuntimeError) as caught:
        asyncio.run(job._submit_job(SimpleNamespace(), str(script)))
    assert str(caught.value) == f"a job ended with code 3; it said: {('x' * 3000 + 'the end' + chr(10))[-2000:]}"


@pytest.mark.parametrize("key", ["min_workers", "max_workers"])
def test_a_cluster_has_at_least_one_worker(key: str) -> None:
    assert getattr(ClusterProfile.model_validate({"cluster": "a.B", key: 1}), key) == 1
    with pytest.raises(ValidationError, match="greater than or equal to 1"):
        ClusterProfile.model_validate({"cluster": "a.B", key: 0})


@pytest.mark.parametrize(
    ("workers", "away_s", "refused", "fails"),
    [(2, 99.0, 1, False), (0, 10.0, 1, False), (0, 99.0, 0, False), (0, 99.0, 1, True)],
)
def test_a_run_ends_where_only_workers_that_do_not_fit_have_come_for_long(
    monkeypatch: pytest.MonkeyPatch, workers: int, away_s: float, refused: int, fails: bool
) -> None:
    words = ["of before", *["it has another numpy"] * refused]
    monkeypatch.setattr("tasks.shards.running.refusals", lambda client: words)
    asked = {"workers": {str(number): {} for number in range(workers)}}
    pool = SimpleNamespace(client=SimpleNamespace(scheduler_info=lambda **_: asked), _num_refused_before=1)
    pool._seen_at = time.monotonic() - away_s
    before = pool._seen_at
    with pytest.raises(ClusterError, match=r"^it has another numpy; no other worker came") if fails else nullcontext():
        ClusterPool._count_workers(pool)  # type: ignore[arg-type]
    assert pool.num_workers == max(1, workers)
    assert (pool._seen_at > before) is bool(workers)
