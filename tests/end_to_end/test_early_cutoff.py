"""A stage made anew with the same content stops the rebuild; nothing after it is lost, changed or refused."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from flows.differences import differences
from flows.finished_builds import read_recorded
from flows.outcomes import Outcome, Run
from flows.publishing import publish
from flows.study import load_study
from storage_schema import Store, list_runs, open_table
from tasks.graph import Graph
from tasks.stage import Shard, StageInputs
from tests.builders.real_study import BuiltStudy, graph
from tests.builders.toy_runs import plan_toys, run_toys

pytestmark = pytest.mark.slow

CHANGES = (
    "views.distance_m=5",
    "seeds.num_grown=2",
    "chains.num_draws=30",
    "lifting.max_frames=2",
    "projections.pitches_deg=[0.0]",
    "reconstruction.methods=['nearest']",
    "augmentation.scales=[0.75, 1.05]",
    "training.models=['copy']",
    "evaluation.num_truth_pairs=11",
)
"""Of each stage a key that changes what it does: then it is planned anew from what stands before it."""


def raised(name: str) -> Graph:
    """Return the graph with a higher version of one stage."""
    stages = graph().stages
    (changed,) = (stage for stage in stages if stage.name == name)

    def plan(inputs: StageInputs, parameters: object) -> list[Shard]:
        keys: dict[str, str] = {}
        shards = []
        for shard in changed.plan(inputs, parameters):
            after = tuple(keys[key] for key in shard.after)
            shards.append(replace(shard, version=shard.version + 1, after=after))
            keys[shard.key] = shards[-1].key
        return shards

    return Graph(tuple(replace(stage, plan=plan, early=()) if stage is changed else stage for stage in stages))


def planned(study: Path, store: Path, graph: Graph, *settings: str) -> dict[str, list[tuple[str, str, str, str]]]:
    """Return the shards of every stage that can be planned: place, key and state."""
    plan = plan_toys(study, store, *settings, graph=graph)
    return {
        stage.stage.name: [(i.shard.partition, i.shard.name, i.shard.key, i.state.value) for i in stage.shards]
        for stage in plan.stages
        if not stage.is_pending
    }


@cache
def planned_as_it_is(study: Path, store: Path, *settings: str) -> dict[str, list[tuple[str, str, str, str]]]:
    """Plan in a store in which nothing more is computed."""
    return planned(study, store, graph(), *settings)


def built(study: Path, store: Path, graph: Graph, settings: Sequence[str]) -> tuple[Run, Outcome]:
    chosen, stages = load_study(str(study), graph, settings=settings, environment={})
    return Run(chosen, stages, Store(store)), run_toys(study, store, *settings, graph=graph)


@pytest.mark.parametrize("name", [name for name in graph().names if name != "generation"])
def test_a_stage_made_anew_with_the_same_content_changes_nothing_after_it(
    small: BuiltStudy, tmp_path: Path, name: str
) -> None:
    store, once_store = small.copy_store(tmp_path), small.store
    publishes = ["publish.name=small", "publish.required=[]"]
    if name == "priors":  # which have something to say of named takes alone
        publishes.append('ingest.prior=["waltz"]')
        once_store = tmp_path / "once"
        run_toys(small.study, store, *publishes, graph=graph())
        shutil.copytree(store, once_store)
    before = publish(*built(small.study, store, graph(), publishes))
    assert before is not None
    assert before.dataset is not None

    run, outcome = built(small.study, store, raised(name), publishes)
    done = {stage.name: stage.num_computed for stage in outcome.stages if stage.num_computed}
    assert list(done) == [name], "only the stage itself is computed"
    after = publish(run, outcome)
    assert after is not None
    assert after.dataset == before.dataset, "a version with the same content is none"

    for setting in ("study.title=again", *CHANGES):
        once = planned_as_it_is(small.study, once_store, *publishes, setting)
        again = planned(small.study, store, raised(name), *publishes, setting)
        assert again | {name: once.get(name)} == once | {name: once.get(name)}, f"planned with {setting}"

    last = read_recorded(Store(store), list_runs(Store(store))[-1].run_id)
    changes = differences(Store(store), read_recorded(Store(store), "small@1"), last)
    assert all(counts["same"] == sum(counts.values()) for counts in changes.artifacts.values())
    assert not changes.scores
    assert not changes.pairs["licences"]


def test_a_key_without_effect_leaves_everything_fresh(small: BuiltStudy, tmp_path: Path) -> None:
    store = small.copy_store(tmp_path)
    run_toys(small.study, store, "ingest.capture.skip_failing=true", graph=graph())
    plan = plan_toys(small.study, store, "ingest.capture.skip_failing=true", graph=graph())
    assert plan.is_fresh
    once = plan_toys(small.study, small.store, graph=graph())
    assert [m.ref for m in plan.manifests] == [m.ref for m in once.manifests]
    assert [stage.stage.name for stage in plan.stages if not stage.shards] == ["generation"]
    scores = [open_table("scores:small", where).num_rows for where in (small.store, store)]
    assert scores[0] == scores[1] > 0


def test_what_lifted_pairs_say_of_their_draws_can_be_asked_for(small: BuiltStudy) -> None:
    named = [str(text) for text in open_table("lifted_pairs:small", small.store)["draw"] if text is not None]
    assert named
    for text in named[:5]:
        assert open_table(text, small.store).num_rows == 1
