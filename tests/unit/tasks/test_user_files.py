"""Files that a user names: nothing but regular files is read, no place waits for one, and sizes have limits."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from flows.console.live import _read as read_live_frame
from pasdedeux.errors import InputError
from tasks.files.curation import choices_in
from tasks.files.user_files import exported_unit_m, read_file, read_text_file, user_file_digest
from tasks.ingest.files import load_file
from tasks.ingest.film.readers import open_film
from tasks.ingest.poses2d.readers import open_capture
from tasks.ingest.takes.known_sources import was_fetched
from tasks.shards.profiles import read_profile
from tests.builders.command_line import CommandLine

ROOT = Path(__file__).parents[3]
KINDS = {"folder": "a folder", "pipe": "a pipe", "socket": "a socket", "device": "a device", "link": "a device"}
READERS: dict[str, Callable[[Path], object]] = {
    "read_file": read_file,
    "read_text_file": read_text_file,
    "user_file_digest": user_file_digest,
    "load_file": load_file,
    "choices": choices_in,
    "profile": read_profile,
    "capture": open_capture,
    "film": open_film,
}
COMMANDS = [
    "plan {path} --store {out}",
    'plan duets --set ingest.annotations=[{{id="a",path="{path}"}}] --store {out}',
    'plan duets --set ingest.videos=[{{id="a",path="{path}",keys="{path}"}}] --store {out}',
    'plan duets --set seeds.files=[{{path="{path}"}}] --store {out}',
    "plan duets --set curation.file={path} --store {out}",
    "study new {out} --from {path}",
    "retarget {path} {path} --to {path} --out {out}",
    "complete {path} --draws draws@{key} --store {out}",
    "reconstruct {path} --database projections:duets --out {out} --store {out}",
    "annotate {path} --keys {path} --out {out}.csv",
    "run duets --cluster {path} --store {out}",
]


@pytest.fixture(autouse=True)
def _ends() -> Iterator[None]:
    """End what waits for a pipe or reads a device."""

    def end(*_: object) -> None:
        raise TimeoutError("it waits")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(params=KINDS)
def strange(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Path, str]]:
    kind, path = request.param, tmp_path / "strange.mp4"
    with closing(socket.socket(socket.AF_UNIX)) as listening:
        if kind == "folder":
            path.mkdir()
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "socket":
            os.chdir(tmp_path)  # a socket's path has at most 108 characters
            listening.bind(path.name)
            os.chdir(ROOT)
        elif kind == "link":
            path.symlink_to("/dev/zero")
        yield (Path("/dev/zero") if kind == "device" else path), KINDS[kind]


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_regular_file_is_refused_at_once(reader: str, strange: tuple[Path, str]) -> None:
    path, kind = strange
    if reader == "film" and path.is_dir():
        with pytest.raises(InputError, match="holds no images"):
            open_film(path)
        return
    with pytest.raises(InputError, match=re.escape(f"{path} is {kind}, and a regular file is needed")):
        READERS[reader](path)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_waits_for_a_pipe(command: str, tmp_path: Path, invoke: CommandLine) -> None:
    path = tmp_path / ("pipe.mp4" if "annotate" in command or "videos" in command else "pipe.toml")
    os.mkfifo(path)
    words = [word.format(path=path, out=tmp_path / "out.toml", key="0" * 64) for word in command.split()]
    assert "is a pipe, and a regular file is needed" in invoke.refusal(*words)


def test_a_pipe_beside_files_or_among_live_frames_is_passed_by(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "CMU.sha256")
    assert not was_fetched(tmp_path / "60_01.amc", "0" * 64)
    os.mkfifo(tmp_path / "frame_1_keypoints.json")
    assert "is a pipe" in read_live_frame(1, tmp_path / "frame_1_keypoints.json").problem


def test_a_file_over_the_limit_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    path.write_bytes(b"12345")
    assert read_file(path, max_bytes=5) == b"12345"
    with pytest.raises(InputError, match=r"large\.json is larger than 0 MB"):
        read_file(path, max_bytes=4)
    with path.open("wb") as file:
        file.truncate(3_000_000_000)
    with pytest.raises(InputError, match=r"large\.json is larger than 2000 MB, the most that is read"):
        read_file(path)
    with pytest.raises(InputError, match=r"large\.json is larger than 16 MB"):
        read_text_file(path)


def test_text_in_another_encoding_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes("título".encode("latin-1"))
    with pytest.raises(InputError, match=r"a\.toml is no text in UTF-8: invalid .* at byte 1"):
        read_text_file(tmp_path / "a.toml")


def test_a_file_is_digested_once_while_it_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, old = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"one")
    for _ in range(2):  # it may be written again within a step of the disk's clock
        path.write_bytes(b"two")
        assert user_file_digest(path) == hashlib.sha256(b"two").hexdigest()
        path.write_bytes(b"six")
        assert user_file_digest(path) == hashlib.sha256(b"six").hexdigest()
    old.write_bytes(b"old")
    monkeypatch.setattr("tasks.files.user_files._SETTLED_NS", -(10**18))
    assert user_file_digest(old) == user_file_digest(old, b"old")
    monkeypatch.setattr(hashlib, "file_digest", None)
    monkeypatch.setattr(hashlib, "sha256", None)
    assert user_file_digest(old) == user_file_digest(old, b"old")


@pytest.mark.parametrize("unit_m", [0.0, -1.0, np.nan, np.inf, "metre", [0.01, 0.01]])
def test_a_unit_that_is_none_is_not_taken_from_an_export(tmp_path: Path, unit_m: object) -> None:
    np.savez(tmp_path / "a.npz", bvh_metres_per_unit=np.array(unit_m))
    assert exported_unit_m(tmp_path / "a.bvh") is None


def test_a_damaged_export_states_no_unit(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", bvh_metres_per_unit=0.0254, joints_m=np.linspace(0.0, 1.0, 500))
    assert exported_unit_m(tmp_path / "a.bvh") == 0.0254
    whole = (tmp_path / "a.npz").read_bytes()
    units_m = set()
    for at in range(0, len(whole), 3):
        (tmp_path / "a.npz").write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        units_m.add(exported_unit_m(tmp_path / "a.bvh"))
    assert units_m == {None, 0.0254}
