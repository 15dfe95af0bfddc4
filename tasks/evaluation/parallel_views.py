"""Topic `parallel_views`: held-out takes on the database's body, seen by parallel rays, as in the paper's tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.evaluation.parallel_views import TOPIC, parallel_view_scores
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import Codebook
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
        # A codebook is of use with exactly the parts it numbers.
        books = [
            book
            for book in inputs.of("codebook")
            if set(book.facts["part_keys"]) == {part.ref.key for part in database}
        ]
        if database:
            found.append(
                make_shard(
                    topic=TOPIC,
                    name=take_id,
                    inputs=[take, *database, *books],
                    parameters={"yaws_deg": list(yaws_deg), "num_parts": len(database)},
                    seed=inputs.seed,
                )
            )
    return found


def run(shard: Shard, store: Store) -> TopicResult:
    """Score one take."""
    take, *others = shard.inputs
    parts, books = others[: shard.parameters["num_parts"]], others[shard.parameters["num_parts"] :]
    facts = store.manifest(take).facts
    used = [store.manifest(part).facts for part in parts]
    refuse_overlap("the projection database", [name for one in used for name in one["takes"]], [shard.name])
    if books:
        by_key = {part.key: part for part in parts}
        parts = [by_key[key] for key in store.manifest(books[0]).facts["part_keys"]]
    tables = [store.read(part, "projections", columns=["op14_m", "is_sequence_start"]) for part in parts]
    rate_hz = float(used[0]["rate_hz"])
    searcher = Searcher.of(
        Database(
            np.concatenate([np.asarray(table["op14_m"]) for table in tables]),
            np.concatenate([np.asarray(table["is_sequence_start"]) for table in tables]),
            rate_hz=rate_hz,
        )
    )
    codebook = None
    if books:
        table = store.read(books[0], "codebook")
        codebook = Codebook(np.asarray(table["representative_m"]), tuple(np.asarray(one) for one in table["members"]))
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
            codebook=codebook,
            stream=lambda condition, view, person=person: stream(  # type: ignore[misc]
                shard.seed, "evaluation", TOPIC, shard.name, person, condition, view
            ),
        )
    note = (
        f"{shard.name}: {searcher.database.num_projections:,} projections; best_of_50 is a mark that knows the truth."
    )
    return TopicResult(scores=scores, notes=[note])
