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

from flows.console.context import busy
from flows.machine import usable_cores
from flows.planning import StageSelection
from flows.study_files import read_study_tree, shipped_studies
from storage_schema import Store, list_datasets
from storage_schema.provenance import code_version
from tasks.data import LOOK
from tests.builders.command_line import CommandLine
from tests.builders.pages import Page
from tests.builders.storage_rows import put, random_columns
from tests.builders.toy_runs import ROOT, STUDY, run_toys, wait_until, write_study


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A study and a store in which it is built."""
    folder = tmp_path_factory.mktemp("built")
    study = write_study(folder)
    run_toys(study, folder / "store")
    return str(study), str(folder / "store")


@pytest.fixture
def toys(built: tuple[str, str], invoke_toys: CommandLine) -> CommandLine:
    """Return the commands on the store in which the toy study is built."""
    return invoke_toys.at(built[1])


def test_a_run_with_nothing_to_do_says_so_and_where_the_report_is(built: tuple[str, str], toys: CommandLine) -> None:
    study, store = built
    before = sorted((Path(store) / "runs").glob("[!.]*"))
    out = toys("run", study).out
    assert "everything is fresh, nothing to do" in out
    assert f"report: {store}/runs/latest/toy.html\n" in out
    assert "profile" not in out
    assert "no profile, because nothing was computed; use --force STAGE" in toys("run", study, "--profile").out
    assert sorted((Path(store) / "runs").glob("[!.]*")) == before != [], "a fresh run leaves no record"


@pytest.mark.parametrize(("is_there", "words"), [(True, ""), (False, "no browser starts here; open {} in one\n")])
def test_the_report_is_opened_at_the_end(
    built: tuple[str, str], toys: CommandLine, monkeypatch: pytest.MonkeyPatch, is_there: bool, words: str
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or is_there)
    study, store = built
    assert (toys("run", study).err, opened) == ("", [])
    page = Path(store) / "runs" / "latest" / "toy.html"
    assert toys("run", study, "--open").err == words.format(page)
    assert opened == [page.as_uri()]


def test_a_run_until_a_stage_ends_with_a_page_on_what_it_made_and_keeps_a_whole_page(
    store: Store, tmp_path: Path, in_this_process: None, invoke_toys: CommandLine
) -> None:
    study, toys = write_study(tmp_path, f"{STUDY}[publish]\nrequired = []\n"), invoke_toys.at(store)
    first = toys("run", study, "--until", "grow", "--json").json
    assert list_datasets(store) == [], "a part of a study is no version of its dataset"
    assert [stage["stage"] for stage in first["stages"]] == ["grow", "judge"]
    assert (Path(first["report"]) / "report.html").is_file()
    whole = toys("run", study, "--json").json
    assert [dataset.label for dataset in list_datasets(store)] == ["toy@1"]
    again = toys("run", study, "--until", "grow", "--json").json
    assert (again["num_computed"], again["report"]) == (0, whole["report"])


def test_a_run_answers_a_program_in_json(built: tuple[str, str], toys: CommandLine) -> None:
    answer = toys("run", built[0], "--json").json
    assert answer["num_computed"] == 0
    assert [stage["stage"] for stage in answer["stages"]] == ["aside", "grow", "bend", "judge"]
    assert (Path(answer["report"]) / "report.html").read_text() == "<h1>toys</h1>"


@pytest.mark.parametrize("name", ["run", "plan", "status"])
def test_verdicts_are_in_every_table_and_in_json(built: tuple[str, str], toys: CommandLine, name: str) -> None:
    words = [name] if name == "status" else [name, built[0]]
    out = toys(*words).out
    (line,) = (line for line in out.splitlines() if line.split()[0].rstrip(":") == "judge" and "warn" in line)
    assert "warn: made for a test; total " in line
    assert " cm (twice that)" in out
    assert ("built: " in out, "is it good: 1 warn" in out) == (name != "plan",) * 2
    answer = toys(*words, "--json").json
    stages = answer["studies"][0]["stages"] if name == "status" else answer["stages"]
    verdicts = {stage["stage"]: stage["verdict"] for stage in stages}
    assert verdicts["grow"] is None
    assert (verdicts["judge"]["level"], verdicts["judge"]["reason"]) == ("warn", "made for a test")
    assert verdicts["judge"]["baseline"] == pytest.approx(2 * verdicts["judge"]["value"])


def test_a_stage_without_shards_has_nothing_to_do(store: Store, tmp_path: Path, invoke_toys: CommandLine) -> None:
    study, toys = write_study(tmp_path), invoke_toys.at(store)
    run_toys(study, store.root, "aside.size=0")
    assert re.search(r"^aside .*nothing to do$", toys("run", study, "--set", "aside.size=0").out, re.MULTILINE)
    assert "aside           nothing to do\n" in toys("plan", study, "--set", "aside.size=0").out


@pytest.mark.parametrize(
    ("section", "chosen"),
    [("[aside]\nsize = 0\n", ()), ("", ("--set", 'study.stages=["aside"]')), ("", ("--until", "aside"))],
)
@pytest.mark.parametrize("name", ["run", "plan"])
def test_a_stage_that_was_asked_for_and_makes_nothing_is_an_error(
    store: Store, tmp_path: Path, invoke_toys: CommandLine, section: str, chosen: tuple[str, ...], name: str
) -> None:
    run_toys(write_study(tmp_path), store.root, "aside.size=0")
    study = write_study(tmp_path, STUDY + section)
    said = invoke_toys.at(store)(name, study, "--set", "aside.size=0", *chosen, code=1)
    assert said.err.splitlines()[-1] == "error: nothing was made by aside: it needs a size (aside.size)"
    assert "everything is fresh" not in said.out


def test_the_keys_of_a_study_are_printed_with_type_default_unit_and_meaning(invoke_toys: CommandLine) -> None:
    lines = [" ".join(line.split()) for line in invoke_toys("study", "keys", "grow").out.splitlines()]
    assert lines[0] == "key type default unit meaning"
    assert {"grow.num_takes whole number >= 1, <= 50 2 Takes", "grow.source path A file whose bytes enter"} <= {*lines}
    keys = {key["name"]: key for key in invoke_toys("study", "keys", "--json").json}
    assert keys["grow.scale"]["default"] == 1.0
    assert keys["study.name"]["is_needed"]
    invoke_toys.refusal("study", "keys", "growth")


def test_a_resolved_study_is_toml_that_resolves_to_the_same(tmp_path: Path, invoke_toys: CommandLine) -> None:
    given, again = (write_study(tmp_path), "--set", "grow.num_takes=4"), tmp_path / "again.toml"
    again.write_text(invoke_toys("study", "show", "--resolved", *given).out)
    resolved = invoke_toys("study", "show", *given, "--json").json
    assert invoke_toys("study", "show", again, "--json").json == resolved
    assert resolved["grow"]["num_takes"] == 4


def test_a_resolved_study_writes_infinity_as_toml_has_it(invoke: CommandLine) -> None:
    setting = "ingest.virtual_video.pitch_deviation_deg=inf"
    resolved = tomllib.loads(invoke("study", "show", "--resolved", "duets", "--set", setting).out)
    assert resolved["ingest"]["virtual_video"]["pitch_deviation_deg"] == math.inf


def test_plan_says_what_would_be_computed_and_why(built: tuple[str, str], toys: CommandLine) -> None:
    out = toys("plan", built[0], "--set", "bend.step=3").out
    assert "stale: bend.step 1000 -> 3" in out
    assert "pending: depends on bend; rebuilt only if its bytes change" in out
    assert toys("plan", built[0], "--json").json["is_fresh"] is True


def test_status_names_studies_stages_and_runs(toys: CommandLine) -> None:
    answer = toys("status", "--json").json
    assert answer["studies"][0]["study"] == "toy"
    assert {stage["num_there"] for stage in answer["studies"][0]["stages"]} == {1, 6}
    assert answer["runs"][-1]["status"] == "finished"


def test_artifacts_of_an_older_program_are_named(toy_store: Store, invoke_toys: CommandLine) -> None:
    for path in toy_store.root.glob("*/??/*/manifest.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": 1}))
    toys = invoke_toys.at(toy_store)
    missing = r"missing: 14 artifacts, such as \w+@[0-9a-f]{12}, which is of an older schema"
    assert re.search(missing, toys("status").out)
    assert "of study 'toy' is of an older schema in the store" in toys("show", "models:toy", code=1).err


def test_a_dataset_of_an_older_program_blocks_nothing(toy_store: Store, invoke_toys: CommandLine) -> None:
    (toy_store.root / "datasets" / "old@1").mkdir(parents=True)
    (toy_store.root / "datasets" / "old@1" / "dataset.json").write_text('{"schema_version": 1, "artifacts": []}')
    create = invoke_toys.of("dataset", "create").at(toy_store)
    for name, said in (("new", "new@1 made"), ("new", "new@1 exists already"), ("old", "old@2 made")):
        assert said in create(name, "--study", "toy").out


def test_show_gives_columns_rows_lineage_and_sources(toys: CommandLine) -> None:
    source = "source t1: CC0-1.0; made for a test"
    for reference, words in (
        ("training_log:toy/t1", ("unit", "step=0", "grow@", source)),
        ("scores:toy", ("is the best of a row", "models: figures", source)),
    ):
        out = toys("show", reference).out
        assert [word for word in words if word not in out] == []
    assert toys("show", "training_log:toy/t1#7", "--json").json["rows"][0]["step"] == 2


def test_show_is_cut_and_says_how_to_see_more(store: Store, tmp_path: Path, invoke_toys: CommandLine) -> None:
    run_toys(write_study(tmp_path), store.root, "grow.num_takes=9")
    toys = invoke_toys.at(store)
    lines = toys("show", "training_log:toy").out.splitlines()
    assert "  ... and 15 more artifacts: --json" in lines
    assert sum("grow@" in line for line in lines) == 12
    columns = random_columns("scores", 80) | {
        "topic": ["lifting"] * 40 + ["views"] * 40,
        "method": [*(["a"] * 20 + ["b"] * 20) * 2],
        "metric": [f"m{number:02d}" for number in range(20)] * 4,
        **{name: ["all"] * 80 for name in ("split", "item")},
        "at": [np.nan] * 80,
    }
    key = put(store, "evaluation", "all", {"scores": columns}, {}).ref.key[:12]
    for row, shown, hint in (("", 6, "... 17 more rows: pasdedeux show"), ("#3", 1, "")):
        lines = toys("show", f"scores@{key}{row}").out.splitlines()
        assert sum(re.match(r"(m\d\d|  #3)", line) is not None for line in lines) == shown
        assert any(line.startswith(hint) for line in lines)


def test_verify_finds_a_changed_byte(toy_store: Store, tmp_path: Path, invoke_toys: CommandLine) -> None:
    toys = invoke_toys.at(toy_store)
    toys("verify")
    stray = next(toy_store.root.glob("grow/*/*")) / "stray.txt"
    stray.write_text("")
    assert "--force" not in toys("verify", code=1).out, "nothing of it is damaged"
    stray.unlink()
    page = next(toy_store.root.glob("judge/*/*/report.html"))
    page.write_bytes(page.read_bytes().replace(b"toys", b"boys"))
    out = toys("verify", code=1).out
    assert "report.html" in out
    assert "`pasdedeux run STUDY --force judge` recomputes" in out
    assert "there is no store in" in invoke_toys.at(tmp_path / "typo").refusal("verify")


def test_export_writes_arrays_lines_and_credits(toys: CommandLine, tmp_path: Path) -> None:
    export = toys.of("export", "--out", tmp_path)
    export("models:toy")
    arrays = np.load(tmp_path / "models.npz")
    assert arrays["values_offsets"].tolist() == [0, 5, 10, 15, 20, 25, 30]
    assert arrays["split"].tolist() == ["t0"] * 3 + ["t1"] * 3
    export("in_betweens:toy", "--format", "csv")
    lines = (tmp_path / "in_betweens.csv").read_text().splitlines()
    assert "last_frame,pair17_m.0.pelvis.x,pair17_m.0.pelvis.y,pair17_m.0.pelvis.z,pair17_m.0.spine.x" in lines[0]
    assert len(lines) == 5
    assert len(Page((tmp_path / LOOK).read_text()).scenes) == 1, "who can be seen can be looked at beside the files"
    (tmp_path / LOOK).unlink()
    export("training_log:toy", "--format", "csv")
    assert "licence: CC0-1.0" in (tmp_path / "CREDITS.txt").read_text()
    assert not (tmp_path / LOOK).exists()


def test_a_dataset_is_made_once_and_named_again(toys: CommandLine) -> None:
    create = toys.of("dataset", "create")
    create("first", "--study", "toy")
    assert "first@1 exists already" in create("first", "--study", "toy").out
    create.refusal("first", "--study", "toy", "--version", "1")
    toys("show", "scores:first@1")
    assert "first@1  14 artifacts" in toys("dataset", "list").out
    create.refusal("second", "--study", "unbuilt")


def test_a_mixture_of_runs_is_no_dataset(tmp_path: Path, store: Store, invoke_toys: CommandLine) -> None:
    study, create = write_study(tmp_path), invoke_toys.of("dataset", "create", "d", "--study", "toy").at(store)
    run_toys(study, store.root)
    for change in ("grow.scale=2", "grow.num_takes=3"):
        run_toys(study, store.root, change, selection=StageSelection(until="grow"))
        assert "is a mixture of runs" in create.refusal()
        create("--stage", "grow")
        run_toys(study, store.root, change)
        assert "d@" in create().out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("run duetts", "did you mean"),
        ("run {study} --set grow.num_take=1", "grow.num_take: unknown; did you mean num_takes?"),
        ("run {study} --set grow.source=nowhere", "does not exist"),
        ("run {study} --set grow.num_takes=9 --only bend", "stage bend needs grow, which is not finished and not sel"),
        ("plan {study} --until chains", "unknown stage 'chains'; known stages: aside, grow, bend, judge"),
        ("show poses:nothing", "nothing"),
        ("show everything", "not a reference"),
        ("rum", "No such command"),
        ("run --nope", "No such option"),
    ],
)
def test_bad_input_is_one_sentence(built: tuple[str, str], toys: CommandLine, words: str, sentence: str) -> None:
    said = toys.refusal(*words.format(study=built[0]).split())
    assert sentence in said
    assert "Traceback" not in said


@pytest.mark.parametrize(("name", "code"), [("run", 0), ("deploy", 2)])
def test_too_many_workers_need_an_option(built: tuple[str, str], toys: CommandLine, name: str, code: int) -> None:
    too_many = usable_cores() + 1
    command = toys.of(name, built[0], "--workers", too_many)
    assert f"--workers {too_many} is more than the cores" in command.refusal()
    for meant in (("--scheduler", "tcp://127.0.0.1:1"), ("--oversubscribe",)):
        assert "cores" not in command(*meant, code=code).err


def test_debug_shows_the_traceback(tmp_path: Path, invoke_toys: CommandLine) -> None:
    assert "Traceback" in invoke_toys("--debug", "run", "duetts", "--store", tmp_path, code=2).err


def test_help_teaches_with_examples(invoke_toys: CommandLine) -> None:
    for name, words in (
        ("", "pasdedeux run --set"),
        ("run", "pasdedeux run my.toml --scheduler"),
        ("plan", "pending  it depends"),
        ("export", "pasdedeux export variants"),
    ):
        assert words in invoke_toys(*name.split(), "--help").out


def test_studies_that_ship_are_listed_and_printed(invoke: CommandLine) -> None:
    lines = {line.split()[0]: line for line in invoke("study", "list").out.splitlines()}
    for name, words in {
        "duets": "none, built-in duets",
        "augmentation_paper_duets": "none, built-in duets",
        "salsa": "(to extend)",
        "sampling_paper": "subjects 01, 02, 03, 60, 61",
    }.items():
        assert words in lines[name]
    assert '[study]\nname = "duets"' in invoke("study", "show", "duets").out
    invoke.refusal("study", "show", "duetts")


@pytest.mark.parametrize(
    "chosen", ["--set aside.size=3", "--until bend", "--from grow --force bend", "--only grow --only aside"]
)
def test_the_printed_command_keeps_all_options(tmp_path: Path, invoke_toys: CommandLine, chosen: str) -> None:
    words = [str(write_study(tmp_path)), "--store", str(tmp_path / "a store"), *chosen.split()]
    printed = invoke_toys("plan", *words).out.splitlines()[-1]
    assert Counter(shlex.split(printed.removeprefix("run it with: "))) == Counter(["pasdedeux", "run", *words])


def test_the_version_is_said(invoke_toys: CommandLine) -> None:
    assert invoke_toys("--version").out == f"pasdedeux {code_version()}\n"


@pytest.mark.parametrize("study", [name for name, text in shipped_studies().items() if "\nname = " in text])
def test_a_study_that_ships_runs_or_says_which_files_it_lacks_and_how_they_are_had(
    study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, invoke: CommandLine
) -> None:
    monkeypatch.chdir(tmp_path)
    ingest = read_study_tree(study, tmp_path).values["ingest"]
    if "takes" in ingest:  # of a user's own files
        assert "does not exist" in invoke.refusal("plan", study)
    elif all(family.get("takes") == [] for family in ingest.get("pairs", {}).values()):
        invoke("plan", study)
    else:
        said = invoke.refusal("plan", study)
        words = r"does not exist in .*, nor do (\d+) others of the (\d+) that ingest.pairs names; .* MB\b"
        lacking = re.search(words, said)
        assert int(lacking[1]) == int(lacking[2]) - 1
        assert re.search(r"`pasdedeux fetch [ \w-]+` brings them|--set ingest.pairs.\w+.folder", said)


def test_a_study_without_evaluation_is_summed_up(toy_store: Store, invoke_toys: CommandLine) -> None:
    shutil.rmtree(toy_store.root / "judge")
    out = invoke_toys.at(toy_store)("status").out
    assert re.search(r" models \(\d+ kB\)", out)
    assert "is it good: not judged" in out


@pytest.mark.parametrize("package", ["flows", "tasks", "storage_schema", "pasdedeux"])
def test_numbers_get_their_nouns_in_one_place(package: str) -> None:
    by_hand = re.compile(r"""\{'s' \*|else 's'\}|counted\([^()]*, .more.\)|\bproblems"\)""")
    texts = {path.relative_to(ROOT): path.read_text() for path in (ROOT / package).rglob("*.py")}
    by_file = {str(path): match[0] for path, text in texts.items() if (match := by_hand.search(text))}
    assert by_file == {}, "`counted` does it"


def test_long_work_says_that_it_goes_on(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
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
