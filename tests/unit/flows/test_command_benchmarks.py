"""Benchmarks of commands and of growth: found by their names, and small ones measured."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import commands, registry, scale
from benchmarks.benchmark import BenchmarkResult
from benchmarks.registry import BENCHMARKS
from benchmarks.scale import grown
from flows.console import bench
from flows.console.app import run_command_line
from flows.study import load_study
from tasks.graph import load_graph
from tests.builders.command_line import CommandLine


def test_commands_and_scale_have_benchmarks_beside_the_stages() -> None:
    assert list(BENCHMARKS["commands"]) == ["status", "demo"]
    assert set(BENCHMARKS["full-scale"]) == {*BENCHMARKS["scale"], "takes"}
    files = Path(registry.__file__).parent.glob("*.py")
    named = {path.stem for path in files if re.search("^BENCHMARKS\\b", path.read_text("utf-8"), re.MULTILINE)}
    assert named - {"registry"} == set(BENCHMARKS) - {"full-scale"}


def test_status_is_measured_on_a_store_of_that_many_artifacts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "_NUM_ARTIFACTS", 50)
    monkeypatch.setattr(commands, "measure_rate", lambda name, work, count: (name, count / len(list(work()))))
    result = commands.BENCHMARKS["status"]()
    assert result.plain_per_s == 1.0, "the plain form reads one manifest for each artifact"


def test_whole_commands_run_only_if_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    measured: list[str] = []

    def counted(name: str) -> BenchmarkResult:
        measured.append(name)
        return BenchmarkResult(name, "runs", "fast", 2.0, "plain", 1.0)

    names = ("chains", "full-scale", "commands")
    monkeypatch.setattr(registry, "BENCHMARKS", {n: {n: partial(counted, n)} for n in names})
    assert run_command_line(["bench"]) == run_command_line(["bench", "commands"]) == 0
    assert measured == ["chains", "commands"]
    capsys.readouterr()


def test_a_demo_that_fails_is_one_sentence(monkeypatch: pytest.MonkeyPatch, invoke: CommandLine) -> None:
    failing = [sys.executable, "-c", "import sys; sys.exit('error: no space is left')"]
    plain = subprocess.run
    monkeypatch.setattr(commands.subprocess, "run", lambda _, **how: plain(failing, **how))
    monkeypatch.setitem(BENCHMARKS, "commands", {"demo": commands.BENCHMARKS["demo"]})
    last = invoke("bench", "commands", code=1).err.splitlines()[-1]
    assert last.startswith("error: `pasdedeux run duets --workers ")
    assert last.endswith(" failed: no space is left")


def test_benchmarks_need_a_checkout(monkeypatch: pytest.MonkeyPatch, invoke: CommandLine, tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "_ROOT", tmp_path)
    assert invoke("bench", code=2).err == (
        "error: benchmarks are not installed: run this command in a checkout (`pip install --editable .`)\n"
    )


def test_stages_are_measured_on_ever_more_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    def spend(_: int, study: str, *only: str) -> commands._Spent:
        (family,) = load_study(study, load_graph())[0].parameters["ingest"].duets
        assert only == ("--only", "ingest", "--only", "augmentation", "--only", "projections")
        return commands._Spent(1.0, family.count**2.0, 400.0 * family.count, 2.0 * family.count - 1.0)

    monkeypatch.setattr(commands, "_run", spend)
    assert commands.FULL_BENCHMARKS["takes"]().note == (
        "1: 1 s, 400.0 MB memory, 1.0 MB written; 10: 1e+02 s, 4000.0 MB memory, 19.0 MB written; "
        "100: 1e+04 s, 40000.0 MB memory, 199.0 MB written; exponents: time 2.00, memory 1.00, written 1.00"
    )


def test_growth_is_measured_as_an_exponent(monkeypatch: pytest.MonkeyPatch) -> None:
    spent_s = [0.0]

    def spend(size: int) -> None:
        spent_s[0] += size**2 / 1e6

    monkeypatch.setattr(scale, "time", SimpleNamespace(process_time=lambda: spent_s[0]))
    result = grown("a square", "rows", (200, 400, 800), lambda size: partial(spend, size))
    assert "time 2.00, memory " in result.note
    assert result.ratio == pytest.approx(1 / 4)
