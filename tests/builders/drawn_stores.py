"""Drawn stores of takes and their variants, for tests of what is cut out of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from storage_schema import Manifest, ShardRecord, Store, record_latest
from tests.builders.moving_pairs import swaying_people
from tests.builders.storage_rows import put, random_columns, take_rows

BATCH = {"scales": [0.9], "persons": ["A"], "kinds": ["uniform"]}


@dataclass(frozen=True)
class Drawn:
    """A take: its interaction (empty: it is one of its own), its frames, the verdicts of its variants, its people.

    With holes, a joint of A is missing in every second frame of the variants.
    """

    interaction: str
    num_frames: int
    is_held_out: bool
    verdicts: tuple[str, ...]
    num_people: int = 2
    has_holes: bool = False


def motion(number: int, num_frames: int, num_people: int = 2) -> Any:
    """Return the people of a take (frame, person, 22, 3): no two frames are alike, who stands behind comes nearer."""
    people = swaying_people(num_people, num_frames, seed=number)
    people[..., 2] -= np.linspace(0.0, 0.25, num_frames)[:, None, None] * np.arange(num_people)[:, None]
    return people


def aside(index: int) -> Any:
    """Return how far a variant of a take is from it, metres."""
    return np.array([1.0 + index, 0.0, 0.0])


def put_take(store: Store, number: int, drawn: Drawn) -> Manifest:
    name = f"take-{number}"
    people_m = np.swapaxes(motion(number, drawn.num_frames, drawn.num_people), 0, 1)
    count, rows = drawn.num_people, people_m.reshape(-1, 22, 3)
    columns, facts = take_rows(name, count, drawn.num_frames, is_held_out=drawn.is_held_out, body22_m=rows)
    columns["body22_world_unitquat"] = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 22, 1))
    people = {**random_columns("takes", count), "take_id": [name] * count, "person": range(count)}
    people["body22_rest_m"] = people_m[:, 0] - people_m[:, 0, :1]
    parameters = {"duet": {"name": drawn.interaction}} if drawn.interaction else {}
    return put(store, "ingest", name, {"poses": columns, "takes": people}, facts, **parameters)


def put_variants(store: Store, take: Manifest, number: int, drawn: Drawn) -> Manifest:
    """Commit variants that are the take, each further to the side than the one before."""
    names = [f"v{index}" for index in range(len(drawn.verdicts))]
    motions = [motion(number, drawn.num_frames, drawn.num_people) + aside(index) for index in range(len(names))]
    if drawn.has_holes:
        for people in motions:
            people[::2, 0, 7, 1] = np.nan
    rows = np.concatenate(motions).reshape(-1, 22, 3)
    count = drawn.num_people
    each = drawn.num_frames * count
    variants = {
        **random_columns("variants", len(rows)),
        "take_id": [take.name] * len(rows),
        "variant_id": np.repeat(names, each).tolist(),
        "frame": np.tile(np.repeat(np.arange(drawn.num_frames), count), len(names)),
        "person": np.tile(range(count), len(rows) // count),
        "body22_m": rows,
    }
    quality = random_columns("variant_quality", len(names))
    quality["bone_scale"] = [np.full(22 * count, 1.0 + 0.1 * index) for index in range(len(names))]
    quality |= {"take_id": [take.name] * len(names), "variant_id": names, "verdict": list(drawn.verdicts)}
    facts = {
        "kind": "variants",
        "takes": [take.name],
        "take_id": take.name,
        "variants": names,
        "told": BATCH | {"variants": names, "contacts": []},
    }
    facts |= {"num_frames": drawn.num_frames, "num_persons": count, "rate_hz": 30.0}
    return put(store, "augmentation", take.name, {"variants": variants, "variant_quality": quality}, facts, (take,))


def drawn_store(folder: str, takes: list[Drawn]) -> tuple[Store, list[Manifest]]:
    store = Store(folder)
    made = [put_take(store, number, drawn) for number, drawn in enumerate(takes)]
    variants = [put_variants(store, take, *drawn) for take, drawn in zip(made, enumerate(takes), strict=True)]
    stages = {"ingest": made, "augmentation": variants}
    record_latest(
        store,
        "drawn",
        "run-1",
        {name: [ShardRecord.of(manifest, store) for manifest in stages[name]] for name in stages},
    )
    return store, made
