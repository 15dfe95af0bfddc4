"""`reconstruct`: OpenPose files to lines while another process is still writing them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from flows.console.live import STOP_NAME, FollowedFile, follow_folder, follow_lines, list_frames
from flows.signals import ENDING, ended_as_by_ctrl_c, remembered_ctrl_c
from pasdedeux.kinematics import forward_kinematics
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.body import SHARED
from pasdedeux.reconstruction.live.chain import LivePeople
from pasdedeux.reconstruction.live.person import LiveOptions
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.skeletons import OP14, Skeleton
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from storage_schema import Store
from tasks.projections import read_database
from tests.builders.command_line import CommandLine
from tests.builders.walkers_on_video import build_store, reference, write_walkers

FRAMES = 75
"""Longer than the time in which bones are learned."""

WRITER = """
import pathlib, sys
source, target = map(pathlib.Path, sys.argv[1:])
for path in sorted(source.iterdir()):
    data = path.read_bytes()
    with (target / path.name).open("wb") as file:
        file.write(data[: len(data) // 2])
        file.flush()
        file.write(data[len(data) // 2 :])
(target / "STOP").touch()
"""


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walkers(tmp_path_factory.mktemp("video"), FRAMES)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return build_store(tmp_path_factory.mktemp("store"))


def test_files_become_lines_while_written(video: Path, store: Store, tmp_path: Path, invoke: CommandLine) -> None:
    folder, out = tmp_path / "live", tmp_path / "lines" / "poses.jsonl"
    folder.mkdir()
    follow = invoke.of("reconstruct", folder, *reference(store), "--follow", "--out", out)
    with subprocess.Popen([sys.executable, "-c", WRITER, str(video), str(folder)]) as writer:
        said = follow("--idle", "60", "--lag", "3").err
    assert writer.returncode == 0
    _, *lines = [json.loads(line) for line in out.read_text().splitlines()]
    for person in (0, 1):
        of_person = [line for line in lines if line["person_id"] == person]
        assert [line["frame"] for line in of_person] == list(range(FRAMES))
        steps = np.linalg.norm(np.diff([line["root_m"] for line in of_person], axis=0), axis=-1)
        assert steps.max() < 0.25
    assert f"{FRAMES} frames, {2 * FRAMES} poses; work per frame" in said


def test_rotations_of_lines_give_the_joints(video: Path, store: Store, tmp_path: Path, invoke: CommandLine) -> None:
    out = tmp_path / "lines"
    statures = ("--stature", "1=1.5", "--stature", "1.9", "--stature", "7=1.2")
    said = invoke("reconstruct", video, *reference(store), "--follow", "--idle", "0", "--out", out, *statures).err
    assert "a stature is stated for person 7, who never appeared" in said
    head, *lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert (head["unit"], head["rate_hz"], head["joint_names"][head["parents"].index(-1)]) == ("m", 30.0, "Hips")
    skeleton = Skeleton("live", tuple(head["joint_names"]), tuple(head["parents"]))
    offsets: dict[int, np.ndarray] = {}
    floors = []
    for line in lines:
        if "rest_offset_m" in line:
            offsets[line["person_id"]] = np.array(line["rest_offset_m"])
        joints, _ = forward_kinematics(
            skeleton, offsets[line["person_id"]], np.array(line["hips_m"]), np.array(line["local_unitquat"])
        )
        by_rotations = joints[[skeleton.index(HUMANOID_NAMES[name]) for name in SHARED]]
        op14 = np.array(line["op14_m"])[[head["op14_names"].index(name) for name in SHARED]]
        np.testing.assert_allclose(by_rotations, op14, atol=2e-6)
        stature = body_height_m(OP14, bone_lengths(OP14, np.array(line["op14_m"])))
        assert stature == pytest.approx((1.9, 1.5)[line["person_id"]], abs=1e-5)
        floors.append(op14[[SHARED.index("left_ankle"), SHARED.index("right_ankle")], 1].min() - line["floor_m"])
    assert sum("rest_offset_m" in line for line in lines) == 2
    assert 0.05 < np.quantile(floors, 0.1) < 0.1


def read_while(folder: Path, steps: list[Callable[[], object]], idle_s: float = 100.0) -> list[FollowedFile]:
    """Follow a folder; every time the follower waits, the next step is taken, and ten seconds pass."""
    now = [0.0]

    def sleep(_: float) -> None:
        now[0] += 10.0
        if steps:
            steps.pop(0)()

    return list(follow_folder(folder, idle_s=idle_s, sleep=sleep, clock=lambda: now[0]))


def test_half_a_file_is_waited_for(video: Path, tmp_path: Path) -> None:
    data = [path.read_bytes() for _, path in list_frames(video)[:3]]
    names = [tmp_path / f"film_{n}.json" for n in range(3)]
    steps: list[Callable[[], object]] = [
        lambda: names[0].write_bytes(data[0][:50]),
        lambda: names[0].write_bytes(data[0]),
        lambda: names[1].write_bytes(b""),
        lambda: names[1].write_bytes(data[1]),
        lambda: names[2].write_bytes(data[2]),
        lambda: (tmp_path / STOP_NAME).touch(),
    ]
    files = read_while(tmp_path, steps)
    assert [file.number for file in files] == [0, 1, 2]
    assert not any(file.problem for file in files)
    assert steps == []


def test_a_file_that_never_becomes_whole_is_passed_over_when_the_writer_went_on(video: Path, tmp_path: Path) -> None:
    data = [path.read_bytes() for _, path in list_frames(video)[:3]]
    steps: list[Callable[[], object]] = [
        lambda: (tmp_path / "film_7.json").write_bytes(data[0][:50]),
        lambda: (tmp_path / "film_9.json").write_bytes(data[1]),
        lambda: (tmp_path / "film_8.json").write_bytes(data[2]),
    ]
    files = read_while(tmp_path, steps, idle_s=35.0)
    assert [(file.number, file.problem != "") for file in files] == [(7, True), (9, False)]
    assert "JSON" in files[0].problem


def test_ctrl_c_ends_the_video_and_the_second_time_everything(video: Path, tmp_path: Path) -> None:
    with remembered_ctrl_c(is_passed_on=False) as is_stopped:
        assert not is_stopped()
        signal.raise_signal(signal.SIGINT)
        assert is_stopped()
        (tmp_path / "film_3.json").write_bytes(list_frames(video)[0][1].read_bytes())
        files = list(follow_folder(tmp_path, idle_s=1e9, is_stopped=is_stopped))
        assert [file.number for file in files] == [3]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_the_video_ends_by_the_signal_of_ctrl_c_in_the_background_too() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with remembered_ctrl_c(is_passed_on=False) as is_stopped:
            signal.raise_signal(signal.SIGINT)
            assert is_stopped()
        with remembered_ctrl_c(is_passed_on=True) as is_stopped:
            signal.raise_signal(signal.SIGINT)
            assert not is_stopped()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", ENDING)
@pytest.mark.parametrize("is_remembered", [True, False])
def test_no_second_signal_breaks_off_what_the_first_one_ends(number: signal.Signals, is_remembered: bool) -> None:
    before = {ending: signal.signal(ending, signal.SIG_DFL) for ending in ENDING}
    try:
        with ended_as_by_ctrl_c():
            outer = signal.getsignal(number)
            inner = remembered_ctrl_c(is_passed_on=True) if is_remembered else nullcontext()
            with pytest.raises(KeyboardInterrupt), inner:
                signal.raise_signal(number)
            assert {signal.getsignal(ending) for ending in ENDING} == {signal.SIG_IGN}
            signal.signal(number, outer)  # as Prefect does where a flow ends
            signal.raise_signal(number)
        assert {signal.getsignal(ending) for ending in ENDING} == {signal.SIG_IGN}, "until the process has ended"
    finally:
        for ending, handler in before.items():
            signal.signal(ending, handler)


def test_delays_count_from_arrival_or_start(video: Path, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = next(iter(store.artifacts("projections")))
    database, _, _ = read_database(store, [manifest.ref])
    files = list(follow_folder(video, idle_s=-1.0))
    old_s = time.time() - min(file.path.stat().st_mtime for file in files)
    delays = []
    for began in (0.0, time.time() + 1000.0):
        people = LivePeople(Searcher.of(database), rate_hz=30.0, options=LiveOptions(lag=2))
        follow_lines(people, iter(files), None, rate_hz=30.0, began=began)
        _, *lines = map(json.loads, capsys.readouterr().out.splitlines())
        assert len(lines) == 2 * FRAMES
        delays.append([line["delay_s"] for line in lines])
    assert max(delays[0]) >= old_s - 0.1
    assert max(delays[1]) < 0.0


def test_nothing_new_for_the_idle_time_ends_it(tmp_path: Path) -> None:
    assert read_while(tmp_path, [], idle_s=25.0) == []
