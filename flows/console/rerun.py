"""`rerun`: builds a recorded run or dataset once more, elsewhere, and compares."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.console.context import (
    JsonOption,
    OversubscribeOption,
    SchedulerOption,
    WorkersOption,
    graph_of,
    open_store,
    print_json,
)
from flows.console.display import counted, outcome_lines
from flows.console.run import build
from flows.machine import cluster_settings
from flows.planning import PlanError, Selection, make_plan
from flows.recorded import artifacts_by_place, read_environment, read_recorded
from flows.records import environment
from flows.rerunning import compare, environment_lines, refuse_changed_inputs, why_it_differs
from flows.study import study_from_record
from pasdedeux.errors import InputError
from storage_schema import in_use

__all__ = ["app"]

app = typer.Typer(rich_markup_mode=None)

_RERUN = """Build a finished run, or a version of a dataset, once more elsewhere, and compare artifact by artifact.

\b
  pasdedeux rerun 20260301T020000-salsa-3fa9c0 --store /tmp/again
  pasdedeux rerun salsa@2 --from /data/store --store /tmp/again --json

The study is the one on record, with every key as it was.  Before anything is computed it is said what of program,
packages, processor and settings is different now, and files from outside are compared with their digests.  On one
platform the bytes are the same.  Where they are not, the first table and column that differ are named, how much, and
what may be why: within the tolerances of the data dictionary that is rounding, beyond them the exit code is 1.
"""


@app.command(help=_RERUN)
def rerun(
    context: typer.Context,
    name: Annotated[str, typer.Argument(metavar="RUN|NAME@V", help="Id of a run (`pasdedeux status`), or a dataset.")],
    store: Annotated[Path, typer.Option("--store", metavar="DIR", help="Folder of the store to build in.")],
    source: Annotated[Path, typer.Option("--from", metavar="DIR", help="Store that has it on record.")] = Path("store"),
    workers: WorkersOption = None,
    oversubscribe: OversubscribeOption = False,
    scheduler: SchedulerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Build what is on record once more, and compare."""
    cluster = cluster_settings(workers, scheduler=scheduler, oversubscribe=oversubscribe)
    origin, target = open_store(source), open_store(store)
    if origin.root.resolve() == target.root.resolve():
        raise PlanError(f"{store} is the store that has {name}; --store names another one, to build in")
    with in_use(origin):
        old = read_recorded(origin, name)
        study, graph = study_from_record(old.sections, old.stages, graph_of(context))
        try:
            plan = make_plan(study, graph, origin)
        except InputError as error:
            raise PlanError(f"{old.label} cannot be built again in this folder: {error}") from None
        refuse_changed_inputs(old, plan)
        if not as_json:
            pending = [stage.stage.name for stage in plan.stages if stage.is_pending]
            late = sum(name.split()[0] in pending for name in old.sources)
            words = f"{counted(len(old.sources) - late, 'file')} from outside, as they were"
            words += f"; {counted(late, 'file')} of stages that are planned later" if late else ""
            typer.echo(f"{old.label}: {counted(len(old.artifacts), 'artifact')}; {words}")
            for line in environment_lines(old.environment, environment()) or ["as it was"]:
                typer.echo(f"environment: {line}")
        outcome, made = build(study, graph, target, Selection(), cluster, is_quiet=as_json)
        named = [ref for stage in outcome.stages if stage.name in old.named for ref in stage.artifacts]
        new = artifacts_by_place(target, named)
        found = compare(origin, old.artifacts, target, new)
        reasons = why_it_differs(old, new, read_environment(target, outcome.run_id)) if found.differs else []
    stale = [f"{store} had results of other sources, which were compared; --store names an empty folder"] * bool(
        made.warnings
    )
    if as_json:
        print_json(
            {"name": old.label, "run_id": outcome.run_id, **found.to_json(), "reasons": reasons, "warnings": stale}
        )
    else:
        lines = (*(f"warning: {words}" for words in stale), *(f"why it may be: {reason}" for reason in reasons))
        for line in (*outcome_lines(outcome), *found.lines(), *lines):
            typer.echo(line)
    if not found.is_same:
        raise typer.Exit(1)
