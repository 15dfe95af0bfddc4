"""Topic `people`: identities through crossings and repair of detector faults, on virtual video of the pairs' takes."""

from __future__ import annotations

from functools import partial

from pydantic import Field

from pasdedeux.evaluation.verdicts import Yardstick
from pasdedeux.experiments.people import fault_scores, identity_scores
from pasdedeux.projections.sources import resample_positions
from storage_schema import Store
from tasks.evaluation.topic import Topic, TopicResult, read_people
from tasks.stage import Parameters, Shard, StageInputs, stream

__all__ = ["TOPIC"]

_NOISES_PX = (0.0, 5.0)
_VIDEO_HZ = 30.0


class PeopleSettings(Parameters):
    """How many people are followed."""

    num_crowd_views: int = Field(
        0, ge=0, description="Random views per take of two people that identities are followed through; 0: none"
    )


class PeopleParameters(PeopleSettings):
    """One question at one noise."""

    question: str
    noise_px: float


def _plan(inputs: StageInputs, settings: PeopleSettings) -> list[Shard]:
    """Plan one shard per question and noise, over all takes of two people."""
    takes = [take for take in inputs.of("poses") if take.facts["num_persons"] == 2]
    if not (takes and settings.num_crowd_views):
        return []
    return [
        TOPIC.shard(
            inputs,
            f"{question}-{noise_px:g}px",
            settings.part(PeopleParameters, question=question, noise_px=noise_px),
            takes=takes,
        )
        for question in ("identities", "faults")
        for noise_px in _NOISES_PX
    ]


def _run(shard: Shard, store: Store) -> TopicResult:
    """Answer one question; nothing is learned from takes here, so none has to be held out."""
    couples = {}
    for ref in shard.refs("takes"):
        facts = store.manifest(ref).facts
        people = read_people(store, ref, "op14_m")
        couples[facts["take_id"]] = resample_positions(people, from_hz=float(facts["rate_hz"]), to_hz=_VIDEO_HZ)
    options = shard.options(PeopleParameters)
    noise_px, num_views = options.noise_px, options.num_crowd_views
    draw = partial(stream, shard.seed, "evaluation", TOPIC.name, options.question)
    if options.question == "faults":
        return TopicResult(scores=fault_scores(couples, rate_hz=_VIDEO_HZ, noise_px=noise_px, stream=draw))
    scores = identity_scores(couples, rate_hz=_VIDEO_HZ, num_views=num_views, noise_px=noise_px, stream=draw)
    minutes = sum(map(len, couples.values())) * num_views / _VIDEO_HZ / 60.0
    note = f"Identities: {len(couples)} takes from {num_views} random views each, {minutes:.1f} minutes of video."
    return TopicResult(scores=scores, notes=[note])


TOPIC = Topic(
    name="people",
    heading="People kept apart",
    introduction="Virtual video of the takes of two people from random views, people in random order in every frame: "
    "how often those who are followed by pose and motion are taken for each other, and what the repair does with "
    "injected faults of detectors. Noise is at 1080 lines.",
    reads=("poses",),
    plan=_plan,
    run=_run,
    metrics=("identity_switches*", "dropped_rows", "share_of_*"),
    settings=PeopleSettings,
    yardsticks=(
        Yardstick(
            "share_of_wrong_joints_left",
            "injected faults that are left",
            methods=("repaired",),
            chance=1.0,
            chance_name="no repair",
        ),
    ),
)
