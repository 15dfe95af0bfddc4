"""Motion files that a study cannot be built from: the command line says so in one sentence before any work.

What a reader finds in a file and in which line is tested where the reader is; here it has to arrive with its take.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.placement import place_motion
from tests.builders.real_study import call_in_process, refused
from tests.builders.source_samples import figure_motion

STUDY = """
[study]
name = "bad"

[ingest]
takes = [{ id = "dance", files = ["60_01.bvh", "61_01.bvh"] }]
"""
Spoil = Callable[[Path], object]
"""What is done to the folder of a study."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a study over two good BVH files."""
    motion = figure_motion(num_frames=12, rate_hz=60.0)
    (tmp_path / "60_01.bvh").write_text(write_bvh(motion))
    facing = place_motion(motion, translation_m=(1.0, 0.0, 0.0), yaw_rad=np.pi)
    (tmp_path / "61_01.bvh").write_text(write_bvh(facing))
    (tmp_path / "bad.toml").write_text(STUDY)
    return tmp_path


def of_nine_frames(folder: Path) -> None:
    (folder / "61_01.bvh").write_text(write_bvh(figure_motion(num_frames=9, rate_hz=60.0)))


def a_folder(folder: Path) -> None:
    (folder / "61_01.bvh").unlink()
    (folder / "61_01.bvh").mkdir()


def without_half_the_last_frame(folder: Path) -> None:
    head, _, row = (folder / "61_01.bvh").read_text().rstrip().rpartition("\n")
    (folder / "61_01.bvh").write_text(f"{head}\n{row[: len(row) // 2]}\n")


def a_bone_of_length_zero(folder: Path) -> None:
    text = (folder / "61_01.bvh").read_text()
    offset = text.index("OFFSET", text.index("JOINT left_knee"))
    (folder / "61_01.bvh").write_text(text[:offset] + "OFFSET 0 0 0" + text[text.index("\n", offset) :])


def test_the_good_files_are_planned(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call_in_process(capsys, "plan", folder / "bad.toml", "--store", folder / "store").code == 0


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: (folder / "61_01.bvh").unlink(), ("file FOLDER/61_01.bvh does not exist",)),
        (a_folder, ("FOLDER/61_01.bvh is a folder, and a regular file is needed",)),
        (without_half_the_last_frame, ("61_01.bvh: line ", " values where 69 are needed")),
        (a_bone_of_length_zero, ("61_01.bvh: ", "'left_hip' to 'left_knee' of 'pair17'")),
        (
            of_nine_frames,
            (
                "its files have unequal lengths (60_01.bvh 12 and 61_01.bvh 9 frames); ",
                'set on_unequal = "trim" to keep what both have',
            ),
        ),
    ],
)
def test_bad_files_are_named_with_their_take_and_what_is_wrong(
    folder: Path, capsys: pytest.CaptureFixture[str], spoil: Spoil, says: tuple[str, ...]
) -> None:
    spoil(folder)
    found = refused(capsys, folder / "bad.toml", commands=("plan", "run")).replace(str(folder), "FOLDER")
    assert found.startswith(f"take dance: {says[0]}")
    assert all(part in found for part in says)
