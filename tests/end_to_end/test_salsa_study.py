"""The salsa study over the real files: planned, and refused before any work where they are not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flows.console.app import run_command_line


def plan(folder: Path, store: Path) -> int:
    setting = f"ingest.pairs.salsa.folder={folder}"
    return run_command_line(["plan", "cmu_salsa", "--set", setting, "--store", str(store), "--json"])


def test_the_salsa_study_plans_over_bvh_pairs(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan(data_dir / "cmu_salsa_bvh", tmp_path / "store") == 0
    stages = {stage["stage"]: stage for stage in json.loads(capsys.readouterr().out)["stages"]}
    assert {shard["partition"] for shard in stages["ingest"]["shards"]} == {"salsa_01", "salsa_02", "salsa_03"}
    assert stages["chains"]["state"] == "pending"
    assert not (tmp_path / "store").exists()


def test_missing_motion_is_named_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plan(tmp_path, tmp_path / "store") == 2
    assert "60_01" in capsys.readouterr().err
    assert not (tmp_path / "store").exists()
