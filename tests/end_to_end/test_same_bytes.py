"""Who computes a study does not matter: two workers and no worker at all give the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from storage_schema import Store, read_latest
from tasks.shards import run
from tasks.stage import Parameters, Shard
from tests.builders.real_study import BuiltStudy, RealRun, digests


def test_a_shard_computes_with_one_thread_whatever_its_process_was_started_with(tmp_path: Path) -> None:
    """With two, OpenBLAS adds up in another order, and the models of a longer study come out with other bytes."""

    def count_threads(shard: Shard, store: Store) -> Any:
        return {library["num_threads"] for library in threadpool_info()}

    shard = Shard(stage="grow", version=1, partition="t0", name="s0", parameters=Parameters())
    with threadpool_limits(limits=2):
        assert run(count_threads, shard, str(tmp_path))[0] == {1}
        assert count_threads(shard, Store(tmp_path)) == {2}


@pytest.mark.slow
def test_a_rerun_from_the_record_without_workers_gives_the_same_bytes_as_two_workers(
    small: BuiltStudy, tmp_path: Path, prefect_home: Path
) -> None:
    latest = read_latest(Store(small.store), "small")
    assert latest is not None
    stores = ("--from", small.store, "--store", tmp_path / "store")
    run = RealRun("rerun", latest.run_id, *stores, "--workers", "0", "--json", prefect_home=prefect_home)
    answer = run.finish()
    assert answer.code == 0, answer.err
    assert answer.json["num_same_bytes"] == len(digests(small.store))
    assert digests(tmp_path / "store") == digests(small.store)
