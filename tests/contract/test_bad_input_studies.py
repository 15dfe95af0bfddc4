"""Studies and stores that cannot be used: one sentence, exit code 2, nothing begun; a disk that fills up gives 1."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from storage_schema import Store, verify
from tests.builders.real_study import SMALL, RealRun, build_here, call_in_process, refused

ONE_TAKE = """
[study]
name = "one"
stages = ["ingest"]

[ingest]
duets = [{ name = "hug", duration_s = 1.0 }]
rate_hz = 12.0
virtual_video = { num_random_views = 4 }
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("duration_s = 1.5", "duration = 1.5", "ingest.duets.1.duration: unknown; did you mean duration_s?"),
        ('"prior_only"', '"prior_onli"', "chains.densities.1: there is no density 'prior_onli'; there are: ic, cart"),
    ],
)
def test_what_a_study_says_wrongly_is_named_with_its_full_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, sentence: str
) -> None:
    assert SMALL.count(old) == 1
    study = write(tmp_path, SMALL.replace(old, new))
    assert refused(capsys, study).startswith(f"study {study}: {sentence}")


def test_seeds_that_no_take_has_are_refused_where_it_can_be_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before_seeds = SMALL.replace('name = "small"', 'name = "small"\nstages = ["ingest", "priors", "views"]')
    build_here(write(tmp_path, before_seeds), tmp_path / "store")
    study = write(tmp_path, SMALL)
    for frames, sentence in (
        ('[{take="tango",frame=1}]', "seeds.frames: take 'tango' is no take of two people that may be learned from"),
        ('[{take="hug",frame=1}]', "seeds.frames: take 'hug' is no take of two people that may be learned from"),
        ('[{take="waltz",frame=99}]', "seeds.frames: take 'waltz' has frames 0 to 23, found 99"),
    ):
        found = call_in_process(capsys, "run", study, "--store", tmp_path / "store", "--set", f"seeds.frames={frames}")
        assert found.code == 2, found
        assert found.err.startswith(f"error: {sentence}")


def test_a_store_of_a_newer_program_is_refused_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = write(tmp_path, ONE_TAKE)
    store = tmp_path / "store"
    build_here(study, store)
    mark = store / "store.json"
    mark.write_text(json.dumps({"schema_version": 999}) + "\n")
    before = sorted(path for path in store.rglob("*"))
    for arguments in (
        ("run", study, "--store", store),
        ("plan", study, "--store", store),
        ("status", "--store", store),
        ("verify", "--store", store),
        ("show", "takes:one", "--store", store),
        ("export", "poses:one", "--store", store, "--out", tmp_path / "out"),
        ("dataset", "create", "d", "--study", "one", "--store", store),
    ):
        found = call_in_process(capsys, *arguments)
        assert (found.code, found.err.count("\n")) == (2, 1), found
        assert all(words in found.err for words in (str(store), "newer", "999"))
    assert sorted(path for path in store.rglob("*")) == before
    assert not (tmp_path / "out").exists()


def test_next_to_no_room_is_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**12, 10**12 - 10**6, 10**6))
    found = refused(capsys, write(tmp_path, ONE_TAKE))
    assert found == f"the disk of {tmp_path / 'store'} has 1 MB left; free some space first"


def test_a_folder_that_cannot_be_written_to_is_not_called_full(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = call_in_process(capsys, "run", write(tmp_path, ONE_TAKE), "--store", "/proc/store")
    assert found.code == 2
    assert found.err.startswith("error: the store /proc/store cannot be created: /proc is not writable; name")


FILL = """
import errno, os, sys
from storage_schema.durable import HashingFile
write, left = HashingFile.write, int(sys.argv.pop(1))
def limited(file, data):
    global left
    if left <= 0:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    left -= 1
    return write(file, data)
HashingFile.write = limited
from flows.console import main
main(sys.argv[1:])
"""


@pytest.mark.slow
def test_a_disk_that_fills_up_during_a_run_is_one_sentence_with_the_shard_and_the_same_command_finishes(
    tmp_path: Path, prefect_home: Path
) -> None:
    study = write(tmp_path, ONE_TAKE)
    arguments = ("30", "run", study, "--store", tmp_path / "store", "--workers", "0")
    found = RealRun(*arguments, prefect_home=prefect_home, program=("-c", FILL)).finish()
    assert found.code == 1, found
    last = next(line for line in reversed(found.err.splitlines()) if line.startswith("error: "))
    assert last.startswith("error: stage ingest, hug, shard "), found.err
    assert f"the disk is full: no room left in {tmp_path / 'store'}" in last
    assert "Traceback" not in found.err
    assert verify(Store(tmp_path / "store")).is_ok
    assert not list((tmp_path / "store" / "tmp").iterdir())

    build_here(study, tmp_path / "store")
    build_here(study, tmp_path / "undisturbed")
    mended, undisturbed = (
        {(m.partition, m.name): m.ref.content_digest for m in Store(tmp_path / name).artifacts()}
        for name in ("store", "undisturbed")
    )
    assert mended == undisturbed
