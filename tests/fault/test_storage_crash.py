"""A store survives kill -9 at every step of what writes to it, and the same command afterwards finishes the job."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


def kill_at_every_step(action: str, folder: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.builders.storage_killer", action, str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("action", "min_steps"),
    [
        ("commit", 15),
        ("heal", 15),
        ("replace", 15),
        ("replace_in_two_steps", 15),
        ("record", 5),
        ("dataset", 8),
        ("sweep", 8),
    ],
)
def test_a_store_killed_at_any_step_is_whole_and_the_rerun_finishes(
    tmp_path: Path, action: str, min_steps: int
) -> None:
    found = kill_at_every_step(action, tmp_path)
    assert found["exit"] == 0
    assert len(found["deaths"]) > min_steps
    expected = found["undisturbed"]
    for step, seen in enumerate(found["deaths"]):
        death, rerun = seen["death"], seen["rerun"]
        assert rerun.pop("is_same"), step
        leftovers = rerun.pop("tmp")
        assert rerun == expected, step
        assert death["lost_inputs"] == [], step
        assert expected["problems"] == []
        if not death["datasets"]:
            # A rerun that finds its dataset writes nothing, so it clears nothing away.
            assert leftovers == [], step
        if action == "heal":
            # The damaged artifact is never found; it is the one problem until the new one stands.
            assert death["artifacts"] in ([], expected["artifacts"]), step
            assert len(death["problems"]) <= 1, step
        elif action.startswith("replace"):
            assert death["problems"] == [], step
            assert len(death["artifacts"]) == 1, step
            assert step or death["artifacts"] != expected["artifacts"], "another one was there"
        elif action == "sweep":
            assert death["problems"] == [], step
            assert set(death["artifacts"]) >= set(expected["artifacts"]), step
        else:
            assert death["problems"] == [], step
            assert set(death["artifacts"]) <= set(expected["artifacts"]), step
        assert death["latest"] in ({"record": ["old", "new"]}.get(action, [None])), step
        assert set(death["datasets"]) <= set(expected["datasets"]), step


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fresh", "update"])
def test_a_folder_of_a_dataset_that_was_killed_while_it_was_written_is_the_same_after_the_same_command(
    tmp_path: Path, kind: str
) -> None:
    command = [sys.executable, "-m", "tests.builders.folder_killer", kind, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["exit"] == 0
    assert found["deaths"] > 10
    assert found["differing"] == []
