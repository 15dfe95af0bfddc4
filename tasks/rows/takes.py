"""Reading of takes: everybody's motion by frame and person, rest poses and objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError
from pasdedeux.interaction.objects import MovingObjects
from pasdedeux.plain_text import counted
from storage_schema import ArtifactRef, Manifest, Store
from storage_schema.ancestry import inputs_with
from tasks.stage import StageInputs
from tasks.stage.facts import TakeFacts, VariantFacts


@dataclass(frozen=True)
class TakeMotion:
    """A take as the store holds it: its motion, its rest poses (P, 22, 3) and world rotations (T, P, 22, 4)."""

    source: Source
    rest_m: np.ndarray
    world_unitquat: np.ndarray
    time_s: np.ndarray


def rate_of(times_s: np.ndarray) -> float:
    """Return the frames per second of times (row,), rising; 25 of a single one."""
    times = np.unique(times_s)
    return float(1.0 / np.median(np.diff(times))) if len(times) > 1 else 25.0


def by_frame_and_person(
    frame: np.ndarray, person_id: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values (row, ...) as (frame, person, ...), NaN where a person is not there, with the frames and people."""
    frames, rows = np.unique(frame, return_inverse=True)
    people, columns = np.unique(person_id, return_inverse=True)
    arranged = np.full((len(frames), len(people), *values.shape[1:]), np.nan)
    arranged[rows, columns] = values
    return arranged, frames, people


def takes_of(inputs: StageInputs, num_persons: int, *, or_more: bool = False) -> list[Manifest]:
    """Return the takes of so many people, or of at least so many."""
    counts = [(take, TakeFacts.of(take).num_persons) for take in inputs.of("poses")]
    return [take for take, count in counts if count == num_persons or (or_more and count > num_persons)]


def read_motion(store: Store, ref: ArtifactRef, *columns: str) -> dict[str, np.ndarray]:
    """Return columns of a take's poses as (frame, person, ...), float64, arranged by frame and person.

    Raises:
        InputError: A person is missing in a frame, or is there twice.
    """
    table = store.read(ref, "poses", columns=["person", "frame", *columns])
    person, frame = np.asarray(table["person"]), np.asarray(table["frame"])
    order = np.lexsort((person, frame))
    take = TakeFacts.of(store.manifest(ref))
    frames, count = np.unique(frame), take.num_persons
    expected = np.repeat(frames, count), np.tile(np.arange(count), len(frames))
    if not (np.array_equal(frame[order], expected[0]) and np.array_equal(person[order], expected[1])):
        raise InputError(
            f"the poses of take {take.take_id} do not have each of {count} people once in every frame; "
            "build it again with --force"
        )
    return {
        name: np.asarray(table[name], dtype=np.float64)[order].reshape(len(frames), count, *table[name].shape[1:])
        for name in columns
    }


def take_of(store: Store, ref: ArtifactRef) -> ArtifactRef:
    """Return the artifact with the take that variants were made from."""
    return next(inputs_with(store, ref, "poses"))


def read_variants(store: Store, ref: ArtifactRef, index: int | None = None) -> np.ndarray:
    """Return the motions of the variants of an artifact (variant, frame, person, 22, 3), float32, or one of them alone.

    They stand in the order of its `variant_quality`.  Reading all takes the time of reading one, because groups of rows
    hold several.

    Raises:
        InputError: Their number of frames differs from that of their take.
    """
    facts = VariantFacts.of(store.manifest(ref))
    size = facts.num_frames * facts.num_persons
    rows = None if index is None else slice(index * size, (index + 1) * size)
    motions = store.read(ref, "variants", columns=["body22_m"], rows=rows)["body22_m"]
    if not size or len(motions) % size:
        raise InputError(
            f"the variants of take {facts.take_id} do not have {counted(facts.num_frames, 'frame')} of "
            f"{counted(facts.num_persons, 'person')}; build them again with --force"
        )
    return np.asarray(motions.reshape(-1, facts.num_frames, facts.num_persons, *motions.shape[1:]))


def read_rest(store: Store, ref: ArtifactRef) -> np.ndarray:
    """Return everybody's rest pose (person, 22, 3), metres, root at the origin."""
    takes = store.read(ref, "takes", columns=["person", "body22_rest_m"])
    return np.asarray(takes["body22_rest_m"][np.argsort(takes["person"])], dtype=np.float64)


def read_take(store: Store, ref: ArtifactRef) -> TakeMotion:
    """Read a take of any number of people from its artifact.

    Raises:
        InputError: A frame is not finite.
    """
    facts = TakeFacts.of(store.manifest(ref))
    poses = read_motion(store, ref, "time_s", "body22_m", "body22_world_unitquat")
    objects = read_take_objects(store, ref)
    return TakeMotion(
        source=Source(poses["body22_m"], facts.rate_hz, f"take {facts.take_id}", objects=objects),
        rest_m=read_rest(store, ref),
        world_unitquat=poses["body22_world_unitquat"],
        time_s=poses["time_s"][:, 0],
    )


def read_take_objects(store: Store, ref: ArtifactRef) -> MovingObjects | None:
    """Return the objects of a take; None where it has none."""
    if "objects" not in store.manifest(ref).tables:
        return None
    rows = store.read(ref, "objects", columns=["object", "ends_m", "radius_m"])
    names = tuple(dict.fromkeys(map(str, rows["object"])))
    ends = rows["ends_m"].astype(np.float64).reshape(len(names), -1, 2, 3)
    return MovingObjects(
        names, np.ascontiguousarray(np.swapaxes(ends, 0, 1)), rows["radius_m"].reshape(len(names), -1)[:, 0]
    )
