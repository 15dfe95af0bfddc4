"""Topic `takes`: what each take looks like."""

from __future__ import annotations

from itertools import cycle
from string import ascii_uppercase

from pasdedeux.evaluation.players import COLOUR_NAMES, pack_player, people_panel, shown_frames
from pasdedeux.evaluation.takes import take_scores
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import Store
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import TakeFacts
from tasks.stage import Parameters, Shard, StageInputs, verdict_of
from tasks.takes import read_motion


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per take."""
    return [TOPIC.shard(inputs, TakeFacts.of(take).take_id, take=[take]) for take in inputs.of("poses")]


def _run(shard: Shard, store: Store) -> TopicResult:
    """Describe and draw one take."""
    manifest = store.manifest(shard.ref("take"))
    facts, verdict = TakeFacts.of(manifest), verdict_of(manifest)
    notes = []
    if verdict is not None and verdict.level is not Level.PASS:
        notes = [f"Take {facts.take_id}: {verdict.level}: {verdict.reason}."]
    people = read_motion(store, shard.ref("take"), "body22_m")["body22_m"]
    name = f"take-{facts.take_id}.player.json"
    frames, rate_hz = shown_frames(len(people), facts.rate_hz)
    shown = people_panel(facts.take_id, BODY22, people[frames])
    held_out = ", held out" if facts.is_held_out else ""
    coloured = zip(ascii_uppercase[: people.shape[1]], cycle(COLOUR_NAMES), strict=False)
    who = "".join(f"person {letter} {colour}, " for letter, colour in coloured) if people.shape[1] > 1 else ""
    return TopicResult(
        scores=take_scores(facts.take_id, people, facts.rate_hz),
        pictures={name: pack_player([shown], rate_hz=rate_hz)},
        notes=notes,
        captions={
            name: f"Take {facts.take_id}{held_out}: {who}left limbs darker. Better: feet on the floor, no jumps."
        },
    )


TOPIC = Topic(
    name="takes",
    heading="Takes",
    introduction="The 3D motion that came in, at the frame rate of the study, and what the check of its capture found.",
    reads=("poses",),
    plan=_plan,
    run=_run,
)
