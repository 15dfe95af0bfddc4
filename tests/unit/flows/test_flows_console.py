"""The command line: what it answers, its exit codes, and that an error is one sentence."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from flows.console.app import run_command_line
from flows.console.context import busy
from flows.machine import usable_cores
from flows.planning import StageSelection
from flows.study_files import read_study_tree, shipped_studies
from storage_schema import Store, list_datasets
from storage_schema.provenance import code_version
from tasks.data import LOOK
from tests.builders.pages import Page
from tests.builders.storage_rows import put
from tests.builders.toy_runs import ROOT, STUDY, build_here, call, run_toys, wait_until, write_study


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A study and a store in which it is built."""
    folder = tmp_path_factory.mktemp("built")
    study = write_study(folder)
    run_toys(study, folder / "store")
    return str(study), str(folder / "store")


def test_a_run_with_nothing_to_do_says_so_and_where_the_report_is(
    built: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = built
    assert call("run", study, "--store", store) == 0
    out = capsys.readouterr().out
    assert "everything is fresh, nothing to do" in out
    assert f"report: {store}/runs/latest/toy.html\n" in out
    assert "profile" not in out
    assert call("run", study, "--store", store, "--profile") == 0
    assert "no profile, because nothing was computed; use --force STAGE" in capsys.readouterr().out


@pytest.mark.parametrize(("is_there", "words"), [(True, ""), (False, "no browser starts here; open ")])
def test_the_report_is_opened_at_the_end(
    built: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    is_there: bool,
    words: str,
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or is_there)
    study, store = built
    assert call("run", study, "--store", store) == 0
    assert (opened, capsys.readouterr().err) == ([], "")
    assert call("run", study, "--store", store, "--open") == 0
    page = Path(store) / "runs" / "latest" / "toy.html"
    assert opened == [page.as_uri()]
    assert capsys.readouterr().err == (f"{words}{page} in one\n" if words else "")


def test_a_run_until_a_stage_ends_with_a_page_on_what_it_made_and_keeps_a_whole_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    build_here(monkeypatch)
    study, store = str(write_study(tmp_path, f"{STUDY}[publish]\nrequired = []\n")), str(tmp_path / "store")
    assert call("run", study, "--store", store, "--until", "grow", "--json") == 0
    first = json.loads(capsys.readouterr().out)
    assert list_datasets(Store(store)) == [], "a part of a study is no version of its dataset"
    assert [stage["stage"] for stage in first["stages"]] == ["grow", "judge"]
    assert (Path(first["report"]) / "report.html").is_file()
    assert call("run", study, "--store", store, "--json") == 0
    whole = json.loads(capsys.readouterr().out)
    assert [one.label for one in list_datasets(Store(store))] == ["toy@1"]
    assert call("run", study, "--store", store, "--until", "grow", "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert (again["num_computed"], again["report"]) == (0, whole["report"])


def test_a_run_answers_a_program_in_json(built: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    study, store = built
    assert call("run", study, "--store", store, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["num_computed"] == 0
    assert [stage["stage"] for stage in answer["stages"]] == ["aside", "grow", "bend", "judge"]
    assert (Path(answer["report"]) / "report.html").read_text() == "<h1>toys</h1>"


def test_what_is_thought_of_a_result_stands_in_every_table_and_in_json(
    built: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = built
    words = "warn: made for a test; total "
    for arguments in (("run", study), ("plan", study), ("status",)):
        assert call(*arguments, "--store", store) == 0
        out = capsys.readouterr().out
        assert sum(words in line for line in out.splitlines() if line.split()[0].rstrip(":") == "judge") == 1
        assert " cm (twice that)" in out
        if arguments[0] != "plan":
            assert "built: " in out
            assert "is it good: 1 warn" in out
    for arguments, name in ((("run", study), "stages"), (("plan", study), "stages"), (("status",), "studies")):
        assert call(*arguments, "--store", store, "--json") == 0
        found = json.loads(capsys.readouterr().out)[name]
        stages = found[0]["stages"] if name == "studies" else found
        verdicts = {stage["stage"]: stage["verdict"] for stage in stages}
        assert verdicts["grow"] is None
        assert (verdicts["judge"]["level"], verdicts["judge"]["reason"]) == ("warn", "made for a test")
        assert verdicts["judge"]["baseline"] == pytest.approx(2 * verdicts["judge"]["value"])


def test_a_stage_without_shards_has_nothing_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, store = write_study(tmp_path), str(tmp_path / "store")
    run_toys(study, Path(store), "aside.size=0")
    assert call("run", str(study), "--store", store, "--set", "aside.size=0") == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("aside"))
    assert line.endswith("nothing to do")
    assert call("plan", str(study), "--store", store, "--set", "aside.size=0") == 0
    assert "aside           nothing to do\n" in capsys.readouterr().out


@pytest.mark.parametrize("asks", ["[aside]\nsize = 0\n", "stages", "--until"])
def test_a_stage_that_was_asked_for_and_makes_nothing_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asks: str
) -> None:
    study, store = Path(write_study(tmp_path)), str(tmp_path / "store")
    run_toys(study, Path(store), "aside.size=0")
    if asks.startswith("["):
        study.write_text(study.read_text() + asks)
    chosen = {"stages": ["--set", 'study.stages=["aside"]'], "--until": ["--until", "aside"]}.get(asks, [])
    for command in ("run", "plan"):
        assert call(command, str(study), "--store", store, "--set", "aside.size=0", *chosen) == 1
        said = capsys.readouterr()
        assert said.err.splitlines()[-1] == "error: nothing was made by aside: it needs a size (aside.size)"
        assert "everything is fresh" not in said.out


def test_the_keys_of_a_study_are_printed_with_type_default_unit_and_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("study", "keys", "grow") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["key", "type", "default", "unit", "meaning"]
    assert any(
        line.split() == ["grow.num_takes", "whole", "number", ">=", "1,", "<=", "50", "2", "Takes"] for line in lines
    )
    assert any(line.split() == ["grow.source", "path", "A", "file", "whose", "bytes", "enter"] for line in lines)
    assert call("study", "keys", "--json") == 0
    keys = {key["name"]: key for key in json.loads(capsys.readouterr().out)}
    assert keys["grow.scale"]["default"] == 1.0
    assert keys["study.name"]["is_needed"]
    assert call("study", "keys", "growth") == 2


def test_a_resolved_study_is_toml_that_resolves_to_the_same(
    built: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("study", "show", "--resolved", built[0], "--set", "grow.num_takes=4") == 0
    again = tmp_path / "again.toml"
    again.write_text(capsys.readouterr().out)
    answers = []
    for study in ((built[0], "--set", "grow.num_takes=4"), (str(again),)):
        assert call("study", "show", *study, "--json") == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0] == answers[1]
    assert answers[0]["grow"]["num_takes"] == 4


def test_a_resolved_study_writes_infinity_as_toml_has_it(capsys: pytest.CaptureFixture[str]) -> None:
    setting = "ingest.virtual_video.pitch_deviation_deg=inf"
    assert run_command_line(["study", "show", "--resolved", "duets", "--set", setting]) == 0
    resolved = tomllib.loads(capsys.readouterr().out)
    assert resolved["ingest"]["virtual_video"]["pitch_deviation_deg"] == math.inf


def test_a_fresh_run_leaves_no_new_record(built: tuple[str, str]) -> None:
    study, store = built
    before = sorted((Path(store) / "runs").glob("[!.]*"))
    assert before
    assert call("run", study, "--store", store) == 0
    assert sorted((Path(store) / "runs").glob("[!.]*")) == before


def test_plan_says_what_would_be_computed_and_why(built: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    study, store = built
    assert call("plan", study, "--store", store, "--set", "bend.step=3") == 0
    out = capsys.readouterr().out
    assert "stale: bend.step 1000 -> 3" in out
    assert "pending: depends on bend; rebuilt only if its bytes change" in out
    assert call("plan", study, "--store", store, "--json") == 0
    assert json.loads(capsys.readouterr().out)["is_fresh"] is True


def test_status_names_studies_stages_and_runs(built: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert call("status", "--store", built[1], "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["studies"][0]["study"] == "toy"
    assert {stage["num_there"] for stage in answer["studies"][0]["stages"]} == {1, 6}
    assert answer["runs"][-1]["status"] == "finished"


def test_status_and_references_say_what_an_older_program_has_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "store"
    run_toys(write_study(tmp_path), store)
    for path in store.glob("*/??/*/manifest.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": 1}))
    assert call("status", "--store", str(store)) == 0
    assert re.search(
        r"missing: 14 artifacts, such as \w+@[0-9a-f]{12}, which is of an older schema", capsys.readouterr().out
    )
    assert call("show", "models:toy", "--store", str(store)) == 1
    assert "of study 'toy' is of an older schema in the store" in capsys.readouterr().err


def test_a_dataset_of_an_older_program_keeps_nobody_from_making_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "store"
    run_toys(write_study(tmp_path), store)
    (store / "datasets" / "old@1").mkdir(parents=True)
    (store / "datasets" / "old@1" / "dataset.json").write_text('{"schema_version": 1, "artifacts": []}')
    for name in ("new", "new", "old"):
        assert call("dataset", "create", name, "--study", "toy", "--store", str(store)) == 0
    out = capsys.readouterr().out
    assert "new@1 exists already" in out
    assert "old@2 made" in out


def test_show_gives_columns_rows_lineage_and_sources(
    built: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("show", "training_log:toy/t1", "--store", built[1]) == 0
    out = capsys.readouterr().out
    for words in ("unit", "step=0", "grow@", "source t1: CC0-1.0; made for a test"):
        assert words in out
    assert call("show", "scores:toy", "--store", built[1]) == 0
    out = capsys.readouterr().out
    for words in ("is the best of a row", "models: figures", "source t1: CC0-1.0; made for a test"):
        assert words in out
    assert call("show", "training_log:toy/t1#7", "--store", built[1], "--json") == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["step"] == 2


def test_show_ends_before_it_floods_and_says_how_to_see_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = write_study(tmp_path), tmp_path / "store"
    run_toys(study, store, "grow.num_takes=9")
    assert call("show", "training_log:toy", "--store", str(store)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "  ... and 15 more artifacts: --json" in lines
    assert sum("grow@" in line for line in lines) == 12
    opened = Store(store)
    names = ("topic", "metric", "method", "split", "item", "at", "value", "unit", "count", "low", "high", "is_baseline")
    plain = {"split": "all", "at": np.nan, "value": 1.0, "unit": "m", "count": 1, "low": np.nan, "high": np.nan}
    scores = [
        plain | {"topic": topic, "metric": f"m{number:02d}", "method": method, "item": "all", "is_baseline": False}
        for topic in ("lifting", "views")
        for method in "ab"
        for number in range(20)
    ]
    columns = {name: [row[name] for row in scores] for name in names}
    made = put(opened, "evaluation", "all", {"scores": columns}, {})
    for reference, shown, hint in (
        (f"scores@{made.ref.key[:12]}", 6, "... 17 more rows: pasdedeux show"),
        (f"scores@{made.ref.key[:12]}#3", 1, ""),
    ):
        assert call("show", reference, "--store", str(store)) == 0
        lines = capsys.readouterr().out.splitlines()
        assert sum(re.match(r"(m\d\d|  #3)", line) is not None for line in lines) == shown
        assert any(line.startswith(hint) for line in lines)


def test_verify_finds_a_changed_byte(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    run_toys(write_study(tmp_path), store)
    assert call("verify", "--store", str(store)) == 0
    stray = next(store.glob("grow/*/*")) / "stray.txt"
    stray.write_text("")
    capsys.readouterr()
    assert call("verify", "--store", str(store)) == 1
    assert "--force" not in capsys.readouterr().out, "nothing of it is damaged"
    stray.unlink()
    page = next(store.glob("judge/*/*/report.html"))
    page.write_bytes(page.read_bytes().replace(b"toys", b"boys"))
    capsys.readouterr()
    assert call("verify", "--store", str(store)) == 1
    out = capsys.readouterr().out
    assert "report.html" in out
    assert "`pasdedeux run STUDY --force judge` recomputes" in out


def test_export_writes_arrays_lines_and_credits(built: tuple[str, str], tmp_path: Path) -> None:
    assert call("export", "models:toy", "--store", built[1], "--out", str(tmp_path)) == 0
    arrays = np.load(tmp_path / "models.npz")
    assert arrays["values_offsets"].tolist() == [0, 5, 10, 15, 20, 25, 30]
    assert arrays["split"].tolist() == ["t0"] * 3 + ["t1"] * 3
    assert call("export", "in_betweens:toy", "--store", built[1], "--format", "csv", "--out", str(tmp_path)) == 0
    lines = (tmp_path / "in_betweens.csv").read_text().splitlines()
    assert "last_frame,pair17_m.0.pelvis.x,pair17_m.0.pelvis.y,pair17_m.0.pelvis.z,pair17_m.0.spine.x" in lines[0]
    assert len(lines) == 5
    assert len(Page((tmp_path / LOOK).read_text()).scenes) == 1, "who can be seen can be looked at beside the files"
    (tmp_path / LOOK).unlink()
    assert call("export", "training_log:toy", "--store", built[1], "--format", "csv", "--out", str(tmp_path)) == 0
    assert "licence: CC0-1.0" in (tmp_path / "CREDITS.txt").read_text()
    assert not (tmp_path / LOOK).exists()


def test_a_dataset_is_made_once_and_named_again(built: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    store = built[1]
    assert call("dataset", "create", "first", "--study", "toy", "--store", store) == 0
    assert call("dataset", "create", "first", "--study", "toy", "--store", store) == 0
    assert "first@1 exists already" in capsys.readouterr().out
    assert call("dataset", "create", "first", "--study", "toy", "--version", "1", "--store", store) == 2
    assert call("show", "scores:first@1", "--store", store) == 0
    assert call("dataset", "list", "--store", store) == 0
    assert "first@1  14 artifacts" in capsys.readouterr().out
    assert call("dataset", "create", "second", "--study", "unbuilt", "--store", store) == 2


def test_a_mixture_of_runs_is_no_dataset(
    built: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = built[0], str(tmp_path / "store")
    shutil.copytree(built[1], store)
    create = ("dataset", "create", "d", "--study", "toy", "--store", store)
    for change in ("grow.scale=2", "grow.num_takes=3"):
        run_toys(Path(study), Path(store), change, selection=StageSelection(until="grow"))
        assert call(*create) == 2
        assert "is a mixture of runs" in capsys.readouterr().err
        assert call(*create, "--stage", "grow") == 0
        run_toys(Path(study), Path(store), change)
        assert call(*create) == 0
    assert "d@" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "duetts"), "did you mean"),
        (("run", "{study}", "--set", "grow.num_take=1"), "grow.num_take: unknown; did you mean num_takes?"),
        (("run", "{study}", "--set", "grow.num_takes=0"), "grow.num_takes"),
        (("run", "{study}", "--set", "grow.source=nowhere"), "does not exist"),
        (("run", "{study}", "--set", "grow.num_takes=9", "--only", "bend"), "not finished and not selected"),
        (("plan", "{study}", "--until", "chains"), "unknown stage 'chains'"),
        (("show", "poses:nothing"), "nothing"),
        (("show", "everything"), "not a reference"),
        (("rum",), "No such command"),
        (("run", "--nope"), "No such option"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(
    built: tuple[str, str], arguments: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = built
    line = [argument.format(study=study) for argument in arguments]
    if len(line) > 1 and "--nope" not in line:
        line += ["--store", store]
    assert call(*line) == 2
    err = capsys.readouterr().err
    assert words in err
    assert "Traceback" not in err


@pytest.mark.parametrize("command", ["run", "deploy"])
def test_more_workers_than_cores_are_refused_unless_they_are_meant(
    built: tuple[str, str], command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = built
    too_many = str(usable_cores() + 1)
    line = (command, study, "--store", store, "--workers", too_many)
    assert call(*line) == 2
    assert f"--workers {too_many} is more than the cores" in capsys.readouterr().err
    assert call(*line, "--scheduler", "tcp://127.0.0.1:1") == (2 if command == "deploy" else 0)
    assert "cores" not in capsys.readouterr().err
    assert call(*line, "--oversubscribe") == (2 if command == "deploy" else 0)
    assert "cores" not in capsys.readouterr().err


def test_debug_shows_the_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--debug", "run", "duetts", "--store", str(tmp_path)) == 2
    assert "Traceback" in capsys.readouterr().err


def test_help_teaches_with_examples(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        (("--help",), "pasdedeux run --set"),
        (("run", "--help"), "pasdedeux run my.toml --scheduler"),
        (("plan", "--help"), "pending  it depends"),
        (("export", "--help"), "pasdedeux export variants"),
    ):
        assert call(*arguments) == 0
        assert words in capsys.readouterr().out


def test_studies_that_ship_are_listed_and_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command_line(["study", "list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "all" in lines["duets"]
    assert all("none, built-in duets" in lines[name] for name in ("duets", "augmentation_paper_duets"))
    assert "(to extend)" in lines["salsa"]
    assert "subjects 01, 02, 03, 60, 61" in lines["sampling_paper"]
    assert call("study", "show", "duets") == 0
    assert '[study]\nname = "duets"' in capsys.readouterr().out
    assert call("study", "show", "duetts") == 2


def test_verifying_a_store_that_is_not_there_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("verify", "--store", str(tmp_path / "typo")) == 2
    assert "there is no store in" in capsys.readouterr().err


def test_the_next_command_that_is_printed_does_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, store = str(write_study(tmp_path)), str(tmp_path / "a store")
    assert call("plan", study, "--store", store, "--set", "aside.size=3") == 0
    command = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("run it with: "))
    assert command == ["pasdedeux", "run", study, "--store", store, "--set", "aside.size=3"]
    for chosen in (["--until", "bend"], ["--from", "bend", "--force", "bend"], ["--only", "grow", "--only", "aside"]):
        assert call("plan", study, "--store", store, *chosen) in (0, 2)
        said = capsys.readouterr().out
        if said:
            command = shlex.split(said.splitlines()[-1].removeprefix("run it with: "))
            assert Counter(command) == Counter(["pasdedeux", "run", study, "--store", store, *chosen])


def test_the_version_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--version") == 0
    assert capsys.readouterr().out == f"pasdedeux {code_version()}\n"


@pytest.mark.parametrize("study", [name for name, text in shipped_studies().items() if "\nname = " in text])
def test_a_study_that_ships_runs_or_says_which_files_it_lacks_how_large_they_are_and_how_they_are_had(
    study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = run_command_line(["plan", study])
    said = capsys.readouterr()
    ingest = read_study_tree(study, tmp_path).values["ingest"]
    families = ingest.get("pairs", {}).values()
    if "takes" in ingest:  # of a user's own files
        assert code == 2
        assert "does not exist" in said.err
    elif all(family.get("takes") == [] for family in families):
        assert code == 0, said.err
    else:
        assert code == 2
        words = r"does not exist in .*, nor do (\d+) others of the (\d+) that ingest.pairs names; .* MB\b"
        lacking = re.search(words, said.err)
        assert lacking is not None
        assert int(lacking[1]) == int(lacking[2]) - 1
        assert re.search(r"`pasdedeux fetch [ \w-]+` brings them|--set ingest.pairs.\w+.folder", said.err)


def test_what_is_there_of_a_run_that_failed_or_had_no_evaluation_is_summed_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = str(write_study(tmp_path)), str(tmp_path / "store")
    run_toys(study, Path(store))
    assert call("run", study, "--store", store) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("is it good: ") for line in lines)
    shutil.rmtree(next(path for path in Path(store).iterdir() if path.name == "judge"))
    assert call("status", "--store", store) == 0
    out = capsys.readouterr().out
    assert re.search(r" models \(\d+ kB\)", out)
    assert "is it good: not judged" in out


@pytest.mark.parametrize("package", ["flows", "tasks", "storage_schema", "pasdedeux"])
def test_numbers_get_their_nouns_in_one_place(package: str) -> None:
    by_hand = re.compile(r"""\{'s' \*|else 's'\}|counted\([^()]*, .more.\)|\bproblems"\)""")
    texts = {path.relative_to(ROOT): path.read_text() for path in (ROOT / package).rglob("*.py")}
    found = {str(path): match[0] for path, text in texts.items() if (match := by_hand.search(text))}
    assert found == {}, "`counted` does it"


def test_work_that_takes_long_says_that_it_goes_on_and_short_work_says_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with busy("reading"):
        pass
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("flows.console.context._BUSY_S", 0.02)
    said: list[str] = []

    def has_said_it_twice() -> bool:
        said.extend(capsys.readouterr().err.splitlines())
        return len(said) > 1

    with busy("solving 60 frames"):
        wait_until(has_said_it_twice, "two lines", limit_s=20.0)
    assert all(line.startswith("solving 60 frames: ") for line in said)
