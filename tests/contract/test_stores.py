"""The laws of every kind of store: a kind is a class that says how its store is opened here, and from elsewhere."""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

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
    list_runs,
    new_run,
    read_latest,
    record_latest,
    verify,
)
from storage_schema.bucket_store import BucketStore
from storage_schema.datasets import open_dataset
from storage_schema.errors import DatasetExists, NamedByDataset
from storage_schema.folder_store import FolderStore
from storage_schema.version import SCHEMA_VERSION
from tests.builders.s3_server import s3_server
from tests.builders.storage_rows import assert_same_values, commit_rows, random_columns

Elsewhere = Callable[[], Store]
READS: dict[str, Callable[[Store, ArtifactRef], object]] = {
    "table": lambda store, ref: store.read(ref, "scores"),
    "batches": lambda store, ref: list(store.iter_batches(ref, "scores")),
    "attachment": lambda store, ref: store.attachment(ref, "note.txt"),
}


class StoreTests:
    """What holds of any store."""

    kind: type[Store]

    @pytest.fixture
    def store(self) -> Store:
        """Return a store that is not there yet."""
        raise NotImplementedError

    @pytest.fixture
    def elsewhere(self, store: Store) -> Elsewhere:
        """Return what opens it as another machine does, which looks at what there is now."""
        raise NotImplementedError

    def test_a_place_names_a_store_of_its_kind_which_travels_by_pickle(self, store: Store) -> None:
        assert type(Store(str(store))) is self.kind
        assert pickle.loads(pickle.dumps(store)) == store == Store(str(store))
        assert type(pickle.loads(pickle.dumps(store))) is self.kind

    def test_one_that_is_not_there_has_nothing_and_is_not_made_by_looking(self, store: Store) -> None:
        store.refresh()
        assert store.find("judge", "0" * 64) is None
        assert list(store.artifacts()) == list_datasets(store) == list_runs(store) == []
        with pytest.raises(MissingArtifact, match=r"judge@0+ is not in the store"):
            store.manifest(ArtifactRef("judge", "0" * 64, "0" * 64))
        assert [path for path in store.root.rglob("*") if path.is_file()] == []

    def test_a_commit_is_found_by_all_and_its_manifest_says_what_it_is(
        self, store: Store, elsewhere: Elsewhere
    ) -> None:
        named = {"stage": "ingest", "partition": "waltz", "name": "3", "seed": 5, "files": (("a.bvh", "ab"),)}
        facts = {"takes": ["waltz"], "num_frames": 7}
        ref = commit_rows(store, "poses", 7, **named, facts=facts, attachments={"note.txt": b"hello"})
        for place in (store, elsewhere()):
            manifest = place.find("ingest", ref.key)
            assert manifest is not None
            assert manifest.ref == ref
            assert (manifest.partition, manifest.name, manifest.version, manifest.seed) == ("waltz", "3", 1, 5)
            assert manifest.parameters == {"partition": "waltz", "name": "3", "num_rows": 7}
            assert manifest.files == (("a.bvh", "ab"),)
            assert manifest.tables["poses"].rows == 7
            assert manifest.attachments["note.txt"].bytes == 5
            assert manifest.facts == facts
            assert manifest.schema_version == SCHEMA_VERSION
            assert len(manifest.source_digest) == 64
            assert {"python", "numpy", "pyarrow"} <= set(manifest.package_versions)
            assert place.manifest(ref) == manifest
            assert place.attachment(ref, "note.txt") == b"hello"
            assert [found.ref for found in place.artifacts()] == [ref]
            assert list(place.artifacts("chains")) == []
            assert verify(place).is_ok

    def test_rows_come_back_as_they_were_given(self, store: Store, elsewhere: Elsewhere) -> None:
        ref, given = commit_rows(store, "draws", 5), random_columns("draws", 5)
        found = elsewhere().read(ref, "draws")
        for name, values in given.items():
            assert_same_values(found[name], values)

    def test_who_commits_second_gets_what_is_there(
        self, store: Store, elsewhere: Elsewhere, caplog: pytest.LogCaptureFixture
    ) -> None:
        def make(place: Store, note: bytes) -> ArtifactRef:
            return commit_rows(place, attachments={"note.txt": note})

        first = make(store, b"1")
        assert make(elsewhere(), b"1") == first
        assert not caplog.records
        assert make(elsewhere(), b"2") == first
        assert "computed a second time with other bytes" in caplog.text
        assert [manifest.ref for manifest in elsewhere().artifacts()] == [first]
        assert list((store.root / "tmp").iterdir()) == []

    def test_what_is_made_again_takes_its_place_unless_a_dataset_needs_the_old_one(
        self, store: Store, elsewhere: Elsewhere
    ) -> None:
        def make(place: Store, note: bytes) -> ArtifactRef:
            return commit_rows(place, attachments={"note.txt": note}, replaces=True)

        first, second = make(store, b"1"), make(elsewhere(), b"2")
        assert first != second
        with pytest.raises(CorruptArtifact, match="it was rebuilt with other bytes"):
            elsewhere().manifest(first)
        assert elsewhere().attachment(second, "note.txt") == b"2"
        create_dataset(elsewhere(), "toys", [second])
        with pytest.raises(NamedByDataset, match="dataset toys@1 needs the old one, which stays"):
            make(elsewhere(), b"3")
        assert make(elsewhere(), b"2") == second
        assert verify(elsewhere()).is_ok

    @pytest.mark.parametrize("read", READS)
    def test_what_takes_the_place_of_an_artifact_while_it_is_read_is_not_taken_for_it(
        self, store: Store, monkeypatch: pytest.MonkeyPatch, read: str
    ) -> None:
        ref, found = commit_rows(store, attachments={"note.txt": b"1"}), self.kind.data_file

        def find_late(*wanted: object) -> Path:
            commit_rows(store, attachments={"note.txt": b"2"}, replaces=True)
            return found(*wanted)  # type: ignore[arg-type]

        monkeypatch.setattr(self.kind, "data_file", find_late)
        with pytest.raises(CorruptArtifact):
            READS[read](store, ref)

    def test_a_writer_whose_block_raises_leaves_nothing_behind(self, store: Store, elsewhere: Elsewhere) -> None:
        def broken() -> None:
            named = {"stage": "judge", "key": "0" * 64, "partition": "p", "name": "n", "version": 1, "parameters": {}}
            with store.writer(**named, seed=0, inputs=[], files=[]) as writer:  # type: ignore[arg-type]
                writer.append("scores", random_columns("scores", 3))
                raise RuntimeError("solver diverged")

        with pytest.raises(RuntimeError, match="solver diverged"):
            broken()
        assert store.find("judge", "0" * 64) is None
        assert list(elsewhere().artifacts()) == []
        assert list((store.root / "tmp").iterdir()) == []

    def test_an_input_that_is_not_in_the_store_is_refused(self, store: Store) -> None:
        with pytest.raises(MissingArtifact, match="ingest@"):
            commit_rows(store, inputs=(ArtifactRef("ingest", "0" * 64, "0" * 64),))

    def test_a_discarded_artifact_is_missing_everywhere(self, store: Store, elsewhere: Elsewhere) -> None:
        ref, far = commit_rows(store), elsewhere()
        store.discard(ref)
        store.discard(ref)
        for place in (store, elsewhere()):
            assert place.find(ref.stage, ref.key) is None
        far.refresh()
        assert list(far.artifacts()) == []
        assert commit_rows(store) == ref

    def test_a_damaged_file_is_named_and_dropped_and_a_new_commit_heals_it(self, store: Store) -> None:
        ref = commit_rows(store, attachments={"note.txt": b"note"})
        assert not store.drop_damaged(store.manifest(ref))
        path = store.data_file(ref, "note.txt", store.manifest(ref).attachments["note.txt"])
        path.write_bytes(b"nose")
        assert store.drop_damaged(store.manifest(ref))
        assert commit_rows(store, attachments={"note.txt": b"note"}) == ref
        assert store.attachment(ref, "note.txt") == b"note"
        assert verify(store).is_ok

    def test_what_runs_leave_is_there_for_the_next(self, store: Store, elsewhere: Elsewhere) -> None:
        with store.in_use():
            run = new_run(store, "duets")
            run.write("run.json", {"status": "finished"})
            latest = record_latest(store, "duets", run.run_id, {})
            assert store.can_write()
        far = elsewhere()
        assert [record.run_id for record in list_runs(far)] == [run.run_id]
        assert read_latest(far, "duets") == latest
        with far.in_use(alone=True):
            far.remove_folders([far.root / "runs" / run.run_id])
            far.sweep()
        assert list_runs(elsewhere()) == []

    def test_a_dataset_is_a_named_list_that_reads_back(self, store: Store, elsewhere: Elsewhere) -> None:
        refs = [commit_rows(store, name=str(number)) for number in range(3)]
        made = create_dataset(store, "released", refs, note="for the paper", attachments={"card.md": b"# Card"})
        assert (made.label, made.refs) == ("released@1", tuple(refs))
        for place in (store, elsewhere()):
            (found,) = list_datasets(place)
            assert (found.digest, found.note, found.sources) == (made.digest, made.note, made.sources)
            assert open_dataset(place, "released@1") == found
            assert (found.path / "card.md").read_bytes() == b"# Card"
        assert list((store.root / "tmp").iterdir()) == []

    def test_versions_count_up_and_the_newest_is_the_default(self, store: Store) -> None:
        refs = [commit_rows(store)]
        for _ in range(11):
            last = create_dataset(store, "released", refs)
        named = create_dataset(store, "released", refs, version="draft")
        assert last.version == "11"
        assert open_dataset(store, "released") == last
        assert open_dataset(store, "released@draft") == named
        assert create_dataset(store, "other", refs).version == "1"

    def test_a_dataset_is_never_overwritten(self, store: Store, elsewhere: Elsewhere) -> None:
        refs, far = [commit_rows(store, name=str(number)) for number in range(2)], elsewhere()
        made = create_dataset(store, "released", refs, version="1")
        with pytest.raises(DatasetExists, match="released@1 was already made"):
            create_dataset(far, "released", refs[:1], version="1")
        assert open_dataset(far, "released@1").digest == open_dataset(store, "released@1").digest == made.digest
        assert create_dataset(elsewhere(), "released", refs[:1]).version == "2"

    def test_the_digest_of_a_dataset_follows_its_artifacts(self, store: Store) -> None:
        refs = [commit_rows(store, name=str(number)) for number in range(3)]
        first, same, shorter = (create_dataset(store, "a", part) for part in (refs, refs, refs[:2]))
        assert first.digest == same.digest
        assert first.digest != shorter.digest

    def test_what_cannot_be_a_dataset_is_refused(self, store: Store) -> None:
        refs = [commit_rows(store, name=str(number)) for number in range(3)]
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


class TestFolderStore(StoreTests):
    kind = FolderStore

    @pytest.fixture
    def store(self, tmp_path: Path) -> Store:
        return Store(tmp_path / "store")

    @pytest.fixture
    def elsewhere(self, store: Store) -> Elsewhere:
        return lambda: Store(store.root)

    def test_a_damaged_list_is_said(self, store: Store) -> None:
        made = create_dataset(store, "released", [commit_rows(store)])
        (made.path / "dataset.json").write_text("{")
        with pytest.raises(CorruptArtifact, match="dataset released@1 cannot be read"):
            open_dataset(store, "released")


class TestBucketStore(StoreTests):
    kind = BucketStore

    @pytest.fixture
    def store(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
        with s3_server(monkeypatch) as server:
            monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
            yield Store(server.place)

    @pytest.fixture
    def elsewhere(self, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Elsewhere:
        number = itertools.count()

        def opened() -> Store:
            monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / f"cache-{next(number)}"))
            there = Store(str(store))
            there.refresh()
            return there

        return opened
