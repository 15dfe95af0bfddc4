"""`diff`: what two runs or versions of datasets differ by, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.planning import StageSelection
from flows.staleness import MAX_CHARACTERS, shorten_text
from storage_schema import Store
from tests.builders.command_line import CommandLine
from tests.builders.toy_runs import run_toys, write_study


@pytest.fixture
def runs(tmp_path: Path) -> list[str]:
    """Two runs of the toy study: of more takes at another scale, from another file of the same name."""
    run_ids = []
    for number, settings in enumerate(([], ["grow.num_takes=3", "grow.scale=2.0"])):
        (tmp_path / "source.txt").write_text(str(number))
        settings = ["bend.step=1", f"grow.source={tmp_path / 'source.txt'}", *settings]
        run_ids.append(run_toys(write_study(tmp_path), tmp_path / "store", *settings).run_id)
    environment = tmp_path / "store" / "runs" / run_ids[0] / "environment.json"
    values = json.loads(environment.read_text())
    values["packages"]["numpy"] = "1.0"
    environment.write_text(json.dumps(values))
    return run_ids


@pytest.fixture
def toys(store: Store, invoke_toys: CommandLine) -> CommandLine:
    """Return the commands on the store."""
    return invoke_toys.at(store)


def test_two_runs_differ_by_what_was_changed_between_them(runs: list[str], toys: CommandLine) -> None:
    answer = toys("diff", *runs, "--json").json
    assert answer["parameters"] == {"grow.num_takes": {"a": "2", "b": "3"}, "grow.scale": {"a": "1.0", "b": "2.0"}}
    assert list(answer["environment"]) == ["packages.numpy"]
    assert {name.split()[-1] for name in answer["files"]} == {"source.txt"}
    assert answer["artifacts"]["aside"] == {"same": 1, "other": 0, "only_a": 0, "only_b": 0}
    assert answer["artifacts"]["grow"] == {"same": 0, "other": 6, "only_a": 0, "only_b": 3}
    (score,) = answer["scores"]
    assert (score["metric"], score["at"], answer["num_scores"]) == ("total", None, 1)
    assert score["a"] != score["b"]

    out = toys("diff", *runs).out
    for words in ("parameters: 2 differ\n", "environment: 1 differs\n", "scores: 1 of 1 differ"):
        assert words in out
    assert [len(line.split()) for line in out.splitlines() if line.startswith("  grow.scale")] == [3]
    assert max(map(len, out.splitlines())) < 120


def test_a_partial_run_has_all_licences_of_its_inputs(runs: list[str], tmp_path: Path, toys: CommandLine) -> None:
    part = StageSelection(only=("bend",), force=("bend",))
    settings = ("bend.step=1", f"grow.source={tmp_path / 'source.txt'}", "grow.num_takes=3", "grow.scale=2.0")
    last = run_toys(tmp_path / "toy.toml", tmp_path / "store", *settings, selection=part).run_id
    assert toys("diff", runs[1], last, "--json").json["licences"] == {}


def test_a_dataset_differs_from_an_older_run_as_its_own_run_does(runs: list[str], toys: CommandLine) -> None:
    toys("dataset", "create", "last", "--study", "toy")
    assert "there is no run 'last'" in toys.refusal("diff", "last@1", "last")
    of_dataset, of_run = (toys("diff", runs[0], name, "--json").json for name in ("last@1", runs[1]))
    assert of_dataset == {**of_run, "b": "last@1"}
    out = toys("diff", runs[1], "last@1").out
    for name in ("parameters", "environment", "files"):
        assert f"{name}: nothing differs" in out
    assert "scores: 0 of" in out


@given(st.text(max_size=3 * MAX_CHARACTERS))
def test_a_text_is_shown_as_it_is_or_its_beginning_as_long_as_allowed(text: str) -> None:
    shown = shorten_text(text)
    assert len(shown) == min(len(text), MAX_CHARACTERS)
    assert shown == text or text.startswith(shown.removesuffix("..."))
