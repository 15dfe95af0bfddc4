"""A real study that is killed: it is finished bit for bit, and who computes it does not matter.

The run that is killed is the command line in a process of its own with Prefect's server and two Dask workers. This
process, without workers, computes the rest. Interrupts and lost workers are tested on the toys.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from flows.planning import StageSelection
from storage_schema import Store, read_latest, verify
from tasks.shards import run
from tasks.stage import Parameters, Shard
from tests.builders.real_study import (
    BuiltStudy,
    RealRun,
    call_in_process,
    committed,
    digests,
    graph,
    wait_until_gone,
)
from tests.builders.toy_runs import run_toys

KILLED_AT = 7
"""Number of artifacts that are there when the run is killed: before most chains."""


def test_a_shard_computes_with_one_thread_whatever_its_process_was_started_with(tmp_path: Path) -> None:
    """With two, OpenBLAS adds up in another order, and the models of a longer study come out with other bytes."""

    def count_threads(shard: Shard, store: Store) -> Any:
        return {library["num_threads"] for library in threadpool_info()}

    shard = Shard(stage="grow", version=1, partition="t0", name="s0", parameters=Parameters())
    with threadpool_limits(limits=2):
        assert run(count_threads, shard, str(tmp_path))[0] == {1}
        assert count_threads(shard, Store(tmp_path)) == {2}


@pytest.mark.slow
def test_a_run_of_two_workers_that_is_killed_is_finished_without_workers_bit_for_bit(
    small: BuiltStudy,
    tmp_path: Path,
    prefect_home: Path,
    in_this_process: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store = tmp_path / "store"
    arguments = ("run", small.study, "--store", store, "--workers", "2", "--oversubscribe")
    killed = RealRun(*arguments, prefect_home=prefect_home)
    killed.wait_for_artifacts(store, KILLED_AT)
    left = killed.kill()
    assert len(left) >= 3, "two workers and Prefect's server"
    wait_until_gone(left)
    kept = committed(store)
    assert verify(Store(store)).is_ok

    latest, everything = read_latest(Store(small.store), "small"), digests(small.store)
    assert latest is not None
    answer = call_in_process(capsys, "rerun", latest.run_id, "--from", small.store, "--store", store, "--json")
    assert answer.code == 0, answer.err
    assert answer.json["num_same_bytes"] == len(everything)
    assert digests(store) == everything
    assert kept.items() <= committed(store).items(), "nothing is computed twice"
    assert list((store / "tmp").iterdir()) == [], "what the killed run was writing was cleared away"
    assert verify(Store(store)).is_ok


@pytest.mark.slow
def test_stages_before_the_chains_have_the_bytes_of_two_workers_without_any(small: BuiltStudy, tmp_path: Path) -> None:
    run_toys(small.study, tmp_path / "store", selection=StageSelection(until="seeds"), graph=graph())
    alone = digests(tmp_path / "store")
    assert {stage for stage, _, _ in alone} == {"ingest", "priors", "views", "seeds"}
    assert alone.items() <= digests(small.store).items()
