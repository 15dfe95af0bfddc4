"""Topic `parallel_views`: held-out takes on the database's body, seen by parallel rays, as in the paper's tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.evaluation.parallel_views import TOPIC, parallel_view_scores
from pasdedeux.projections.database import Database
from pasdedeux.projections.reconstruct import Searcher
from pasdedeux.projections.sources import resample_positions
from storage_schema import Store
from tasks.evaluation.topic import TopicResult, make_shard, read_people, refuse_overlap
from tasks.stage import Shard, StageInputs, stream

__all__ = ["TOPIC", "run", "shards"]


def shards(inputs: StageInputs, *, yaws_deg: Sequence[float]) -> list[Shard]:
    """One shard per held-out take, with every part of the projection database that has not seen it."""
    if not yaws_deg:
        return []
    found = []
    for take in inputs.of("poses"):
        if not take.facts["is_held_out"]:
            continue
        take_id = take.facts["take_id"]
        database = [part for part in inputs.of("projections") if take_id not in part.facts["takes"]]
        if database:
            found.append(
                make_shard(
                    topic=TOPIC,
                    name=take_id,
                    inputs=[take, *database],
                    parameters={"yaws_deg": list(yaws_deg)},
                    seed=inputs.seed,
                )
            )
    return found


def run(shard: Shard, store: Store) -> TopicResult:
    """Score one take."""
    take, *parts = shard.inputs
    facts = store.manifest(take).facts
    used = [store.manifest(part).facts for part in parts]
    refuse_overlap("the projection database", [name for one in used for name in one["takes"]], [shard.name])
    tables = [store.read(part, "projections", columns=["op14_m", "is_sequence_start"]) for part in parts]
    rate_hz = float(used[0]["rate_hz"])
    searcher = Searcher.of(
        Database(
            np.concatenate([np.asarray(table["op14_m"]) for table in tables]),
            np.concatenate([np.asarray(table["is_sequence_start"]) for table in tables]),
            rate_hz=rate_hz,
        )
    )
    people = read_people(store, take, "op14_m")
    scores = []
    for person in range(people.shape[1]):
        world = resample_positions(people[:, person], from_hz=float(facts["rate_hz"]), to_hz=rate_hz)
        scores += parallel_view_scores(
            searcher,
            world,
            rate_hz=rate_hz,
            item=shard.name if people.shape[1] == 1 else f"{shard.name} person {person}",
            yaws_deg=shard.parameters["yaws_deg"],
            stream=lambda condition, view, person=person: stream(  # type: ignore[misc]
                shard.seed, "evaluation", TOPIC, shard.name, person, condition, view
            ),
        )
    note = (
        f"{shard.name}: {searcher.database.num_projections:,} projections; best_of_50 is a mark that knows the truth."
    )
    return TopicResult(scores=scores, notes=[note])
