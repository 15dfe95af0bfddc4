"""One run, whoever computes it: any number of workers, any order of finishing, and shards that fail."""

from __future__ import annotations

import itertools
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any, Self

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flows.building import ShowPartitions, by_urgency, stages_behind
from flows.console.display import LineListener, progress_text
from flows.execution import begin, execute, open_pool
from flows.outcomes import Outcome, Run
from flows.planning import StagePlan, StageSelection, make_plan
from flows.progress import Listener, PartitionCount, Progress, Tally
from flows.records import describe_runs
from flows.study import load_study
from pasdedeux.errors import InputError
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, CorruptArtifact, RunFolder, Store, create_dataset, read_latest, verify
from storage_schema.errors import FullDisk
from tasks.graph import Graph
from tasks.shards import (
    Call,
    ClusterPool,
    ClusterSettings,
    HereClient,
    HerePool,
    Pool,
    ShardDone,
    ShardError,
    ShardFailed,
    Stopped,
    connect,
)
from tasks.shards.profiles import ClusterProfile
from tasks.stage import EarlyPlan, Parameters, Shard
from tests.builders.toy_runs import STUDY, computed, digests, plan_toys, run_toys, wait_until, write_study
from tests.builders.toys import TOYS, toys_with


class Workers(HereClient):
    """Computes when a worker is free what is ready by then, and tells of what has ended in any order."""

    def __init__(self, num_workers: int, order: list[int], fail: frozenset[str]) -> None:
        super().__init__()
        self.num_workers, self.order, self.fail = num_workers, order, fail
        self.started: list[str] = []
        self._ended: list[tuple[Call, Any]] = []

    def work(self) -> bool:
        while len(self._ended) < self.num_workers and (call := self.next_call()) is not None:
            try:
                self._ended.append((call, self._make(call)))
            except ShardError as error:
                self._ended.append((call, error))
        if not self._ended:
            return False
        call, result = self._ended.pop(self.order.pop(0) % len(self._ended) if self.order else 0)
        call.future.set_exception(result) if isinstance(result, ShardError) else call.future.set_result(result)
        return True

    def next_call(self) -> Call | None:
        """Return the call of the highest priority whose arguments are there; None where there is none."""
        waiting = sorted(self.waiting.get() for _ in range(self.waiting.qsize()))
        ready = [call for call in waiting if all(part.done() for part in call.arguments if isinstance(part, Future))]
        for call in waiting:
            if call not in ready[:1]:
                self.waiting.put(call)
        return ready[0] if ready else None

    def _make(self, call: Call) -> Any:
        _, shard, _, *before = call.arguments
        for future in before:
            future.result()
        self.started.append(name_of(shard))
        if name_of(shard) in self.fail:
            raise ShardError(f"stage {shard.stage}, {shard.partition}, shard {shard.name}", "Error", "broken")
        return call.make()


class ManyWorkers(HerePool):
    """Several workers; what they commit is there at once, and told in any order; shards of some names fail.

    Args:
        order: Which of those in work is told of next, one number for each; after the last the first that was started.
    """

    def __init__(
        self, store: Path, num_workers: int = 1, order: Sequence[int] = (), fail: frozenset[str] = frozenset()
    ) -> None:
        self.workers = Workers(num_workers, list(order), fail)
        super().__init__(str(store), self.workers)
        self.num_workers = num_workers

    @property
    def started(self) -> list[str]:
        return self.workers.started


def name_of(shard: Shard) -> str:
    return f"{shard.stage} {shard.partition} {shard.name}"


class Deaf(HerePool):
    """Somebody presses Ctrl-C while it waits, and it goes on; so does Python where a finalizer is interrupted."""

    def work(self) -> bool:
        if is_there := not self.client.waiting.empty():
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        return super().work() and is_there


@pytest.fixture(scope="module")
def undisturbed(_toys: Path) -> Path:
    """A store in which the toy study was built one shard after the other; nothing may be computed in it."""
    return _toys


def names(store: Path) -> dict[str, str]:
    return {f"{m.ref.stage} {m.partition} {m.name}": m.ref.content_digest for m in Store(store).artifacts()}


def lineage(store: Path) -> dict[str, set[str]]:
    """Return for each artifact all that it was computed from, by name."""
    manifests = {m.ref: m for m in Store(store).artifacts()}

    def above(ref: ArtifactRef) -> set[str]:
        manifest = manifests[ref]
        return {f"{ref.stage} {manifest.partition} {manifest.name}"}.union(
            *(above(input_ref) for input_ref in manifest.inputs)
        )

    return {f"{ref.stage} {m.partition} {m.name}": above(ref) for ref, m in manifests.items()}


EVERYBODY = [
    *(f"{stage} t{t} s{s}" for stage in ("grow", "bend") for t in range(2) for s in range(3)),
    "aside aside all",
    "judge all all",
]


@settings(max_examples=6, deadline=None)
@given(num_workers=st.integers(1, 6), order=st.lists(st.integers(0, 5), max_size=14))
def test_workers_and_finishing_order_change_nothing(undisturbed: Path, num_workers: int, order: list[int]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        outcome = run_toys(write_study(Path(folder)), store, pool=ManyWorkers(store, num_workers, order))
        assert outcome.num_computed == len(EVERYBODY)
        assert [stage.name for stage in outcome.stages] == list(TOYS.names)
        assert digests(store) == digests(undisturbed)
        latest, before = read_latest(Store(store), "toy"), read_latest(Store(undisturbed), "toy")
        assert latest.stages == before.stages, "the record has the order of the plan"


@settings(max_examples=6, deadline=None)
@given(
    fail=st.frozensets(st.sampled_from(EVERYBODY), min_size=1, max_size=3),
    num_workers=st.integers(1, 4),
    order=st.lists(st.integers(0, 5), max_size=14),
)
def test_what_needs_nothing_of_what_failed_is_there_and_a_second_run_computes_the_rest(
    undisturbed: Path, fail: frozenset[str], num_workers: int, order: list[int]
) -> None:
    everything, above = names(undisturbed), lineage(undisturbed)
    possible = {name for name in everything if not above[name] & fail}
    with tempfile.TemporaryDirectory() as folder:
        study, store = write_study(Path(folder)), Path(folder) / "store"
        pool = ManyWorkers(store, num_workers, order, fail)
        with pytest.raises(ShardError, match="broken") as caught:
            run_toys(study, store, pool=pool)
        tried = {f"stage {n.split()[0]}, {n.split()[1]}, shard {n.split()[2]}" for n in fail & set(pool.started)}
        assert {caught.value.where, *(error.where for error in caught.value.others)} == tried
        assert names(store) == {name: everything[name] for name in possible}
        assert sorted(pool.started) == sorted(possible | (fail & set(pool.started))), "nothing is tried twice"
        latest = read_latest(Store(store), "toy")
        whole = {stage for stage in TOYS.names if all(n in possible for n in everything if n.startswith(stage))}
        assert set(latest.stages if latest else ()) == whole, "only whole stages are on record"
        assert run_toys(study, store).num_computed == len(everything) - len(possible)
        assert digests(store) == digests(undisturbed)


def test_ctrl_c_ends_the_run_also_where_what_it_raises_is_lost(store: Store, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_toys(write_study(tmp_path), store.root, pool=Deaf(str(store)))
    assert len(list(store.artifacts())) == 1, "what was in work was kept, and nothing begun after it"
    assert [run["status"] for run in describe_runs(store)] == ["interrupted"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_breaks_off_what_the_run_waits_for(tmp_path: Path) -> None:
    class Waiting(HerePool):
        has_waited = False

        def work(self) -> bool:
            signal.raise_signal(signal.SIGINT)
            Waiting.has_waited = True
            return super().work()

    with pytest.raises(KeyboardInterrupt):
        run_toys(write_study(tmp_path), tmp_path / "store", pool=Waiting(str(tmp_path / "store")))
    assert not Waiting.has_waited


def test_a_full_disk_ends_the_run_as_failed(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    def find_no_room(shard: Shard, store: Store) -> ArtifactRef:
        tried.append(name_of(shard))
        monkeypatch.setattr(RunFolder, "write", refuse)
        raise FullDisk("no room")

    def refuse(*_: object) -> None:
        raise FullDisk("no room")

    with pytest.raises(ShardError, match=r"^stage grow, t0, shard s0: no room$"):
        run_toys(write_study(tmp_path), store.root, graph=toys_with("grow", run_shard=find_no_room))
    assert tried == ["grow t0 s0"]
    (store.root / "runs" / "20200101T000000-damaged-000000").mkdir()
    assert [run["status"] for run in describe_runs(store)] == ["failed"], "a run without a record hides no other"


@pytest.mark.parametrize("is_on_cluster", [False, True])
def test_a_thousand_shards_fail_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_on_cluster: bool) -> None:
    store, gates = tmp_path / "store", tmp_path / "gates"
    for folder in (store, gates):
        folder.mkdir()
    (gates / "fail-grow-t0-s1").touch()
    monkeypatch.setenv("TOY_FOLDER", str(gates))
    with ExitStack() as stack:
        pool: Pool = HerePool(str(store))
        if is_on_cluster:
            pool = ClusterPool(stack.enter_context(connect(ClusterSettings(1), store_root=str(store))), str(store))
        with pytest.raises(ShardError, match=r"^stage grow, t0, shard s1: \[Errno 28\]") as caught:
            run_toys(write_study(tmp_path), store, "grow.num_segments=1000", "grow.num_takes=1", pool=pool)
    assert caught.value.others == ()
    assert [name for name in names(store) if name.startswith("grow")] == ["grow t0 s0"]


def test_a_shard_starts_when_what_it_reads_is_there_and_the_most_urgent_first(tmp_path: Path) -> None:
    pool = ManyWorkers(tmp_path / "store", num_workers=2)
    run_toys(write_study(tmp_path), tmp_path / "store", "grow.num_takes=1", pool=pool)
    began = pool.started
    assert began[:2] == ["grow t0 s0", "aside aside all"]
    assert began.index("bend t0 s0") < began.index("grow t0 s2"), "of a stage that cannot be planned yet"
    assert stages_behind(TOYS) == {"aside": 1, "judge": 1, "bend": 2, "grow": 3}
    assert by_urgency(TOYS) == [*sorted(("aside", "judge"), key=TOYS.names.index, reverse=True), "bend", "grow"]


def execute_shown(
    tmp_path: Path, graph: Graph, *settings: str, fail: frozenset[str] = frozenset(), until: str = "grow"
) -> tuple[ManyWorkers, dict[str, Future[None]], dict[str, list[PartitionCount]]]:
    """Build up to a stage; gives the pool, the task of each stage, and the partitions that it showed last."""
    tasks: dict[str, Future[None]] = {}
    shown: dict[str, list[PartitionCount]] = {}
    chosen, known = load_study(str(write_study(tmp_path)), graph, settings=settings, environment={})
    run = Run(chosen, known, Store(tmp_path / "store"), StageSelection(until=until))
    pool = ManyWorkers(tmp_path / "store", num_workers=2, fail=fail)
    with ThreadPoolExecutor(9) as threads:

        def start(stage: str, follow: Callable[[ShowPartitions], None]) -> None:
            assert stage not in tasks
            tasks[stage] = threads.submit(follow, lambda counts: shown.update({stage: list(counts)}))

        plan = make_plan(chosen, known, run.store, run.selection)
        with suppress(ShardError):
            execute(run, begin(run, plan), plan, pool, start)
    return pool, tasks, shown


def test_a_task_is_a_stage_that_shows_its_partitions_one_of_which_may_follow_others(tmp_path: Path) -> None:
    def plan_linked(*given: Any) -> list[Shard]:
        shards = [replace(shard, after=()) for shard in TOYS.stage("grow").plan(*given)]
        last = replace(shards[0], partition="a-last", after=tuple(shard.key for shard in shards))
        return [last, *shards]

    linked = toys_with("grow", plan=plan_linked)
    pool, tasks, shown = execute_shown(tmp_path, linked, "grow.num_takes=3", "grow.num_segments=2")
    assert list(tasks) == ["grow"]
    assert tasks["grow"].exception() is None
    assert pool.started[-1] == "grow a-last s0"
    counts = {count.partition: (count.num_shards, count.num_computed) for count in shown["grow"]}
    assert counts == {"t0": (2, 2), "t1": (2, 2), "t2": (2, 2), "a-last": (1, 1)}


def test_the_task_of_a_stage_fails_as_the_stage_does(tmp_path: Path) -> None:
    settings, fail = ["grow.num_takes=2", "grow.num_segments=2"], frozenset({"grow t1 s0"})
    _, tasks, shown = execute_shown(tmp_path, TOYS, *settings, fail=fail)
    assert str(tasks["grow"].exception()).startswith("stage grow, t1, shard s0: ")
    failed = {count.partition: (count.num_computed, count.num_failed) for count in shown["grow"]}
    assert failed == {"t0": (2, 0), "t1": (0, 2)}, "the other one of t1 was not tried"


def test_the_task_of_a_stage_that_is_not_whole_fails_though_all_its_early_shards_ended(tmp_path: Path) -> None:
    settings, fail = ["grow.num_takes=2", "grow.num_segments=2"], frozenset({"grow t1 s1"})
    pool, tasks, _ = execute_shown(tmp_path, TOYS, *settings, fail=fail, until="bend")
    assert "bend t0 s1" in pool.started
    assert isinstance(tasks["bend"].exception(), Stopped)


def test_tasks_end_also_where_shards_cannot_be_cancelled(tmp_path: Path) -> None:
    class Unreachable(ManyWorkers):
        def give_up(self) -> None:
            raise OSError("nobody answers")

    tasks: list[Thread] = []

    def start(stage: str, follow: Callable[[ShowPartitions], None]) -> None:
        def do() -> None:
            with suppress(ShardError, Stopped):
                follow(lambda _: None)

        tasks.append(Thread(target=do, daemon=True))
        tasks[-1].start()

    pool = Unreachable(tmp_path / "store", fail=frozenset({"grow t1 s2"}))
    with pytest.raises(OSError, match="nobody answers"):
        build(tmp_path, pool, start)
    for task in tasks:
        task.join(timeout=10.0)
    assert [task.is_alive() for task in tasks] == [False] * 3


def test_a_stage_whose_task_is_never_begun_is_built_all_the_same(undisturbed: Path, tmp_path: Path) -> None:
    build(tmp_path, HerePool(str(tmp_path / "store")), lambda stage, follow: None)
    assert digests(tmp_path / "store") == digests(undisturbed)


def test_what_was_begun_early_counts_as_computed_and_is_told_once(tmp_path: Path) -> None:
    heard: list[str] = []

    class Told(Listener):
        def stage_started(self, plan: StagePlan) -> None:
            heard.append(f"{plan.stage.name} has {len(plan.todo)}")

        def shard_done(self, done: ShardDone) -> None:
            heard.append(name_of(done.shard))

        def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
            heard.append(f"{plan.stage.name} whole")

    outcome = build(tmp_path, ManyWorkers(tmp_path / "store", num_workers=3), listener=Told())
    assert sorted(heard) == sorted(
        [*EVERYBODY, *(f"{n} whole" for n in TOYS.names), "aside has 1", "bend has 6", "grow has 6", "judge has 1"]
    )
    assert heard.index("bend t0 s0") < heard.index("bend has 6")
    assert computed(outcome) == {"grow": 6, "bend": 6, "aside": 1, "judge": 1}


def build(
    folder: Path, pool: Pool, start: Any = None, *, listener: Listener | None = None, text: str = STUDY
) -> Outcome:
    """Build the toy study, and tell a listener of it."""
    chosen, graph = load_study(str(write_study(folder, text)), TOYS, environment={})
    run = Run(chosen, graph, Store(folder / "store"), listener=listener or Listener())
    plan = make_plan(chosen, graph, run.store)
    return execute(run, begin(run, plan), plan, pool, start)


def test_an_early_shard_is_no_work_for_a_stage_that_is_forced(toy_store: Store, tmp_path: Path) -> None:
    study, store, forced = write_study(tmp_path), toy_store.root, StageSelection(force=("grow",))
    assert computed(run_toys(study, store, selection=forced, pool=ManyWorkers(store, 3))) == {"grow": 6}
    assert plan_toys(study, store).is_fresh


def test_a_stage_that_cannot_be_planned_leaves_others_their_work(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    assert plan_toys(study, tmp_path / "store").stage("bend").is_pending

    def refuse(*_: object) -> list[Shard]:
        raise InputError("bend: no")

    with pytest.raises(InputError, match="bend: no"):
        run_toys(study, tmp_path / "store", graph=toys_with("bend", plan=refuse, early=()))
    assert {name.split()[0] for name in names(tmp_path / "store")} == {"grow", "aside"}


def test_a_stage_of_which_an_early_shard_failed_is_planned_and_its_other_shards_are_computed(tmp_path: Path) -> None:
    def plan_first(*given: Any) -> list[Shard]:
        return [shard for shard in TOYS.stage("bend").plan(*given) if shard.name == "s0"]

    graph = toys_with("bend", early=(EarlyPlan(plan_first, each=("training_log",)),))
    pool = ManyWorkers(tmp_path / "store", fail=frozenset({"bend t0 s0"}))
    with pytest.raises(ShardError, match=r"^stage bend, t0, shard s0: broken$"):
        run_toys(write_study(tmp_path), tmp_path / "store", graph=graph, pool=pool)
    assert set(EVERYBODY) - set(names(tmp_path / "store")) == {"bend t0 s0", "judge all all"}


def test_two_runs_at_once_in_one_store_end_with_the_same_artifacts(undisturbed: Path, tmp_path: Path) -> None:
    study, store = write_study(tmp_path), tmp_path / "store"
    with ThreadPoolExecutor(2) as both:
        runs = [both.submit(run_toys, study, store, pool=ManyWorkers(store, 3, order)) for order in ([1, 2], [2, 0, 1])]
        assert sum(run.result().num_computed for run in runs) >= len(EVERYBODY)
    assert digests(store) == digests(undisturbed)
    assert verify(Store(store)).is_ok
    assert len(names(store)) == len(EVERYBODY)


def test_a_jumping_clock_changes_no_result(undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = itertools.cycle([timedelta(days=400), timedelta(days=-400), timedelta(hours=1)])

    class Jumping(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            return super().now(tz) + next(jumps)

    for module in ("runs", "artifact_writer"):
        monkeypatch.setattr(f"storage_schema.{module}.datetime", Jumping)
    study, store = write_study(tmp_path), tmp_path / "store"
    with pytest.raises(ShardError):
        run_toys(study, store, pool=ManyWorkers(store, 2, fail=frozenset({"bend t1 s1"})))
    run_toys(study, store)
    assert digests(store) == digests(undisturbed)
    assert plan_toys(study, store).is_fresh
    years = {manifest.created_at[:4] for manifest in Store(store).artifacts()}
    assert len(years) > 1, "the clock did jump"


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def test_a_flipped_bit_is_named_and_its_artifact_computed_again(toy_store: Store, tmp_path: Path) -> None:
    study, store = write_study(tmp_path), toy_store.root
    before = digests(store)["bend"]
    flip(next(store.glob("bend/*/*/models.parquet")))
    assert plan_toys(study, store).is_fresh
    with pytest.raises(ShardError, match=r"; bend@\w{12} is damaged and was removed, the same command"):
        run_toys(study, store, "judge.title=again")
    assert computed(run_toys(study, store, "judge.title=again")) == {"bend": 1, "judge": 1}
    assert digests(store)["bend"] == before
    assert verify(Store(store)).is_ok


def test_what_cannot_be_read_once_stays(toy_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, store = write_study(tmp_path), toy_store.root
    there = names(store)

    def fail(path: Path, *_: object, **__: object) -> None:
        raise CorruptArtifact(f"{path} cannot be read (Input/output error)")

    with monkeypatch.context() as patch:
        patch.setattr("storage_schema.store.read_table", fail)
        with pytest.raises(ShardError, match=r"Input/output error\)$"):
            run_toys(study, store, "judge.title=again")
    assert names(store) == there
    assert run_toys(study, store, "judge.title=again").num_computed == 1


def test_a_forced_stage_puts_a_flipped_bit_right_also_under_a_dataset(toy_store: Store, tmp_path: Path) -> None:
    create_dataset(toy_store, "toys", [manifest.ref for manifest in toy_store.artifacts()])
    flip(next(toy_store.root.glob("bend/*/*/models.parquet")))
    assert [(problem.stage, problem.file_name) for problem in verify(toy_store).problems] == [
        ("bend", "models.parquet")
    ]
    run_toys(write_study(tmp_path), toy_store.root, selection=StageSelection(force=("bend",)))
    assert verify(toy_store).is_ok


def test_how_far_a_run_is_counts_every_shard_and_what_is_left_shrinks_to_nothing(tmp_path: Path) -> None:
    class Kept(Listener):
        def __init__(self) -> None:
            self.kept: list[Progress] = []

        def progressed(self, progress: Progress) -> None:
            self.kept.append(progress)

    first, second = Kept(), Kept()
    for listener, sections in ((first, ""), (second, "[grow]\nscale = 2.0\n[aside]\nsize = 3\n")):
        text, pool = f"{STUDY}[bend]\nstep = 1\n{sections}", ManyWorkers(tmp_path / "store", num_workers=3)
        build(tmp_path, pool, listener=listener, text=text)
        *under_way, last = listener.kept
        assert [progress.num_done for progress in listener.kept] == list(range(len(EVERYBODY) + 1))
        assert all(progress.running for progress in under_way)
        assert (last.num_shards, last.running, last.left_s) == (len(EVERYBODY), (), 0.0)
    assert not first.kept[0].is_all, "nothing is known of what was never built"
    assert all(
        progress.is_all and progress.num_shards == len(EVERYBODY) and progress.left_s > 0
        for progress in second.kept[:-1]
    )


def test_what_is_left_is_told_by_what_ended_and_by_what_a_stage_had_that_cannot_be_planned_yet(tmp_path: Path) -> None:
    """Of six shards, two took 2 and 4 s, one failed and one was not tried; of the seven of another, one took 10 s."""
    tally = Tally(Store(tmp_path), "toy")
    grow = [Shard("grow", 1, "a" if at < 5 else "b", f"s{at}", Parameters(), seed=at) for at in range(6)]
    early = Shard("bend", 1, "a", "s0", Parameters())
    for priority, shard in enumerate([*grow, early]):
        tally.add(shard, priority)
    at_fault = ShardError("stage grow, a, shard s2", "InputError", "no")
    for shard in grow[2:4]:
        tally.end(ShardFailed(shard, at_fault))
    for shard, seconds in ((grow[0], 2.0), (grow[1], 4.0), (early, 10.0)):
        tally.end(ShardDone(shard, ArtifactRef(shard.stage, shard.key, "0" * 64), seconds))
    last_partitions = (("a", 3), ("b", 4))
    waiting = StagePlan(TOYS.stage("bend"), is_selected=True, pending_on=("grow",), last_partitions=last_partitions)
    progress = tally.progress([waiting], 2)
    assert (progress.num_done, progress.num_shards) == (4, 4 + 2 + 6)
    assert (progress.left_s, progress.is_all) == ((2 * 3.0 + 6 * 10.0) / 2, True)
    assert progress.running == (grow[5], grow[4])
    assert progress.partitions == {("grow", "a"): (4, 5), ("grow", "b"): (0, 1)}
    assert tally.partitions("grow") == [PartitionCount("a", 5, 2, 2, 6.0), PartitionCount("b", 1)]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Let silence be broken soon; return what waits for words and gives all that was said by then."""
    for name, seconds in (("_SILENCE_S", 0.05), ("_LOOK_UP_S", 0.01)):
        monkeypatch.setattr(f"flows.console.display.{name}", seconds)
    lines: list[str] = []

    def wait_for(words: str) -> str:
        wait_until(lambda: lines.append(capsys.readouterr().err) or words in "".join(lines), words)
        return "".join(lines)

    return wait_for


def test_the_same_line_is_printed_less_and_less_often(said: Callable[[str], str]) -> None:
    listener = LineListener()
    listener.progressed(Progress(1, 9, [], 0.0, is_all=True))
    time.sleep(1.5)
    listener.progressed(Progress(2, 9, [], 0.0, is_all=True))
    num_lines = said("2 of 9").count("1 of 9 shards")
    listener.close()
    assert 1 <= num_lines <= 6, "0.05, 0.1, 0.2, 0.4 and 0.8 s apart, not 30 times"


def test_silence_is_broken_with_how_far_the_run_is(said: Callable[[str], str]) -> None:
    listener = LineListener()
    shard = Shard("chains", 1, "ic", "seed0", Parameters())
    listener.progressed(Progress(12, 45, [shard], 200.0, is_all=True))
    assert "12 of 45 shards, computing chains ic seed0; about 3 min 20 s left" in said("left")
    listener.close()
    assert progress_text(Progress(1, 1, [], 0.0, is_all=True)) == "1 of 1 shard"
    video = Shard("reconstruction", 1, "video00", "video00", Parameters())
    assert progress_text(Progress(0, 1, [video], 0.2, is_all=False)) == "0 of 1 shard, computing reconstruction video00"
    assert progress_text(Progress(12, 45, [shard] * 5, 40.0, is_all=False)) == (
        "12 of 45 shards, computing chains ic seed0, chains ic seed0, chains ic seed0 and 2 more; more than 40 s left"
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"num_workers": 0}, []),
        ({"num_workers": 1, "memory_bytes": 1}, ["starting 1 local worker"]),
        ({"scheduler": "tcp://10.0.0.1:8786"}, ["connecting to the Dask scheduler at tcp://10.0.0.1:8786"]),
        (
            {"profile": ClusterProfile(cluster="dask_jobqueue.SLURMCluster")},
            ["starting dask_jobqueue.SLURMCluster, waiting for its first worker"],
        ),
    ],
)
def test_who_computes_is_said_before_it_is_waited_for(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], words: list[str]
) -> None:
    notes: list[str] = []
    connected: list[tuple[ClusterSettings, str]] = []

    @contextmanager
    def connect(settings: ClusterSettings, *, store_root: str) -> Iterator[Any]:
        assert notes == words
        connected.append((settings, store_root))
        yield SimpleNamespace(scheduler_info=lambda **_: {"workers": {"a": {}}}, run_on_scheduler=lambda *_: [])

    monkeypatch.setenv("TOY_THREADS", "9")
    monkeypatch.setattr("flows.execution.worker_environment", lambda: {"TOY_THREADS": "1"})
    monkeypatch.setattr("flows.execution.connect", connect)
    monkeypatch.setattr("tasks.shards.running.refusals", lambda client: [])
    chosen, stages = load_study(str(write_study(tmp_path)), TOYS, environment={})
    listener = Listener()
    listener.note = notes.append  # type: ignore[method-assign]
    settings = ClusterSettings(**options)
    with open_pool(Run(chosen, stages, store, listener=listener), settings) as pool:
        assert isinstance(pool, ClusterPool) is bool(words)
        assert os.environ["TOY_THREADS"] == ("9" if words else "1"), "who computes here has the threads of a worker"
    assert connected == [(settings, str(store))] * bool(words)
    assert store.root.is_dir()
