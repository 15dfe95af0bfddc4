from __future__ import annotations

import pytest

from storage_schema import (
    ArtifactRef,
    CorruptArtifact,
    MissingArtifact,
    StorageError,
    Store,
    UnknownReference,
    create_dataset,
    list_datasets,
)
from storage_schema.datasets import open_dataset
from storage_schema.errors import DatasetExists
from tests.builders.storage_rows import commit_rows


@pytest.fixture
def refs(store: Store) -> list[ArtifactRef]:
    return [commit_rows(store, name=str(number)) for number in range(3)]


def test_a_dataset_is_a_named_list_that_reads_back(store: Store, refs: list[ArtifactRef]) -> None:
    made = create_dataset(store, "released", refs, note="for the paper", attachments={"card.md": b"# Card"})
    assert made.label == "released@1"
    assert open_dataset(store, "released@1") == made
    assert made.refs == tuple(refs)
    assert (made.path / "card.md").read_bytes() == b"# Card"
    assert list_datasets(store) == [made]
    assert list((store.root / "tmp").iterdir()) == []


def test_versions_count_up_and_the_newest_is_the_default(store: Store, refs: list[ArtifactRef]) -> None:
    for _ in range(11):
        last = create_dataset(store, "released", refs)
    named = create_dataset(store, "released", refs, version="draft")
    assert last.version == "11"
    assert open_dataset(store, "released") == last
    assert open_dataset(store, "released@draft") == named
    assert create_dataset(store, "other", refs).version == "1"


def test_a_dataset_is_never_overwritten(store: Store, refs: list[ArtifactRef]) -> None:
    made = create_dataset(store, "released", refs, version="1")
    with pytest.raises(DatasetExists, match="released@1 was already made"):
        create_dataset(store, "released", refs[:1], version="1")
    assert open_dataset(store, "released@1") == made


def test_its_digest_follows_the_artifacts(store: Store, refs: list[ArtifactRef]) -> None:
    one, same, other = (create_dataset(store, "a", part) for part in (refs, refs, refs[:2]))
    assert one.digest == same.digest
    assert one.digest != other.digest


def test_what_cannot_be_a_dataset_is_refused(store: Store, refs: list[ArtifactRef]) -> None:
    for name in ("", "a/b", "a@b", ".a"):
        with pytest.raises(StorageError, match="cannot name a dataset"):
            create_dataset(store, name, refs)
    with pytest.raises(StorageError, match="at least one artifact"):
        create_dataset(store, "a", [])
    store.discard(refs[0])
    with pytest.raises(MissingArtifact):
        create_dataset(store, "a", refs)
    assert list_datasets(store) == []
    with pytest.raises(UnknownReference, match=r"there is no dataset 'a' .*there are: none"):
        open_dataset(store, "a")


def test_a_damaged_list_is_said(store: Store, refs: list[ArtifactRef]) -> None:
    made = create_dataset(store, "released", refs)
    (made.path / "dataset.json").write_text("{")
    with pytest.raises(CorruptArtifact, match="dataset released@1 cannot be read"):
        open_dataset(store, "released")
