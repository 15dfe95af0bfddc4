"""The commands of a tutorial run as they are printed, one after another, in an empty folder; so do the examples.

They build in this process: that workers make the same of a study is shown elsewhere.
"""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from flows.console.app import run_command_line
from flows.exports.export_format import _CODECS
from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.bvh_writer import write_bvh
from tests.builders.notebooks import run_notebook
from tests.builders.toy_runs import ROOT

pytestmark = pytest.mark.slow
TUTORIALS = ROOT / "docs" / "tutorials"


def follow(page: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """Run every command and piece of Python of a tutorial in this folder, but installations; return how many."""
    text = (TUTORIALS / page).read_text(encoding="utf-8")
    count = 0
    for language, block in re.findall(r"```(sh|python)\n(.*?)```", text, re.DOTALL):
        if language == "python":
            exec(compile(block, page, "exec"), {})
            count += 1
            continue
        for line in block.splitlines():
            program, *words = shlex.split(line)
            if program == "pasdedeux":
                assert run_command_line(words) == 0, line
            elif program == "python":
                monkeypatch.setattr(sys, "argv", words)
                runpy.run_path(str(ROOT / words[0]), run_name="__main__")
            else:
                assert program == "pip", line
            count += 1
    return count


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_this_process: None) -> Path:
    """Return an empty folder in which commands run."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_two_bvh_files_become_files_of_variants(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for letter, motion in zip("AB", make_duet("hug", duration_s=2.0, rate_hz=30.0).motions, strict=True):
        (here / f"hug_{letter}.bvh").write_text(write_bvh(motion, units_per_metre=100.0, decimals=6))
    assert follow("two-bvh-files.md", monkeypatch) == 6
    named = re.findall(r"`([\w.-]+\.[AB]\.bvh)`", (TUTORIALS / "two-bvh-files.md").read_text(encoding="utf-8"))
    assert named
    assert [name for name in named if not list((here / "bvh").rglob(name))] == []
    assert list((here / "glb").rglob("*.glb"))
    for folder in ("bvh", "glb"):
        assert (here / folder / "UNITS.txt").is_file()
        assert (here / folder / "CREDITS.txt").is_file()


def test_2d_poses_become_pairs_and_motion(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert follow("2d-poses.md", monkeypatch) == 9
    assert list((here / "lifted").glob("*.glb"))
    assert (here / "lifted" / "look.html").is_file()
    assert sorted(path.name for path in (here / "motion").glob("*.bvh")) == ["hug.A.bvh", "hug.B.bvh"]


def test_a_film_becomes_motion(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(_CODECS, ".mp4", "mp4v")  # 50 times as fast as VP9
    assert follow("film.md", monkeypatch) == 5
    assert (here / "next.jpg").is_file()
    out = {path.name for path in (here / "out").iterdir()}
    assert out >= {"dance_0.bvh", "dance_1.bvh", "dance.glb", "dance.html", "dance_units.txt", "dance_people.csv"}
    shown = run_notebook("film.ipynb", 'folder, name = "out", "dance"', here)
    assert re.search(r"60 frames at 30 Hz; distance \d\.\d\d to \d\.\d\d m", shown)


def test_a_dataset_becomes_a_trained_network(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    assert follow("train.md", monkeypatch) == 8
    assert (here / "duets-1" / "index.html").is_file()
