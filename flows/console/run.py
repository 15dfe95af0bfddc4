"""`run` and `plan`: build a study, or say what a build would do."""

from __future__ import annotations

import errno
import tempfile
import time
from dataclasses import asdict, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flows.console.context import (
    ClusterOption,
    JsonOption,
    OversubscribeOption,
    SchedulerOption,
    SettingOption,
    StoreOption,
    StudyArgument,
    WorkersOption,
    graph_of,
    next_command,
    open_store,
    print_json,
)
from flows.console.display import cost_lines, counted, make_listener, outcome_lines, plan_lines, summary_lines
from flows.costs import estimate_cost, planned_work
from flows.execution import outcome_of_fresh
from flows.machine import GIB, WORKER_MEMORY_GB, cluster_settings, free_bytes, nearest_folder
from flows.outcomes import Outcome, Run
from flows.planning import Plan, PlanError, Selection, make_plan, refuse_nothing
from flows.publishing import Published, publish, refuse_bad_verdicts, refuse_unpublished
from flows.records import uncollected
from flows.study import Study, load_study
from pasdedeux.verdict import Level
from storage_schema import Store, in_use
from tasks.graph import Graph
from tasks.shards import ClusterSettings

app = typer.Typer(rich_markup_mode=None)

MIN_FREE_BYTES = 64 * 1024**2
PREVIEW_S = 4.0
NUMBERS_OF_WORKERS = (1, 2, 10, 100, 1000)
"""That `plan --cost` tells of where nothing is said."""

_RUN = """Build a study: compute what is missing or stale in the store, and nothing else.

\b
Examples:
  pasdedeux run                                  the built-in duets, into ./store
  pasdedeux run my.toml --store /data/store --workers 8
  pasdedeux run my.toml --set chains.num_chains=4 --until chains
  pasdedeux run my.toml --preview                on a few seconds of each take, to look at first
  pasdedeux run my.toml --scheduler tcp://cluster:8786
  pasdedeux run my.toml --cluster deploy/clusters/slurm.toml
"""
_PLAN = """Say what a run would compute and why, stage by stage and partition by partition; starts nothing.

\b
fresh    it is there and nothing it depends on has changed
missing  it was never built, or its files are gone
stale    something it depends on has changed; says what
pending  it depends on a stage that is not there yet; rebuilt only if that stage's bytes change

--cost says what the run would take, from what each shard took when it was last computed.
"""


class FailOn(StrEnum):
    """How bad a verdict may be at most, and one less."""

    WARN = Level.WARN.value
    FAIL = Level.FAIL.value


OnlyOption = Annotated[list[str] | None, typer.Option("--only", metavar="STAGE", help="These stages alone.")]
FromOption = Annotated[str | None, typer.Option("--from", metavar="STAGE", help="This stage and what follows from it.")]
UntilOption = Annotated[str | None, typer.Option("--until", metavar="STAGE", help="This stage and what it needs.")]
ForceOption = Annotated[
    list[str] | None,
    typer.Option("--force", metavar="STAGE", help="Compute this stage again, in place; what a dataset needs stays."),
]


@app.command(help=_RUN)
def run(
    context: typer.Context,
    study: StudyArgument = "duets",
    settings: SettingOption = None,
    store: StoreOption = Path("store"),
    workers: WorkersOption = None,
    oversubscribe: OversubscribeOption = False,
    worker_memory: Annotated[
        float, typer.Option(min=0.25, metavar="GB", help="Memory of one local worker.")
    ] = WORKER_MEMORY_GB,
    scheduler: SchedulerOption = None,
    cluster: ClusterOption = None,
    only: OnlyOption = None,
    start: FromOption = None,
    until: UntilOption = None,
    force: ForceOption = None,
    is_preview: Annotated[
        bool, typer.Option("--preview", help=f"On {PREVIEW_S:g} s of each take and video, kept as <study>-preview.")
    ] = False,
    fail_on: Annotated[
        FailOn | None, typer.Option("--fail-on", help="End with exit code 1 when a verdict is at least so bad.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Build a study."""
    selection = Selection(tuple(only or ()), start, until, tuple(force or ()))
    short = [f"ingest.take_seconds={PREVIEW_S}"] if is_preview else []
    chosen, graph = load_study(study, graph_of(context), settings=[*short, *(settings or ())])
    if is_preview:
        head = chosen.head.model_copy(update={"name": f"{chosen.name}-preview"})
        chosen = chosen.model_copy(update={"head": head, "publish": None})
    where = cluster_settings(workers, worker_memory, scheduler, cluster=cluster, oversubscribe=oversubscribe)
    worst = None if fail_on is None else Level(fail_on.value)
    build_and_report(chosen, graph, open_store(store), selection, where, fail_on=worst, as_json=as_json)
    if is_preview and not as_json:
        typer.echo(f"all of it: {next_command('run', study, *selection.words, store=store, settings=settings)}")


def build_and_report(
    chosen: Study,
    graph: Graph,
    opened: Store,
    selection: Selection,
    cluster: ClusterSettings,
    *,
    as_json: bool,
    fail_on: Level | None = None,
) -> None:
    """Bring a study up to date and say what was done."""
    started = time.perf_counter()
    outcome, made = build(chosen, graph, opened, selection, cluster, is_quiet=as_json)
    seconds = time.perf_counter() - started
    with in_use(opened):
        run = Run(chosen, graph, opened)
        published = publish(run, outcome)
    if as_json:
        said = {} if published is None else {"published": published.to_json()}
        print_json({**outcome.to_json(), "seconds": round(seconds, 3), **said})
        _refuse(outcome, published, run, fail_on)
        return
    for line in (*outcome_lines(outcome), *(f"warning: {w}" for w in made.warnings)):
        typer.echo(line)
    if made.is_fresh:
        typer.echo(f"{'' if outcome.missing else 'everything is fresh, '}nothing to do ({seconds:.1f} s)")
    else:
        memory = f", at most {outcome.peak_memory_bytes / GIB:.2f} GB per process" if outcome.peak_memory_bytes else ""
        typer.echo(f"done: {counted(outcome.num_computed, 'shard')} computed in {seconds:.1f} s{memory}")
    for line in summary_lines(opened, chosen.name, made.manifests if made.is_fresh else ()):
        typer.echo(line)
    if outcome.report is not None:
        typer.echo(f"report: {_shown(outcome.report)}")
    if published is not None and not published.failures:
        typer.echo(published.words)
    _refuse(outcome, published, run, fail_on)


def _refuse(outcome: Outcome, published: Published | None, run: Run, fail_on: Level | None) -> None:
    """Fail where nothing was made of what was asked for, or a verdict is too bad to publish or for who asked."""
    refuse_nothing(outcome.missing)
    refuse_unpublished(published)
    if fail_on is not None:
        refuse_bad_verdicts(run, outcome, fail_on)


def build(
    chosen: Study, graph: Graph, opened: Store, selection: Selection, cluster: ClusterSettings, *, is_quiet: bool
) -> tuple[Outcome, Plan]:
    """Bring a study up to date; gives what was done and the plan.  Nothing is removed from the store meanwhile."""
    with in_use(opened):
        made = make_plan(chosen, graph, opened, selection)
        run = Run(chosen, graph, opened, selection)
        if made.is_fresh:
            return outcome_of_fresh(run, made), made
        _refuse_full_disk(opened)
        opened.prepare()
        with in_use(opened):  # a store that is new was not there to be locked before
            return _build(run, made, cluster, is_quiet=is_quiet), made


@app.command(help=_PLAN)
@uncollected()
def plan(
    context: typer.Context,
    study: StudyArgument = "duets",
    settings: SettingOption = None,
    store: StoreOption = Path("store"),
    only: OnlyOption = None,
    start: FromOption = None,
    until: UntilOption = None,
    force: ForceOption = None,
    is_long: Annotated[bool, typer.Option("--long", help="Show fresh partitions too.")] = False,
    cost: Annotated[bool, typer.Option("--cost", help="Say what the run would take, on how many workers.")] = False,
    workers: Annotated[
        list[int] | None, typer.Option("--workers", min=1, help="With --cost: on so many; may be given again.")
    ] = None,
    measured: Annotated[
        Path | None, typer.Option("--measured", metavar="DIR", help="With --cost: store that has a build of the study.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what a run would compute and why."""
    if not cost and (workers or measured):
        raise PlanError("--workers and --measured are for --cost; give that too")
    selection = Selection(tuple(only or ()), start, until, tuple(force or ()))
    chosen, graph = load_study(study, graph_of(context), settings=settings or ())
    made = make_plan(chosen, graph, open_store(store), selection)
    if cost and not made.is_fresh:
        work = planned_work(made, graph, open_store(store), open_store(measured or store))
        costs = [estimate_cost(work, count) for count in workers or NUMBERS_OF_WORKERS]
        if as_json:
            print_json({"work": work.to_json(), "costs": [asdict(one) for one in costs]})
            return
        for line in cost_lines(work, costs):
            typer.echo(line)
        return
    if as_json:
        print_json({**made.to_json(), "settings": chosen.resolved()})
        return
    for line in plan_lines(made, is_long=is_long):
        typer.echo(line)
    refuse_nothing(made.missing)
    typer.echo(
        "everything is fresh"
        if made.is_fresh
        else f"run it with: {next_command('run', study, *selection.words, store=store, settings=settings)}"
    )


def _build(run: Run, plan: Plan, cluster: ClusterSettings, *, is_quiet: bool) -> Outcome:
    """Run what is not fresh; only here are Prefect and Dask imported."""
    listener = make_listener(is_quiet=is_quiet)
    listener.note("loading Prefect")
    try:
        from flows.dataset import orchestrate

        return orchestrate(replace(run, listener=listener), plan, cluster)
    finally:
        listener.close()


def _refuse_full_disk(store: Store) -> None:
    """Refuse to begin where nothing, or next to nothing, can be written."""
    folder = nearest_folder(store.root)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise PlanError(
                f"the store {store.root} cannot be made: nothing can be written in {folder}; name a folder of your own "
                "with --store"
            ) from None
    free = free_bytes(store.root)
    if free < MIN_FREE_BYTES:
        raise PlanError(f"the disk of {store.root} has {free / 1e6:.0f} MB left; free some space first")


def _shown(path: Path) -> str:
    page = path / "report.html"
    return str(page if page.is_file() else path)
