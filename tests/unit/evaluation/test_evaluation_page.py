"""The page of small and odd runs: one stage alone, names that are markup, more takes than fit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pasdedeux.evaluation.summary import Summary
from pasdedeux.evaluation.verdicts import merge_verdicts
from pasdedeux.verdict import Level, Verdict
from storage_schema import Store
from tasks.evaluation import STAGE
from tasks.stage import StageInputs
from tasks.stage.facts import ModelFacts, VariantFacts
from tasks.stage.judgements import VERDICT_FACT
from tasks.summary import summary_of
from tests.builders.pages import Page
from tests.builders.storage_rows import put, random_columns
from tests.builders.walking_takes import put_take

MARKUP = '"><script>alert(1)</script> & <b>'


def page_of(store: Store, num_takes: int, **settings: object) -> tuple[Page, str, str]:
    """Return the page, its text and the card of a run of the first stage alone; takes are made if there are none."""
    takes = list(store.artifacts("ingest")) or [put_take(store, f"take{number:03d}") for number in range(num_takes)]
    inputs = StageInputs(dict.fromkeys(("poses", "takes"), takes), seed=1)
    for shard in STAGE.plan(inputs, STAGE.parameters(**settings)):
        if shard.partition not in ("takes", "report"):
            continue
        artifact = store.find(shard.stage, shard.key)
        ref = STAGE.run_shard(shard, store) if artifact is None else artifact.ref
    text = store.attachment(ref, "report.html").decode()
    return Page(text), text, store.attachment(ref, "card.md").decode()


def test_the_page_of_a_run_of_one_stage_names_the_sections_without_data(tmp_path: Path) -> None:
    page, text, card = page_of(Store(tmp_path), 1, title=MARKUP, description=MARKUP)
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    assert page.headings[0] == (1, MARKUP)
    titles = ["What was built", "Is it good?", "Takes", "Skipped, and why", "Sources and licences"]
    assert [heading for _, heading in page.headings[1:]] == titles
    assert "<script>alert" not in text
    assert "No data in this run: Film, Sequences, Views, Chains" in text
    assert "`" not in text.split("<script>")[0]
    assert "1 take" in card
    assert "No data in this run" not in card, "the card lists what the data skipped, not the page"
    assert "made up (licence: CC0)" in text


@pytest.mark.parametrize("level", [Level.PASS, Level.WARN])
def test_the_section_of_takes_says_what_their_stage_warns_of(tmp_path: Path, level: Level) -> None:
    store = Store(tmp_path)
    put_take(store, "waltz", **{VERDICT_FACT: Verdict(level, "feet float").to_json()})
    _, text, _ = page_of(store, 1)
    assert ("Stage ingest: warn: feet float." in text) == (level is Level.WARN)


def test_a_page_of_30_takes_shows_some_and_names_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.evaluation.report._MAX_ROWS", 20)
    store = Store(tmp_path)
    page, text, _ = page_of(store, 30)
    assert len(page.scenes) == 25, "the first one stands on top as well"
    assert "6 pictures lie beside the page: take-take024.player.json, " in text
    assert re.search(r"the first 20 of \d+ rows; the table <code>scores</code> has all", text)
    beside = {name for artifact in store.artifacts("evaluation") for name in artifact.attachments}
    assert sum(name.endswith(".player.json") for name in beside) == 30


@pytest.mark.parametrize("num_arrays", [0, 5])
def test_a_model_of_any_number_of_arrays_is_one_model(tmp_path: Path, num_arrays: int) -> None:
    store = Store(tmp_path)
    facts = ModelFacts(
        split="random", model="copy", **{"class": "CopyModel"}, shares_takes=True, train={}, validation={}, test={}
    ).to_json()
    stored = [put(store, "training", name, {"models": random_columns("models", num_arrays)}, facts) for name in "ab"]
    assert summary_of(stored).built.startswith("2 models (")
    assert summary_of(stored[:1]).built.startswith("1 model (")


@pytest.mark.parametrize(("num_takes", "words"), [(1, "take with variants"), (2, "takes with variants")])
def test_one_take_with_variants_is_counted_in_the_singular(tmp_path: Path, num_takes: int, words: str) -> None:
    stored = []
    for take_id in (f"take{number}" for number in range(num_takes)):
        tables = {"variant_quality": random_columns("variant_quality", 2)}
        stored.append(put(Store(tmp_path), "augmentation", take_id, tables, VariantFacts(take_id=take_id).to_json()))
    assert [row.independent for row in summary_of(stored).made] == [(num_takes, words)]


@pytest.mark.parametrize(
    ("levels", "advice"),
    [
        ((Level.FAIL, Level.PASS), "Leave out the takes that fail."),
        ((Level.FAIL, Level.FAIL), "Do not use the takes."),
        ((Level.WARN, Level.PASS), "Read the warnings on the takes."),
    ],
)
def test_takes_of_which_some_fail_are_not_all_thrown_away(levels: tuple[Level, ...], advice: str) -> None:
    merged = merge_verdicts(Verdict(level, "the left_toe jumps" if level is not Level.PASS else "") for level in levels)
    assert merged is not None
    assert Summary([], [], {"ingest": merged}).advice == advice


def test_a_run_ends_with_what_to_use_and_with_what_fails() -> None:
    verdicts = {
        "augmentation": Verdict(Level.PASS),
        "evaluation: coverage": Verdict(Level.FAIL, "far from real pairs"),
        "views": Verdict(Level.WARN, "few views"),
    }
    lines = Summary([], [], verdicts).headlines()
    assert lines[2:4] == ["is it good: 1 fail, 1 pass, 1 warn", "Use the variants; do not use the draws."]
    assert lines[4].startswith("draws: fail: ")
    assert lines[6] == "evaluation: coverage: fail: far from real pairs"
    assert lines[7].startswith("2 more verdicts")
    assert "few views" not in "".join(lines)
