"""Sets of pairs are judged at one size, on held-out motion, beside as many real frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.plausibility.joint_limits import JointLimits
from tasks.evaluation.leave_one_out import TOPIC as LEAVE_ONE_OUT
from tasks.evaluation.sets import TOPIC, judge_set, set_table
from tasks.stage import Parameters, StageInputs
from tests.builders.sampling_store import ONE_OF_THE_PRIOR, run_chains, with_seeds
from tests.builders.storage_rows import having

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


def test_every_set_is_judged_at_one_size_on_held_out_takes_alone(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20, num_filled=10)
    sweep = {"repaired": {"starts": "every", "densities": ["ic"], "repair_steps": 5}}
    made = run_chains(store, given, **ONE_OF_THE_PRIOR, sweep=sweep)
    drawn = {name: having(name, made) for name in ("draws", "chain_info")}
    known = {**given.manifests, **drawn}
    (shard,) = TOPIC.plan(StageInputs(known, seed=1), Parameters())
    result = TOPIC.compute(shard, store)
    items = result.items[""]
    assert set(items.takes) == {"kept_back"}
    names = {"prior_only", "repaired", "grown_seeds", "filled_seeds", "selected_pairs", "real_frames"}
    assert set(items.values) == names
    sizes = {name: {score.at for score in result.scores if score.method == name} for name in names}
    assert set.intersection(*sizes.values()) == {8.0}
    (table,) = set_table(result.scores)
    assert [row[1] for row in table.rows[:6]] == ["8"] * 6
    (shard,) = LEAVE_ONE_OUT.plan(StageInputs(known, seed=1), Parameters())
    for found in (result, LEAVE_ONE_OUT.compute(shard, store)):
        judged = {"real_frames", *found.baselines}
        means = {name: values.mean() for name, values in found.items[""].values.items() if name in judged}
        assert len(means) > 1
        assert min(means, key=means.__getitem__) == "real_frames", "no yardstick fails the truth"
    seen = [take for take in known["poses"] if not take.facts.get("is_held_out")]
    assert TOPIC.plan(StageInputs({**known, "poses": seen}, seed=1), Parameters()) == []
