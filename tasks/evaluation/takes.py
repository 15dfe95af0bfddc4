"""Topic `takes`: figures of each take: closeness of the two people, floor and foot contact."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import NamedTuple

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.pictures import COLOUR_NAMES, Picture, pack_player, people_panel, shown_frames, times_shown
from pasdedeux.evaluation.scores import Score
from pasdedeux.interaction.surfaces import closest_joint_distance
from pasdedeux.people.names import person_names
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import Store
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.takes import read_motion
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import TakeFacts
from tasks.stage.judgements import verdict_of

_CLOSE_M = 0.15
"""Closest joints under this distance count as close contact."""


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per take."""
    return [TOPIC.shard(inputs, TakeFacts.of(take).take_id, take=[take]) for take in inputs.of("poses")]


class _ShownTakes(NamedTuple):
    """A take: its facts, and its people (frame, person, 22, 3), metres."""

    facts: TakeFacts
    people_m: Array


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownTakes]:
    """Describe one take."""
    manifest = store.manifest(shard.ref("take"))
    facts, verdict = TakeFacts.of(manifest), verdict_of(manifest)
    notes = []
    if verdict is not None and verdict.level is not Level.PASS:
        notes = [f"Take {facts.take_id}: {verdict.level}: {verdict.reason}."]
    people = read_motion(store, shard.ref("take"), "body22_m")["body22_m"]
    return TopicResult(take_scores(facts.take_id, people, facts.rate_hz), notes, shown=_ShownTakes(facts, people))


def _draw(shown: _ShownTakes) -> Iterator[Picture]:
    """Show the take."""
    take_id, people = shown.facts.take_id, shown.people_m
    frames, shown_hz = shown_frames(len(people), shown.facts.rate_hz)
    times = times_shown(frames, len(people), shown.facts.rate_hz)
    player = pack_player([people_panel(take_id, BODY22, people[frames])], rate_hz=shown_hz, labels=times)
    held_out = ", held out" if shown.facts.is_held_out else ""
    coloured = zip(person_names(people.shape[1]), cycle(COLOUR_NAMES), strict=False)
    who = "".join(f"person {letter} {colour}, " for letter, colour in coloured) if people.shape[1] > 1 else ""
    caption = f"Take {take_id}{held_out}: {who}left limbs darker. Good: feet on the floor, no jumps."
    yield Picture(f"take-{take_id}.player.json", caption, player)


def take_scores(take_id: str, people_m: Array, rate_hz: float) -> list[Score]:
    """Describe a take, body22 positions (frame, person, 22, 3), metres, in figures."""
    ankles = people_m[:, :, BODY22.indices(("left_ankle", "right_ankle", "left_toe", "right_toe")), 1]
    figures = [
        ("duration", len(people_m) / rate_hz, "s"),
        ("lowest_foot_joint", float(np.percentile(ankles.min(axis=(1, 2)), 5)), "m"),
    ]
    if people_m.shape[1] == 2:
        closest = closest_joint_distance(people_m)
        roots = np.linalg.norm(people_m[:, 0, 0] - people_m[:, 1, 0], axis=-1)
        figures += [
            ("closest_joints_median", float(np.median(closest)), "m"),
            ("share_closer_than_15_cm", float(np.mean(closest < _CLOSE_M)), ""),
            ("root_distance_median", float(np.median(roots)), "m"),
        ]
    count = len(people_m)
    return [Score(name, "capture", value, unit, item=take_id, count=count) for name, value, unit in figures]


TOPIC = Topic(
    name="takes",
    heading="Takes",
    introduction="The captured 3D motion at the frame rate of the study, and the result of the capture check.",
    reads=("poses",),
    plan=_plan,
    compute=_compute,
    draw=_draw,
)
