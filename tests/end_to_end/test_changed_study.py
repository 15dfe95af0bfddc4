"""A changed study: `plan` says beforehand what would be computed and why, and a run computes that and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from storage_schema import Store
from tests.builders.real_study import BuiltStudy, build_here, call_in_process, digests

pytestmark = pytest.mark.slow


def planned(small: BuiltStudy, capsys: pytest.CaptureFixture[str], *settings: str) -> dict[str, Any]:
    """Return the stages that are not fresh, by name, as `plan --json` tells them."""
    arguments = [part for setting in settings for part in ("--set", setting)]
    answer = call_in_process(capsys, "plan", small.study, "--store", small.store, "--json", *arguments)
    assert answer.code == 0, answer.err
    return {stage["stage"]: stage for stage in answer.json["stages"] if stage["state"] != "fresh"}


def reasons(stage: dict[str, Any]) -> set[str]:
    return {f"{shard['state']}: {shard['reason']}" for shard in stage["shards"] if shard["state"] != "fresh"}


def test_another_scale_rebuilds_the_variants_and_what_is_made_of_them(
    small: BuiltStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setting = "augmentation.scales=[0.75, 0.95, 1.05, 1.2]"
    plan = planned(small, capsys, setting)
    assert reasons(plan["augmentation"]) == {
        "missing: new: augmentation.scales [0.75,0.95,1.05,1.25] -> [0.75,0.95,1.05,1.2]"
    }
    others = {name: stage["state"] for name, stage in plan.items() if name != "augmentation"}
    assert set(others.values()) == {"pending"}
    assert {"training", "evaluation"} <= set(others)
    assert not {"ingest", "priors", "views", "seeds", "chains"} & set(others)

    store = small.copy_store(tmp_path)
    computed = build_here(small.study, store, setting)
    assert {name for name, count in computed.items() if count} == {"augmentation", "training", "evaluation"}
    known = {manifest.ref for manifest in Store(small.store).artifacts()}
    new = [manifest for manifest in Store(store).artifacts("evaluation") if manifest.ref not in known]
    assert {manifest.partition for manifest in new} == {"augmentation", "models", "report"}


def test_a_threshold_that_changes_no_verdict_stops_the_rebuild_at_its_own_stage(
    small: BuiltStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setting = "augmentation.limits.jerk_ratio=[50.0, 60.0]"
    plan = planned(small, capsys, setting)
    assert reasons(plan["augmentation"]) == {"stale: augmentation.limits.jerk_ratio [1.2,2.0] -> [50.0,60.0]"}
    assert plan["training"]["state"] == "pending"
    store = small.copy_store(tmp_path)
    computed = build_here(small.study, store, setting)
    assert {name: count for name, count in computed.items() if count} == {"augmentation": 2}
    stages = ("training", "evaluation", "augmentation")
    assert [d for place, d in digests(store).items() if place[0] in stages] == [
        d for place, d in digests(small.store).items() if place[0] in stages
    ]


def test_more_draws_extend_the_chains_and_keep_what_is_there(
    small: BuiltStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setting = "chains.num_draws=30"
    plan = planned(small, capsys, setting)
    assert "chains" in plan
    assert not {"ingest", "augmentation", "training", "priors", "views", "seeds"} & set(plan)
    shards = {(s["partition"], s["shard"]): s for s in plan["chains"]["shards"]}
    assert len(shards) == 2 * (2 * 3 + 1)
    for (_, name), shard in shards.items():
        if name == "summary":
            assert (shard["state"], shard["reason"]) == ("stale", "chains.num_draws 20 -> 30")
        elif name.endswith("segment2"):
            assert (shard["state"], shard["reason"]) == ("missing", "new: chains.num_draws 20 -> 30")
        else:
            assert shard["state"] == "fresh"

    store = small.copy_store(tmp_path)
    computed = build_here(small.study, store, setting)
    assert computed["chains"] == 2 * (2 + 1)
    assert {name for name, count in computed.items() if count} <= {
        "chains",
        "lifting",
        "projections",
        "reconstruction",
        "evaluation",
    }
    before, after = digests(small.store), digests(store)
    old = {place: digest for place, digest in before.items() if place[0] == "chains" and place[2] != "summary"}
    assert old.items() <= after.items()
    assert len(after) == len(before) + 4
    # Back to fewer: everything of the first run is still there.
    assert sum(build_here(small.study, store).values()) == 0


def test_another_seed_rebuilds_everything(small: BuiltStudy, capsys: pytest.CaptureFixture[str]) -> None:
    plan = planned(small, capsys, "study.seed=4")
    assert reasons(plan["ingest"]) == {"stale: study.seed 3 -> 4"}
    assert len(plan) == 12


def test_another_title_of_the_report_rebuilds_the_report_alone(
    small: BuiltStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setting = "evaluation.title=Shorter"
    plan = planned(small, capsys, setting)
    assert list(plan) == ["evaluation"]
    shards = [s for s in plan["evaluation"]["shards"] if s["state"] != "fresh"]
    assert [(s["partition"], s["shard"]) for s in shards] == [("report", "report")]
    assert shards[0]["reason"].startswith("evaluation.title ")
    store = small.copy_store(tmp_path)
    assert build_here(small.study, store, setting)["evaluation"] == 1
