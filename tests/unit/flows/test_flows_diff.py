"""`diff`: what two runs or versions of datasets differ by, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.planning import StageSelection
from flows.reasons import MAX_CHARACTERS, shorten_text
from tests.builders.toy_runs import call, run_toys, write_study


@pytest.fixture
def runs(tmp_path: Path) -> list[str]:
    """Two runs of the toy study: of more takes at another scale, from another file of the same name."""
    found = []
    for number, settings in enumerate(([], ["grow.num_takes=3", "grow.scale=2.0"])):
        (tmp_path / "source.txt").write_text(str(number))
        settings = ["bend.step=1", f"grow.source={tmp_path / 'source.txt'}", *settings]
        found.append(run_toys(write_study(tmp_path), tmp_path / "store", *settings).run_id)
    environment = tmp_path / "store" / "runs" / found[0] / "environment.json"
    values = json.loads(environment.read_text())
    values["packages"]["numpy"] = "1.0"
    environment.write_text(json.dumps(values))
    return found


def test_two_runs_differ_by_what_was_changed_between_them(
    runs: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ("diff", *runs, "--store", str(tmp_path / "store"))
    assert call(*line, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["parameters"] == {"grow.num_takes": {"a": "2", "b": "3"}, "grow.scale": {"a": "1.0", "b": "2.0"}}
    assert list(found["environment"]) == ["packages.numpy"]
    assert {name.split()[-1] for name in found["files"]} == {"source.txt"}
    assert found["artifacts"]["aside"] == {"same": 1, "other": 0, "only_a": 0, "only_b": 0}
    assert found["artifacts"]["grow"] == {"same": 0, "other": 6, "only_a": 0, "only_b": 3}
    (score,) = found["scores"]
    assert (score["metric"], score["at"], found["num_scores"]) == ("total", None, 1)
    assert score["a"] != score["b"]

    assert call(*line) == 0
    out = capsys.readouterr().out
    assert "parameters: 2 differ\n" in out
    assert "environment: 1 differs\n" in out
    assert "scores: 1 of 1 differ" in out
    assert [len(line.split()) for line in out.splitlines() if line.startswith("  grow.scale")] == [3]
    assert max(map(len, out.splitlines())) < 120


def test_a_run_of_a_part_has_the_licences_of_all_that_the_part_was_computed_from(
    runs: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = StageSelection(only=("bend",), force=("bend",))
    settings = ("bend.step=1", f"grow.source={tmp_path / 'source.txt'}", "grow.num_takes=3", "grow.scale=2.0")
    last = run_toys(tmp_path / "toy.toml", tmp_path / "store", *settings, selection=part).run_id
    assert call("diff", runs[1], last, "--store", str(tmp_path / "store"), "--json") == 0
    assert json.loads(capsys.readouterr().out)["licences"] == {}


def test_a_dataset_differs_from_an_older_run_as_its_own_run_does(
    runs: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = ("--store", str(tmp_path / "store"))
    assert call("dataset", "create", "last", "--study", "toy", *store) == 0
    assert call("diff", "last@1", "last", *store) == 2
    assert "there is no run 'last'" in capsys.readouterr().err
    answers = []
    for name in ("last@1", runs[1]):
        assert call("diff", runs[0], name, *store, "--json") == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0]["b"] == "last@1"
    assert answers[0] == {**answers[1], "b": "last@1"}
    assert call("diff", runs[1], "last@1", *store) == 0
    out = capsys.readouterr().out
    for words in (
        "parameters: nothing differs",
        "environment: nothing differs",
        "files: nothing differs",
        "scores: 0 of",
    ):
        assert words in out


@given(st.text(max_size=3 * MAX_CHARACTERS))
def test_a_text_is_shown_as_it_is_or_its_beginning_as_long_as_allowed(text: str) -> None:
    shown = shorten_text(text)
    assert len(shown) == min(len(text), MAX_CHARACTERS)
    assert shown == text or text.startswith(shown.removesuffix("..."))
