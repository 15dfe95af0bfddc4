"""The page of small and odd runs: one stage alone, names that are markup, more takes than fit."""

from __future__ import annotations

from pathlib import Path

import pytest

from storage_schema import Store
from tasks.evaluation import STAGE
from tasks.stage import StageInputs
from tasks.summary import summary_of
from tests.builders.pages import Page
from tests.builders.storage_rows import put, random_columns
from tests.builders.walking_takes import put_take

NUM_MANY = 300
MARKUP = '"><script>alert(1)</script> & <b>'


def page_of(store: Store, num_takes: int, **settings: object) -> tuple[Page, str, str]:
    """Return the page of a run of the first stage alone, its text, and the card; makes what is not there."""
    made = list(store.artifacts("ingest")) or [put_take(store, f"take{number:03d}") for number in range(num_takes)]
    inputs = StageInputs(dict.fromkeys(("poses", "takes"), made), seed=1)
    planned = [
        shard for shard in STAGE.plan(inputs, STAGE.parameters(**settings)) if shard.partition in ("takes", "report")
    ]
    there = [store.find(shard.stage, shard.key) for shard in planned]
    refs = [
        STAGE.run_shard(one, store) if found is None else found.ref for one, found in zip(planned, there, strict=True)
    ]
    text = store.attachment(refs[-1], "report.html").decode()
    return Page(text), text, store.attachment(refs[-1], "card.md").decode()


def test_a_run_of_one_stage_has_a_page_that_says_what_is_not_there_and_which_keys_ask_for_it(tmp_path: Path) -> None:
    page, text, card = page_of(Store(tmp_path), 1, title=MARKUP, description=MARKUP)
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    assert page.headings[0] == (1, MARKUP)
    assert [heading for _, heading in page.headings[1:]] == [
        "What was built",
        "Is it good?",
        "Takes",
        "Left out, and why",
        "Sources and licences",
    ]
    assert "<script>alert" not in text
    assert "made nothing of the kind: Sequences, Views, Chains" in text
    assert "`" not in text.split("<script>")[0]
    assert "1 take" in card
    assert "othing to show" not in card, "the card says what the data leaves out, not the page"
    assert "made up (CC0)" in text


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(tmp_path_factory.mktemp("many"))


@pytest.mark.parametrize("max_page_mb", [0.2, 4.5])
def test_a_page_of_300_takes_is_never_larger_than_asked_for_and_says_what_it_left_out(
    many: Store, max_page_mb: float
) -> None:
    page, text, _ = page_of(many, NUM_MANY, max_page_mb=max_page_mb)
    assert len(text.encode()) <= 1e6 * max_page_mb
    assert 4 <= len(page.scenes) < NUM_MANY
    assert f"{NUM_MANY - len(page.scenes)} pictures lie beside the page" in text
    assert "<code>evaluation.max_page_mb</code>" in text
    beside = {name for one in many.artifacts("evaluation") for name in one.attachments}
    assert sum(name.endswith(".player.json") for name in beside) == NUM_MANY


def test_a_model_of_many_arrays_is_one_model(tmp_path: Path) -> None:
    store = Store(tmp_path)
    made = [put(store, "training", name, {"models": random_columns("models", 5)}, {}) for name in "ab"]
    assert summary_of(made).built.startswith("2 models (")
