"""Facts of artifacts: what is given is written, nothing else is, and what another version wrote is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from pasdedeux.errors import InputError
from storage_schema import Manifest, Store
from tasks.stage import facts
from tasks.stage.facts import Facts, ModelFacts, SeedFacts, SequenceFacts, TakeFacts, facts_of
from tests.builders.storage_rows import put

TAKE: dict[str, Any] = {"kind": "take", "take_id": "waltz", "takes": ["waltz"], "num_persons": 2, "rate_hz": 30.0}


def stored(folder: Path, facts: dict[str, Any]) -> Manifest:
    return put(Store(folder), "ingest", "waltz", {}, facts)


def test_facts_are_written_as_they_were_given_and_read_back(tmp_path: Path) -> None:
    take = TakeFacts(take_id="waltz", takes=("waltz",), num_persons=2, rate_hz=30.0)
    assert take.to_json() == TAKE, "what is not given is not written"
    assert TakeFacts.of(stored(tmp_path, TAKE)) == take
    model = ModelFacts(
        split="random", model="copy", class_name="copy", shares_takes=True, train={}, validation={}, test={}
    )
    assert model.to_json()["class"] == "copy"


def test_what_is_not_given_is_none_and_a_model_is_of_the_whole_body_on_the_processor() -> None:
    kinds = [kind for kind in vars(facts).values() if isinstance(kind, type) and issubclass(kind, Facts)]
    given: dict[str, Any] = {}
    for kind in kinds:
        fields = {
            name: field for name, field in kind.model_fields.items() if name != "kind" and not field.is_required()
        }
        given |= {
            name: default for name, field in fields.items() if (default := field.get_default(call_default_factory=True))
        }
    assert len(kinds) > 15
    assert given == {"device": "cpu", "skeleton": "body22"}


def test_facts_that_no_stage_has_are_refused_when_they_are_written() -> None:
    with pytest.raises(ValidationError, match="rate"):
        TakeFacts(take_id="waltz", rate=30.0)  # type: ignore[call-arg]
    with pytest.raises(ValidationError, match="num_persons"):
        TakeFacts(take_id="waltz", num_persons="two")  # type: ignore[arg-type]


def test_what_another_version_wrote_is_read_as_far_as_it_goes_and_else_named(tmp_path: Path) -> None:
    later = stored(tmp_path / "later", {**TAKE, "weather": "fine"})
    assert TakeFacts.of(later).num_persons == 2
    with pytest.raises(InputError, match=r"was written by another version: its fact take_id: Field required"):
        TakeFacts.of(stored(tmp_path / "earlier", {"kind": "take"}))
    with pytest.raises(InputError, match="its fact kind"):
        SequenceFacts.of(later)


def test_facts_are_those_of_their_kind(tmp_path: Path) -> None:
    assert isinstance(facts_of(stored(tmp_path / "take", TAKE)), TakeFacts)
    assert isinstance(facts_of(stored(tmp_path / "seed", {"kind": "grown_seeds", "takes": []})), SeedFacts)
    assert type(facts_of(stored(tmp_path / "none", {"takes": ["hug"]}))) is Facts
