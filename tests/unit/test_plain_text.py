"""Names, notes and credits of others: they drive no terminal, compute nothing in a table, and are no HTML."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flows.console.app import run_command_line
from flows.console.context import answer, echo
from flows.console.display import format_table
from flows.exports import export_reference
from flows.exports.credits import write_credits
from flows.templates import fill_template
from pasdedeux.evaluation.report import Report, Section, render
from pasdedeux.evaluation.summary import Credit, Summary
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, get_keypoint_layout
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv, write_annotation_csv
from pasdedeux.people.decisions import Decision, read_decisions, write_decisions
from pasdedeux.plain_text import csv_line, from_cell, markdown_text, visible
from storage_schema import SourceCredit, Store, create_dataset
from tasks.evaluation.report import DatasetCard
from tests.builders.storage_rows import commit_rows, put, random_columns

ROOT = Path(__file__).parents[2]
ESCAPES = ("\x1b]0;owned\x07", "\x1b[2J", "\x9b31m", "a\rb", "\u202egnp.exe", "\x00", "\udc9b")
FORMULAS = ('=HYPERLINK("http://x","y")', "+1+cmd", "-2+3", "@SUM(1)", " =1", "\uff1d1")
_RAW = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


@given(st.text())
def test_nothing_that_is_shown_drives_a_terminal_and_json_stays_the_same(text: str) -> None:
    assert not _RAW.search(visible(text))
    assert not re.search(r"[\n\t]", visible(text, is_line=True))
    assert json.loads(visible(json.dumps([text], ensure_ascii=False))) == [text]


@pytest.mark.parametrize("text", ESCAPES)
def test_escapes_are_written_out_everywhere(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = Store(tmp_path / "store")
    ref = commit_rows(store)
    if "\udc9b" not in text:
        create_dataset(store, "pulled", [ref], note=f"note {text}")
        assert run_command_line(["dataset", "list", "--store", str(store.root)]) == 0
        assert run_command_line(["dataset", "list", "--store", str(store.root), "--json"]) == 0
        credited = write_credits([SourceCredit(*[f"s {text}"] * 3)], [ref], "scores", tmp_path).read_text("utf-8")
        assert not _RAW.search(credited)
    assert run_command_line(["plan", f"{text}.toml", "--store", str(store.root)]) == 2
    assert run_command_line(["plan", f"--{text}"]) == 2
    answer([text], format_table(("a", "b"), [(text, f"{text}\nb")]), as_json=False)
    answer([text], [], as_json=True)
    echo(text, err=True)
    said = capsys.readouterr()
    assert not _RAW.search(said.out + said.err)


def test_commands_print_in_one_place() -> None:
    printing = {
        path.relative_to(ROOT / "flows").as_posix(): re.findall(r"\b(?:typer\.s?echo|print)\([^\n]*", text)
        for path in (ROOT / "flows").rglob("*.py")
        if (text := path.read_text(encoding="utf-8"))
    }
    assert {name: calls for name, calls in printing.items() if calls} == {
        "console/context.py": ["typer.echo(visible(text), err=err)"],
        "console/live.py": ["typer.echo(json.dumps(line), file=self._out)"],
        "console/display.py": ["print(line, markup=False, soft_wrap=True)"],
    }


@given(st.lists(st.one_of(st.text(), st.text("a\n\r,\"'=-1"), st.sampled_from(FORMULAS)), min_size=1))
def test_no_cell_of_a_line_is_a_formula_and_texts_come_back(cells: list[str]) -> None:
    (read,) = csv.reader(io.StringIO(csv_line(*cells), newline=""), strict=True)
    assert [from_cell(cell) for cell in read] == [visible(cell) for cell in cells]
    for cell in read:
        assert not re.match(r"\s*[=@]|\s*[+-](?![\d.in])", cell, re.IGNORECASE)


@pytest.mark.parametrize("name", ["-walk", "-2-3", "walk"])
def test_tables_of_2d_poses_and_people_keep_their_names_and_hold_no_formula(name: str) -> None:
    frames = AnnotatedFrames.of(
        get_keypoint_layout("pair17"),
        sequence_id=(name,),
        frame=np.array([3]),
        person_id=np.array([1]),
        keypoints_px=np.arange(34.0).reshape(1, 17, 2) - 5.0,
        confidence=np.ones((1, 17)),
    )
    table, people = write_annotation_csv(frames), write_decisions([Decision(name, 0, 9, 1, -1)])
    assert "\n-5.00" not in table
    assert ",-5.00,-4.00,1" in table
    for text in (table, people):
        rows = list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))[1:]
        assert all(not row[0].lstrip().startswith(tuple("=+-@")) for row in rows)
    assert set(read_annotation_csv(table).sequence_id) == {name}
    assert read_decisions(people)[0].sequence_id == name


def test_an_exported_table_holds_no_formula(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    columns = random_columns("scores", len(FORMULAS)) | {"item": list(FORMULAS), "value": -np.ones(len(FORMULAS))}
    ref = put(store, "evaluation", "odd", {"scores": columns}, {}).ref
    path, *_ = export_reference(store, f"scores@{ref.key}", "csv", tmp_path / "out")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["item"] for row in rows] == [f"'{text}" for text in FORMULAS]
    assert [row["value"] for row in rows] == ["-1.0"] * len(FORMULAS)


HOSTILE = ("<script>alert(1)</script>", "![x](http://x/y)", "[click](javascript:1)", "a | b\n| c |", "\x1b]0;x\x07")


@pytest.mark.parametrize("text", HOSTILE)
def test_cards_and_pages_show_what_others_wrote_as_text(text: str) -> None:
    summary = Summary(made=[], sources=[Credit(text, text, text)], verdicts={})
    card = DatasetCard(text, text, summary, {text: 1}, {text: True}, [text])
    for page in (render("card.md", card=card), markdown_text(text)):
        assert not re.search(r"<script|(?<!\\)\[(x|click)(?<!\\)\]|\x1b", page)
    assert "<script>alert" not in render("report.html", report=Report(text, text, summary, [Section(text, (text,))]))
    rows = [line for line in render("card.md", card=card).splitlines() if line.startswith("| ")]
    assert len(rows) == 2, "a name makes no rows of its own"
    verdict = {"figure": text, "value": 1.0, "unit": text, "baseline_name": text, "baseline": 1.0}
    facts = {"model": text, "split": text, "class_name": text, "skeleton": text, "takes": [text], "shares_takes": False}
    manifest = {"ref": {"stage": "s", "key": "k"}, "seed": 1, "code_version": text, "version": 1, "inputs": []}
    values = {"facts": facts, "manifest": manifest, "counts": {text: 1}, "settings": "{}", "metrics": ["| a | b | c |"]}
    page = fill_template("model_card.md", verdict=verdict, **values)
    assert not re.search(r"<script|(?<!\\)\[(x|click)(?<!\\)\]|\x1b", page)
    assert "\n| a | b | c |\n" in page
