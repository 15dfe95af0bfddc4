from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from storage_schema import (
    ArtifactRef,
    MissingArtifact,
    Reference,
    ShardRecord,
    StorageError,
    Store,
    UnknownReference,
    create_dataset,
    iter_rows,
    open_table,
    parse_reference,
    record_latest,
    resolve,
)
from storage_schema.arrow import schema_digest
from storage_schema.tables import TABLES
from tests.builders.storage_rows import commit_rows, random_columns


def about(key: str) -> dict:
    shard = {"stage": "ingest", "key": key, "partition": "p", "name": "n", "version": 1, "parameters": {}, "seed": 0}
    return {**shard, "inputs": [], "files": []}


@pytest.fixture
def refs(store: Store) -> list[ArtifactRef]:
    """Commit a study `duets`: poses of waltz in two shards and of hug in one, and a table of scores."""
    refs = [
        commit_rows(store, "poses", 3, stage="ingest", partition="waltz", name="0"),
        commit_rows(store, "poses", 4, stage="ingest", partition="waltz", name="1", seed=1),
        commit_rows(store, "poses", 2, stage="ingest", partition="hug", seed=2),
        commit_rows(store, "scores", 5, stage="evaluation", partition="all"),
    ]
    records = [ShardRecord.of(store.manifest(ref), store) for ref in refs]
    record_latest(store, "duets", "run-1", {"ingest": records[:3], "evaluation": records[3:]})
    return refs


@pytest.mark.parametrize(
    ("text", "reference"),
    [
        ("poses@3fa9", Reference("poses", key_prefix="3fa9")),
        ("draws@3FA9bc#17", Reference("draws", key_prefix="3fa9bc", row=17)),
        ("poses:duets", Reference("poses", study="duets")),
        ("poses:duets/waltz", Reference("poses", study="duets", partition="waltz")),
        ("draws:duets/seed 0/a", Reference("draws", study="duets", partition="seed 0/a")),
        ("poses:released@2#0", Reference("poses", dataset="released@2", row=0)),
    ],
)
def test_a_reference_is_read_from_text(text: str, reference: Reference) -> None:
    assert parse_reference(text) == reference


@pytest.mark.parametrize("text", ["", "poses", "poses@", "poses@3fa", "poses@xyz1", "poses:", "@3fa9", "poses@3fa9#x"])
def test_another_form_is_refused_with_the_forms_there_are(text: str) -> None:
    with pytest.raises(UnknownReference, match="a reference is table@key"):
        parse_reference(text)


def test_an_unknown_table_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownReference, match="there is no table 'posen'; tables: takes, take_quality, poses"):
        parse_reference("posen@3fa9")


def test_a_key_prefix_opens_the_artifact_that_has_the_table(store: Store, refs: list[ArtifactRef]) -> None:
    rows = open_table(f"poses@{refs[1].key[:10]}", store)
    np.testing.assert_array_equal(rows["pair17_m"], random_columns("poses", 4, 1)["pair17_m"])
    assert resolve(f"poses@{refs[1].key}", store) == [refs[1]]


def test_a_partition_is_its_shards_one_after_another(store: Store, refs: list[ArtifactRef]) -> None:
    rows = open_table("poses:duets/waltz", store, columns=["frame", "pair17_m"])
    given = [random_columns("poses", 3), random_columns("poses", 4, 1)]
    assert rows.column_names == ["frame", "pair17_m"]
    for name in rows:
        np.testing.assert_array_equal(rows[name], np.concatenate([columns[name] for columns in given]))
    assert resolve("poses:duets", store) == refs[:3]
    batches = list(iter_rows("poses:duets/waltz", store))
    assert [batch.num_rows for batch in batches] == [3, 4]


def test_a_row_is_counted_through_the_shards(store: Store, refs: list[ArtifactRef]) -> None:
    rows = open_table("poses:duets/waltz#5", store)
    assert rows.num_rows == 1
    np.testing.assert_array_equal(rows["pair17_m"][0], random_columns("poses", 4, 1)["pair17_m"][2])
    assert next(iter_rows("poses:duets/waltz#5", store))["frame"] == rows["frame"]
    assert open_table(f"scores@{refs[3].key[:8]}#4", store).num_rows == 1
    with pytest.raises(UnknownReference, match="there is no row 7, the table has 7 rows here"):
        open_table("poses:duets/waltz#7", store)


def test_a_dataset_can_be_opened(store: Store, refs: list[ArtifactRef]) -> None:
    create_dataset(store, "released", refs[1:])
    assert resolve("poses:released@1", store) == refs[1:3]
    assert open_table("poses:released@1", store).num_rows == 6
    with pytest.raises(UnknownReference, match=r"there is no dataset 'released@2'.*there are: released@1"):
        resolve("poses:released@2", store)


def test_what_a_reference_does_not_find_is_said_with_what_is_there(store: Store, refs: list[ArtifactRef]) -> None:
    with pytest.raises(UnknownReference, match=r"study 'salsa' has not run .* studies that have: duets"):
        resolve("poses:salsa", store)
    with pytest.raises(UnknownReference, match="study 'duets' has no partition 'judo'; it has: all, hug, waltz"):
        resolve("poses:duets/judo", store)
    with pytest.raises(UnknownReference, match="partition 'waltz' holds no table 'draws'; it holds: poses"):
        resolve("draws:duets/waltz", store)
    with pytest.raises(UnknownReference, match=r"no artifact in the store .* has such a key"):
        resolve("poses@" + "0" * 12, store)
    with pytest.raises(UnknownReference, match="holds no such table; it holds: poses"):
        resolve(f"draws@{refs[0].key[:12]}", store)


def test_a_prefix_of_two_keys_is_refused_with_both(store: Store) -> None:
    keys = ["ab12" + "0" * 60, "ab12" + "1" * 60]
    for key in keys:
        store.commit(**about(key), tables={"poses": random_columns("poses", 1)})
    with pytest.raises(UnknownReference, match=r"names 2 artifacts; give more digits: ingest@ab12.*, ingest@ab12"):
        resolve("poses@ab12", store)
    assert resolve("poses@ab121", store)[0].key == keys[1]


def test_a_recorded_artifact_that_is_gone_is_said(store: Store, refs: list[ArtifactRef]) -> None:
    store.discard(refs[1])
    with pytest.raises(MissingArtifact, match=r"ingest@.* of study 'duets' is incomplete .* run the study again"):
        open_table("poses:duets/waltz", store)


def test_earlier_columns_are_said(store: Store, refs: list[ArtifactRef], monkeypatch: pytest.MonkeyPatch) -> None:
    now = TABLES["poses"]
    fewer = replace(now, columns=now.columns[:-1])
    monkeypatch.setattr("storage_schema.store._declared", lambda table: schema_digest(fewer))
    said = (
        r"artifact ingest@\w+ of study 'duets' has columns of an earlier version \(poses\) in the store .*; "
        "run the study again"
    )
    with pytest.raises(MissingArtifact, match=said):
        resolve("poses:duets/waltz", store)


def test_a_table_is_read_whatever_other_stages_have_lost(store: Store, refs: list[ArtifactRef]) -> None:
    lost = store.commit(**{**about("f" * 64), "stage": "chains"}, tables={"draws": random_columns("draws", 1)})
    records = {ref.stage: [ShardRecord.of(store.manifest(ref), store)] for ref in (refs[0], lost)}
    record_latest(store, "both", "run-1", records)
    store.discard(lost)
    assert resolve("poses:both", store) == [refs[0]]
    with pytest.raises(MissingArtifact, match="chains@ffffffffffff of study 'both' is incomplete"):
        resolve("draws:both", store)


def test_the_environment_names_the_store(
    store: Store, refs: list[ArtifactRef], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PASDEDEUX_STORE", str(store.root))
    assert open_table("poses:duets/hug").num_rows == 2
    monkeypatch.delenv("PASDEDEUX_STORE")
    monkeypatch.chdir(store.root.parent)
    assert open_table("poses:duets/hug").num_rows == 2
    assert open_table("poses:duets/hug", str(store.root)).num_rows == 2


def test_a_study_cannot_be_named_out_of_the_store(store: Store, refs: list[ArtifactRef]) -> None:
    with pytest.raises(StorageError):
        resolve("poses:../x", store)
