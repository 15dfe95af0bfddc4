"""Rows of takes are read by what they say of person and frame, and takes have their sides of a split."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Store
from tasks.evaluation.ground_truth import GroundTruth
from tasks.rows.sides import Side, take_sides
from tasks.rows.takes import read_motion
from tests.builders.storage_rows import put, take_rows

FRAMES, PEOPLE = 5, 3


def put_rows(store: Store, rows: np.ndarray, *, name: str = "jig") -> tuple[ArtifactRef, dict[str, Any]]:
    """Commit a take with these of its rows; gives its columns before that."""
    numbers = np.arange(FRAMES * PEOPLE * 22 * 3, dtype=float).reshape(-1, 22, 3)
    columns, facts = take_rows(name, PEOPLE, FRAMES, body22_m=numbers)
    chosen = {key: [value[row] for row in rows] for key, value in columns.items()}
    return put(store, "ingest", name, {"poses": chosen}, facts).ref, columns


def test_rows_in_any_order_give_everybody_in_every_frame(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ref, columns = put_rows(store, np.random.default_rng(0).permutation(FRAMES * PEOPLE))
    expected = columns["body22_m"].reshape(PEOPLE, FRAMES, 22, 3).swapaxes(0, 1)
    np.testing.assert_array_equal(read_motion(store, ref, "body22_m")["body22_m"], expected)
    np.testing.assert_array_equal(GroundTruth.read(store, [ref], (), column="body22_m").takes["jig"], expected)


@pytest.mark.parametrize(
    "rows",
    [np.arange(1, FRAMES * PEOPLE), np.arange(FRAMES), np.r_[0, 0, 2 : FRAMES * PEOPLE]],
    ids=["a row is gone", "a person is gone", "a row is there twice"],
)
def test_poses_with_somebody_missing_or_twice_are_refused(tmp_path: Path, rows: np.ndarray) -> None:
    store = Store(tmp_path)
    ref, _ = put_rows(store, rows)
    with pytest.raises(InputError, match="do not have each of 3 people once in every frame; build it again"):
        read_motion(store, ref, "body22_m")


@pytest.mark.parametrize(
    ("num_takes", "num_held", "wanted"),
    [
        (1, 0, {"train": 1}),
        (2, 0, {"train": 1, "validation": 1}),
        (10, 0, {"train": 7, "validation": 1, "test": 2}),
        (20, 3, {"train": 15, "validation": 2, "test": 3}),
        (2, 2, {"test": 2}),
    ],
)
def test_held_out_takes_test_and_a_tenth_validates(num_takes: int, num_held: int, wanted: dict[str, int]) -> None:
    takes = {f"take{number}": number < num_held for number in range(num_takes)}
    sides = take_sides(takes)
    assert Counter(side.split for side in sides.values()) == wanted
    assert list(sides) == list(takes)
    assert {name for name, is_held in takes.items() if is_held} <= {n for n, s in sides.items() if s.split == "test"}
    assert all(side.reason for side in sides.values())
    assert take_sides(dict(reversed(takes.items()))) == sides, "order does not matter"


def test_a_take_keeps_its_side_when_others_come() -> None:
    first = take_sides({f"take{number}": False for number in range(10)})
    more = {f"take{number}": False for number in range(40)}
    sides = take_sides(more, known=first)
    assert {name: sides[name] for name in first} == first
    assert Counter(side.split for side in sides.values()) == {"test": 8, "validation": 4, "train": 28}
    known = {"take1": Side("test", "it was so")}
    assert take_sides({"take2": False}, known=known).keys() == {"take2"}
