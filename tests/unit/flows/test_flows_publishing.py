"""Publishing: a version of exactly one finished run where verdicts allow it, with what changed; else which do not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flows.console.app import run_command_line
from flows.study import load_study
from flows.study_files import StudyError
from storage_schema import Dataset, Store, list_datasets
from tests.builders.storage_rows import list_as_of_schema_1
from tests.builders.toy_runs import STUDY, write_study
from tests.builders.toys import TOYS

pytestmark = pytest.mark.usefixtures("in_this_process")

PUBLISH = '[publish]\nname = "released"\nrequired = ["judge"]\n'


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """The toy study with values that are not rounded away, and what it publishes."""
    return write_study(tmp_path, f"{STUDY}[bend]\nstep = 1\n{PUBLISH}")


def run(study: Path, *more: str) -> int:
    return run_command_line(["run", str(study), "--store", str(study.parent / "store"), *more], graph=TOYS)


def versions(study: Path) -> list[Dataset]:
    return list_datasets(Store(study.parent / "store"))


def test_a_run_whose_verdicts_do_not_fail_becomes_a_version_of_all_it_made(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(study) == 0
    assert "released@1 is published" in capsys.readouterr().out
    (made,) = versions(study)
    assert {ref.stage for ref in made.refs} == set(TOYS.names)
    assert json.loads((made.path / "study.json").read_text())["publish"]["name"] == "released"
    assert {path.name for path in made.path.iterdir()} == {"dataset.json", "study.json", "environment.json"}


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


def test_a_version_follows_one_of_an_older_schema(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(study) == 0
    list_as_of_schema_1(versions(study)[0].path)
    capsys.readouterr()
    assert run(study) == 0
    assert "released@2 is published" in capsys.readouterr().out
    assert [one.label for one in versions(study)] == ["released@2"]
    store = str(study.parent / "store")
    assert run_command_line(["dataset", "list", "--store", store], graph=TOYS) == 0
    assert "released@1  is of an older schema" in capsys.readouterr().out


def test_a_rebuild_that_stopped_is_published_compared_rerun_and_built_upon(study: Path, tmp_path: Path) -> None:
    store, scale = str(tmp_path / "store"), ("--set", "grow.scale=1.0001")
    assert run(study) == 0
    before = {one.ref for one in Store(store).artifacts("judge")}
    assert run(study, *scale) == 0
    assert {one.ref for one in Store(store).artifacts("judge")} == before, "bend has rounded the difference away"
    assert [one.label for one in versions(study)] == ["released@1", "released@2"]
    for line in (
        ["diff", "released@1", "released@2", "--store", store],
        *(["rerun", name, "--from", store, "--store", str(tmp_path / name)] for name in ("released@1", "released@2")),
    ):
        assert run_command_line(line, graph=TOYS) == 0
    assert run(study, *scale, "--set", "judge.title=more") == 0
    assert len(versions(study)) == 3


def test_what_a_version_has_lost_is_published_anew_though_the_same_was_made_since(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = study.parent / "source.txt"
    for text in ("once", "again"):
        source.write_text(text)
        assert run(study, "--set", f"grow.source={source}") == 0
    assert "released@1 stays: nothing has changed" in capsys.readouterr().out
    for ref in versions(study)[0].refs:
        if ref.stage == "grow":
            Store(study.parent / "store").discard(ref)
    assert run(study, "--set", f"grow.source={source}") == run(study, "--set", f"grow.source={source}") == 0
    out = capsys.readouterr().out
    assert "released@2 is published" in out
    assert "released@2 stays: nothing has changed" in out


def test_a_verdict_that_fails_publishes_nothing_and_is_named_with_the_figure(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(study, "--set", "judge.level=fail") == 1
    said = capsys.readouterr()
    lines = said.err.splitlines()[-2:]
    assert lines[0] == "error: released is not published: 1 of 1 required verdicts fail"
    assert lines[1].strip().startswith("judge: fail: made for a test; total ")
    assert versions(study) == []
    assert "done: " in said.out
    assert run(study, "--set", "judge.level=fail") == 1, "also where everything is fresh: a schedule must notice"
    assert run(study, "--set", "judge.level=fail", "--set", "publish.required=[]") == 0
    assert len(versions(study)) == 1, "a list put right is answered from what is there"


def test_a_required_verdict_that_is_not_there_publishes_nothing(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(study, "--set", "publish.required=['judge', 'grow']") == 1
    assert "grow: there is no such verdict; verdicts: judge" in capsys.readouterr().err


@pytest.mark.parametrize("level", ["pass", "not judged", "warn"])
def test_what_does_not_fail_is_published(study: Path, level: str) -> None:
    assert run(study, "--set", f"judge.level={level}") == 0
    assert len(versions(study)) == 1


def test_without_a_list_the_verdicts_on_products_must_not_fail(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The toy's models come from `bend`; `judge` writes scores, which are no product."""
    study.write_text(study.read_text().replace('required = ["judge"]\n', ""))
    assert run(study, "--set", "judge.level=fail") == 0
    assert run(study, "--set", "bend.level=fail") == 1
    assert "bend: fail: 6 of 6: made for a test" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("level", "codes"), [("pass", (0, 0)), ("not judged", (0, 0)), ("warn", (1, 0)), ("fail", (1, 1))]
)
def test_a_run_may_be_asked_to_fail_on_a_verdict(
    study: Path, capsys: pytest.CaptureFixture[str], level: str, codes: tuple[int, int]
) -> None:
    more = ("--set", f"judge.level={level}", "--set", "publish.required=[]")
    assert tuple(run(study, *more, "--fail-on", worst) for worst in ("warn", "fail")) == codes
    assert ("judge: " + level in capsys.readouterr().err) == any(codes)
    assert run(study, *more) == 0


def test_a_part_of_a_study_is_not_published(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(study, "--until", "bend") == 0
    assert "released is not published: this is not the whole of the study" in capsys.readouterr().out
    assert versions(study) == []
    every = [word for stage in ("aside", "grow", "bend", "judge") for word in ("--only", stage)]
    assert run(study, *every, "--set", "publish.required=[]") == 0
    assert len(versions(study)) == 1, "all that the study asks for is the whole of it"


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("required = ['juge']", "publish.required.0: 'juge': unknown; did you mean judge?"),
        ("required = ['evaluation: lifting']", "unknown; known: aside, grow, bend, judge"),
        ("nam = 1", "publish.nam: unknown; did you mean name?"),
    ],
)
def test_verdicts_that_no_stage_can_have_are_refused_while_planning(study: Path, section: str, words: str) -> None:
    study.write_text(f"{STUDY}[publish]\n{section}\n")
    with pytest.raises(StudyError) as error:
        load_study(str(study), TOYS, environment={})
    assert words in str(error.value)


def test_what_a_study_publishes_is_not_inherited(study: Path) -> None:
    child = study.with_name("child.toml")
    child.write_text('[study]\nname = "child"\nextends = "toy.toml"\n')
    assert load_study(str(child), TOYS, environment={})[0].publish is None
