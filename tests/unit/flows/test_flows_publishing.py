"""Publishing: a version of exactly one finished run where verdicts allow it, with what changed; else which do not."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from flows.study import load_study
from flows.study_files import StudyError
from storage_schema import Store, list_datasets
from tests.builders.command_line import CommandLine
from tests.builders.storage_rows import list_as_of_schema_1
from tests.builders.toy_runs import STUDY, write_study
from tests.builders.toys import TOYS

pytestmark = pytest.mark.usefixtures("in_this_process")

PUBLISH = '[publish]\nname = "released"\nrequired = ["judge"]\n'


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """The toy study with values that are not rounded away, and what it publishes."""
    return write_study(tmp_path, f"{STUDY}[bend]\nstep = 1\n{PUBLISH}")


@pytest.fixture
def run(study: Path, store: Store, invoke_toys: CommandLine) -> CommandLine:
    """Return the command that builds the study."""
    return invoke_toys.of("run", study).at(store)


def labels(store: Store) -> list[str]:
    return [dataset.label for dataset in list_datasets(store)]


@pytest.mark.parametrize("level", ["pass", "not judged", "warn"])
def test_a_run_that_does_not_fail_becomes_a_version(run: CommandLine, store: Store, level: str) -> None:
    assert "released@1 is published" in run("--set", f"judge.level={level}").out
    (version,) = list_datasets(store)
    assert {ref.stage for ref in version.refs} == set(TOYS.names)
    assert json.loads((version.path / "study.json").read_text())["publish"]["name"] == "released"
    assert {path.name for path in version.path.iterdir()} == {"dataset.json", "study.json", "environment.json"}


def test_nothing_new_makes_no_new_version(run: CommandLine, store: Store, tmp_path: Path) -> None:
    run()
    assert "released@1 stays: nothing has changed" in run().out
    published = run("--force", "bend", "--json").json["published"]
    assert (published["dataset"], published["failures"]) == ("released@1", [])
    source = tmp_path / "source.txt"
    source.write_text("whose bytes change nothing but keys")
    assert "released@1 stays: nothing has changed" in run("--set", f"grow.source={source}").out
    assert len(list(store.artifacts("grow"))) == 12, "every key is another one"
    assert labels(store) == ["released@1"]


def test_a_version_follows_one_of_an_older_schema(run: CommandLine, store: Store, invoke_toys: CommandLine) -> None:
    run()
    list_as_of_schema_1(list_datasets(store)[0].path)
    assert "released@2 is published" in run().out
    assert labels(store) == ["released@2"]
    assert "released@1  is of an older schema" in invoke_toys("dataset", "list", "--store", store).out


def test_a_rebuild_that_stopped_is_published_compared_rerun_and_built_upon(
    run: CommandLine, store: Store, tmp_path: Path, invoke_toys: CommandLine
) -> None:
    scaled = run.of("--set", "grow.scale=1.0001")
    run()
    before = {judged.ref for judged in store.artifacts("judge")}
    scaled()
    assert {judged.ref for judged in store.artifacts("judge")} == before, "bend has rounded the difference away"
    assert labels(store) == ["released@1", "released@2"]
    invoke_toys.at(store)("diff", "released@1", "released@2")
    for name in ("released@1", "released@2"):
        invoke_toys("rerun", name, "--from", store, "--store", tmp_path / name)
    scaled("--set", "judge.title=more")
    assert len(labels(store)) == 3


def test_a_version_that_lost_files_is_published_anew(run: CommandLine, store: Store, tmp_path: Path) -> None:
    source = tmp_path / "source.txt"
    of_source = run.of("--set", f"grow.source={source}")
    source.write_text("once")
    of_source()
    source.write_text("again")
    assert "released@1 stays: nothing has changed" in of_source().out
    for ref in list_datasets(store)[0].refs:
        if ref.stage == "grow":
            store.discard(ref)
    assert "released@2 is published" in of_source().out
    assert "released@2 stays: nothing has changed" in of_source().out


def test_a_verdict_that_fails_publishes_nothing_and_is_named_with_the_figure(run: CommandLine, store: Store) -> None:
    failing = run.of("--set", "judge.level=fail")
    said = failing(code=1)
    heading, verdict = said.err.splitlines()[-2:]
    assert heading == "error: released is not published: 1 of 1 required verdicts fail"
    assert verdict.strip().startswith("judge: fail: made for a test; total ")
    assert labels(store) == []
    assert "done: " in said.out
    failing(code=1)  # also where everything is fresh: a schedule must notice
    failing("--set", "publish.required=[]")
    assert len(labels(store)) == 1, "a list put right is answered from what is there"


def test_a_required_verdict_that_is_not_there_publishes_nothing(run: CommandLine) -> None:
    said = run("--set", "publish.required=['judge', 'grow']", code=1).err
    assert "grow: there is no such verdict; verdicts: judge" in said


def test_without_a_list_the_verdicts_on_products_must_not_fail(study: Path, run: CommandLine) -> None:
    """The toy's models come from `bend`; `judge` writes scores, which are no product."""
    study.write_text(study.read_text().replace('required = ["judge"]\n', ""))
    run("--set", "judge.level=fail")
    assert "bend: fail: 6 of 6: made for a test" in run("--set", "bend.level=fail", code=1).err


@pytest.mark.parametrize(
    ("level", "on_warn", "on_fail"), [("pass", 0, 0), ("not judged", 0, 0), ("warn", 1, 0), ("fail", 1, 1)]
)
def test_a_run_may_be_asked_to_fail_on_a_verdict(run: CommandLine, level: str, on_warn: int, on_fail: int) -> None:
    judged = run.of("--set", f"judge.level={level}", "--set", "publish.required=[]")
    assert ("judge: " + level in judged("--fail-on", "warn", code=on_warn).err) == bool(on_warn)
    judged("--fail-on", "fail", code=on_fail)
    judged()


def test_a_part_of_a_study_is_not_published(run: CommandLine, store: Store) -> None:
    said = run("--until", "bend").out
    assert "released is not published: this is not the whole of the study" in said
    assert labels(store) == []
    every = [word for stage in ("aside", "grow", "bend", "judge") for word in ("--only", stage)]
    run(*every, "--set", "publish.required=[]")
    assert len(labels(store)) == 1, "all that the study asks for is the whole of it"


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
    with pytest.raises(StudyError, match=re.escape(words)):
        load_study(str(study), TOYS, environment={})


def test_what_a_study_publishes_is_not_inherited(study: Path) -> None:
    child = study.with_name("child.toml")
    child.write_text('[study]\nname = "child"\nextends = "toy.toml"\n')
    assert load_study(str(child), TOYS, environment={})[0].publish is None
