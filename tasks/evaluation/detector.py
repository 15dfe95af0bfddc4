"""Topic `detector`: the loss of accuracy by a simulated detector, beside the same video with the same noise alone."""

from __future__ import annotations

import numpy as np

from pasdedeux.evaluation.scores import scores_of
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.reconstruction.errors import root_centred_error_m
from storage_schema import Store
from tasks.evaluation.reconstruction import read_reconstructed
from tasks.evaluation.topic import Topic, TopicResult
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import MotionFacts, SequenceFacts, TakeFacts

_SUFFIX = ".detector"
_NOISE_ALONE = "noise_alone"
_MAX_SWITCHES = 1.0  # a minute


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per reconstructed sequence of a detector, with that of the same video beside it."""
    motions = {manifest.partition: manifest for manifest in inputs.of("motions") if manifest.tables["motions"].rows}
    annotations = {
        name: manifest for manifest in inputs.of("annotations") for name in SequenceFacts.of(manifest).sequence_ids
    }
    shards = []
    for name, detected in motions.items():
        plain = motions.get(name.removesuffix(_SUFFIX))
        if name.endswith(_SUFFIX) and plain is not None:
            shown = MotionFacts.of(detected).sequence_takes
            takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).take_id in shown]
            sources = [annotations[manifest.partition] for manifest in (detected, plain)]
            shards.append(
                TOPIC.shard(inputs, name, detected=[detected], plain=[plain], annotations=sources, takes=takes)
            )
    return shards


def _compute(shard: Shard, store: Store) -> TopicResult[None]:
    """Score one sequence: the identities of people, and the error of each person by the last method."""
    annotations, takes = shard.refs("annotations"), shard.refs("takes")
    facts = SequenceFacts.of(store.manifest(annotations[0]))
    (settled,) = (identities for identities in facts.detected if identities.sequence_id == shard.name)
    scores = []
    for name, label in (("detected", "detector"), ("plain", _NOISE_ALONE)):
        for person in read_reconstructed(store, shard.ref(name), annotations, takes)[0]:
            method, positions_m = list(person.found_m.items())[-1]
            error = root_centred_error_m(positions_m, person.truth_m)
            item = f"{shard.name.removesuffix(_SUFFIX)} person {person.person_id}"
            median = {"median_error": float(np.median(error))}
            scores += scores_of(median, label, "m", split=method, item=item, count=len(error))
    minutes = float(np.ptp(store.read(annotations[1], "annotations", columns=["time_s"])["time_s"])) / 60.0
    figures = {
        "identity_switches_per_minute": settled.num_identity_switches / minutes if minutes else 0.0,
        "extra_people": float(settled.num_people - settled.num_true_people),
        "wrong_pairs": float(sum(pair != (0, 1) for pair in settled.couples) + ((0, 1) not in settled.couples)),
    }
    scores += scores_of(figures, "followed", item=shard.name)
    switches = {"followed": np.array([figures["identity_switches_per_minute"]])}
    return TopicResult(scores, items={"": Items(switches, [shard.name], [0.0])}, baselines=(_NOISE_ALONE,))


TOPIC = Topic(
    name="detector",
    heading="A simulated detector",
    introduction="Virtual video with the faults of a detector: missing joints, spurious joints of low confidence, "
    "people in changing order, and a third person who walks through. The scores are identity switches per "
    "minute, extra people, and wrong pairs. `median_error` is the median over frames of the mean joint "
    "error (op14, centred on the mid-hip), beside the same video with noise only.",
    reads=("motions", "annotations", "cameras", "poses"),
    plan=_plan,
    compute=_compute,
    criteria=(
        Criterion("identity_switches_per_minute", "identity switches per minute", "", "sequences", limit=_MAX_SWITCHES),
    ),
)
