"""Topic `takes`: what each take looks like."""

from __future__ import annotations

from pasdedeux.evaluation.takes import take_scores, take_sheet
from storage_schema import Store
from tasks.evaluation.topic import TopicResult, make_shard, read_people
from tasks.stage import Shard, StageInputs

__all__ = ["TOPIC", "run", "shards"]

TOPIC = "takes"


def shards(inputs: StageInputs) -> list[Shard]:
    """One shard per take."""
    return [
        make_shard(topic=TOPIC, name=manifest.facts["take_id"], inputs=[manifest], parameters={}, seed=inputs.seed)
        for manifest in inputs.of("poses")
    ]


def run(shard: Shard, store: Store) -> TopicResult:
    """Describe and draw one take."""
    ref = shard.inputs[0]
    facts = store.manifest(ref).facts
    people = read_people(store, ref, "body22_m")
    name = f"take-{facts['take_id']}.png"
    held_out = ", held out" if facts["is_held_out"] else ""
    who = "person A orange, person B blue, " if people.shape[1] > 1 else ""
    return TopicResult(
        scores=take_scores(facts["take_id"], people, facts["rate_hz"]),
        pictures={name: take_sheet(facts["take_id"], people, facts["rate_hz"])},
        captions={name: f"Take {facts['take_id']}{held_out}: {who}left limbs darker."},
    )
