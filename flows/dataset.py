"""The Prefect flow: its body plans and submits, its tasks are stages, and Dask computes their shards.

Importing this module imports Prefect, so nothing above it does so before there is work.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from httpx import HTTPError

from flows.building import ShowPartitions
from flows.execution import begin, execute, open_pool, outcome_of_fresh
from flows.machine import WORKER_MEMORY_GB, cluster_settings
from flows.outcomes import Outcome, Run
from flows.planning import Plan, make_plan, refuse_nothing
from flows.prefect_server import LocalServer, check_server, signed_in, telemetry_off
from flows.progress import PartitionCount
from flows.publishing import Published, publish, refuse_unpublished
from flows.study import load_study
from pasdedeux.evaluation.verdicts import figure_words
from pasdedeux.plain_text import markdown_text
from pasdedeux.verdict import Verdict
from storage_schema import Store, in_use
from tasks.graph import load_graph
from tasks.shards import Pool, in_one_line

telemetry_off()

# These imports come after telemetry is off.
from prefect import flow, task  # noqa: E402
from prefect.artifacts import create_markdown_artifact, create_table_artifact  # noqa: E402
from prefect.cache_policies import NO_CACHE  # noqa: E402
from prefect.client.orchestration import get_client  # noqa: E402
from prefect.events.clients import PrefectEventsClient  # noqa: E402
from prefect.events.worker import EventsWorker  # noqa: E402
from prefect.runtime import flow_run  # noqa: E402
from prefect.settings import (  # noqa: E402
    PREFECT_API_URL,
    PREFECT_CLIENT_MAX_RETRIES,
    PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
    get_current_settings,
    temporary_settings,
)
from prefect.task_runners import ThreadPoolTaskRunner  # noqa: E402
from prefect.utilities.annotations import quote  # noqa: E402

_THREADS: Any = ThreadPoolTaskRunner(max_workers=100)
"""One waiting thread for each stage."""


def build_in_flow(run: Run, plan: Plan, pool: Pool, server: LocalServer | None) -> Outcome:
    """Build a plan as a flow, and return the outcome or raise its error also if Prefect can no longer be reached.

    Args:
        run: The run to execute.
        plan: Its plan.
        pool: Computes shards.
        server: Prefect's server of this run, which may be starting; unused if the user's profile names another one.

    Raises:
        ServerError: Prefect's server cannot be used.
        ShardError: Shards failed; everything that does not need them is committed.
    """
    results: list[Outcome | Exception] = []
    settings: dict[Any, Any] = {}
    if address := get_current_settings().api.url:
        check_server(address, run.listener.note)
        if server is not None:
            server.end()
    folder = begin(run, plan)  # while the server starts
    if not address and server is not None:
        # Heartbeats find flows whose process died. This server dies with its only flow, and they cost a second.
        # Nobody restarts it either, so each request waits some seconds for it, not a minute.
        settings = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None, PREFECT_CLIENT_MAX_RETRIES: 1}
        settings[PREFECT_API_URL] = server.wait()

    @flow(name=dataset.name, flow_run_name=folder.run_id, retries=0, persist_result=False, task_runner=_THREADS)
    def build(study: str, run_id: str) -> None:
        try:
            results.append(execute(run, folder, plan, pool, _start_task))
        except Exception as error:
            results.append(error)
            raise

    try:
        with (
            signed_in(address or "this machine"),
            temporary_settings(settings),
            nullcontext() if address else _impatient_events(),
        ):
            build(study=run.study.name, run_id=folder.run_id)
    except Exception as error:
        if not results:
            raise
        if error is not results[0]:
            run.listener.note(f"Prefect's server has not recorded the end: {in_one_line(error)}")
    if isinstance(results[0], Exception):
        raise results[0] from None
    return results[0]


@contextmanager
def _impatient_events() -> Iterator[None]:
    """Let events of this block be dropped after one attempt to reconnect: the process waits for all ten at its end."""
    EventsWorker.set_client_override(PrefectEventsClient, reconnection_attempts=1)
    try:
        yield
    finally:
        EventsWorker.set_client_override(None)


@flow(name="pasdedeux-dataset", retries=0, persist_result=False, task_runner=_THREADS)
def dataset(
    study: str = "duets",
    store: str = "store",
    settings: Sequence[str] = (),
    workers: int | None = None,
    worker_memory_gb: float = WORKER_MEMORY_GB,
    scheduler: str | None = None,
    folder: str | None = None,
    oversubscribe: bool = False,
    cluster: str | None = None,
) -> dict[str, int]:
    """Bring a study up to date, as the entry point of deployments; return the number of computed shards by stage.

    Relative paths of settings and of a shipped study start from `folder`, because a worker's current folder changes.
    """
    where = cluster_settings(workers, worker_memory_gb, scheduler, cluster=cluster, oversubscribe=oversubscribe)
    chosen, graph = load_study(study, load_graph(), settings=settings, folder=None if folder is None else Path(folder))
    run = Run(chosen, graph, Store(store))
    with in_use(run.store):
        plan = make_plan(chosen, graph, run.store)
        if plan.is_fresh:
            outcome = outcome_of_fresh(run, plan)
        else:
            run.store.prepare()
            with in_use(run.store), open_pool(run, where) as pool:
                record = begin(run, plan)
                _name_flow_run(record.run_id)
                outcome = execute(run, record, plan, pool, _start_task)
        published = publish(run, outcome)
    _show(run, outcome, published)
    refuse_nothing(outcome.missing)
    refuse_unpublished(published)
    return {stage.name: stage.num_computed for stage in outcome.stages}


def _show(run: Run, outcome: Outcome, published: Published | None) -> None:
    """Show results, report and published version on the page of the flow run."""
    rows = [
        {
            "stage": stage.name,
            "shards": stage.num_shards,
            "computed": stage.num_computed,
            "verdict": stage.verdict.level.value if stage.verdict else "",
            "reason": _reason(stage.verdict),
        }
        for stage in outcome.stages
    ]
    where = "" if outcome.page is None else f"; report: {outcome.page}"
    key = _key(run.study.name)
    create_table_artifact(rows, key=key, description=f"run {outcome.run_id}{where}")
    if published is not None:
        words = "\n- ".join(map(markdown_text, (published.words, *published.failures)))
        create_markdown_artifact(words, key=f"{key}-dataset", description=published.words)


def _reason(verdict: Verdict | None) -> str:
    """Return the reason of a verdict and its figure; a pass has only the figure."""
    return "" if verdict is None else "; ".join(filter(None, (verdict.reason, figure_words(verdict))))


def _name_flow_run(run_id: str) -> None:
    """Name the flow run after the run of the store; it keeps another name if the server does not answer."""
    with suppress(HTTPError), get_client(sync_client=True) as client:
        client.update_flow_run(flow_run.id, name=run_id)


@task(task_run_name="{stage}", retries=0, cache_policy=NO_CACHE, persist_result=False)
def _stage(stage: str, follow: Callable[[ShowPartitions], None]) -> None:
    """Show a running stage as a task run of Prefect, whose artifact has a row for each partition."""
    key = _key("stage", stage)

    def show(counts: Sequence[PartitionCount]) -> None:
        rows = [{**asdict(count), "seconds": round(count.seconds, 1)} for count in counts]
        with suppress(HTTPError):  # a build does not need the server
            create_table_artifact(rows, key=key, description=f"partitions of stage {stage}")

    follow(show)


def _start_task(stage: str, follow: Callable[[ShowPartitions], None]) -> None:
    """Start the task of a stage in a thread of the current flow."""
    given: Any = quote(follow)  # unquoted, Prefect would search it for futures
    _stage.with_options(name=stage).submit(stage, given, return_state=False)


def _key(*words: str) -> str:
    """Return the key of an artifact."""
    return re.sub("[^a-z0-9]", "-", "-".join(("pasdedeux", *words)).lower())
