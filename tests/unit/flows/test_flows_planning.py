"""The rerun rule: fresh, missing, stale with the reason in words, pending; and what a run then computes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flows.planning import PlanError, StageSelection
from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Store, create_dataset, read_latest, source_credits, verify
from tasks.graph import Graph
from tasks.shards import ShardError
from tasks.stage import Shard
from tests.builders.toy_runs import computed, digests, plan_toys, run_toys, states, write_study
from tests.builders.toys import TOYS, SegmentParameters, run_grow, toys_with

FRESH = {"aside": "1 fresh", "grow": "6 fresh", "bend": "6 fresh", "judge": "1 fresh"}


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return write_study(tmp_path)


@pytest.fixture
def store(toy_store: Store) -> Path:
    """Return the folder of a store in which the study is built."""
    return toy_store.root


@pytest.fixture
def new(tmp_path: Path) -> Path:
    """Return the folder of a store that is not there yet."""
    return tmp_path / "new"


def reasons(plan: object, stage: str) -> set[str]:
    return {item.reason for item in plan.stage(stage).shards if item.reason}  # type: ignore[attr-defined]


def test_before_the_first_run_everything_is_missing_or_pending(study: Path, new: Path) -> None:
    plan = plan_toys(study, new)
    assert states(plan) == {"aside": "1 missing", "grow": "6 missing", "bend": "pending", "judge": "pending"}
    assert reasons(plan, "grow") == {"never built"}
    assert plan.stage("bend").pending_reason == "depends on grow; never built"
    assert not new.exists()


def test_after_a_run_everything_is_fresh_and_a_second_run_computes_nothing(study: Path, new: Path) -> None:
    assert run_toys(study, new).num_computed == 14
    assert states(plan_toys(study, new)) == FRESH
    assert run_toys(study, new).num_computed == 0


def test_one_parameter_makes_stale_what_reads_it_and_says_which(study: Path, store: Path) -> None:
    plan = plan_toys(study, store, "bend.step=2")
    assert states(plan) == {"aside": "1 fresh", "grow": "6 fresh", "bend": "6 stale", "judge": "pending"}
    assert reasons(plan, "bend") == {"bend.step 1000 -> 2"}
    assert run_toys(study, store, "bend.step=2").num_computed == 7


def test_a_rebuilt_input_with_the_same_bytes_stops_the_rebuild(study: Path, store: Path) -> None:
    assert computed(run_toys(study, store, "grow.scale=1.5")) == {"grow": 6, "bend": 6}


def test_more_takes_leave_the_old_ones_fresh(study: Path, store: Path) -> None:
    plan = plan_toys(study, store, "grow.num_takes=3")
    assert states(plan)["grow"] == "6 fresh, 3 missing"
    assert reasons(plan, "grow") == {"new: grow.num_takes 2 -> 3"}


def test_a_changed_seed_a_raised_version_and_a_changed_file_are_named(study: Path, new: Path, tmp_path: Path) -> None:
    def second_version(*given: Any) -> list[Shard]:
        return [replace(shard, version=2) for shard in TOYS.stage("aside").plan(*given)]

    source = tmp_path / "source.bin"
    source.write_bytes(b"one")
    setting = f"grow.source={source}"
    run_toys(study, new, setting)
    source.write_bytes(b"two")
    assert reasons(plan_toys(study, new, setting), "grow") == {"file source.bin changed"}
    source.write_bytes(b"one")
    assert "study.seed 7 -> 8" in reasons(plan_toys(study, new, setting, "study.seed=8"), "grow")
    plan = plan_toys(study, new, setting, graph=toys_with("aside", version=2, plan=second_version))
    assert reasons(plan, "aside") == {"stage version 1 -> 2"}
    moved = source.rename(tmp_path / "moved.bin")
    assert states(plan_toys(study, new, f"grow.source={moved}")) == FRESH, "where a file lies does not matter"


def test_a_changed_take_is_named(study: Path, new: Path) -> None:
    run_toys(study, new, "bend.step=1")
    run_toys(study, new, "bend.step=1", "grow.scale=3.0", selection=StageSelection(until="grow"))
    plan = plan_toys(study, new, "bend.step=1", "grow.scale=3.0")
    assert states(plan)["bend"] == "6 stale"
    assert {"take t0 changed", "take t1 changed"} <= reasons(plan, "bend")


def test_lost_files_are_missing_and_only_they_are_rebuilt(study: Path, store: Path) -> None:
    before = digests(store)
    latest = read_latest(Store(store), "toy")
    Store(store).discard(latest.refs("bend")[2])
    plan = plan_toys(study, store)
    assert states(plan)["bend"] == "5 fresh, 1 missing"
    assert reasons(plan, "bend") == {"its files are missing or incomplete"}
    assert run_toys(study, store).num_computed == 1
    assert digests(store) == before


def test_results_of_lost_inputs_are_computed_again_even_if_equal_ones_are_there(study: Path, store: Path) -> None:
    """Licences are known through what something was computed from, and that has to be there."""
    olds = list(Store(store).artifacts("grow"))
    run_toys(study, store, "grow.licence=CC-BY-4.0")
    for old in olds:
        Store(store).discard(old.ref)
    plan = plan_toys(study, store, "grow.licence=CC-BY-4.0")
    assert states(plan) == {**FRESH, "bend": "6 stale", "judge": "pending"}
    assert reasons(plan, "bend") == {"what it was computed from is gone"}
    before = digests(store)
    run_toys(study, store, "grow.licence=CC-BY-4.0")
    last = read_latest(Store(store), "toy")
    assert {credit.licence for credit in source_credits(Store(store), *last.refs("judge"))} == {"CC-BY-4.0"}
    assert digests(store) == before
    assert plan_toys(study, store, "grow.licence=CC-BY-4.0").is_fresh


def test_forced_stages_are_computed_again_and_end_in_the_same_bytes(study: Path, store: Path) -> None:
    before, forced = digests(store), StageSelection(force=("bend",))
    plan = plan_toys(study, store, selection=forced)
    assert (states(plan)["bend"], states(plan)["judge"]) == ("6 stale", "pending")
    assert computed(run_toys(study, store, selection=forced)) == {"bend": 6}
    assert digests(store) == before


def test_until_from_and_only_choose_stages(study: Path, new: Path) -> None:
    for selection, names in (
        (StageSelection(until="grow"), ["grow"]),
        (StageSelection(until="bend"), ["grow", "bend", "judge"]),  # the page is made of what is there
        (StageSelection(start="bend"), ["bend", "judge"]),
        (StageSelection(only=("aside",)), ["aside"]),
    ):
        outcome = run_toys(study, new, selection=selection)
        assert [stage.name for stage in outcome.stages] == names
        assert (outcome.report is None) == ("judge" not in names)


def test_changed_sources_are_a_warning(study: Path, store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert plan_toys(study, store).warnings == ()
    monkeypatch.setattr("flows.planning.source_digest", lambda: "other")
    plan = plan_toys(study, store)
    assert plan.is_fresh
    assert len(plan.warnings) == 1
    assert "since aside and 3 more stages were computed" in plan.warnings[0]
    assert "--force STAGE computes again in place, and leaves what a dataset needs as it is" in plan.warnings[0]


def test_a_damaged_record_of_the_last_run_costs_words_only(study: Path, store: Path) -> None:
    (store / "runs" / "latest" / "toy.json").write_text("{")
    assert states(plan_toys(study, store)) == FRESH
    assert run_toys(study, store, "bend.step=2").num_computed == 7
    assert verify(Store(store)).is_ok


def test_two_shards_with_one_key_are_refused(study: Path, new: Path) -> None:
    def plan_twice(*given: Any) -> list[Shard]:
        shards = TOYS.stage("aside").plan(*given)
        return [*shards, replace(shards[0])]

    with pytest.raises(PlanError, match="twice"):
        plan_toys(study, new, graph=toys_with("aside", plan=plan_twice))


def test_other_bytes_of_a_forced_stage_replace_the_old_ones(study: Path, new: Path, tmp_path: Path) -> None:
    run_toys(study, new, "bend.step=1")
    forced = StageSelection(force=("grow",))
    outcome = run_toys(study, new, "bend.step=1", selection=forced, graph=with_longer_steps())
    assert computed(outcome) == {"grow": 6, "bend": 6, "judge": 1}
    run_toys(study, tmp_path / "anew", "bend.step=1", graph=with_longer_steps())
    assert digests(new) == digests(tmp_path / "anew")


def test_a_forced_stage_leaves_what_a_dataset_needs_and_says_what_to_do(study: Path, new: Path) -> None:
    run_toys(study, new, "bend.step=1")
    (judged,) = Store(new).artifacts("judge")
    create_dataset(Store(new), "scores", [judged.ref])
    before = digests(new)
    with pytest.raises(ShardError, match=r"dataset scores@1 needs the old one, which stays; raise the version of the"):
        run_toys(study, new, "bend.step=1", selection=StageSelection(force=("grow",)), graph=with_longer_steps())
    assert verify(Store(new)).is_ok
    run_toys(study, new, "bend.step=1", selection=StageSelection(force=("grow", "bend", "judge")))
    assert digests(new) == before


def test_shards_behind_a_forced_one_are_computed_again(study: Path, store: Path, tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="killed"):
        run_toys(study, store, selection=StageSelection(force=("grow",)), graph=with_longer_steps(fail_at="s1"))
    plan = plan_toys(study, store)
    assert states(plan)["grow"] == "2 fresh, 4 stale"
    assert reasons(plan, "grow") == {"a shard before it was computed again with other bytes"}
    run_toys(study, store, graph=with_longer_steps())
    run_toys(study, tmp_path / "anew", graph=with_longer_steps())
    assert digests(store) == digests(tmp_path / "anew")
    assert plan_toys(study, store).is_fresh


def with_longer_steps(*, fail_at: str = "") -> Graph:
    """Return the toys as a programmer leaves them who changed a stage and not its version."""

    def grow(shard: Shard, store: Store) -> ArtifactRef:
        if shard.name == fail_at:
            raise InputError("killed")
        options = shard.options(SegmentParameters)
        changed = replace(shard, parameters=options.model_copy(update={"scale": 2 * options.scale}))
        vars(changed)["key"] = shard.key
        return run_grow(changed, store)

    return toys_with("grow", run_shard=grow)
