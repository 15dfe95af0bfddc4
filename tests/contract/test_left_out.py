"""What was skipped, and why, is one list: of every kind, in the card, on the page and in the console."""

from __future__ import annotations

import html
from collections.abc import Callable

import pytest

from flows.planning import stage_inputs
from pasdedeux.evaluation.scores import Score
from storage_schema import ArtifactRef, Manifest, Store
from tasks import augmentation, ingest
from tasks.augmentation import NobodyParameters
from tasks.evaluation import evaluation_stage
from tasks.evaluation.topic import Topic, TopicResult
from tasks.graph import Graph, load_graph
from tasks.ingest.parameters import SkippedParameters
from tasks.ingest.virtual_video.parameters import VideoParameters
from tasks.stage import Parameters, Shard, StageInputs
from tasks.summary import summary_of
from tests.builders.storage_rows import put, random_columns, take_rows

Commit = Callable[[Store], ArtifactRef | Manifest]

FAILED = "Take spin was skipped, its capture fails: joints jump."


def shard_of(stage: str, partition: str, parameters: Parameters, **more: object) -> Shard:
    return Shard(stage=stage, version=1, partition=partition, name=partition, parameters=parameters, **more)


def file_skipped(store: Store) -> ArtifactRef:
    parameters = SkippedParameters(skipped={"torn.bvh": "torn.bvh: line 3 is no number"})
    return ingest.run_shard(shard_of("ingest", "folder", parameters), store)


def take_skipped(store: Store) -> Manifest:
    facts = {"kind": "take", "take_id": "spin", "takes": ["spin"], "num_persons": 2, "skipped": [FAILED]}
    return put(store, "ingest", "spin", {"take_quality": random_columns("take_quality", 2, seed=0)}, facts)


def video_of_a_skipped_take(store: Store) -> ArtifactRef:
    take = take_skipped(store)
    parameters = VideoParameters.model_construct(take_id="spin", count=1, purpose="video")
    return ingest.run_shard(shard_of("ingest", "spin video", parameters, after=(take.ref.key,)), store)


def take_of_one(store: Store) -> Manifest:
    columns, facts = take_rows("solo", 1, 2)
    return put(store, "ingest", "solo", {"poses": columns}, facts)


def nobody_is_scaled(store: Store) -> ArtifactRef:
    parameters = NobodyParameters(persons=("B",), num_persons=1)
    return augmentation.run_shard(shard_of("augmentation", "solo", parameters), store)


KINDS = {
    file_skipped: "torn.bvh: line 3 is no number",
    take_skipped: FAILED,
    video_of_a_skipped_take: FAILED,
    take_of_one: "Take solo: 1 person; the stages that need pairs skipped it.",
    nobody_is_scaled: "No variants of take solo: one person, and nobody of those who are scaled: B.",
}


def plan_toys(inputs: StageInputs, _: Parameters) -> list[Shard]:
    return [TOPIC.shard(inputs, "all")]


def count_toys(shard: Shard, store: Store) -> TopicResult:
    return TopicResult(scores=[Score("toys", "counted", 3.0, "", split="all")])


READS = ("poses", "variants", "models", "annotations")
TOPIC = Topic("toys", "Toys", "How many there are.", READS, plan_toys, count_toys)
EVALUATION = evaluation_stage([TOPIC])


def report_of(store: Store, inputs: StageInputs) -> Manifest:
    *topics, report = EVALUATION.plan(inputs, EVALUATION.parameters())
    for shard in topics:
        EVALUATION.run_shard(shard, store)
    return store.manifest(EVALUATION.run_shard(report, store))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_what_was_skipped_is_said_in_card_page_and_console(store: Store, kind: Commit) -> None:
    kind(store)
    graph = Graph((*(stage for stage in load_graph().stages if stage.name != "evaluation"), EVALUATION))
    made: dict[str, list[Manifest]] = {name: [] for name in graph.upstream["evaluation"]}
    for manifest in store.artifacts():
        made[manifest.ref.stage].append(manifest)
    report = report_of(store, stage_inputs(EVALUATION, 0, made))
    page, card = (store.attachment(report.ref, name).decode() for name in ("report.html", "card.md"))
    console = "\n".join(summary_of(list(store.artifacts())).lines())
    for text in (html.unescape(page), card, console):
        assert KINDS[kind] in text
    assert "- Nothing." not in card
    assert "Nothing was skipped." not in page


def test_a_store_in_which_nothing_was_skipped_says_so(store: Store) -> None:
    columns, facts = take_rows("waltz", 2, 2)
    take = put(store, "ingest", "waltz", {"poses": columns}, facts)
    report = report_of(store, StageInputs({"poses": [take]}, seed=0))
    assert "## Skipped\n\n- Nothing." in store.attachment(report.ref, "card.md").decode()
    assert not [line for line in summary_of([take]).lines() if line.startswith("skipped")]
