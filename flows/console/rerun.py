"""`rerun`: builds a recorded run or dataset again elsewhere and compares."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from flows.console import options
from flows.console.context import answer, app, graph_of, open_store
from flows.console.display import outcome_lines
from flows.console.run import build
from flows.dataset_folder.reading import is_folder, read_recorded_folder, rebuild_folder
from flows.differences import compare_builds
from flows.finished_builds import Recorded, artifacts_by_place, environment_changes, read_environment, read_recorded
from flows.machine import cluster_settings
from flows.outcomes import Run
from flows.planning import PlanError, make_plan
from flows.staleness import shorten_text
from flows.study import Study, study_from_record
from pasdedeux.errors import InputError
from storage_schema import Store, in_use
from tasks.graph import Graph
from tasks.shards import ClusterSettings


@app.command()
def rerun(
    context: typer.Context,
    name: Annotated[
        str, Argument(metavar="RUN|NAME@V|FOLDER", help="Id of a run (`pasdedeux status`), a dataset, or its folder.")
    ],
    store: Annotated[Path, Option("--store", metavar="DIR", help="Folder of the store to build in.")],
    source: Annotated[Path, Option("--from", metavar="DIR", help="Store with the record.")] = Path("store"),
    workers: options.Workers = None,
    oversubscribe: options.Oversubscribe = False,
    scheduler: options.Scheduler = None,
    as_json: options.Json = False,
) -> None:
    """Rebuild a finished run or a version of a dataset in another store and compare artifact by artifact.

    \b
      pasdedeux rerun 20260301T020000-salsa-3fa9c0 --store /tmp/again
      pasdedeux rerun salsa@2 --from /data/store --store /tmp/again --json

    The recorded study is used, with all its keys; input files must be unchanged.  On one platform the bytes are
    the same.  If they are not, the output names the first table and column that differ by more than the tolerances of
    the data dictionary (exit code 1), and the differences of program, packages and processor.

    The folder of a dataset (`dataset write`) is built and written again, and compared file by file.
    """
    cluster = cluster_settings(workers, scheduler=scheduler, oversubscribe=oversubscribe)
    if is_folder(name):
        _rerun_folder(context, Path(name), open_store(store), cluster, as_json=as_json)
        return
    origin, target = open_store(source), open_store(store)
    if origin.root.resolve() == target.root.resolve():
        raise PlanError(f"{store} is the store that has {name}; --store names another one, to build in")
    with in_use(origin):
        old = read_recorded(origin, name)
        study, graph = study_from_record(old.sections, old.stages, graph_of(context))
        _refuse_changed_files(old, study, graph, origin)
        outcome, work = build(Run(study, graph, target), cluster, is_quiet=as_json)
        named = [ref for stage in outcome.stages if stage.name in old.named for ref in stage.artifacts]
        new = artifacts_by_place(target, named)
        comparison = compare_builds(origin, old.artifacts, target, new)
    changes = environment_changes(old.environment, read_environment(target, outcome.run_id))
    changes |= {
        f"version of stage {place[0]}": (str(was.version), str(new[place].version))
        for place, was in old.artifacts.items()
        if place in new and was.version != new[place].version
    }
    stale = f"{store} had results of other sources, which were compared; --store names an empty folder"
    warnings = [stale] if work.warnings else []
    lines = [*outcome_lines(outcome), *comparison.lines(), *(f"warning: {words}" for words in warnings)]
    lines += _change_lines(changes)
    described = {"name": old.label, "run_id": outcome.run_id, **comparison.to_json()}
    answer({**described, "changes": changes, "warnings": warnings}, lines, as_json=as_json)
    if not comparison.is_same:
        raise typer.Exit(1)


def _rerun_folder(
    context: typer.Context, folder: Path, target: Store, cluster: ClusterSettings, *, as_json: bool
) -> None:
    """Build a dataset's folder again from its record; the store has the dataset afterwards."""
    old = read_recorded_folder(folder)
    study, graph = study_from_record(old.sections, old.stages, graph_of(context))
    _refuse_changed_files(old, study, graph, target)
    outcome, _ = build(Run(study, graph, target), cluster, is_quiet=as_json)
    named = tuple(ref for stage in outcome.stages if stage.name in old.named for ref in stage.artifacts)
    with in_use(target):
        differing = rebuild_folder(folder, target, named)
    changes = environment_changes(old.environment, read_environment(target, outcome.run_id))
    words = f"same bytes: all files of {folder}" if not differing else f"other bytes: {', '.join(differing)}"
    lines = [*outcome_lines(outcome), words, *_change_lines(changes)]
    described = {"name": old.label, "run_id": outcome.run_id, "differing": differing, "changes": changes}
    answer(described, lines, as_json=as_json)
    if differing:
        raise typer.Exit(1)


def _change_lines(changes: Mapping[str, tuple[str, str]]) -> list[str]:
    """Return what changed since the record, a line each."""
    return [
        f"{what}: {shorten_text(was) or 'not on record'} -> {shorten_text(now) or 'none'}"
        for what, (was, now) in changes.items()
    ]


def _refuse_changed_files(old: Recorded, study: Study, graph: Graph, store: Store) -> None:
    """Refuse source files of the old study that have changed since the record was written.

    Raises:
        PlanError: One has changed, or the study cannot be planned here.
    """
    try:
        plan = make_plan(study, graph, store)
    except InputError as error:
        raise PlanError(f"{old.label} cannot be built again in this folder: {error}") from None
    for shard in (item.shard for stage in plan.stages for item in stage.shards):
        before = old.artifacts.get((shard.stage, shard.partition, shard.name))
        for file in shard.files:
            if before is not None and (Path(file.path).name, file.sha256) not in before.files:
                raise PlanError(
                    f"{file.path} is not what {old.label} read ({shard.stage} {shard.partition}): its sha256 is "
                    f"{file.sha256[:12]}; put the old file there, or run the study itself for the new one"
                )
