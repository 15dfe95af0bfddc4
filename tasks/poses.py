"""Reading the poses of takes: how many people there are, and everybody's rows in order."""

from __future__ import annotations

import numpy as np

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Store
from tasks.facts import TakeFacts


def read_poses(store: Store, ref: ArtifactRef, *columns: str) -> dict[str, np.ndarray]:
    """Return columns of a take's poses as (frame, person, ...), float64, by what the rows say of frame and person.

    Raises:
        InputError: Somebody is missing in a frame, or is there twice.
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
