"""README and docs: links lead somewhere, commands, studies, modules and equations exist, snippets and examples run."""

from __future__ import annotations

import doctest
import importlib
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from flows.console.app import COMMANDS, app
from flows.study_files import shipped_studies
from flows.study_keys import study_keys
from pasdedeux.formats.poses2d.own_layout import read_layout
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from storage_schema import ShardRecord, Store, record_latest
from tasks.graph import load_graph
from tests.builders.storage_rows import commit_rows

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "deploy" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAPERS = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
STUDY_COLUMN = [
    [cell.strip() for cell in line.strip("|").split("|")][2]
    for line in PAPERS.splitlines()
    if line.startswith("| ") and line.count(" | ") == 3
]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file(page: Path) -> None:
    links = re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


def commands_shown() -> dict[str, list[str]]:
    """Return the commands that pages, studies that ship and helps show, by where."""
    found: dict[str, list[str]] = {}
    for page in PAGES:
        lines = [line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()]
        lines += re.findall(r"`(pasdedeux [^`]+)`", page.read_text(encoding="utf-8").replace("\n", " "))
        found[page.name] = [line for line in lines if line.startswith("pasdedeux ")]
    for name, text in shipped_studies().items():
        found[name] = re.findall(r"^#.*?\s(pasdedeux \w+ .*?)(?:  | \\|\)|$)", text, re.MULTILINE)
    return found


@pytest.mark.parametrize(("where", "lines"), commands_shown().items(), ids=list(commands_shown()))
def test_every_command_and_option_that_is_shown_exists(where: str, lines: list[str]) -> None:
    for name in COMMANDS:
        importlib.import_module(f"flows.console.{name}")
    commands = typer.main.get_command(app)
    for line in lines:
        words = line.split("#  ")[0].split(" # ")[0].split()[1:]
        command = commands
        while hasattr(command, "commands") and words[0] not in ("...", "--debug", "--help", "--version"):
            assert words[0] in command.commands, line
            command = command.commands[words.pop(0)]
        options = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        assert [word for word in words if word.startswith("--") and word not in {*options, "--help"}] == [], line
        if command.name in ("run", "plan", "show") and words and words[0].isidentifier() and words[0].islower():
            assert words[0] in shipped_studies(), line


def help_pages(command: Any, *words: str) -> Iterator[tuple[str, str]]:
    """Return each command and its `--help` on a terminal of 80 columns."""
    context = typer.Context(command, info_name=" ".join(("pasdedeux", *words)), terminal_width=80)
    yield " ".join(words), command.get_help(context)
    for name, below in getattr(command, "commands", {}).items():
        yield from help_pages(below, *words, name)


def test_help_fits_80_columns() -> None:
    for name in COMMANDS:
        importlib.import_module(f"flows.console.{name}")
    pages = dict(help_pages(typer.main.get_command(app)))
    assert len(pages) > 25
    assert {(name, line) for name, page in pages.items() for line in page.splitlines() if len(line) > 80} == set()


def test_every_study_that_ships_stands_in_the_table_of_studies_and_no_other() -> None:
    page = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8").partition("## Studies that ship")[2]
    rows = re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
    in_table = re.findall(r"`(\w+)`", " ".join(rows))
    runnable = [name for name, text in shipped_studies().items() if "name" in tomllib.loads(text)["study"]]
    assert sorted(in_table) == sorted(runnable)


def test_only_the_studies_of_the_papers_say_how_long_they_once_took() -> None:
    for name, text in shipped_studies().items():
        if "_paper" in name:
            continue
        said = re.findall(r"^#.*(?:\d (?:min|h|hours?)\b|hour|took \d).*$", text, re.MULTILINE)
        assert said == [], name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_study_that_is_shown_has_keys_that_exist(page: Path) -> None:
    keys = {key.name: key.meaning for key in study_keys(load_graph())}
    shared = {f"{name[:-1]}{key}" for name in keys if name.endswith(".*") for key in keys[name][15:].split(", ")}
    known = {re.sub(r"\.(N|NAME)(?=\.|$)", "", name) for name in {*keys, *shared}}

    def check(path: str, value: object) -> None:
        if isinstance(value, dict) and path.endswith(".sweep"):
            for item in value.values():
                check(path.removesuffix(".sweep"), item)
        elif isinstance(value, dict) and path:
            tables = [name for name in value if f"{path}.{name}" not in known]
            assert path in known or "." not in path, path
            for name, item in value.items():
                # A name of the reader's own stands where a key is not known; what is below it must be.
                check(path if name in tables and isinstance(item, dict) else f"{path}.{name}", item)
        elif isinstance(value, dict):
            for name, item in value.items():
                check(name, item)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for item in value:
                check(path, item)
        else:
            named = ("ingest.mappings.", "ingest.capture.limits.", "generation.key_frames.")  # by the reader
            assert path in known or path.startswith(named), path

    for text in blocks(page, "toml"):
        if "keypoints" in tomllib.loads(text):
            read_layout(text)  # a layout of the reader's own, in a file of its own
        else:
            check("", tomllib.loads(text))


def test_the_snippets_about_reading_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path / "store")
    stages = {"poses": "ingest", "variant_quality": "augmentation"}
    refs = {table: commit_rows(store, table, 6, stage=stage, partition="waltz") for table, stage in stages.items()}
    records = {stages[table]: [ShardRecord.of(store.manifest(ref), store)] for table, ref in refs.items()}
    record_latest(store, "duets", "run-1", records)
    monkeypatch.chdir(tmp_path)
    snippets = blocks(ROOT / "docs" / "reading-the-store.md", "python")
    assert len(snippets) == 4
    for snippet in snippets:
        exec(compile(snippet, "reading-the-store.md", "exec"), {})


EXAMPLES = [
    path.relative_to(ROOT).with_suffix("")
    for package in ("pasdedeux", "tasks", "flows", "storage_schema")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "    >>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("module", EXAMPLES, ids=str)
def test_the_examples_of_docstrings_give_what_they_show(module: Path) -> None:
    shown = doctest.testmod(importlib.import_module(".".join(module.parts)))
    assert (shown.attempted > 0, shown.failed) == (True, 0)


def test_the_table_of_humanoid_names_is_that_of_the_code() -> None:
    page = (ROOT / "docs" / "formats-and-units.md").read_text(encoding="utf-8")
    for joint, name in HUMANOID_NAMES.items():
        is_written = f"| {joint} | {name} |" in page
        assert is_written is not joint.startswith("right_")


def test_every_module_of_the_page_on_papers_exists() -> None:
    modules = set(re.findall(r"`((?:pasdedeux|flows|tasks)/[\w/]+\.py)`", PAPERS))
    assert len(modules) > 20
    assert [module for module in sorted(modules) if not (ROOT / module).is_file()] == []


def test_every_study_of_the_page_on_papers_ships() -> None:
    studies = {name for cell in STUDY_COLUMN for name in re.findall(r"`(\w+)`", cell)}
    assert {"sampling_paper", "projection_paper", "augmentation_paper"} <= studies
    assert studies - set(shipped_studies()) == set()


@pytest.mark.parametrize(
    ("number", "count"), [(1, 13), (2, 2), (3, 8)], ids=["Yin et al. 2018", "Yiannakides et al. 2019", "Li et al. 2024"]
)
def test_every_equation_of_a_paper_has_a_row(number: int, count: int) -> None:
    cells = re.findall(r"^\| (.*?) \|", PAPERS.split("\n## ")[number], re.MULTILINE)
    named: set[int] = set()
    for first, _, second in re.findall(r"\beqs?\. (\d+)( and | to )?(\d+)?", "\n".join(cells)):
        named |= set(range(int(first), int(second or first) + 1))
    assert named == set(range(1, count + 1))
