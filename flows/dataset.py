"""The Prefect flows: one per stage, made from the registry, and one that runs the graph; Dask does the work.

Importing this module imports Prefect, so nothing above it does so before there is work.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.execution import Outcome, Partition, Run, begin, execute, outcome_of_fresh, partitions_to_run
from flows.machine import WORKER_MEMORY_GB, cluster_settings
from flows.planning import Plan, StagePlan, make_plan, refuse_nothing
from flows.prefect_server import check_server, starting_server, telemetry_off
from flows.publishing import CHANGES_FILE, Published, publish, refuse_failed_gates
from flows.study import load_study
from storage_schema import Store, in_use
from tasks.graph import load_graph
from tasks.shards import (
    ClusterSettings,
    ShardError,
    Stopped,
    connect,
    joined,
    peak_memory_bytes,
    run_on_cluster,
    run_serially,
    worker_environment,
)

telemetry_off()

# Telemetry is off first, so these imports come late.
from prefect import flow, task  # noqa: E402
from prefect.artifacts import create_link_artifact, create_markdown_artifact, create_table_artifact  # noqa: E402
from prefect.cache_policies import NO_CACHE  # noqa: E402
from prefect.settings import (  # noqa: E402
    PREFECT_API_URL,
    PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
    get_current_settings,
    temporary_settings,
)
from prefect.task_runners import ThreadPoolTaskRunner  # noqa: E402

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["Workers", "dataset", "orchestrate"]

_MAX_PARTITIONS_AT_ONCE = 16
_IN_FLIGHT_PER_WORKER = 2


@dataclass(frozen=True)
class Workers:
    """Who computes shards: a Dask client, or nobody but this process; `stop` ends the work of every thread."""

    client: Client | None = None
    num_workers: int = 0
    stop: threading.Event = field(default_factory=threading.Event)

    def run(self, run: Run, plan: StagePlan, partition: Partition) -> None:
        """Compute and commit the shards of one partition."""
        options: dict[str, Any] = {"on_done": run.listener.shard_done, "stop": self.stop}
        root = str(run.store.root)
        if self.client is None:
            run_serially(plan.stage.run_shard, partition.shards, root, **options)
        else:
            window = max(_IN_FLIGHT_PER_WORKER * self.num_workers, 1)
            run_on_cluster(self.client, plan.stage.run_shard, partition.shards, root, max_in_flight=window, **options)


def orchestrate(run: Run, plan: Plan, settings: ClusterSettings) -> Outcome:
    """Run a study as Prefect flows on a Dask cluster that lives as long as the run; no workers is this process alone.

    Prefect's server is the user's (PREFECT_API_URL, or their profile), else one that lives as long as the run.

    Raises:
        ServerError, ClusterError: Prefect's server or the Dask cluster cannot be used.
        ShardError: Shards failed; everything that needs none of them is committed.
    """
    with _prefect_server(run) as await_server, _workers(run, settings) as workers, await_server():
        outcome = _graph_flow(run, plan, workers)
        return replace(outcome, peak_memory_bytes=peak_memory_bytes(workers.client))


@flow(name="pasdedeux-dataset", retries=0, persist_result=False)
def dataset(
    study: str = "duets",
    store: str = "store",
    settings: Sequence[str] = (),
    workers: int | None = None,
    worker_memory_gb: float = WORKER_MEMORY_GB,
    scheduler: str | None = None,
    folder: str | None = None,
    oversubscribe: bool = False,
) -> dict[str, int]:
    """Bring a study up to date: the entry point of deployments (see `deploy/`); gives the shards computed per stage.

    Relative paths of settings and of a study that ships start from `folder`: a worker's own is another each time.
    """
    cluster = cluster_settings(workers, worker_memory_gb, scheduler, oversubscribe=oversubscribe)
    chosen, graph = load_study(study, load_graph(), settings=settings, folder=None if folder is None else Path(folder))
    run = Run(chosen, graph, Store(store))
    with in_use(run.store):
        plan = make_plan(chosen, graph, run.store)
        if plan.is_fresh:
            outcome = outcome_of_fresh(run, plan)
        else:
            run.store.prepare()
            with in_use(run.store), _workers(run, cluster) as found:
                record = begin(run, plan)
                outcome = execute(run, record, plan, partial(_run_stage, found, record.run_id))
        published = publish(run, outcome)
    _show(chosen.name, outcome, published)
    refuse_nothing(outcome.missing)
    refuse_failed_gates(published)
    return {stage.name: stage.num_computed for stage in outcome.stages}


def _show(study: str, outcome: Outcome, published: Published | None) -> None:
    """Put what a build did, where its report is and what it published on the page of its flow run."""
    rows = [
        {
            "stage": stage.name,
            "shards": stage.num_shards,
            "computed": stage.num_computed,
            "verdict": "" if stage.verdict is None else stage.verdict.level.value,
            "reason": "" if stage.verdict is None else stage.verdict.reason,
        }
        for stage in outcome.stages
    ]
    where = "" if outcome.report is None else f"; report: {outcome.report / 'report.html'}"
    key = "".join(letter if letter.isalnum() else "-" for letter in f"pasdedeux-{study}".lower())
    create_table_artifact(rows, key=key, description=f"run {outcome.run_id}{where}")
    if published is not None and published.dataset is not None:
        link = (published.dataset.path / CHANGES_FILE).as_uri()
        create_link_artifact(link, published.dataset.label, key=f"{key}-dataset", description=published.words)
    elif published is not None:
        words = "\n- ".join([published.words, *published.failures])
        create_markdown_artifact(words, key=f"{key}-dataset", description=published.words)


def _graph_flow(run: Run, plan: Plan, workers: Workers) -> Outcome:
    """Run the whole graph as one flow whose stages are flows of their own."""
    folder = begin(run, plan)

    @flow(name="pasdedeux-dataset", flow_run_name=folder.run_id, retries=0, persist_result=False)
    def build(study: str, run_id: str) -> Outcome:
        return execute(run, folder, plan, partial(_run_stage, workers, run_id))

    return build(study=run.study.name, run_id=folder.run_id)


def _run_stage(workers: Workers, run_id: str, run: Run, plan: StagePlan) -> None:
    """Run one stage as a flow with a task per partition, on threads of this process; others outlive one that fails."""
    partitions = partitions_to_run(plan)
    failures: dict[str, Exception] = {}
    is_serial = workers.client is None
    runner: Any = ThreadPoolTaskRunner(max_workers=1 if is_serial else min(len(partitions), _MAX_PARTITIONS_AT_ONCE))

    @task(
        name=f"{plan.stage.name}-partition",
        task_run_name="{name}",
        retries=0,
        cache_policy=NO_CACHE,
        persist_result=False,
    )
    def build_partition(name: str) -> None:
        try:
            workers.run(run, plan, by_name[name])
        except Exception as error:
            failures[name] = error
            if not isinstance(error, ShardError) or error.is_fatal:
                workers.stop.set()
            raise

    @flow(
        name=plan.stage.name,
        flow_run_name=f"{plan.stage.name}-{run_id}",
        retries=0,
        persist_result=False,
        task_runner=runner,
    )
    def build_stage(study: str, run_id: str) -> None:
        if is_serial:
            behind: set[str] = set()
            for partition in partitions:
                if behind.isdisjoint(partition.needs):
                    build_partition(partition.name, return_state=True)
                if partition.name in failures or not behind.isdisjoint(partition.needs):
                    behind.add(partition.name)
        else:
            futures: dict[str, Any] = {}
            try:
                for partition in partitions:
                    waits = [futures[name] for name in partition.needs]
                    futures[partition.name] = build_partition.submit(partition.name, wait_for=waits, return_state=False)
                for future in futures.values():
                    future.wait()
            except BaseException:
                workers.stop.set()
                raise
        errors = [failures[partition.name] for partition in partitions if partition.name in failures]
        shard_errors = [error for error in errors if isinstance(error, ShardError)]
        for error in errors:
            if not (isinstance(error, ShardError) or (shard_errors and isinstance(error, Stopped))):
                raise error
        if shard_errors:
            raise joined(shard_errors)

    by_name = {partition.name: partition for partition in partitions}
    build_stage(study=run.study.name, run_id=run_id)


@contextmanager
def _prefect_server(run: Run) -> Iterator[Callable[[], AbstractContextManager[object]]]:
    """Begin to make sure that there is a Prefect server for this block; what is given waits for it, and sets it."""
    address = get_current_settings().api.url
    if address is not None:
        check_server(address)
        yield nullcontext
        return
    run.listener.note("starting Prefect's local server (the first time on a machine this takes 10 to 20 s)")
    with starting_server() as server:
        # Heartbeats find flows whose process died; this server dies with its only flow, and they cost a second a flow.
        yield lambda: temporary_settings({PREFECT_API_URL: server.wait(), PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None})


@contextmanager
def _workers(run: Run, settings: ClusterSettings) -> Iterator[Workers]:
    """Return the workers for this block."""
    Path(run.store.root).mkdir(parents=True, exist_ok=True)
    if settings.scheduler is None and settings.num_workers == 0:
        os.environ.update(worker_environment())
        yield Workers()
        return
    if settings.scheduler is None:
        run.listener.note(f"starting {settings.num_workers} local workers")
    else:
        run.listener.note(f"connecting to the Dask scheduler at {settings.scheduler}")
    with connect(settings, store_root=str(run.store.root)) as client:
        num_workers = len(client.scheduler_info(n_workers=-1)["workers"])
        yield Workers(client, num_workers)
