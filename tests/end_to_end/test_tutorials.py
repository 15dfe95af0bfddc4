"""The commands of a tutorial run as they are printed, one after another, in an empty folder."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from flows.console.app import run_command_line
from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.bvh_writer import write_bvh

pytestmark = pytest.mark.slow
TUTORIALS = Path(__file__).parents[2] / "docs" / "tutorials"


def test_two_bvh_files_become_files_of_variants(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefect_home: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PREFECT_HOME", str(prefect_home))
    for letter, motion in zip("AB", make_duet("hug", duration_s=2.0, rate_hz=30.0).motions, strict=True):
        (tmp_path / f"hug_{letter}.bvh").write_text(write_bvh(motion, units_per_metre=100.0, decimals=6))
    text = (TUTORIALS / "two-bvh-files.md").read_text(encoding="utf-8")
    lines = "".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).splitlines()
    assert len(lines) == 6
    for line in lines:
        assert run_command_line(shlex.split(line)[1:]) == 0, line
    named = re.findall(r"`([\w.-]+\.A\.bvh)`", text)
    assert named
    assert [name for name in named if not list((tmp_path / "bvh").rglob(name))] == []
    assert list((tmp_path / "glb").rglob("*.glb"))
    for folder in ("bvh", "glb"):
        assert (tmp_path / folder / "UNITS.txt").is_file()
        assert (tmp_path / folder / "CREDITS.txt").is_file()
