"""`run`: build a study."""

from __future__ import annotations

import errno
import os
import signal
import tempfile
import time
import webbrowser
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer
from typer import Option

from flows.console import options
from flows.console.context import answer, app, busy, echo, graph_of, next_command, open_store
from flows.console.display import headlines, make_listener, outcome_lines
from flows.execution import open_pool, outcome_of_fresh
from flows.machine import GIB, WORKER_MEMORY_GB, cluster_settings, free_bytes, kernel_cache, nearest_folder
from flows.outcomes import Outcome, Run
from flows.planning import Plan, PlanError, StageSelection, make_plan, refuse_nothing
from flows.prefect_server import check_server, starting_server, writable_home
from flows.publishing import Published, publish, refuse_bad_verdicts, refuse_unpublished
from flows.signals import ENDING
from flows.study import Study, load_study
from pasdedeux.errors import InputError
from pasdedeux.plain_text import counted
from pasdedeux.verdict import Level
from storage_schema import Store, in_use
from tasks.graph import Graph
from tasks.ingest.parameters import IngestParameters
from tasks.shards import ClusterSettings
from tasks.stage import Parameters

MIN_FREE_BYTES = 64 * 1024**2


PREVIEW_S = 4.0


PREVIEWED = "augmentation"
"""Last stage of a preview of takes, unless the command names another; a preview of 2D poses alone goes on."""


_IMPORTED_BY_FLOWS = ("prefect.flow_engine", "prefect.task_engine", "prefect.utilities.visualization", "fastapi")
"""Modules that Prefect imports late, at the first flow, while everything else waits."""


@app.command()
def run(
    context: typer.Context,
    study: options.Study = "duets",
    settings: options.Settings = None,
    store: options.Store = Path("store"),
    workers: options.Workers = None,
    oversubscribe: options.Oversubscribe = False,
    worker_memory: Annotated[float, Option(min=0.25, metavar="GB", help="Memory of a worker.")] = WORKER_MEMORY_GB,
    scheduler: options.Scheduler = None,
    cluster: options.Cluster = None,
    only: options.Only = None,
    start: options.From = None,
    until: options.Until = None,
    force: options.Force = None,
    is_preview: Annotated[bool, Option("--preview", help=f"{PREVIEW_S:g} s of each take, as <study>-preview.")] = False,
    is_profiled: Annotated[
        bool, Option("--profile", help="Also write a profile beside the report: which process computed what, and when.")
    ] = False,
    opens: Annotated[bool, Option("--open", help="Open the report in a browser at the end.")] = False,
    fail_on: options.FailOn = None,
    as_json: options.Json = False,
) -> None:
    """Build a study: compute missing and stale artifacts.

    \b
    Examples:
      pasdedeux run                  the built-in duets, into ./store
      pasdedeux run my.toml --store /data/store --workers 8
      pasdedeux run my.toml --set chains.num_chains=4 --until chains
      pasdedeux run my.toml --preview   the 4 s with most contact of each take
      pasdedeux run my.toml --open      and open the report at the end
      pasdedeux run my.toml --scheduler tcp://cluster:8786
      pasdedeux run my.toml --cluster deploy/clusters/slurm.toml
    """
    selection = StageSelection(tuple(only or ()), start, until, tuple(force or ()))
    given = selection.words
    short = [f"ingest.take_seconds={PREVIEW_S}"] if is_preview else []
    chosen, graph = load_study(study, graph_of(context), settings=[*short, *(settings or ())])
    if is_preview:
        if not selection.words and PREVIEWED in chosen.parameters and _has_takes(chosen):
            selection = replace(selection, until=PREVIEWED)
        head = chosen.head.model_copy(update={"name": f"{chosen.name}-preview"})
        chosen = chosen.model_copy(
            update={"head": head, "publish": None, "parameters": _most_contact(chosen.parameters)}
        )
    where = cluster_settings(workers, worker_memory, scheduler, cluster=cluster, oversubscribe=oversubscribe)
    worst = None if fail_on is None else Level(fail_on)
    opened = open_store(store)
    graph = with_page(chosen, graph, opened, selection)
    to_build = Run(chosen, graph, opened, selection, is_profiled=is_profiled)
    build_and_report(to_build, where, opens=opens, fail_on=worst, as_json=as_json)
    if is_preview and not as_json:
        echo(f"for the whole study: {next_command('run', study, *given, store=store, settings=settings)}")


def _most_contact(sections: Mapping[str, Parameters]) -> dict[str, Parameters]:
    """Return the sections of a study, with takes of files cut to the seconds with most contact."""
    ingest = sections.get("ingest")
    if not isinstance(ingest, IngestParameters) or not ingest.takes:
        return dict(sections)
    from tasks.ingest.previewing import with_most_contact  # here, because it compiles

    with busy("looking for the seconds with most contact"):
        return {**sections, "ingest": with_most_contact(ingest, PREVIEW_S)}


def _has_takes(study: Study) -> bool:
    """Return whether the study has takes."""
    ingest = study.parameters["ingest"]
    return isinstance(ingest, IngestParameters) and bool(ingest.take_ids())


def with_page(study: Study, graph: Graph, store: Store, selection: StageSelection) -> Graph:
    """Return the graph of a selection: for `until`, only its needs and the report on it, unless everything is fresh."""
    if selection.until is None or selection.until not in graph.names:
        return graph
    if not selection.force:
        # A later stage that cannot be planned, such as training on too few sizes, must not stop the selected one.
        with suppress(InputError):
            if make_plan(study, graph, store).is_fresh:
                return graph
    return graph.only({selection.until, *graph.above(selection.until), *graph.reporting})


def build_and_report(
    run: Run, cluster: ClusterSettings, *, as_json: bool, opens: bool = False, fail_on: Level | None = None
) -> None:
    """Bring a study up to date, report the outcome, and fail if nothing was made or a verdict is too bad."""
    started = time.perf_counter()
    outcome, work = build(run, cluster, is_quiet=as_json)
    seconds = time.perf_counter() - started
    with in_use(run.store):
        published = publish(run, outcome)
    more = {} if published is None else {"published": published.to_json()}
    lines = _report_lines(run, outcome, work, seconds, published)
    answer({**outcome.to_json(), "seconds": round(seconds, 3), **more}, lines, as_json=as_json)
    if opens and outcome.page is None:
        echo("there is no report to open: this study makes none", err=True)
    elif opens and outcome.page is not None and not webbrowser.open(outcome.page.resolve().as_uri()):
        echo(f"no browser starts here; open {outcome.page} in one", err=True)
    refuse_nothing(outcome.missing)
    refuse_unpublished(published)
    if fail_on is not None:
        refuse_bad_verdicts(run, outcome, fail_on)


def _report_lines(run: Run, outcome: Outcome, work: Plan, seconds: float, published: Published | None) -> Iterator[str]:
    """Yield the outcome of a run, the current products, and the path of the report."""
    yield from (*outcome_lines(outcome), *(f"warning: {words}" for words in work.warnings))
    if work.is_fresh:
        yield f"{'' if outcome.missing else 'everything is fresh, '}nothing to do ({seconds:.1f} s)"
        if run.is_profiled:
            yield (
                "no profile, because nothing was computed; use --force STAGE to recompute a stage, or another "
                "--store to recompute everything"
            )
    else:
        memory = f", at most {outcome.peak_memory_bytes / GIB:.2f} GB per process" if outcome.peak_memory_bytes else ""
        yield f"done: {counted(outcome.num_computed, 'shard')} computed in {seconds:.1f} s{memory}"
    yield from headlines(run.store, run.study.name, work.manifests if work.is_fresh else ())
    if outcome.page is not None:
        yield f"report: {outcome.page}"
    if published is not None and not published.failures:
        yield published.words


def build(run: Run, cluster: ClusterSettings, *, is_quiet: bool) -> tuple[Outcome, Plan]:
    """Bring a study up to date, and return outcome and plan. Nothing is removed from the store meanwhile."""
    with in_use(run.store):
        work = make_plan(run.study, run.graph, run.store, run.selection)
        if work.is_fresh:
            return outcome_of_fresh(run, work), work
        _refuse_full_disk(run.store)
        run.store.prepare()
        with in_use(run.store):  # again, because a new store could not be locked before
            return _build(run, work, cluster, is_quiet=is_quiet), work


def _build(run: Run, plan: Plan, cluster: ClusterSettings, *, is_quiet: bool) -> Outcome:
    """Run everything that is not fresh; Prefect's server and the workers start while Prefect is imported."""
    listener = make_listener(is_quiet=is_quiet)
    run = replace(run, listener=listener)
    if why_not := kernel_cache()[1]:
        listener.note(f"compiled kernels cannot be kept, so each process spends minutes compiling: {why_not}")
    try:
        if named := os.environ.get("PREFECT_API_URL"):
            check_server(named, listener.note)
        else:
            listener.note("starting Prefect's local server (the first time on a machine this takes 10 to 20 s)")
        with (
            writable_home(listener.note),
            nullcontext() if named else starting_server() as server,
            ThreadPoolExecutor(1) as threads,
        ):
            if cluster.is_shared or cluster.num_workers:
                import distributed  # noqa: F401 - first: threads that import at once may meet half-loaded modules
            loading = threads.submit(_load_prefect)
            with open_pool(run, cluster) as pool:
                outcome: Outcome = loading.result().build_in_flow(run, plan, pool, server)
                return outcome
    finally:
        listener.close()


def _load_prefect() -> ModuleType:
    """Import modules that need Prefect, in a thread that leaves signals to the main thread."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *ENDING})
    module = import_module("flows.dataset")
    for name in _IMPORTED_BY_FLOWS:
        import_module(name)
    return module


def _refuse_full_disk(store: Store) -> None:
    """Refuse a disk that is full or read-only."""
    folder = nearest_folder(store.root)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise PlanError(
                f"the store {store.root} cannot be created: {folder} is not writable; name another folder with --store"
            ) from None
    free = free_bytes(store.root)
    if free < MIN_FREE_BYTES:
        raise PlanError(f"the disk of {store.root} has {free / 1e6:.0f} MB left; free some space first")
