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
from flows.console.display import outcome_lines
from flows.console.run import build
from flows.differences import compare
from flows.machine import cluster_settings
from flows.planning import Plan, PlanError, Selection, make_plan
from flows.reasons import shorten
from flows.recorded import Recorded, artifacts_by_place, environment_changes, read_environment, read_recorded
from flows.study import study_from_record
from pasdedeux.errors import InputError
from storage_schema import in_use

app = typer.Typer(rich_markup_mode=None)

_RERUN = """Build a finished run, or a version of a dataset, once more elsewhere, and compare artifact by artifact.

\b
  pasdedeux rerun 20260301T020000-salsa-3fa9c0 --store /tmp/again
  pasdedeux rerun salsa@2 --from /data/store --store /tmp/again --json

The study is the one on record, with every key as it was; files from outside have to be what they were.  On one platform
the bytes are the same.  Where they are not, the first table and column that differ by more than the tolerances of the
data dictionary are named, with how much (exit code 1), and what of program, packages and processor is different now.
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
        _refuse_changed_files(old, plan)
        outcome, made = build(study, graph, target, Selection(), cluster, is_quiet=as_json)
        named = [ref for stage in outcome.stages if stage.name in old.named for ref in stage.artifacts]
        new = artifacts_by_place(target, named)
        found = compare(origin, old.artifacts, target, new)
    changes = environment_changes(old.environment, read_environment(target, outcome.run_id))
    changes |= {
        f"version of stage {place[0]}": (str(was.version), str(new[place].version))
        for place, was in old.artifacts.items()
        if place in new and was.version != new[place].version
    }
    stale = f"{store} had results of other sources, which were compared; --store names an empty folder"
    warnings = [stale] if made.warnings else []
    if as_json:
        answer = {"name": old.label, "run_id": outcome.run_id, **found.to_json()}
        print_json({**answer, "changes": changes, "warnings": warnings})
    else:
        for line in (*outcome_lines(outcome), *found.lines(), *(f"warning: {words}" for words in warnings)):
            typer.echo(line)
        for what, (was, now) in changes.items():
            typer.echo(f"{what}: {shorten(was) or 'not on record'} -> {shorten(now) or 'none'}")
    if not found.is_same:
        raise typer.Exit(1)


def _refuse_changed_files(old: Recorded, plan: Plan) -> None:
    """Refuse files from outside that are not what they were; `plan` is of the old study in the store that has it."""
    for shard in (item.shard for stage in plan.stages for item in stage.shards):
        before = old.artifacts.get((shard.stage, shard.partition, shard.name))
        for file in shard.files:
            if before is not None and (Path(file.path).name, file.sha256) not in before.files:
                raise PlanError(
                    f"{file.path} is not what {old.label} read ({shard.stage} {shard.partition}): its sha256 is "
                    f"{file.sha256[:12]}; put the old file there, or run the study itself for the new one"
                )
