"""One run of a study, from its record to its report; a pool that is passed in computes the shards."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress

from flows.building import Build, StartTask
from flows.machine import why_few
from flows.outcomes import Outcome, Run, StageOutcome
from flows.planning import Plan
from flows.records import begin_record, copy_report, end_record, is_on_record, read_last_run, report_folder, shown_page
from flows.signals import remembered_ctrl_c
from pasdedeux.plain_text import counted
from storage_schema import RunFolder, StorageError, new_run
from tasks.shards import ClusterPool, ClusterSettings, HerePool, Pool, connect, worker_environment


def execute(run: Run, folder: RunFolder, plan: Plan, pool: Pool, start_task: StartTask | None = None) -> Outcome:
    """Bring every selected stage of the study up to date; the record of the last run is updated stage by stage.

    A shard of any stage starts when its inputs exist. A stage is recorded when it is complete, in the order of the plan
    made from all its inputs, so that the order of completion has no effect.

    Args:
        run: The run to execute.
        folder: Folder of the run's record, from `begin`.
        plan: The plan made beforehand.
        pool: Computes shards.
        start_task: Starts the task of a stage, which shows its progress.

    Raises:
        ShardError, InputError: Shards or stages failed; those that do not need them are up to date.
        ClusterError: No worker is left.
    """
    status, peak = "failed", None
    build = Build(run, folder.run_id, plan, pool, start_task)
    try:
        with remembered_ctrl_c(is_passed_on=True) as is_interrupted:
            build.bring_up_to_date(is_interrupted)
        status, peak = "finished", pool.peak_memory_bytes() if any(o.num_computed for o in build.outcomes) else None
    except KeyboardInterrupt:
        status = "interrupted"
        raise
    finally:
        build.end()
        # On a full disk the record fails as well: the first error is the one to report.
        with nullcontext() if status == "finished" else suppress(StorageError):
            run.store.clear_leftovers()
            end_record(folder, run.study.name, status, [outcome.to_json() for outcome in build.outcomes], peak)
    reporting = [outcome for outcome in build.outcomes if outcome.name in run.graph.reporting]
    report = copy_report(run.store, folder, [ref for stage in reporting for ref in stage.artifacts])
    if run.is_profiled:
        from flows.profiling import write_profile  # here, because it imports matplotlib

        run.listener.note(f"profile: {write_profile(folder.path / 'report', run.store, build.done)}")
    return Outcome(folder.run_id, build.outcomes, report, peak, shown_page(run.store, run.study.name, report))


@contextmanager
def open_pool(run: Run, settings: ClusterSettings) -> Iterator[Pool]:
    """Start, or connect to, the pool that computes shards in this block."""
    root = str(run.store)
    run.store.root.mkdir(parents=True, exist_ok=True)
    if not settings.is_shared and settings.num_workers == 0:
        os.environ.update(worker_environment())
        yield HerePool(root)
        return
    if settings.profile is not None:
        run.listener.note(f"starting {settings.profile.cluster}, waiting for its first worker")
    elif settings.scheduler is None:
        workers = counted(settings.num_workers, "local worker")
        run.listener.note(f"starting {workers}{why_few(settings)}")
    else:
        run.listener.note(f"connecting to the Dask scheduler at {settings.scheduler}")
    with connect(settings, store_root=root) as client:
        yield ClusterPool(client, root, is_shared=settings.is_shared, note=run.listener.note)


def begin(run: Run, plan: Plan) -> RunFolder:
    """Make the folder of a new run and record the plan."""
    folder = new_run(run.store, run.study.name)
    begin_record(folder, run.study.name, run.study.resolved(), plan.to_json())
    return folder


def outcome_of_fresh(run: Run, plan: Plan) -> Outcome:
    """Return the outcome of a fresh study; a run is recorded only if its state is not on record yet."""
    last = read_last_run(run.store, run.study.name)
    is_known = last is not None and all(
        is_on_record(last, stage.stage.name, stage.manifests) for stage in plan.stages if stage.is_selected
    )
    has_report = any(stage.stage.name in run.graph.reporting and stage.is_selected for stage in plan.stages)
    report = report_folder(run.store, last.run_id) if last is not None else None
    if last is None or not is_known or (has_report and report is None):
        return execute(run, begin(run, plan), plan, HerePool(str(run.store)))
    outcomes = tuple(StageOutcome.of(stage, stage.manifests, 0.0) for stage in plan.stages if stage.is_selected)
    return Outcome(last.run_id, outcomes, report, page=shown_page(run.store, run.study.name, report))
