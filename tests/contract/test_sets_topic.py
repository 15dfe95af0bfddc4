"""Sets of pairs are judged at one size, on held-out motion, beside as many real frames, which no criterion fails."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.verdict import Level
from storage_schema import Store
from tasks import chains
from tasks.chains import ChainsParameters
from tasks.evaluation import TOPICS
from tasks.evaluation.leave_one_out import TOPIC as LEAVE_ONE_OUT
from tasks.evaluation.sets import TOPIC, judge_set, set_table
from tasks.evaluation.topic import Topic, TopicResult
from tasks.stage import Parameters, StageInputs
from tests.builders.sampling_store import QUICK, inputs, run, with_seeds

__all__ = ["inputs"]

PAIRS = random_pairs(np.random.default_rng(0), 24, spread_rad=0.3)


def test_a_set_covers_its_own_members_and_copies_are_counted() -> None:
    limits = JointLimits.published()
    covered, found = judge_set(PAIRS[:8], PAIRS[4:12], PAIRS[:16], limits)
    np.testing.assert_allclose(covered[:4], 0.0, atol=1e-6)
    assert covered[4:].min() > 0.01
    assert found["set_precision_D_C"] == pytest.approx(0.0, abs=1e-6)
    assert (found["set_near_duplicates"], found["set_nearest_other_D_C"] > 0.02) == (0.0, True)
    twice = judge_set(np.repeat(PAIRS[:8], 2, axis=0), PAIRS[4:12], PAIRS[:16], limits)[1]
    assert (twice["set_near_duplicates"], twice["set_coverage_D_C"]) == (100.0, found["set_coverage_D_C"])
    inside = PAIRS[:8].copy()
    inside[:, 1] += (inside[:, 0] - inside[:, 1]).mean(axis=1, keepdims=True)
    worse = judge_set(inside, PAIRS[4:12], PAIRS[:16], limits)[1]
    assert worse["set_penetration"] > found["set_penetration"]
    assert worse["set_implausible"] > found["set_implausible"]


@pytest.fixture
def sampled(inputs: Any) -> tuple[Store, StageInputs]:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20, num_filled=10)
    chosen = {**QUICK, "num_chains": 1, "densities": ("prior_only",), "starts": "seeds"}
    sweep = {"repaired": {"starts": "every", "densities": ["ic"], "repair_steps": 5}}
    made = run(chains.plan(given, ChainsParameters(**chosen, sweep=sweep)), chains, store)
    tables = {name: [one for one in made if name in one.tables] for name in ("draws", "chain_info")}
    return store, StageInputs({**given.manifests, **tables}, seed=1)


def computed(topic: Topic[Any], store: Store, known: StageInputs) -> TopicResult[Any]:
    (shard,) = topic.plan(known, Parameters())
    return topic.compute(shard, store)


def test_every_set_is_judged_at_one_size_on_held_out_takes_alone(sampled: Any) -> None:
    store, known = sampled
    result = computed(TOPIC, store, known)
    items = result.items[""]
    assert set(items.takes) == {"kept_back"}
    names = {"prior_only", "repaired", "grown_seeds", "filled_seeds", "selected_pairs", "real_frames"}
    assert set(items.values) == names
    sizes = {name: {one.at for one in result.scores if one.method == name} for name in names}
    assert set.intersection(*sizes.values()) == {8.0}
    (table,) = set_table(result.scores)
    assert [row[1] for row in table.rows[:6]] == ["8"] * 6
    without = {name: found for name, found in known.manifests.items() if name != "poses"}
    seen = [one for one in known.of("poses") if not one.facts.get("is_held_out")]
    assert TOPIC.plan(StageInputs({**without, "poses": seen}, seed=1), Parameters()) == []


@pytest.mark.parametrize("topic", [TOPIC, LEAVE_ONE_OUT], ids=lambda topic: topic.name)
def test_no_criterion_fails_the_truth(sampled: Any, topic: Topic[Any]) -> None:
    """Real frames take the place of what is judged: a yardstick that they fail measures something else."""
    store, known = sampled
    result = computed(topic, store, known)
    items = result.items[""]
    baselines = {name: found for name, found in items.values.items() if name in result.baselines}
    judged = {"judged": items.values["real_frames"], **baselines}
    assert len(judged) > 1
    (criterion,) = topic.criteria
    verdict = criterion.verdict(type(items)(judged, items.takes, items.times_s), list(baselines))
    assert verdict is not None
    means = {name: float(found.mean()) for name, found in judged.items() if name != "real_frames"}
    assert verdict.level is not Level.FAIL
    assert min(means, key=means.__getitem__) == "judged"


def test_both_topics_are_on_the_page() -> None:
    assert {TOPIC, LEAVE_ONE_OUT} <= set(TOPICS)
