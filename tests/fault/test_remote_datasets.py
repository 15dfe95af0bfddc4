"""Datasets through S3 on loopback: the same bytes come back, also from a server that fails, waits and hangs up."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from flows.collecting import collect
from flows.console.app import run_command_line
from storage_schema import (
    ArtifactRef,
    CorruptArtifact,
    Dataset,
    StorageError,
    Store,
    UnknownReference,
    create_dataset,
    lineage,
    list_datasets,
    verify,
)
from storage_schema.bucket import RemoteError, RemoteStore
from storage_schema.datasets import dataset_digest, open_dataset
from storage_schema.errors import BadName, DatasetExists
from storage_schema.remote import pull_dataset, push_dataset
from tests.builders.s3_server import SECRET, S3Server
from tests.builders.storage_rows import commit_rows, put, random_columns
from tests.builders.toy_runs import run_toys, write_study
from tests.builders.toys import TOYS

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.bucket._PATIENCE_S", 2.0)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, Dataset]:
    """A store with a dataset of two of its four stages; the others are what it was computed from."""
    folder = tmp_path_factory.mktemp("built")
    store = Store(folder / "store")
    outcome = run_toys(write_study(folder), store.root)
    refs = [ref for stage in outcome.stages if stage.name in ("bend", "judge") for ref in stage.artifacts]
    return store, create_dataset(store, "toys", refs, note="for a test", attachments={"card.md": b"# Card"})


def remote_of(server: S3Server, timeout_s: float = 20.0) -> RemoteStore:
    return RemoteStore(server.place, timeout=timedelta(seconds=timeout_s))


def num_puts(server: S3Server) -> int:
    return sum(request.startswith("PUT") for request in server.requests)


def contents(store: Store) -> dict[str, bytes]:
    """Return every file of the artifacts and datasets by its path."""
    folders = [store.root / name for name in ("bend", "judge", "grow", "datasets")]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(store.root)): path.read_bytes() for path in files}


def test_a_dataset_comes_back_with_all_that_it_was_computed_from(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    store, dataset = built
    assert push_dataset(store, dataset, remote_of(server)) == 13
    sent = num_puts(server)
    assert push_dataset(store, dataset, remote_of(server)) == 0
    assert num_puts(server) == sent + 1, "the list alone is tried again"
    other = Store(tmp_path / "other")
    pulled, num_new = pull_dataset(remote_of(server), "toys", other)
    assert (pulled, num_new) == (replace(dataset, path=other.root / "datasets" / "toys@1"), 13)
    assert contents(other) == contents(store)
    assert verify(other).is_ok
    assert pull_dataset(remote_of(server), "toys@1", other)[1] == 0


def test_a_push_that_is_cut_off_shows_nothing_and_goes_on(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    store, dataset = built
    server.fault = lambda method, path: "error" if method == "PUT" and "/manifests/judge" in path else ""
    with pytest.raises(RemoteError, match="cannot write manifests/judge") as error:
        push_dataset(store, dataset, remote_of(server))
    assert SECRET not in str(error.value)
    server.fault = lambda method, path: ""
    with pytest.raises(UnknownReference, match=r"there is no dataset 'toys'.*there are: none"):
        pull_dataset(remote_of(server), "toys", Store(tmp_path / "other"))
    assert push_dataset(store, dataset, remote_of(server)) == 1
    assert pull_dataset(remote_of(server), "toys", Store(tmp_path / "other"))[1] == 13


def test_what_has_come_is_not_collected_before_all_of_it_is_there(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    store, dataset = built
    push_dataset(store, dataset, remote_of(server))
    other = Store(tmp_path / "other")
    refused: list[str] = []

    def collect_meanwhile(method: str, path: str) -> str:
        if "/parts/" in path:
            try:
                collect(other, datetime.now(UTC))
            except StorageError as error:
                refused.append(str(error))
        return ""

    server.fault = collect_meanwhile
    assert pull_dataset(remote_of(server), "toys", other)[1] == 13
    assert len(refused) >= 13
    assert verify(other).is_ok


def test_what_is_there_never_changes(server: S3Server, built: tuple[Store, Dataset], tmp_path: Path) -> None:
    store, dataset = built
    push_dataset(store, dataset, remote_of(server))
    other = Store(tmp_path / "other")
    mine = create_dataset(other, "toys", [commit_rows(other, name="mine")])
    with pytest.raises(DatasetExists, match="has another toys@1 already"):
        push_dataset(other, mine, remote_of(server))
    with pytest.raises(DatasetExists, match="has another toys@1 already"):
        pull_dataset(remote_of(server), "toys", other)


def test_two_that_push_at_once_leave_one_whole_dataset(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    store, dataset = built
    pushing = [threading.Thread(target=push_dataset, args=(store, dataset, remote_of(server))) for _ in range(2)]
    for thread in pushing:
        thread.start()
    for thread in pushing:
        thread.join()
    other = Store(tmp_path / "other")
    assert pull_dataset(remote_of(server), "toys", other)[1] == 13
    assert contents(other) == contents(store)


def test_bytes_that_are_not_what_was_made_are_refused_on_both_ways(server: S3Server, tmp_path: Path) -> None:
    store, other = Store(tmp_path / "store"), Store(tmp_path / "other")
    ref = commit_rows(store, name="one")
    dataset = create_dataset(store, "toys", [ref], attachments={"card.md": b"# Card"})
    remote = remote_of(server)
    push_dataset(store, dataset, remote)
    (sha256,) = {entry.sha256 for entry in store.manifest(ref).data_files.values()}
    remote.write(f"parts/{sha256}", b"something else")
    with pytest.raises(CorruptArtifact, match="does not hold what its name says"):
        pull_dataset(remote, "toys", other)
    assert list_datasets(other) == list(other.artifacts()) == []
    remote.write(f"parts/{sha256}", store.folder(ref.stage, ref.key) / next(iter(store.manifest(ref).data_files)))
    remote.write("datasets/toys@2", remote.read("datasets/toys@1").replace(ref.key[:8].encode(), b"01234567"))
    with pytest.raises(CorruptArtifact, match="toys@2 is not the list that was pushed"):
        pull_dataset(remote, "toys", other)
    assert list_datasets(other) == []
    path = next(store.folder(ref.stage, ref.key).glob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    assert isinstance(ref, ArtifactRef)
    with pytest.raises(CorruptArtifact, match="is not what its manifest says"):
        push_dataset(
            store,
            create_dataset(store, "again", [commit_rows(store, name="two"), ref]),
            RemoteStore(f"{server.place}/b"),
        )


@pytest.mark.parametrize("place", ["row", "fact"])
def test_ids_that_could_lead_elsewhere_are_not_pulled(server: S3Server, tmp_path: Path, place: str) -> None:
    store, other = Store(tmp_path / "store"), Store(tmp_path / "other")
    names = {"row": "walk", "fact": "walk", place: "../ESCAPED"}
    rows = random_columns("poses", 3) | {"take_id": ["walk", "walk", names["row"]]}
    made = put(store, "ingest", "walk", {"poses": rows}, {"take_id": names["fact"]})
    push_dataset(store, create_dataset(store, "toys", [made.ref]), remote_of(server))
    with pytest.raises(CorruptArtifact, match=r'has the take_id "../ESCAPED", and only up to 200 letters'):
        pull_dataset(remote_of(server), "toys", other)
    assert list(other.artifacts()) == []


def test_files_that_could_lead_elsewhere_are_not_pulled(server: S3Server, tmp_path: Path) -> None:
    store, remote = Store(tmp_path / "store"), remote_of(server)
    made = store.manifest(commit_rows(store, name="one", attachments={"note.txt": b"note"}))
    dataset = create_dataset(store, "toys", [made.ref])
    push_dataset(store, dataset, remote)
    hostile = replace(made, attachments={"../../../ESCAPED": made.attachments["note.txt"]})
    ref = replace(made.ref, content_digest=hostile.computed_digest)
    text = replace(hostile, ref=ref).to_json().encode()
    remote.write(f"manifests/{ref.stage}/{ref.key}", text)
    listed = remote.read("datasets/toys@1")
    for old, new in (
        (made.ref.content_digest, ref.content_digest),
        (dataset.digest, dataset_digest([ref], dataset.sources)),
    ):
        listed = listed.replace(old.encode(), new.encode())
    remote.write("datasets/toys@1", listed)
    with pytest.raises(CorruptArtifact, match="is the manifest of something else"):
        pull_dataset(remote, "toys", Store(tmp_path / "other"))
    assert not list(tmp_path.rglob("ESCAPED"))


def push_as_before(store: Store, dataset: Dataset, remote: RemoteStore) -> None:
    """Push a dataset in the form of earlier releases."""
    for step in lineage(store, *dataset.refs):
        manifest = store.manifest(step.ref)
        for name, entry in manifest.data_files.items():
            remote.write(f"files/{entry.sha256}", store.data_file(manifest.ref, name, entry))
        place = f"artifacts/{step.ref.stage}/{step.ref.key}-{step.ref.content_digest}"
        remote.write(place, manifest.to_json().encode())
    card = (dataset.path / "card.md").read_bytes()
    digest = hashlib.sha256(card).hexdigest()
    remote.write(f"files/{digest}", card)
    remote.write(f"datasets/{dataset.label}", dataset.to_json(attachments={"card.md": digest}))


def test_what_earlier_releases_pushed_is_pulled_and_checked(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    (store, dataset), remote, other = built, remote_of(server), Store(tmp_path / "other")
    push_as_before(store, dataset, remote)
    there = Store(server.place)
    there.refresh()
    assert list_datasets(there) == [], "a store in the same place goes on, without the artifacts of that release"
    with pytest.raises(DatasetExists, match="has a dataset toys@1 of an earlier release; name another version"):
        create_dataset(there, "toys", [commit_rows(there, name="more")])
    pulled, num_new = pull_dataset(remote, "toys", other)
    assert (pulled, num_new) == (replace(dataset, path=other.root / "datasets" / "toys@1"), 13)
    assert (pulled.path / "card.md").read_bytes() == b"# Card"
    assert verify(other).is_ok
    assert push_dataset(store, dataset, remote) == 13, "beside it in the form of today"
    assert pull_dataset(remote, "toys", Store(tmp_path / "third"))[1] == 13
    remote.write(f"files/{hashlib.sha256(b'# Card').hexdigest()}", b"# Curd")
    with pytest.raises(CorruptArtifact, match=r"its file card\.md is not the one that was pushed"):
        pull_dataset(remote, "toys", Store(tmp_path / "fourth"))
    (entry,) = store.manifest(dataset.refs[0]).data_files.values()
    remote.write(f"files/{entry.sha256}", b"something else")
    remote.write(f"files/{hashlib.sha256(b'# Card').hexdigest()}", b"# Card")
    with pytest.raises(CorruptArtifact, match="does not hold what its name says"):
        pull_dataset(remote, "toys", Store(tmp_path / "fourth"))


def test_what_is_pushed_is_a_store_and_a_dataset_of_a_store_is_pulled(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    push_dataset(*built, remote_of(server))
    there = Store(server.place)
    there.refresh()
    assert contents(there).keys() < contents(built[0]).keys()
    assert verify(there).is_ok
    create_dataset(there, "more", [commit_rows(there, name="more")])
    other = Store(tmp_path / "other")
    assert pull_dataset(remote_of(server), "more", other)[1] == 1
    assert verify(other).is_ok


def test_what_was_taken_from_the_bucket_before_the_list_was_there_is_pushed_again(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path
) -> None:
    remote = remote_of(server)

    def take(method: str, path: str) -> str:
        if method == "PUT" and "/datasets/toys" in path:
            server.fault = lambda method, path: ""
            remote.delete([file["path"] for folder in ("parts", "manifests") for file in remote.entries(folder)])
        return ""

    server.fault = take
    push_dataset(*built, remote_of(server))
    assert pull_dataset(remote, "toys", Store(tmp_path / "other"))[1] == 13


def test_other_bytes_under_a_key_of_the_bucket_stay(server: S3Server, tmp_path: Path) -> None:
    first, second = (Store(tmp_path / name) for name in ("first", "second"))
    for store, note in ((first, b"1"), (second, b"2")):
        create_dataset(store, store.root.name, [commit_rows(store, attachments={"note.txt": note})])
    push_dataset(first, open_dataset(first, "first"), remote_of(server))
    with pytest.raises(CorruptArtifact, match=r"has other bytes for artifact .*; push to another prefix"):
        push_dataset(second, open_dataset(second, "second"), remote_of(server))
    assert pull_dataset(remote_of(server), "first", Store(tmp_path / "third"))[1] == 1


def test_other_bytes_of_the_same_length_under_a_key_of_the_bucket_are_noticed(server: S3Server, tmp_path: Path) -> None:
    store, remote = Store(tmp_path / "store"), remote_of(server)
    ref = commit_rows(store)
    dataset = create_dataset(store, "toys", [ref])
    push_dataset(store, dataset, remote)
    place = f"manifests/{ref.stage}/{ref.key}"
    text = remote.read(place)
    remote.write(place, text.replace(ref.content_digest.encode(), b"0" * 64))
    assert len(remote.read(place)) == len(text)
    with pytest.raises(CorruptArtifact, match=r"has other bytes for artifact .*; push to another prefix"):
        push_dataset(store, dataset, remote)


def test_the_command_line_pushes_and_pulls_and_says_no_credential(
    server: S3Server, built: tuple[Store, Dataset], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, _ = built

    def call(*arguments: str) -> int:
        return run_command_line(["dataset", *arguments], graph=TOYS)

    other = tmp_path / "other"
    assert call("push", "toys", server.place, "--store", str(store.root)) == 0
    assert call("pull", "toys@1", server.place, "--store", str(other)) == 0
    assert f"toys@1 is in {server.place}: 13 artifacts new" in capsys.readouterr().out
    assert call("push", "toys", "bucket/there", "--store", str(store.root)) == 2
    assert call("pull", "toys", "s3://nowhere/datasets", "--store", str(other)) == 1
    assert "s3://nowhere/datasets: cannot list datasets: there is no such bucket" in capsys.readouterr().err
    server.fault = lambda method, path: "error"
    assert call("pull", "toys", server.place, "--store", str(other)) == 1
    said = capsys.readouterr()
    assert "cannot list datasets" in said.err
    written = [path.read_bytes() for root in (store.root, other) for path in root.rglob("*") if path.is_file()]
    assert not any(SECRET.encode() in data for data in [*written, said.err.encode(), said.out.encode()])
    with pytest.raises(BadName, match="s3://BUCKET/PREFIX is meant"):
        RemoteStore("s3:/bucket")


def test_an_address_that_holds_a_password_is_not_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://me:{SECRET}@127.0.0.1:9"),
        *((name, "x") for name in ("AWS_REGION", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")),
    ):
        monkeypatch.setenv(name, value)
    with pytest.raises(RemoteError, match=r"s3://bucket: cannot list datasets .*GET the server") as error:
        RemoteStore("s3://bucket", timeout=timedelta(seconds=1)).names("datasets")
    assert SECRET not in str(error.value)


@pytest.mark.parametrize("fault", ["slow", "lost"])
def test_a_new_file_whose_answer_is_lost_is_created_once_and_known_as_ours(server: S3Server, fault: str) -> None:
    tried: list[str] = []

    def first_time(method: str, path: str) -> str:
        tried.append(path)
        return fault if method == "PUT" and tried.count(path) == 1 else ""

    server.fault, server.slow_s = first_time, 2.0
    remote = remote_of(server, 1.0 if fault == "slow" else 30.0)
    assert remote.create("mine", b"my bytes")
    assert not remote.create("mine", b"those of another")
    assert remote.read("mine") == b"my bytes"
    _, tag = remote.read_tagged("mine")
    tried.clear()
    remote.replace("mine", b"new bytes", tag)
    assert remote.read("mine") == b"new bytes"
