"""Publishing: a version of exactly one finished run where all gates hold, with what changed; else which do not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flows.console.app import run_command_line
from flows.gates import Figure, Gate
from flows.study import StudyError, load_study
from storage_schema import Dataset, Store, list_datasets, open_table
from tests.builders.toy_runs import STUDY, build_here, write_study
from tests.builders.toys import TOYS

PUBLISH = '[publish]\nname = "released"\ngates = ["models.total.sum >= 1", "verdict.judge <= warn"]\n'


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Build without Prefect and Dask."""
    build_here(monkeypatch)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """The toy study with values that are not rounded away, and what it publishes."""
    return write_study(tmp_path, f"{STUDY}[bend]\nstep = 1\n{PUBLISH}")


def run(study: Path, *more: str) -> int:
    return run_command_line(["run", str(study), "--store", str(study.parent / "store"), *more], graph=TOYS)


def versions(study: Path) -> list[Dataset]:
    return list_datasets(Store(study.parent / "store"))


def changes(dataset: Dataset) -> str:
    return (dataset.path / "CHANGES.md").read_text()


def test_a_run_whose_gates_hold_becomes_a_version_of_all_it_made(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(study) == 0
    assert "released@1 is published" in capsys.readouterr().out
    (made,) = versions(study)
    assert {ref.stage for ref in made.refs} == set(TOYS.names)
    assert "The first version" in changes(made)
    assert json.loads((made.path / "study.json").read_text())["publish"]["name"] == "released"
    assert {path.name for path in made.path.iterdir()} == {
        *("dataset.json", "CHANGES.md", "study.json", "environment.json")
    }


def test_nothing_new_makes_no_new_version(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(study) == run(study) == 0
    assert "released@1 stays: nothing has changed" in capsys.readouterr().out
    assert run(study, "--force", "bend", "--json") == 0
    published = json.loads(capsys.readouterr().out)["published"]
    assert (published["dataset"], published["failures"]) == ("released@1", [])
    assert len(versions(study)) == 1
    (study.parent / "source.txt").write_text("whose bytes change nothing but keys")
    store = Store(study.parent / "store")
    assert run(study, "--set", f"grow.source={study.parent / 'source.txt'}") == 0
    assert len(list(store.artifacts("grow"))) == 12, "every key is another one"
    assert "released@1 stays: nothing has changed" in capsys.readouterr().out
    assert len(versions(study)) == 1


def test_the_changelog_says_what_came_went_and_changed_and_the_scores(study: Path) -> None:
    assert run(study) == 0
    before = open_table("scores:released@1", study.parent / "store")["value"][0]
    assert run(study, "--set", "grow.num_takes=3", "--set", "aside.size=5") == 0
    after = open_table("scores:released@2", study.parent / "store")["value"][0]
    said = changes(versions(study)[-1])
    assert "Beside released@1:" in said
    for line in (
        "| grow.num_takes | 2 | 3 |",
        "| grow | t2 | 3 |  |  |  |",
        "| aside | aside |  |  | 1 |  |",
        f"| models total sum | {before:.5g} | {after:.5g} |  |",
    ):
        assert line in said
    assert "| grow | t0 |" not in said
    assert run(study, "--set", "aside.size=5") == 0
    assert "| grow | t2 |  | 3 |  |  |" in changes(versions(study)[-1])


@pytest.mark.parametrize(
    ("gate", "words"),
    [
        ("models.total.sum < 1", r"models.total.sum < 1: it is \d+ (all)"),
        ("models.total.mean < 1", "there is no such figure; methods: sum"),
        ("models.total.sum[held_out] < 1", "there is no such figure; parts: all"),
        ("models.total.sum > 1 cm", "the figure is in no unit"),
        ("verdict.judge.all <= pass", "all all is warn, made for a test"),
        ("verdict.grow <= pass", "there is no such verdict"),
    ],
)
def test_a_gate_that_does_not_hold_publishes_nothing_and_is_named_with_the_figure(
    study: Path, capsys: pytest.CaptureFixture[str], gate: str, words: str
) -> None:
    study.write_text(study.read_text().replace("verdict.judge <= warn", gate))
    assert run(study) == 1
    said = capsys.readouterr()
    lines = said.err.splitlines()[-2:]
    assert lines[0] == "error: released is not published: 1 of 2 gates do not hold"
    assert words.split(r"\d+")[0] in lines[1]
    assert words.split(r"\d+")[-1] in lines[1]
    assert versions(study) == []
    assert "done: " in said.out
    assert run(study) == 1, "also where everything is fresh: a schedule must notice"
    study.write_text(study.read_text().replace(gate, "models.total.sum > 1"))
    assert run(study) == 0
    assert len(versions(study)) == 1, "a gate put right is answered from what is there"


def test_a_part_of_a_study_is_not_published(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(study, "--until", "bend") == 0
    assert "released is not published: this is not the whole of the study" in capsys.readouterr().out
    assert versions(study) == []


@pytest.mark.parametrize(
    ("gates", "words"),
    [
        ('["model.total.sum < 1"]', "no topic 'model' has scores; topics: models"),
        ('["models.totl.sum < 1"]', "topic models has no metric 'totl'; metrics: total"),
        ('["verdict.juge <= pass"]', "no stage 'juge'; stages: aside, grow, bend, judge"),
        ('["verdict.judge <= fail"]', "a verdict is at most pass or warn"),
        ('["models.total < 1"]', "is no gate: a gate is TOPIC.METRIC.METHOD <= NUMBER UNIT"),
        ('["models.total.sum < 1e"]', "1e is no number"),
        ("[]\nnam = 1", "publish.nam: unknown; did you mean name?"),
    ],
)
def test_gates_that_nothing_can_answer_are_refused_while_planning(study: Path, gates: str, words: str) -> None:
    study.write_text(f"{STUDY}[publish]\ngates = {gates}\n")
    with pytest.raises(StudyError) as error:
        load_study(str(study), TOYS, environment={})
    assert words in str(error.value)


def test_what_a_study_publishes_is_not_inherited(study: Path) -> None:
    child = study.with_name("child.toml")
    child.write_text('[study]\nname = "child"\nextends = "toy.toml"\n')
    assert load_study(str(child), TOYS, environment={})[0].publish is None


def test_a_gate_holds_of_every_part_and_reads_lengths_in_its_own_unit() -> None:
    figures = {
        Figure("lifting", "error", "fitted", "annotated", "all", None): (0.04, "m"),
        Figure("lifting", "error", "fitted", "held_out", "all", None): (0.12, "m"),
        Figure("lifting", "error", "fitted", "held_out", "all", 3.0): (9.0, "m"),
    }
    assert Gate.parse("lifting.error.fitted <= 12 cm").failure([], figures) == ""
    assert Gate.parse("lifting.error.fitted[annotated] <= 40 mm").failure([], figures) == ""
    failure = Gate.parse("lifting.error.fitted < 12 cm").failure([], figures)
    assert failure == "lifting.error.fitted < 12 cm: it is 12 cm (held_out)"
    broken = {**figures, Figure("lifting", "error", "fitted", "all", "waltz", None): (None, "m")}
    assert "it is not a number (waltz)" in Gate.parse("lifting.error.fitted <= 1 m").failure([], broken)
