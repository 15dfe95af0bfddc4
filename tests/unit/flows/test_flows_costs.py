"""What a build would cost and what it took: bounds that any order of work keeps, plans, and the profile of a run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.console.display import cost_lines, duration_text, size_text
from flows.costs import DISPATCH_S, OVERHEAD_S, Cost, Job, Work, estimate_cost, planned_work
from flows.execution import begin, execute
from flows.outcomes import Run
from flows.planning import PlanError, make_plan
from flows.profiling import PROFILE_FILE, write_profile
from flows.study import load_study
from storage_schema import Store
from tasks.shards import HerePool
from tests.builders.command_line import CommandLine
from tests.builders.toy_runs import computed, plan_toys, write_study
from tests.builders.toys import TOYS

EACH_S = DISPATCH_S + OVERHEAD_S


@st.composite
def works(draw: st.DrawFn) -> Work:
    """Draw shards that take up to a minute, each after some of those before it."""
    after = [
        draw(st.sets(st.integers(0, index - 1), max_size=2)) if index else set()
        for index in range(draw(st.integers(1, 12)))
    ]
    return Work([Job(draw(st.floats(0.1, 60.0)), tuple(sorted(before))) for before in after])


def critical_s(work: Work) -> float:
    """Return how long the longest chain of shards takes that come one after the other."""
    ends: list[float] = []
    for job in work.jobs:
        ends.append(job.seconds + EACH_S + max((ends[before] for before in job.after), default=0.0))
    return max(ends)


ONE_AFTER_THE_OTHER = [Job(2.0), Job(2.0), Job(2.0), Job(after=(0, 1, 2), is_shard=False)]
LONG_AND_SHORT = [Job(1.0), Job(3.0), Job(3.0, after=(1,)), Job(5.0)]


@pytest.mark.parametrize(
    ("jobs", "num_workers", "wall_s"),
    [
        (ONE_AFTER_THE_OTHER, 1, 6.0 + 3 * EACH_S),
        (ONE_AFTER_THE_OTHER, 3, 2.0 + 3 * DISPATCH_S + OVERHEAD_S),  # handed out one at a time
        ([Job(1.0)] * 4, 2, 2.0 + 3 * DISPATCH_S + 2 * OVERHEAD_S),
        (LONG_AND_SHORT, 2, 6.0 + 3 * DISPATCH_S + 2 * OVERHEAD_S),  # 3 s and 3 s, beside 5 s and 1 s
        (LONG_AND_SHORT, 1, 12.0 + 4 * EACH_S),
    ],
)
def test_the_clock_of_small_works_is_known(jobs: list[Job], num_workers: int, wall_s: float) -> None:
    cost = estimate_cost(Work(jobs), num_workers)
    assert cost.wall_s == pytest.approx(wall_s)
    assert cost.core_hours == pytest.approx(num_workers * wall_s / 3600)
    assert cost.busy_share == pytest.approx(sum(job.seconds for job in jobs) / (num_workers * wall_s))


@given(work=works(), num_workers=st.integers(1, 8))
def test_the_clock_keeps_the_bounds_of_any_work_that_lets_no_worker_idle(work: Work, num_workers: int) -> None:
    total = sum(job.seconds for job in work.jobs)
    cost = estimate_cost(work, num_workers)
    overhead = EACH_S * len(work.jobs)
    assert cost.wall_s >= max(critical_s(work) - overhead, total / num_workers) - 1e-9
    # Graham (1969): no order that lets no worker idle takes longer.
    assert cost.wall_s <= (total + overhead) / num_workers + critical_s(work) + overhead
    assert cost.busy_share == pytest.approx(total / (num_workers * cost.wall_s))
    if num_workers == 1:
        assert total < cost.wall_s <= total + overhead + 1e-9


def test_what_was_built_once_tells_what_it_takes_from_nothing(toy_store: Store, tmp_path: Path) -> None:
    new = Store(tmp_path / "new")
    plan = plan_toys(write_study(tmp_path), new.root)
    with pytest.raises(PlanError, match="what aside, grow, bend, judge takes was not measured"):
        planned_work(plan, TOYS, new)
    work = planned_work(plan, TOYS, new, toy_store)
    assert work.num_shards == work.num_measured == 14
    assert not work.unknown
    assert work.num_bytes == sum(manifest.num_bytes for manifest in toy_store.artifacts())
    took = [manifest.timings for manifest in toy_store.artifacts()]
    assert sum(job.seconds for job in work.jobs) == pytest.approx(sum(each["shard_s"] for each in took), rel=1e-6)
    assert work.processor_s == pytest.approx(sum(each["processor_s"] for each in took), rel=1e-6)
    long = Work([job._replace(seconds=float(job.is_shard)) for job in work.jobs])
    assert estimate_cost(long, 1).wall_s == pytest.approx(14, abs=0.2)
    # Three segments one after the other, what is made of the last, and the sum of all.
    assert estimate_cost(long, 100).wall_s == pytest.approx(5, abs=0.2)


def test_a_new_shard_takes_what_others_of_its_stage_took(toy_store: Store, tmp_path: Path) -> None:
    plan = plan_toys(write_study(tmp_path), toy_store.root, "grow.num_segments=4")
    more = planned_work(plan, TOYS, toy_store)
    assert more.num_shards == 2 + 6 + 1, "of stages that cannot be planned yet as many as last time"
    assert more.num_measured == 7


def test_options_of_costs_are_refused_without(toy_store: Store, tmp_path: Path, invoke_toys: CommandLine) -> None:
    plan = invoke_toys.of("plan", write_study(tmp_path)).at(tmp_path / "new")
    assert "--measured are for --cost; give that too" in plan.refusal("--workers", "9")
    assert "14 shards" in plan("--measured", toy_store, "--cost", "--workers", "2").out


def test_a_cost_is_a_table_and_says_what_it_rests_on() -> None:
    costs = [Cost(2, 7200.0, 3.5, 0.87), Cost(8, 3599.0, 4.0, 0.5)]
    work = Work(worker_bytes=3 * 1024**3, num_shards=9, processor_s=150.0, num_bytes=12.34e6, num_measured=7)
    work.unknown += ["chains", "lifting"]
    heading, *rows, said, guessed, unknown = cost_lines(work, costs)
    assert heading.split() == ["workers", "wall", "time", "core", "hours", "at", "work", "memory"]
    cells = [" ".join(row.split()) for row in rows if "%" in row]
    assert cells == ["2 2.0 h 3.5 87 % 6 GB", "8 59 min 59 s 4 50 % 24 GB"]
    assert said == "9 shards, 2 min 30 s of one core, 12.3 MB, at most 3.0 GB per process"
    assert guessed == "7 of them were measured; the others are assumed to take as long"
    assert unknown == "not counted, because never measured: chains, lifting"
    *_, last = cost_lines(Work(num_shards=1, num_measured=1, processor_s=99.4), costs[:1])
    assert last == "1 shard, 99 s of one core, 0.0 MB"
    assert [duration_text(seconds) for seconds in (99.9, 100.0, 7199.0)] == ["100 s", "1 min 40 s", "119 min 59 s"]
    assert size_text(49_999.0) == "0.0 MB"


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
