"""Who computes a study does not matter: one worker, two workers and no worker at all give the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.real_study import BuiltStudy, RealRun, build_here, digests

pytestmark = pytest.mark.slow


def test_this_process_alone_gives_the_same_bytes_as_two_workers(small: BuiltStudy, tmp_path: Path) -> None:
    build_here(small.study, tmp_path / "store")
    assert digests(tmp_path / "store") == digests(small.store)


def test_one_worker_gives_the_same_bytes_as_two(small: BuiltStudy, tmp_path: Path, prefect_home: Path) -> None:
    run = RealRun("run", small.study, "--store", tmp_path / "store", "--workers", "1", prefect_home=prefect_home)
    answer = run.finish()
    assert answer.code == 0, answer.err
    assert digests(tmp_path / "store") == digests(small.store)
