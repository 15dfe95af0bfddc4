"""`plan`: lists the steps of a build with their reasons, and estimates its duration."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from flows.console import options
from flows.console.context import answer, app, echo, graph_of, next_command, open_store
from flows.console.display import cost_lines, plan_lines
from flows.console.run import with_page
from flows.costs import estimate_cost, planned_work
from flows.planning import PlanError, StageSelection, make_plan, refuse_nothing
from flows.study import load_study
from pasdedeux.garbage import uncollected

NUMBERS_OF_WORKERS = (1, 2, 10, 100, 1000)
"""Defaults of `plan --cost`."""


@app.command()
@uncollected()
def plan(
    context: typer.Context,
    study: options.Study = "duets",
    settings: options.Settings = None,
    store: options.Store = Path("store"),
    only: options.Only = None,
    start: options.From = None,
    until: options.Until = None,
    force: options.Force = None,
    cost: Annotated[bool, Option("--cost", help="Estimate the duration, by number of workers.")] = False,
    workers: Annotated[list[int] | None, Option("--workers", min=1, help="With --cost: number of workers.")] = None,
    measured: Annotated[
        Path | None, Option("--measured", metavar="DIR", help="With --cost: store with measured times.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """List what a run would compute and why, by stage and partition; nothing is started.

    \b
    fresh    it exists, and nothing it depends on has changed
    missing  it was never built, or its files were removed
    stale    something it depends on has changed (what is named)
    pending  it depends on a stage that is not built yet; rebuilt only if the
             bytes of that stage change

    --cost estimates time, memory and disk space from the last run of each shard.
    """
    if not cost and (workers or measured):
        raise PlanError("--workers and --measured are for --cost; give that too")
    selection = StageSelection(tuple(only or ()), start, until, tuple(force or ()))
    chosen, graph = load_study(study, graph_of(context), settings=settings or ())
    graph = with_page(chosen, graph, open_store(store), selection)
    planned = make_plan(chosen, graph, open_store(store), selection)
    if cost and not planned.is_fresh:
        work = planned_work(planned, graph, open_store(store), open_store(measured or store))
        costs = [estimate_cost(work, count) for count in workers or NUMBERS_OF_WORKERS]
        described = {"work": work.to_json(), "costs": [asdict(estimate) for estimate in costs]}
        answer(described, cost_lines(work, costs), as_json=as_json)
        return
    answer({**planned.to_json(), "settings": chosen.resolved()}, plan_lines(planned), as_json=as_json)
    if as_json:
        return
    refuse_nothing(planned.missing)
    echo(
        "everything is fresh"
        if planned.is_fresh
        else f"run it with: {next_command('run', study, *selection.words, store=store, settings=settings)}"
    )
