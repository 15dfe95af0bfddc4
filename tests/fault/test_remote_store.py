"""A store in a bucket on loopback: runs end with the bytes of a local one, whatever fails, waits, hangs up or dies."""

from __future__ import annotations

import io
import itertools
import json
import os
import signal
import subprocess
import sys
import tarfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from flows.collecting import collect
from flows.console.app import run_command_line
from flows.outcomes import Outcome
from flows.planning import StageSelection
from flows.viewing.shelf import Shelf
from flows.viewing.viewer import Viewer
from storage_schema import (
    ArtifactRef,
    StorageError,
    Store,
    create_dataset,
    in_use,
    list_datasets,
    list_runs,
    open_table,
    verify,
)
from storage_schema.bucket import RemoteError, RemoteStore
from storage_schema.bucket_store import BucketStore, open_bucket
from tasks.files.curation import Choosing
from tasks.shards import ClusterPool, ClusterSettings, ShardError, connect
from tests.builders.s3_server import SECRET, S3Server
from tests.builders.storage_rows import commit_rows, put, random_columns
from tests.builders.toy_runs import ROOT, Gates, Outside, digests, run_toys, wait_until, write_study
from tests.builders.toys import TOYS

if TYPE_CHECKING:
    from obstore import ObjectMeta

pytestmark = pytest.mark.usefixtures("own_cache")

EVERYTHING = 14
_BUILD = """
import sys
from pathlib import Path
from flows.signals import ended_as_by_ctrl_c
from storage_schema import Store, in_use
from tests.builders.toy_runs import run_toys
with ended_as_by_ctrl_c(), in_use(Store(sys.argv[2])):
    run_toys(Path(sys.argv[1]), Path(sys.argv[2]))
"""


@contextmanager
def building(folder: Path, place: str) -> Iterator[subprocess.Popen[bytes]]:
    """Build the toys in a bucket, in a process of its own that this block kills; its errors are in `said.txt`."""
    command = [sys.executable, "-c", _BUILD, str(write_study(folder)), place]
    with (folder / "said.txt").open("w") as errors:
        process = subprocess.Popen(command, cwd=ROOT, stderr=errors)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def run_there(folder: Path, place: str, *settings: str, selection: StageSelection | None = None) -> Outcome:
    """Build the toys in a bucket, in this process."""
    with in_use(Store(place)):
        return run_toys(write_study(folder), Path(place), *settings, selection=selection)


def digests_there(place: str) -> dict[str, list[str]]:
    Store(place).refresh()
    return digests(Path(place))


def test_every_command_works_on_a_bucket_and_another_machine_sees_the_same(
    server: S3Server,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
    in_this_process: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    study = str(write_study(tmp_path))

    def call(*arguments: str) -> str:
        assert run_command_line([*arguments, "--store", server.place], graph=TOYS) == 0
        said = capsys.readouterr()
        assert SECRET not in said.out + said.err
        return said.out

    assert f"--store {server.place}" in call("plan", study)
    assert "done: 14 shards computed" in call("run", study)
    assert digests_there(server.place) == undisturbed
    elsewhere()
    assert "everything is fresh, nothing to do" in call("run", study)
    assert ": finished" in call("status")
    assert "0" in call("show", "scores:toy")
    assert "toys@1 made: 14 artifacts" in call("dataset", "create", "toys", "--study", "toy")
    assert "done: 12 shards computed" in call("run", study, "--set", "grow.scale=2")
    elsewhere()
    assert "toys@1  14 artifacts" in call("dataset", "list")
    assert "26 artifacts, 27 files" in call("verify")
    assert len(open_table("training_log:toy", server.place)) == len(open_table("training_log:toys@1", server.place))
    written = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    remote = RemoteStore(server.place)
    written += [remote.read(file["path"]) for folder in ("records", "manifests") for file in remote.entries(folder)]
    assert not any(SECRET.encode() in data for data in [*written, remote.read("lease")])


def test_what_nothing_needs_goes_from_the_bucket_too(
    server: S3Server, elsewhere: Callable[[], None], tmp_path: Path
) -> None:
    run_there(tmp_path, server.place, "grow.num_takes=3")
    run_there(tmp_path, server.place)
    store, remote = Store(server.place), RemoteStore(server.place)
    assert len(list_runs(store)) == 2
    collect(store, datetime.now(UTC) + timedelta(days=1))
    assert (len(remote.entries("manifests")), len(list_runs(store))) == (EVERYTHING, 1)
    assert len(remote.entries("parts")) > EVERYTHING, "the youngest stay"
    with in_use(store):
        BucketStore(server.place).sweep(younger=timedelta(0))
    named = {file.sha256 for manifest in store.artifacts() for file in manifest.data_files.values()}
    assert {part["path"] for part in remote.entries("parts")} == {f"parts/{sha256}" for sha256 in named}
    assert verify(store).is_ok
    elsewhere()
    there = Store(server.place)
    there.refresh()
    assert (len(list(there.artifacts())), len(list_runs(there))) == (EVERYTHING, 1)
    assert verify(there).is_ok


@pytest.mark.parametrize("fault", ["error", "slow", "cut", "lost"])
def test_faults_of_the_server_cost_time_and_nothing_else(
    server: S3Server,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
    fault: str,
) -> None:
    counter, lock = itertools.count(), threading.Lock()

    def now_and_then(method: str, path: str) -> str:
        with lock:
            number = next(counter)
        return fault if number in (5, 60) or (fault != "slow" and number % 7 == 5) else ""

    def patient() -> None:
        BucketStore(server.place).remote = RemoteStore(
            server.place, timeout=timedelta(seconds=2.5 if fault == "slow" else 30.0)
        )

    server.fault, server.slow_s = now_and_then, 3.5
    patient()
    run_there(tmp_path, server.place)
    store = Store(server.place)
    assert create_dataset(store, "toys", [manifest.ref for manifest in store.artifacts()]).version == "1"
    elsewhere()
    patient()
    assert run_there(tmp_path, server.place).num_computed == 0
    assert digests_there(server.place) == undisturbed
    assert verify(Store(server.place)).is_ok
    assert next(counter) > 60, "there were faults on both ways"


def test_a_bucket_that_refuses_connections_is_waited_for_and_that_is_said_unless_the_run_is_given_up(
    server: S3Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with ThreadPoolExecutor(1) as threads:
        with server.refusing():
            building = threads.submit(run_there, tmp_path, server.place)
            wait_until(lambda: "the bucket does not answer, waiting up to" in caplog.text or building.done(), "a word")
        assert building.result(timeout=60).num_computed == EVERYTHING
    assert len(caplog.messages) == 1, "one word for all requests"
    caplog.clear()

    def give_up() -> None:
        with in_use(Store(server.place)):
            server.stop()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        give_up()
    server.stop = server.start()
    assert caplog.messages == []


def test_a_run_that_waits_for_a_bucket_ends_at_once_when_it_is_interrupted(
    server: S3Server, gates: Gates, tmp_path: Path
) -> None:
    gates.close("grow-t1-s1")
    said = tmp_path / "said.txt"
    with building(tmp_path, server.place) as process:
        gates.wait_for("grow-t1-s1")
        with server.refusing():
            gates.open()
            wait_until(lambda: "the bucket does not answer, waiting up to" in said.read_text(), "a word")
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=15)
    assert said.read_text().rstrip().endswith("KeyboardInterrupt")


def test_a_second_run_is_refused_and_a_killed_one_is_finished_on_another_machine(
    server: S3Server,
    gates: Gates,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
) -> None:
    gates.close("grow-t1-s1")
    with building(tmp_path, server.place):
        gates.wait_for("grow-t1-s1")
        elsewhere()
        with pytest.raises(StorageError, match=rf"^a run plans or builds in the store {server.place} \(process "):
            run_there(tmp_path, server.place)
    gates.open()
    done = len(RemoteStore(server.place).entries("manifests"))
    assert 0 < done < EVERYTHING
    assert run_there(tmp_path, server.place).num_computed == EVERYTHING - done
    assert digests_there(server.place) == undisturbed
    assert verify(Store(server.place)).is_ok


def test_workers_with_an_empty_mirror_fetch_what_they_read_and_push_what_they_make(
    server: S3Server,
    elsewhere: Callable[[], None],
    undisturbed: dict[str, list[str]],
    tmp_path: Path,
) -> None:
    run_there(tmp_path, server.place, selection=StageSelection(until="grow"))
    elsewhere()
    with Outside(tmp_path) as outside:
        elsewhere()
        with (
            in_use(Store(server.place)),
            connect(ClusterSettings(scheduler=outside.address), store_root=server.place) as client,
        ):
            pool = ClusterPool(client, server.place, is_shared=True)
            outcome = run_toys(write_study(tmp_path), Path(server.place), pool=pool)
    assert outcome.num_computed == EVERYTHING - 6
    assert digests_there(server.place) == undisturbed
    assert outcome.report is not None
    mirrors = [Store(server.place).root, *(tmp_path / "cache-0" / "stores").glob("*/")]
    assert len({path.parent for path in mirrors}) == 2
    assert all(any(root.glob("bend/*/*/models.parquet")) for root in mirrors[1:])


def test_what_else_is_in_the_bucket_stays_there_and_names_lead_nowhere(
    server: S3Server, elsewhere: Callable[[], None], tmp_path: Path
) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    ref = commit_rows(store, name="one")
    text = store.folder(ref.stage, ref.key).joinpath("manifest.json").read_bytes()
    for place in (
        "manifests/x",
        f"manifests/runs/{ref.key}",
        f"manifests/rows/{ref.key}/b",
        "records/rows/aa/b",
        "datasets/a",
    ):
        remote.write(place, text)
    mine = tmp_path / "mine"
    mine.write_text("whole")
    values = json.loads(text)
    ((name, entry),) = values["tables"].items()
    values["tables"] = {f"../../../../{name}": {**entry, "sha256": str(mine)}}
    remote.write(f"manifests/{ref.stage}/{ref.key}", json.dumps(values).encode())
    elsewhere()
    store = Store(server.place)
    store.refresh()
    here = {path.relative_to(store.root).parts[0] for path in store.root.rglob("*") if path.is_file()}
    assert here == {ref.stage, "store.json"}
    (manifest,) = [store.load(ref.stage, ref.key)]
    with pytest.raises(StorageError, match="that is not in its folder"):
        store.data_file(manifest.ref, *next(iter(manifest.data_files.items())))
    assert not verify(store).is_ok
    assert mine.read_text() == "whole"
    remote.write("datasets/a@1", b"no tar")
    with pytest.raises(StorageError, match=r"/datasets/a@1 is not a dataset"):
        store.refresh()


def test_who_reads_what_was_computed_again_since_takes_nothing_back(
    server: S3Server, elsewhere: Callable[[], None]
) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    ref = commit_rows(store, name="one")
    place = f"manifests/{ref.stage}/{ref.key}"
    elsewhere()
    late = Store(server.place)
    late.refresh()
    values = json.loads(remote.read(place))
    (part,) = [entry["sha256"] for entry in values["tables"].values()]
    for entry in values["tables"].values():
        entry["sha256"] = "f" * 64
    remote.write(place, json.dumps(values).encode())
    remote.delete([f"parts/{part}"])
    with pytest.raises(StorageError, match="is gone or damaged"):
        late.read(ref, next(iter(values["tables"])))
    assert json.loads(remote.read(place)) == values


def test_a_part_that_is_lost_is_named_and_computed_again_by_the_next_run(
    server: S3Server, elsewhere: Callable[[], None], undisturbed: dict[str, list[str]], tmp_path: Path
) -> None:
    run_there(tmp_path, server.place, selection=StageSelection(until="grow"))
    store, remote = Store(server.place), RemoteStore(server.place)
    lost, changed = [segment for segment in store.artifacts("grow") if segment.name == "s2"]
    (part,) = {entry.sha256 for entry in lost.data_files.values()}
    remote.delete([f"parts/{part}"])
    (part,) = {entry.sha256 for entry in changed.data_files.values()}
    remote.write(f"parts/{part}", b"something else")
    assert [problem.kind.value for problem in verify(store).problems] == ["missing", "changed"]
    elsewhere()
    with pytest.raises(ShardError, match=r"is gone or damaged; a run computes its artifact grow@\w{12} again"):
        run_there(tmp_path, server.place)
    run_there(tmp_path, server.place)
    assert digests_there(server.place) == undisturbed
    assert verify(Store(server.place)).is_ok


def test_a_reader_asks_again_after_a_bad_download_and_takes_nothing_from_the_bucket(
    server: S3Server, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    ref = commit_rows(store, name="one")
    (entry,) = store.manifest(ref).data_files.values()
    elsewhere()
    fetch, answers = RemoteStore.fetch, iter(["0" * 64])
    monkeypatch.setattr(RemoteStore, "fetch", lambda *told: (fetch(*told), next(answers, None) or fetch(*told))[1])
    assert len(Store(server.place).read(ref, "scores"))
    elsewhere()
    remote.write(f"parts/{entry.sha256}", b"something else")
    with pytest.raises(StorageError, match="is gone or damaged"):
        Store(server.place).read(ref, "scores")
    assert len(remote.entries("manifests")) == 1


def test_a_damaged_copy_in_a_mirror_is_fetched_again_by_the_same_command(server: S3Server, tmp_path: Path) -> None:
    run_there(tmp_path, server.place)
    path = next(Store(server.place).root.glob("bend/*/*/models.parquet"))
    whole = path.read_bytes()
    path.write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])
    with pytest.raises(ShardError, match=r"bend@\w{12} is damaged and was removed"):
        run_there(tmp_path, server.place, "judge.title=again")
    assert run_there(tmp_path, server.place, "judge.title=again").num_computed == 1
    assert path.read_bytes() == whole


def test_who_asks_whether_it_may_write_leaves_nothing_behind(server: S3Server) -> None:
    store, remote = Store(server.place), RemoteStore(server.place)
    with in_use(store):
        store.prepare()
        places = ("parts", "records", "manifests")
        before = [remote.entries(place) for place in places]
        assert store.can_write()
        assert [remote.entries(place) for place in places] == before


def test_what_is_taken_from_the_bucket_goes_from_a_mirror_that_has_only_just_seen_it(
    server: S3Server, elsewhere: Callable[[], None]
) -> None:
    refs = [commit_rows(Store(server.place), name=f"row{number}") for number in range(12)]
    elsewhere()
    store = Store(server.place)
    store.refresh()
    assert len(list(store.artifacts())) == len(refs)
    RemoteStore(server.place).delete([f"manifests/{ref.stage}/{ref.key}" for ref in refs])
    store.refresh()
    assert list(store.artifacts()) == []


def another_process(store: BucketStore) -> BucketStore:
    """Return the store as another process of this machine has it, with the same mirror."""
    return open_bucket.__wrapped__(store.place, os.environ["AWS_ENDPOINT_URL"], str(store.root.parents[1]))


def test_what_another_process_brings_while_a_mirror_is_refreshed_stays(
    server: S3Server, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    commit_rows(Store(server.place), name="one")
    elsewhere()
    mirror = BucketStore(server.place)
    entries = mirror.remote.entries

    def overtaken(folder: str) -> Sequence[ObjectMeta]:
        monkeypatch.setattr(mirror.remote, "entries", entries)
        listed = entries(folder)
        elsewhere()
        commit_rows(Store(server.place), name="two")
        another_process(mirror).refresh()
        return listed

    monkeypatch.setattr(mirror.remote, "entries", overtaken)
    mirror.refresh()
    assert len(list(mirror.root.glob("*/??/*/manifest.json"))) == 2


def packed(mode: str, *members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    """Return a tar file of the bucket."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=mode) as file:  # type: ignore[call-overload]
        for member, content in members:
            member.size = len(content)
            file.addfile(member, io.BytesIO(content))
    return data.getvalue()


def member_of(name: str, kind: bytes = tarfile.REGTYPE, target: str = "") -> tarfile.TarInfo:
    member = tarfile.TarInfo(name)
    member.type, member.linkname = kind, target
    return member


def sparse(size: int) -> bytes:
    """Return a tar file of a few bytes that would unpack to this size."""
    member = member_of("card.md")
    member.pax_headers = {
        "GNU.sparse.major": "1",
        "GNU.sparse.minor": "0",
        "GNU.sparse.name": "card.md",
        "GNU.sparse.realsize": str(size),
    }
    return packed("w", (member, b"1\n0\n512\n".ljust(512, b"\0") + b"x" * 512))


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (packed("w:gz", (member_of("card.md"), b"\0" * 50_000_000)), "without compression"),
        (packed("w:xz", (member_of("card.md"), b"\0" * 50_000_000)), "without compression"),
        (sparse(10**12), "no file of a dataset"),
        (packed("w", (member_of("../card.md"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("/tmp/card.md"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("a/card.md"), b"a")), "no file of a dataset"),
        (packed("w", (member_of(".hidden"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("a\x1b]0;b"), b"a")), "no file of a dataset"),
        (packed("w", (member_of("card.md", tarfile.SYMTYPE, "/etc/passwd"), b"")), "no file of a dataset"),
        (packed("w", (member_of("card.md", tarfile.LNKTYPE, "/etc/passwd"), b"")), "no file of a dataset"),
        (packed("w", (member_of("card.md", tarfile.FIFOTYPE), b"")), "no file of a dataset"),
        (packed("w", (member_of("card.md"), b"a"), (member_of("./card.md"), b"b")), "no file of a dataset"),
    ],
    ids=["gz", "xz", "sparse", "above", "root", "folder", "hidden", "escape", "symlink", "link", "pipe", "twice"],
)
def test_a_tar_of_the_bucket_holds_plain_files_and_no_more_than_it_has_bytes(
    data: bytes, why: str, server: S3Server, tmp_path: Path
) -> None:
    RemoteStore(server.place).create("datasets/toys@1", data)
    with pytest.raises(StorageError, match=rf"datasets/toys@1 is not a dataset: .*{why}"):
        Store(server.place).refresh()
    mirror = BucketStore(server.place)
    assert not list((mirror.root / "datasets").glob("*"))


def test_a_tar_of_the_bucket_has_a_limit_of_size(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    data = packed("w", (member_of("card.md"), b"a" * 2000))
    RemoteStore(server.place).create("datasets/toys@1", data)
    monkeypatch.setattr("storage_schema.bucket_layout.MAX_DATASET_BYTES", len(data) - 1)
    with pytest.raises(StorageError, match="is larger than 0 MB"):
        Store(server.place).refresh()
    monkeypatch.setattr("storage_schema.bucket_layout.MAX_DATASET_BYTES", len(data))
    Store(server.place).refresh()


def test_a_commit_that_is_cut_off_shows_nothing(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage_schema.bucket._PATIENCE_S", 0.0)
    server.fault = lambda method, path: "error" if method == "PUT" and "/parts/" in path else ""
    with pytest.raises(RemoteError, match="cannot write parts/"):
        commit_rows(Store(server.place), name="one")
    assert RemoteStore(server.place).entries("manifests") == []


def test_what_is_made_again_takes_its_place_in_one_step(server: S3Server, elsewhere: Callable[[], None]) -> None:
    first = commit_rows(Store(server.place), attachments={"note.txt": b"1"})
    elsewhere()
    server.requests.clear()
    assert commit_rows(Store(server.place), attachments={"note.txt": b"2"}, replaces=True) != first
    assert {request.split()[0] for request in server.requests} <= {"GET", "HEAD", "PUT"}, "nothing was gone in between"


def test_a_dataset_in_a_bucket_does_not_tell_who_made_it_where_and_when(server: S3Server) -> None:
    store = Store(server.place)
    create_dataset(store, "toys", [commit_rows(store, name="one")], attachments={"card.md": b"# Card"})
    with tarfile.open(fileobj=io.BytesIO(RemoteStore(server.place).read("datasets/toys@1"))) as file:
        assert {(member.uname, member.uid, member.mtime) for member in file} == {("", 0, 0)}


def test_a_mirror_takes_a_new_dataset_of_another_machine_beside_the_one_that_it_has(
    server: S3Server, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    store = Store(server.place)
    create_dataset(store, "toys", [commit_rows(store, name="one")])
    store.refresh()
    elsewhere()
    other = Store(server.place)
    create_dataset(other, "toys", [commit_rows(other, name="two")])
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    back = Store(server.place)
    back.refresh()
    assert [dataset.label for dataset in list_datasets(back)] == ["toys@1", "toys@2"]


def test_a_bucket_that_does_not_answer_or_is_not_there_is_one_sentence_before_any_work(
    server: S3Server,
    tmp_path: Path,
    in_this_process: None,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study = str(write_study(tmp_path))
    assert run_command_line(["run", study, "--store", "s3://nowhere/store"], graph=TOYS) == 1
    assert "error: s3://nowhere/store: cannot list manifests" in capsys.readouterr().err
    with (
        pytest.raises(StorageError, match="cannot write lease: there is no such bucket"),
        in_use(Store("s3://nowhere/a")),
    ):
        pass
    assert run_command_line(["run", study, "--store", "s3://"], graph=TOYS) == 2
    assert "s3://BUCKET/PREFIX is meant" in capsys.readouterr().err
    monkeypatch.setattr("storage_schema.bucket._PATIENCE_S", 0.0)
    server.fault = lambda method, path: "gone"
    assert run_command_line(["run", study, "--store", server.place], graph=TOYS) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"error: {server.place}: cannot list manifests")
    assert SECRET not in said


def test_an_artifact_that_is_not_there_is_said_with_the_store(server: S3Server) -> None:
    with pytest.raises(StorageError, match=rf"is not in the store {server.place}"):
        Store(server.place).manifest(ArtifactRef("poses", "0" * 64, "1" * 64))


def test_of_a_store_in_a_bucket_the_viewer_fetches_what_is_looked_at(
    server: S3Server, elsewhere: Callable[[], None], tmp_path: Path
) -> None:
    store = Store(server.place)
    with in_use(store):
        refs = []
        for partition in ("ic-seed0", "ic-seed1"):
            columns = random_columns("draws", 20) | {"density": ["ic"] * 20, "seed_index": [0] * 20, "chain": [0] * 20}
            columns |= {"sequence_id": [None] * 20}
            refs.append(put(store, "chains", partition, {"draws": columns}, {}).ref)
    elsewhere()
    there = Store(server.place)
    there.refresh()
    server.requests.clear()
    viewer = Viewer(Shelf(there, refs), choosing=Choosing(tmp_path / "curation.txt"))
    try:
        fetched = [request for request in server.requests if request.startswith("GET") and "/parts/" in request]
        assert len(fetched) == 1, fetched
        viewer.show_part(viewer.shelf.parts[1])
        viewer.describe_frame()
        assert viewer.shown.facts.value.startswith("frame 0 of 20")
    finally:
        viewer.stop()
    assert {request.split()[0] for request in server.requests} <= {"GET", "HEAD"}, "looking writes nothing there"
