"""Shards of a stage: the key, the random numbers that it draws, and facts of what it has made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import Parameters, Shard, SourceFile, facts
from tasks.stage.facts import Facts, ModelFacts, SeedFacts, SequenceFacts, TakeFacts, facts_of
from tasks.stage.streams import stream
from tests.builders.storage_rows import put


class Named(Parameters):
    name: str = "given"


def test_all_that_decides_a_shard_is_in_its_key_and_where_things_lie_is_not() -> None:
    digest, changed = "1" * 64, "2" * 64
    read = ArtifactRef("ingest", digest, digest)
    shard = Shard(
        *("grow", 1, "t0", "a", Named()), {"log": (read,)}, (SourceFile("here", digest),), after=("k",), seed=1
    )
    deciding: list[dict[str, Any]] = [
        *({"stage": "bend"}, {"version": 2}, {"partition": "t1"}, {"name": "b"}, {"seed": 2}, {"after": ("l",)}),
        {"parameters": Named(name="b")},
        {"inputs": {"log": (replace(read, content_digest=changed),)}},
        {"inputs": {"other": (read,)}},
        {"files": (SourceFile("here", changed),)},
    ]
    keys = {replace(shard, **change).key for change in deciding}
    assert len(keys | {shard.key}) == len(deciding) + 1
    assert replace(shard, files=(SourceFile("there", digest),)).key == shard.key
    assert replace(shard, inputs={"log": (replace(read, key=changed),)}).key == shard.key, "other work, the same bytes"


def test_streams_of_other_seeds_and_labels_are_other_streams_and_the_same_ones_repeat() -> None:
    labels = [
        (1,),
        (2,),
        (1, "a"),
        (1, "b"),
        (2, "a"),
        (1, "a", 0),
        (1, "a", 1),
        (1, "a", "b"),
        (1, "ab"),
        (1, "b", "a"),
    ]
    drawn = [stream(*label).random(4) for label in labels]
    assert len({tuple(values) for values in drawn}) == len(labels)
    for values, label in zip(drawn, labels, strict=True):
        np.testing.assert_array_equal(stream(*label).random(4), values)
    assert stream(3, "chains", 1).integers(10**9) == 546688386, "in every process and on every machine"


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
