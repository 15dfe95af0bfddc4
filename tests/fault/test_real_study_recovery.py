"""A real study that is killed: the same command finishes it, bit for bit; interrupts and lost workers are toys'.

Every run is the command line in a process of its own with Prefect's server and two Dask workers.  What is compared is
every artifact of the study with that of an undisturbed run, and when each was made: nothing is computed twice.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from storage_schema import Store, verify
from tests.builders.real_study import BuiltStudy, RealRun, committed, digests, wait_until_gone

pytestmark = pytest.mark.slow

MOMENTS = (13, 26)
"""Artifacts that are there when the run is killed: in chains, in evaluation."""


def start(small: BuiltStudy, store: Path, prefect_home: Path) -> RealRun:
    return RealRun("run", small.study, "--store", store, "--workers", "2", "--oversubscribe", prefect_home=prefect_home)


def test_a_run_that_is_killed_twice_loses_only_the_shards_in_work(
    small: BuiltStudy, tmp_path: Path, prefect_home: Path
) -> None:
    store = tmp_path / "store"
    kept: dict[tuple[str, str, str], str] = {}
    for count in MOMENTS:
        run = start(small, store, prefect_home)
        run.wait_for_artifacts(store, count)
        left = run.kill()
        assert len(left) >= 3, "two workers and Prefect's server"
        wait_until_gone(left)
        found = committed(store)
        assert kept.items() <= found.items(), "an artifact of an earlier run was computed again"
        kept = found
        assert verify(Store(store)).is_ok

    answer = start(small, store, prefect_home).finish()
    assert answer.code == 0, answer.err
    assert kept.items() <= committed(store).items()
    everything = digests(small.store)
    assert f"done: {len(everything) - len(kept)} shards computed" in answer.out
    assert digests(store) == everything
    assert list((store / "tmp").iterdir()) == [], "what the killed runs were writing was cleared away"
    assert verify(Store(store)).is_ok
