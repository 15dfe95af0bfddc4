"""Studies of files that do not come with the program, over the real files: planned, and nothing begun."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flows.console.app import run_command_line


@pytest.mark.parametrize(
    ("study", "folders", "takes", "chains"),
    [
        ("cmu_salsa", {"salsa": "cmu_salsa_bvh"}, {"salsa_01", "salsa_02", "salsa_03"}, "pending"),
        (
            "projection_paper",
            {"database": "projection_db_yiannakides/rotations", "unseen": "projection_db_yiannakides"},
            {"91_13", "waltz", *(f"clip_{number}" for number in range(25))},
            None,
        ),
    ],
)
def test_a_study_plans_over_its_files(
    data_dir: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    study: str,
    folders: dict[str, str],
    takes: set[str],
    chains: str | None,
) -> None:
    settings = [f"--set=ingest.pairs.{name}.folder={data_dir / folder}" for name, folder in folders.items()]
    assert run_command_line(["plan", study, *settings, "--store", str(tmp_path / "store"), "--json"]) == 0
    stages = {stage["stage"]: stage for stage in json.loads(capsys.readouterr().out)["stages"]}
    assert {shard["partition"] for shard in stages["ingest"]["shards"]} == takes
    assert stages.get("chains", {}).get("state") == chains
    assert not (tmp_path / "store").exists()
