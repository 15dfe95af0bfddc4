"""The study of the published projection database over its real files: planned, and refused where they are not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flows.console.app import run_command_line


def plan(folder: Path, store: Path) -> int:
    settings = [f"ingest.pairs.database.folder={folder / 'rotations'}", f"ingest.pairs.unseen.folder={folder}"]
    spelled = [word for setting in settings for word in ("--set", setting)]
    return run_command_line(["plan", "projection_paper", *spelled, "--store", str(store), "--json"])


def test_the_study_of_the_published_database_plans_over_its_files(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan(data_dir / "projection_db_yiannakides", tmp_path / "store") == 0
    stages = {stage["stage"]: stage for stage in json.loads(capsys.readouterr().out)["stages"]}
    assert {shard["partition"] for shard in stages["ingest"]["shards"]} == {
        "91_13",
        "waltz",
        *(f"clip_{number}" for number in range(25)),
    }
    assert list(stages) == ["ingest", "projections", "reconstruction", "evaluation"]


def test_missing_rotations_are_named_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plan(tmp_path, tmp_path / "store") == 2
    assert "file 0 does not exist" in capsys.readouterr().err
    assert not (tmp_path / "store").exists()
