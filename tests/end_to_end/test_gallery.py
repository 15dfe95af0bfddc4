"""The examples of the gallery: each runs as its own first lines say, and prints what it promises."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.builders.notebooks import run_notebook
from tests.builders.real_study import BuiltStudy
from tests.builders.toy_runs import ROOT

EXAMPLES = ROOT / "examples"
ALONE = {
    "custom_density.py": r"draw 80: right wrists \d\.\d cm apart",
    "live_printed.py": r"image 81: person 1 in frame 75 is at ",
    "practice_2d.py": r"hug.csv: 60 frames of two people",
    "object_between_two.py": r"B at 1.15: pass; wrists within \d mm",
    "retarget_hug_to_child.py": r"B-uniform-0.60: pass, contacts drift by \d\.\d mm \(plain kinematics \d\d\d\.",
    "three_people.py": r"C at 1.2: pass, contacts drift by \d\.\d mm\nmean movement: A \d\.\d cm, B \d\.\d cm, C \d\d",
}
"""Examples that need nothing, and what they print."""
ON_A_STORE = {
    "compare_two_runs.sh": r"augmentation\.scales",
    "curate_variants.sh": r"left out, as somebody rejected it: 1 of variants",
    "custom_export_format.py": r"joints/waltz\.json",
    "restart_a_chain.sh": r"new draws: pasdedeux show draws:small-restart-",
}
"""Examples that need a study that was built."""
TESTED_ELSEWHERE = (
    "train_on_windows.py",
    "train.ipynb",
    "best_variants.py",
    "practice_film.py",
    "look.ipynb",
    "film.ipynb",
)


def _run(words: Sequence[str | Path], folder: Path, **environment: str) -> str:
    """Run an example in an empty folder, with the command line of this environment; return what it printed."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), **environment}
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_every_example_is_run_by_a_test_and_shown_on_the_page() -> None:
    page = (ROOT / "docs" / "gallery.md").read_text()
    for path in EXAMPLES.iterdir():
        if path.is_file():
            assert path.name in page
            assert path.name in {*ALONE, *ON_A_STORE, *TESTED_ELSEWHERE}


@pytest.mark.slow
@pytest.mark.parametrize("name", ALONE)
def test_an_example_prints_what_it_promises(name: str, tmp_path: Path) -> None:
    assert re.search(ALONE[name], _run([sys.executable, EXAMPLES / name], tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_A_STORE)
def test_an_example_works_on_a_store(name: str, small: BuiltStudy, tmp_path: Path, prefect_home: Path) -> None:
    store, example = small.copy_store(tmp_path), EXAMPLES / name
    if name.endswith(".py"):
        words = [sys.executable, example, "poses:small", "--store", store, "--out", "joints"]
    else:
        words = ["sh", example, small.study if name.startswith("compare") else "small", store]
    assert re.search(ON_A_STORE[name], _run(words, tmp_path, PREFECT_HOME=str(prefect_home)))


@pytest.mark.slow
def test_the_notebook_looks_at_a_store(small: BuiltStudy, tmp_path: Path) -> None:
    shown = run_notebook("look.ipynb", f'store, study = {str(small.store)!r}, "small"', tmp_path)
    assert re.search(r"^\d+ variants: \d\.\d\d mm, baseline \d+ mm$", shown, re.MULTILINE)
