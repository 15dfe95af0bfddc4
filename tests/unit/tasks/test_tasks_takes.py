"""Poses of takes are read by what their rows say of person and frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Store
from tasks.evaluation.ground_truth import GroundTruth
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
