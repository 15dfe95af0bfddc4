"""Identities and detector faults as figures of a report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.experiments.detector_faults import KINDS, JointCounts
from pasdedeux.experiments.people import fault_scores, identity_scores
from storage_schema import Store
from tasks.evaluation import STAGE
from tasks.evaluation.experiments.people import TOPIC
from tasks.stage import StageInputs, stream
from tests.builders.crowds import duet_couple
from tests.builders.walking_takes import put_take


def draw(name: str, view: int) -> np.random.Generator:
    return stream(0, name, view)


def test_identities_are_counted_for_each_couple_and_per_minute_of_video() -> None:
    couples = {name: duet_couple(name, duration_s=3.0) for name in ("waltz", "judo")}
    scores = identity_scores(couples, rate_hz=30.0, num_views=2, noise_px=0.0, stream=draw)
    found = {(score.metric, score.item): score for score in scores}
    assert {item for metric, item in found if metric == "identity_switches"} == {"waltz", "judo", "all"}
    # Two couples of 90 frames from two views, two people in each.
    assert found["identity_switches", "all"].count == 720
    total = found["identity_switches", "waltz"].value + found["identity_switches", "judo"].value
    assert found["identity_switches", "all"].value == total == 0.0
    assert found["identity_switches_per_minute", "all"].value == 0.0


def test_people_who_jump_onto_each_others_places_are_counted_as_switched() -> None:
    couple = duet_couple("waltz", duration_s=3.0)
    couple[45:] = couple[45:, ::-1]
    scores = identity_scores({"waltz": couple}, rate_hz=30.0, num_views=1, noise_px=0.0, stream=draw)
    found = {score.metric: score.value for score in scores if score.item == "all"}
    assert found["identity_switches"] >= 1.0
    # Three seconds are a twentieth of a minute.
    assert found["identity_switches_per_minute"] == pytest.approx(20.0 * found["identity_switches"])


def test_faults_of_every_kind_are_injected_and_scored() -> None:
    couples = {"push_hands": duet_couple("push_hands", duration_s=4.0)}
    scores = fault_scores(couples, rate_hz=30.0, noise_px=2.0, stream=draw)
    found = {(score.metric, score.item): score for score in scores}
    for kind in KINDS:
        assert found["share_of_wrong_joints_found", f"fault: {kind}"].count > 0
        assert 0.0 <= found["share_of_wrong_joints_left", f"fault: {kind}"].value <= 1.0
    assert found["share_of_wrong_joints_put_right", "fault: body"].value > 0.95
    assert found["share_of_good_joints_touched", "no fault"].value < 0.01


def test_counts_of_joints_add_up_and_shares_of_nothing_are_unknown() -> None:
    total = JointCounts(4, 3, 6, 2, 1) + JointCounts(4, 1, 2, 2, 1)
    assert tuple(total.shares.values()) == (0.5, 0.5, 0.5, 0.25)
    assert np.isnan(list(JointCounts().shares.values())).all()


def test_the_topic_takes_every_take_of_two_people_when_it_is_asked_for(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    inputs = StageInputs({"poses": [put_take(store, "a"), put_take(store, "b", is_held_out=True)]}, seed=0)
    assert TOPIC.plan(inputs, STAGE.parameters()) == []
    shards = TOPIC.plan(inputs, STAGE.parameters(num_crowd_views=1))
    assert [shard.name for shard in shards] == ["identities-0px", "identities-5px", "faults-0px", "faults-5px"]
    result = TOPIC.run(shards[1], store)
    assert {score.item for score in result.scores} == {"a", "b", "all"}
    assert "2 takes from 1 random views" in result.notes[0]
    assert {score.method for score in TOPIC.run(shards[2], store).scores} == {"repaired"}
