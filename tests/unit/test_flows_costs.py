"""What a build would cost: bounds that any order of work keeps, and what a plan has to compute."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.console.app import run_command_line
from flows.costs import DISPATCH_S, OVERHEAD_S, Faults, Work, estimate_cost, planned_work, scaled_to_takes
from flows.planning import PlanError
from storage_schema import Store
from tasks.stage import Parameters, Shard
from tests.builders.toy_runs import plan_toys, run_toys, write_study
from tests.builders.toys import TOYS

EACH_S = DISPATCH_S + OVERHEAD_S


@st.composite
def works(draw: st.DrawFn) -> Work:
    """Draw shards that take up to a minute, each after some of those before it."""
    shards: list[Shard] = []
    seconds: dict[str, float] = {}
    for index in range(draw(st.integers(1, 12))):
        before = {shards[at].key for at in draw(st.sets(st.integers(0, index - 1), max_size=2))} if index else set()
        shard = Shard("grow", 0, "t", str(index), Parameters(), after=tuple(sorted(before)))
        shards.append(shard)
        seconds[shard.key] = draw(st.floats(0.1, 60.0))
    return Work(tuple(shards), seconds, seconds, seconds, None, len(shards), ())


def critical_s(work: Work) -> float:
    """Return how long the longest chain of shards takes that come one after the other."""
    ends: dict[str, float] = {}
    for shard in work.shards:
        ends[shard.key] = work.seconds[shard.key] + EACH_S + max((ends[key] for key in shard.after), default=0.0)
    return max(ends.values())


@given(work=works(), num_workers=st.integers(1, 8))
def test_the_clock_keeps_the_bounds_of_any_work_that_lets_no_worker_idle(work: Work, num_workers: int) -> None:
    total = sum(work.seconds.values())
    cost = estimate_cost(work, TOYS, num_workers)
    overhead = EACH_S * len(work.shards)
    assert cost.wall_s >= max(critical_s(work) - overhead, total / num_workers) - 1e-9
    # Graham (1969): no order that lets no worker idle takes longer.
    assert cost.wall_s <= (total + overhead) / num_workers + critical_s(work) + overhead
    assert cost.busy_share == pytest.approx(total / (num_workers * cost.wall_s))
    if num_workers == 1:
        assert total < cost.wall_s <= total + overhead + 1e-9


@given(work=works())
def test_slow_shards_and_lost_workers_never_help_one_worker(work: Work) -> None:
    plain = estimate_cost(work, TOYS, 1).wall_s
    assert estimate_cost(work, TOYS, 1, Faults(slow_share=1.0, slow_factor=5.0)).wall_s > 4 * plain * 0.9
    assert estimate_cost(work, TOYS, 1, Faults(losses_per_hour=60.0)).wall_s >= plain


def test_what_was_built_once_tells_what_it_takes_from_nothing(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    built, new = tmp_path / "store", tmp_path / "new"
    run_toys(study, built)
    plan = plan_toys(study, new)
    with pytest.raises(PlanError, match="what aside, grow, bend, judge takes was not measured"):
        planned_work(plan, TOYS, Store(new))
    work = planned_work(plan, TOYS, Store(new), Store(built))
    assert work.num_shards == work.num_measured == 14
    assert work.unknown == ()
    assert work.num_bytes == sum(one.num_bytes for one in Store(built).artifacts())
    assert sum(work.seconds.values()) == pytest.approx(
        sum(one.timings["shard_s"] for one in Store(built).artifacts()), rel=1e-6
    )
    long = replace(work, seconds={shard.key: float(shard.stage in TOYS.names) for shard in work.shards})
    assert estimate_cost(long, TOYS, 1).wall_s == pytest.approx(14, abs=0.2)
    # Three segments one after the other, what is made of the last, and the sum of all.
    assert estimate_cost(long, TOYS, 100).wall_s == pytest.approx(5, abs=0.2)


def test_a_new_shard_takes_what_others_of_its_stage_took(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    run_toys(study, tmp_path / "store")
    more = planned_work(plan_toys(study, tmp_path / "store", "grow.num_segments=4"), TOYS, Store(tmp_path / "store"))
    assert more.num_shards == 2 + 6 + 1, "of stages that cannot be planned yet as many as last time"
    assert more.num_measured == 7


def test_many_takes_are_like_those_that_were_measured(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    run_toys(study, tmp_path / "store")
    plan = plan_toys(study, tmp_path / "new")
    work = scaled_to_takes(planned_work(plan, TOYS, Store(tmp_path / "new"), Store(tmp_path / "store")), TOYS, 50)
    counts = {name: sum(shard.stage == name for shard in work.shards) for name in TOYS.names}
    assert counts["grow"] == counts["bend"] == 150
    assert counts["judge"] == 0
    assert "judge" in work.unknown
    assert work.num_measured == work.num_shards
    long = replace(work, seconds=dict.fromkeys(work.seconds, 10.0))
    assert estimate_cost(long, TOYS, 100).wall_s == pytest.approx(40, rel=0.1)
    assert estimate_cost(long, TOYS, 10).wall_s == pytest.approx(300, rel=0.1)


def test_what_only_a_cost_knows_is_refused_without_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, store = str(write_study(tmp_path)), str(tmp_path / "store")
    assert run_command_line(["plan", study, "--store", store, "--takes", "9"], graph=TOYS) == 2
    assert "--losses are for --cost; give that too" in capsys.readouterr().err
    run_toys(Path(study), Path(store))
    command = ["plan", study, "--store", str(tmp_path / "new"), "--measured", store, "--cost", "--workers", "2"]
    assert run_command_line(command, graph=TOYS) == 0
    assert "14 shards" in capsys.readouterr().out
