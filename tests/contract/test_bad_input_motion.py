"""Motion files that a study cannot be built from: the command line says so in one sentence before any work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.placement import place_motion
from tests.builders.real_study import call_in_process, never_begun
from tests.builders.source_samples import ASF, figure_motion

STUDY = """
[study]
name = "bad"

[ingest]
takes = [{{ id = "dance", files = ["60_01.bvh", "61_01.bvh"]{options} }}]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a study over two good BVH files."""
    motion = figure_motion(num_frames=12, rate_hz=60.0)
    (tmp_path / "60_01.bvh").write_text(write_bvh(motion))
    facing = place_motion(motion, translation_m=(1.0, 0.0, 0.0), yaw_rad=np.pi)
    (tmp_path / "61_01.bvh").write_text(write_bvh(facing))
    write_study(tmp_path)
    return tmp_path


def write_study(folder: Path, options: str = "") -> None:
    (folder / "bad.toml").write_text(STUDY.format(options=options))


def refusal(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one sentence with which `run` and `plan` refuse the study; nothing may have been begun."""
    sentences = set()
    for command in ("plan", "run"):
        found = call_in_process(capsys, command, folder / "bad.toml", "--store", folder / "store")
        assert found.code == 2, found
        assert found.out == ""
        assert found.err.count("\n") == 1, found.err
        assert found.err.startswith("error: ")
        assert "Traceback" not in found.err
        sentences.add(found.err.removeprefix("error: ").rstrip())
    assert never_begun(folder / "store")
    assert len(sentences) == 1
    return sentences.pop()


def lines_of(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_the_good_files_are_planned(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call_in_process(capsys, "plan", folder / "bad.toml", "--store", folder / "store").code == 0


def test_a_missing_file_is_named_with_its_take(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "61_01.bvh").unlink()
    assert refusal(folder, capsys) == f"take dance: file {folder / '61_01.bvh'} does not exist"


def test_a_folder_in_the_place_of_a_file_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "61_01.bvh").unlink()
    (folder / "61_01.bvh").mkdir()
    assert refusal(folder, capsys) == f"take dance: file {folder / '61_01.bvh'} cannot be read: Is a directory"


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.8, 0.97])
def test_a_file_that_was_cut_off_is_named(folder: Path, capsys: pytest.CaptureFixture[str], share: float) -> None:
    path = folder / "61_01.bvh"
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert refusal(folder, capsys).startswith("take dance: 61_01.bvh: ")


def test_a_missing_last_frame_is_counted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "61_01.bvh"
    lines = lines_of(path)
    path.write_text("\n".join(lines[:-1]) + "\n")
    found = refusal(folder, capsys)
    assert found == f"take dance: 61_01.bvh: line {len(lines)}: the file ends after 11 of 12 frames"


def test_a_frame_with_too_few_values_is_named_with_its_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "61_01.bvh"
    lines = lines_of(path)
    first = next(i for i, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    num_channels = len(lines[first].split())
    lines[first + 4] = lines[first + 4].rsplit(" ", 1)[0]
    path.write_text("\n".join(lines) + "\n")
    assert refusal(folder, capsys) == (
        f"take dance: 61_01.bvh: line {first + 5}: frame 4 has {num_channels - 1} values, "
        f"but the hierarchy has {num_channels} channels"
    )


def test_a_channel_too_many_in_the_hierarchy_is_noticed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "61_01.bvh"
    path.write_text(path.read_text().replace("CHANNELS 3 Z", "CHANNELS 4 Yposition Z", 1))
    assert "frame 0 has" in refusal(folder, capsys)


@pytest.mark.parametrize("value", ["nan", "NaN", "inf", "0x1A", "12,5"])
def test_what_is_no_number_is_named_with_its_line_and_channel(
    folder: Path, capsys: pytest.CaptureFixture[str], value: str
) -> None:
    path = folder / "60_01.bvh"
    lines = lines_of(path)
    values = lines[-3].split()
    values[7] = value
    lines[-3] = " ".join(values)
    path.write_text("\n".join(lines) + "\n")
    found = refusal(folder, capsys)
    assert found.startswith(f"take dance: 60_01.bvh: line {len(lines) - 2}, ")
    assert "rotation of '" in found
    assert value in found


def test_a_bone_of_length_zero_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "60_01.bvh"
    text = path.read_text()
    start = text.index("JOINT left_knee")
    offset = text.index("OFFSET", start)
    path.write_text(text[:offset] + "OFFSET 0 0 0" + text[text.index("\n", offset) :])
    found = refusal(folder, capsys)
    assert found.startswith("take dance: 60_01.bvh: ")
    assert "'left_hip' to 'left_knee'" in found


def test_files_of_unequal_length_are_both_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "61_01.bvh").write_text(write_bvh(figure_motion(num_frames=9, rate_hz=60.0)))
    assert refusal(folder, capsys) == (
        "take dance: its files have unequal lengths (60_01.bvh 12 and 61_01.bvh 9 frames); "
        'set on_unequal = "trim" to keep what both have'
    )


def test_frames_beyond_the_end_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_study(folder, ", frames = [4, 20]")
    assert refusal(folder, capsys) == "take dance: frames from 4 to 20 are wanted, but 60_01.bvh has 12 frames"


def test_unknown_joints_are_listed_with_those_that_are_missed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "61_01.bvh"
    path.write_text(path.read_text().replace("JOINT left_hip", "JOINT hipp"))
    found = refusal(folder, capsys)
    assert found.startswith("take dance: 61_01.bvh: its joints fit none of the known layouts (")
    assert "; the nearest is body22, which also needs left_hip; joints: pelvis, " in found


def test_a_joint_that_a_mapping_names_and_the_file_has_not_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (folder / "bad.toml").open("a") as file:
        file.write('\n[ingest.mappings.body22.pair17]\nleft_knee = "left_kneee"\n')
    found = refusal(folder, capsys)
    assert found.startswith("take dance: 60_01.bvh: ")
    assert "'left_kneee'" in found


def test_a_file_of_another_kind_is_called_by_its_kind(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "61_01.bvh").write_text(ASF)
    found = refusal(folder, capsys)
    assert found.startswith("take dance: 61_01.bvh: ")
    assert "asf" in found


@pytest.mark.parametrize("data", [b"", b"\x00" * 4096, b"\xff\xfe\x00", b"HIERARCHY\n", bytes(range(256)) * 16])
def test_bytes_that_are_no_motion_are_named(folder: Path, capsys: pytest.CaptureFixture[str], data: bytes) -> None:
    (folder / "61_01.bvh").write_bytes(data)
    assert refusal(folder, capsys).startswith("take dance: 61_01.bvh: ")


def test_different_frame_rates_in_a_pair_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "61_01.bvh").write_text(write_bvh(figure_motion(num_frames=12, rate_hz=50.0)))
    assert refusal(folder, capsys) == ("take dance: its files have different frame rates, 60 and 50 Hz; set rate_hz")
