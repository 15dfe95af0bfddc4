"""The profile of a run: what was computed where and when, and nothing of what was there."""

from __future__ import annotations

import re
from pathlib import Path

from flows.execution import begin, execute
from flows.outcomes import Run
from flows.planning import make_plan
from flows.profiling import PROFILE_FILE, write_profile
from flows.study import load_study
from storage_schema import Store
from tasks.shards import HerePool
from tests.builders.toy_runs import computed, write_study
from tests.builders.toys import TOYS


def profile_of(run: Run) -> tuple[str, dict[str, int]]:
    """Return the page of a profiled run, and how many shards it computed of each stage."""
    plan = make_plan(run.study, run.graph, run.store)
    outcome = execute(run, begin(run, plan), plan, HerePool(str(run.store)))
    page = (run.store.root / "runs" / outcome.run_id / "report" / PROFILE_FILE).read_text()
    return page, computed(outcome)


def test_a_profile_has_the_shards_that_were_computed_by_stage(tmp_path: Path) -> None:
    path, store = str(write_study(tmp_path)), Store(tmp_path / "store")
    for settings, is_grown in ([], True), (["bend.step=500"], False):
        study, graph = load_study(path, TOYS, settings=settings, environment={})
        page, computed = profile_of(Run(study, graph, store, is_profiled=True))
        rows = re.findall(r"<tr><td>(\w+)</td><td>(\d+)</td><td>[\d.]+ s</td><td>[\d.]+ s</td><td>([\d.]+)%", page)
        assert {stage: int(count) for stage, count, _ in rows} == computed
        assert ("grow" in computed) == is_grown
        assert abs(sum(float(share) for *_, share in rows) - 100.0) < 0.1 * len(rows)
        assert "data:image/svg+xml" in page


def test_the_profile_of_a_run_that_computed_nothing_says_so(tmp_path: Path) -> None:
    page = write_profile(tmp_path, Store(tmp_path / "store"), []).read_text()
    assert "0 shards, without those that were there already" in page
