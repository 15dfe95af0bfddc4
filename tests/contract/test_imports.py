"""What may import what, and what the command line must not import before there is work."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import typer

from flows.console.app import COMMANDS
from flows.console.context import app
from pasdedeux.threads import THREAD_VARIABLES
from tests.builders.toy_runs import ROOT, run_toys, write_study

CONSOLE = ROOT / "flows" / "console"
_PROBE = """
import sys
from flows.console.app import run_command_line
graph = None
if "--store" in sys.argv and "duets" not in sys.argv:
    from tests.builders.toys import TOYS as graph
code = run_command_line(sys.argv[1:], graph=graph)
print("CODE", code)
print("LOADED", *sorted(name for name in sys.modules if name.partition(".")[0] in {names!r}))
"""


def run_python(script: str, *arguments: str, environment: Mapping[str, str] = os.environ) -> str:
    """Run a script in the checkout and return what it prints."""
    command = [sys.executable, "-c", script, *arguments]
    ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def loaded(names: set[str], *arguments: str) -> list[str]:
    """Return which of these packages a command has imported."""
    printed = run_python(_PROBE.format(names=names), *arguments)
    assert "CODE 0" in printed
    return printed.splitlines()[-1].split()[1:]


def test_imports_run_one_way() -> None:
    run_python("from importlinter.cli import lint_imports_command; lint_imports_command()")


def test_only_the_shards_of_the_tasks_speak_to_dask() -> None:
    speakers = {
        path.relative_to(ROOT / "tasks").parts[0]
        for path in (ROOT / "tasks").rglob("*.py")
        if re.search(r"^\s*(from|import) (dask|distributed)\b", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert speakers == {"shards"}


def test_planning_and_a_run_with_nothing_to_do_import_neither_prefect_nor_dask(tmp_path: Path) -> None:
    study, store = write_study(tmp_path), tmp_path / "store"
    run_toys(study, store)
    orchestration = {"prefect", "dask", "distributed"}
    assert loaded(orchestration, "plan", str(study), "--store", str(store)) == []
    assert loaded(orchestration, "run", str(study), "--store", str(store)) == []


def test_planning_every_stage_imports_nothing_heavy(tmp_path: Path) -> None:
    heavy = {"prefect", "dask", "distributed", "numba", "scipy", "matplotlib", "jinja2", "cv2", "arviz_stats"}
    assert loaded(heavy | {"pandas", "torch"}, "plan", "duets", "--store", str(tmp_path)) == []


def test_help_imports_neither_the_science_nor_what_it_stands_on() -> None:
    # Names of variables that must be set before numpy is imported.
    light = ["pasdedeux", "pasdedeux.plain_text", "pasdedeux.threads"]
    assert loaded({"pasdedeux", "storage_schema", "tasks", "numpy", "pyarrow", "pydantic"}, "--help") == light


def test_what_stands_for_a_command_until_it_is_called_is_what_its_module_adds() -> None:
    adding = [
        path.stem
        for path in CONSOLE.glob("*.py")
        if re.search(r"\bapp\.(command|add_typer)\(", path.read_text("utf-8"))
    ]
    assert sorted(adding) == sorted(COMMANDS), "one file a command, with its name"
    for name in adding:
        importlib.import_module(f"flows.console.{name}")
    added = typer.main.get_group(app).commands
    assert {name: command.get_short_help_str(1000) for name, command in added.items()} == COMMANDS


def test_commands_have_one_thread_for_linear_algebra_unless_the_environment_says_otherwise() -> None:
    script = """
from contextlib import suppress
from flows.console import main
with suppress(SystemExit):
    main(["show", "--help"])
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
print(sorted({pool["num_threads"] for pool in threadpool_info()}))
"""
    names = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    two = dict.fromkeys(THREAD_VARIABLES, "2")
    for stated, threads in ({}, "[1]"), (two, "[2]"), ({"OMP_NUM_THREADS": "2"}, "[2]"):
        assert run_python(script, environment=names | stated).splitlines()[-1] == threads
