"""Topic `people`: identities through crossings and repair of detector faults, on virtual video of the pairs' takes."""

from __future__ import annotations

from functools import partial

from pasdedeux.evaluation.people_scores import TOPIC, fault_scores, identity_scores
from pasdedeux.projections.sources import resample_positions
from storage_schema import Store
from tasks.evaluation.topic import TopicResult, make_shard, read_people
from tasks.stage import Shard, StageInputs, stream

__all__ = ["TOPIC", "run", "shards"]

_NOISES_PX = (0.0, 5.0)
_VIDEO_HZ = 30.0


def shards(inputs: StageInputs, *, num_views: int) -> list[Shard]:
    """One shard per question and noise, over all takes of two people."""
    takes = [take for take in inputs.of("poses") if take.facts["num_persons"] == 2]
    if not (takes and num_views):
        return []
    return [
        make_shard(
            topic=TOPIC,
            name=f"{question}-{noise_px:g}px",
            inputs=takes,
            parameters={"question": question, "noise_px": noise_px, "num_views": num_views},
            seed=inputs.seed,
        )
        for question in ("identities", "faults")
        for noise_px in _NOISES_PX
    ]


def run(shard: Shard, store: Store) -> TopicResult:
    """Answer one question; nothing is learned from takes here, so none has to be held out."""
    couples = {}
    for ref in shard.inputs:
        facts = store.manifest(ref).facts
        people = read_people(store, ref, "op14_m")
        couples[facts["take_id"]] = resample_positions(people, from_hz=float(facts["rate_hz"]), to_hz=_VIDEO_HZ)
    noise_px, num_views = shard.parameters["noise_px"], shard.parameters["num_views"]
    draw = partial(stream, shard.seed, "evaluation", TOPIC, shard.parameters["question"])
    if shard.parameters["question"] == "faults":
        return TopicResult(scores=fault_scores(couples, rate_hz=_VIDEO_HZ, noise_px=noise_px, stream=draw))
    scores = identity_scores(couples, rate_hz=_VIDEO_HZ, num_views=num_views, noise_px=noise_px, stream=draw)
    minutes = sum(map(len, couples.values())) * num_views / _VIDEO_HZ / 60.0
    note = f"Identities: {len(couples)} takes from {num_views} random views each, {minutes:.1f} minutes of video."
    return TopicResult(scores=scores, notes=[note])
