"""Read and write BVH: the meaning of channels, faults by line, and a round trip."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pybvh
import pytest
from scipy.spatial.transform import Rotation

from pasdedeux.errors import FormatError
from pasdedeux.formats import bvh_writer
from pasdedeux.formats.bvh import read_bvh, read_bvh_head
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.euler import euler_from_unitquat, unitquat_from_euler
from pasdedeux.formats.rates import plain_rate, rate_from_frame_time
from pasdedeux.kinematics.rotations import angle_between
from tests.builders.source_samples import BVH_SMALL, bvh_text, figure_motion

ORDERS = ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]


def test_files_of_one_rig_keep_their_own_motion_and_the_lines_of_their_faults() -> None:
    shorter = BVH_SMALL.replace("Frames: 3", "Frames: 2").rsplit("\n", 2)[0] + "\n"
    assert [read_bvh(text).num_frames for text in (BVH_SMALL, shorter, BVH_SMALL)] == [3, 2, 3]
    late = "# exported\n\n" + BVH_SMALL.replace("Frame Time: ", "Frame Time: x")
    line = next(at for at, text in enumerate(late.split("\n"), 1) if text.startswith("Frame Time"))
    with pytest.raises(FormatError, match=f"line {line}: "):
        read_bvh(late)
    with pytest.raises(FormatError, match=r"line 3: .*'ROOTS Hips'"):
        read_bvh("\n" + BVH_SMALL.replace("ROOT ", "ROOTS "))


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_are_recovered_as_the_same_rotation_also_at_gimbal_lock(order: str) -> None:
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (200, 3))
    angles[:100, 1] = np.random.default_rng(2).choice([-np.pi / 2, np.pi / 2], 100)
    quaternions = unitquat_from_euler(angles, order)
    again = unitquat_from_euler(euler_from_unitquat(quaternions, order), order)
    assert angle_between(quaternions, again).max() < 1e-6


def test_joints_end_sites_and_channels_are_read_as_the_format_means() -> None:
    motion = read_bvh(BVH_SMALL)
    assert motion.skeleton.joint_names == ("Hips", "Spine", "Spine_end", "LeftUpLeg", "LeftUpLeg_end")
    assert motion.end_sites == {"Spine_end", "LeftUpLeg_end"}
    assert motion.num_frames == 3
    assert motion.rate_hz == 120.0
    positions, _ = motion.to_motion(metres_per_unit=1.0, rate_hz=120.0).world()
    at_rest = {"Hips": (1, 2, 3), "Spine": (1, 12, 3), "Spine_end": (1, 17, 4), "LeftUpLeg_end": (4, -6, 3)}
    for name, place in at_rest.items():
        np.testing.assert_allclose(positions[0, motion.skeleton.index(name)], place, atol=1e-12)
    # Frame 1: Z by 90 degrees at the root turns +Y to -X and +X to +Y; the leg then turns about its own X by 90.
    np.testing.assert_allclose(positions[1, 1], (1.5 - 10, 2, 3), atol=1e-12)
    np.testing.assert_allclose(positions[1, 3], (1.5, 5, 3), atol=1e-12)
    np.testing.assert_allclose(positions[1, 4], (1.5, 5, 3 - 8), atol=1e-12)


def test_rotation_channels_multiply_in_the_order_listed() -> None:
    motion = read_bvh(BVH_SMALL)
    expected = Rotation.from_euler("ZYX", [10, 20, 30], degrees=True).as_quat()
    assert angle_between(motion.local_unitquat[2, 0], expected) < 1e-7
    expected = Rotation.from_euler("ZXY", [40, 50, 60], degrees=True).as_quat()
    assert angle_between(motion.local_unitquat[2, 1], expected) < 1e-7


@pytest.mark.parametrize(
    ("token", "rate"),
    [
        ("0.008333", 120.0),
        (".0083333", 120.0),
        ("0.0333", 30.0),
        ("0.0333333", 30.0),
        ("0.033367", 1 / 0.033367),
        ("0.04170837", 1 / 0.04170837),
        ("0.01666", 60.0),
        ("1.6666e-2", 60.0),
        ("0.04", 25.0),
        (repr(1 / 60), 60.0),
        ("1", 1.0),
    ],
)
def test_a_cut_frame_time_gives_the_rate_that_was_meant(token: str, rate: float) -> None:
    assert rate_from_frame_time(token)[0] == pytest.approx(rate, rel=1e-12)


@pytest.mark.parametrize(
    ("token", "rate"),
    [("0.033", 30), ("0.017", 60), ("0.016", 60), ("0.0083", 120), ("0.008", 120), ("0.042", 24), ("0.03", 30)],
)
def test_a_frame_time_of_few_digits_is_the_usual_rate_and_is_said(token: str, rate: float) -> None:
    found, note = rate_from_frame_time(token)
    assert found == rate
    assert (token in note and f"{rate} Hz" in note) or token == "0.042"
    assert rate_from_frame_time("0.0166667")[1] == rate_from_frame_time("0.033367")[1] == ""


@pytest.mark.parametrize(
    ("stated", "meant"), [(30.0003, 30), (29.9997, 30), (119.99, 120), (29.97, 29.97), (59.94, 59.94)]
)
def test_a_rate_that_misses_a_whole_one_by_its_last_digits_is_that_one(stated: float, meant: float) -> None:
    assert plain_rate(stated) == meant
    assert plain_rate(1 / 0.0333330) == 30


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("1.5 2.0 3.0 90 0 0 0 0 0 90\n", "1.5 2.0 3.0 90 0 0 0 0 90\n", "line 29: 9 values where 10 are needed"),
        ("Frames: 3", "Frames: 14", "the file ends after 3 of 14 frames: it was cut off"),
        ("0 0 0 0 0 90\n", "0 0\n0 0 0 90 1\n", "line 29: 6 values where 10 are needed"),
        ("1.5 2.0 3.0 90", "1.5 nan 3.0 90", "line 29: Yposition of 'Hips' in frame 1: 'nan' is not a finite number"),
        ("30 40 50 60 70", "30 40 5O 60 70", "line 30: Xrotation of 'Spine' in frame 2: '5O' is not a number"),
        ("30 40 50 60 70", "30 40 5.0.0 60 70", "line 30: Xrotation of 'Spine' in frame 2: '5.0.0' is not a number"),
        ("30 40 50 60 70", "30 40 1e200 60 70", "Xrotation of 'Spine' in frame 2 is 1e\\+200; allowed: -10000000 to"),
        ("Frame Time: 0.008333", "Frame Time: 0", "line 27: the frame time in seconds is 0; allowed: 1e-05 to 10"),
        ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "line 18: channel 'Wrotation' of 'LeftUpLeg' is not known"),
        (
            "CHANNELS 1 Xrotation",
            "CHANNELS 3 Xrotation",
            "line 18: CHANNELS of 'LeftUpLeg' states 3 channels but lists 1",
        ),
        ("JOINT LeftUpLeg", "JOINT Spine", "line 15: this JOINT 'Spine' is the second or one too many"),
        ("OFFSET 3.0 0.0 0.0", "OFFSET 3.0 0.0", "line 17: OFFSET of 'LeftUpLeg' needs 3 numbers, found 2"),
        ("MOTION", "JOINT B", "line 25: 'JOINT B' is not expected; allowed: MOTION, ROOT"),
        ("\t}\n}\nMOTION", "\t}\nMOTION", "line 24: 'MOTION' is not expected in 'Hips'; allowed: }, JOINT, END"),
        ("HIERARCHY", "GARBAGE", "line 1: 'GARBAGE' is not expected; allowed: HIERARCHY"),
    ],
)
def test_a_fault_is_named_with_its_line(old: str, new: str, sentence: str) -> None:
    assert old in BVH_SMALL
    with pytest.raises(FormatError, match=sentence):
        read_bvh(BVH_SMALL.replace(old, new, 1))


@pytest.mark.parametrize("token", ["nan", "1e999", "5O", "1e200"])
def test_the_quick_check_finds_what_is_no_finite_number(token: str) -> None:
    assert read_bvh_head(BVH_SMALL.replace("30 40 50 60 70", "30 4e1 50 60 70")).num_frames == 3
    with pytest.raises(FormatError, match="line 30: Xrotation of 'Spine'"):
        read_bvh_head(BVH_SMALL.replace("30 40 50 60 70", f"30 40 {token} 60 70"))


def test_a_file_cut_anywhere_is_refused_or_lacks_whole_frames_and_says_so() -> None:
    whole = BVH_SMALL.rstrip()
    for length in range(0, len(whole) - 2):
        try:
            notes = read_bvh(whole[:length]).notes
        except FormatError:
            continue
        assert "it states 3 frames and holds" in notes[0]
        assert whole[:length].count("\n") >= whole.count("\n") - 2


@pytest.mark.parametrize(
    ("stated", "note"), [(1, "states 1 frame and holds 3"), (0, "holds 3"), (13, "holds 3"), (3, "")]
)
def test_whole_rows_are_read_whatever_the_header_counts(stated: int, note: str) -> None:
    text = BVH_SMALL.replace("Frames: 3", f"Frames: {stated}")
    for source in (read_bvh(text), read_bvh_head(text).rest):
        assert (note in source.notes[0]) if note else source.notes == ()
    assert read_bvh(text).num_frames == read_bvh_head(text).num_frames == 3


@pytest.mark.parametrize("order", ORDERS)
def test_reading_is_the_inverse_of_writing(order: str, monkeypatch: pytest.MonkeyPatch) -> None:
    motion = figure_motion(num_frames=20, rate_hz=60.0)
    monkeypatch.setattr(bvh_writer, "_ROTATION_ORDER", order)
    written = write_bvh(motion)
    again = read_bvh(written)
    joints = range(motion.skeleton.num_joints)
    assert str(written).count("End Site") == sum(not motion.skeleton.children(joint) for joint in joints)
    assert again.rate_hz == 60.0
    place = [again.skeleton.index(name) for name in motion.skeleton.joint_names]
    positions, unitquat = again.to_motion(metres_per_unit=0.01, rate_hz=60.0).world()
    expected, expected_unitquat = motion.world()
    # Half a unit of the sixth decimal, in centimetres and degrees, times the length of the chain.
    assert np.abs(positions[:, place] - expected).max() < 2e-7
    assert angle_between(unitquat[:, place], expected_unitquat).max() < 1e-6


@pytest.mark.parametrize(("axis", "matrix"), [
    ("y", np.eye(3)),
    ("z", np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])),
    ("x", np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])),
])  # fmt: skip
def test_the_up_axis_is_turned_to_y_without_mirroring(axis: str, matrix: np.ndarray) -> None:
    source = read_bvh(bvh_text())
    as_is, _ = source.to_motion(metres_per_unit=1.0, rate_hz=30.0).world()
    turned, _ = source.to_motion(metres_per_unit=1.0, rate_hz=30.0, up_axis=axis).world()
    np.testing.assert_allclose(turned, as_is @ matrix.T, atol=1e-9)


@pytest.mark.parametrize("name", ["cmu_salsa_bvh/60_10.bvh", "projection_db_yiannakides/91_13.bvh"])
def test_real_files_agree_with_an_independent_reader(data_dir: Path, name: str) -> None:
    path = data_dir / name
    ours = read_bvh(path.read_bytes())
    theirs = pybvh.read_bvh_file(path, world_up="+y")
    nodes = [node.name for node in theirs.nodes if not node.is_end_site()]
    place = [ours.skeleton.index(joint) for joint in nodes]
    picked = np.linspace(0, ours.num_frames - 1, 20).astype(int)
    positions, _ = ours.to_motion(metres_per_unit=1.0, rate_hz=ours.rate_hz or 1).world()
    expected = np.asarray(theirs.node_positions())
    inner = [i for i, node in enumerate(theirs.nodes) if not node.is_end_site()]
    np.testing.assert_allclose(positions[picked][:, place], expected[picked][:, inner], atol=1e-6)
    assert read_bvh_head(path.read_bytes()).num_frames == ours.num_frames


def test_the_head_of_a_large_file_is_read_by_some_of_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only `read_bvh` finds a wrong number between the sampled frames; anything but numbers is found at once."""
    monkeypatch.setattr("pasdedeux.formats.bvh._LARGE_BYTES", 50_000)
    monkeypatch.setattr("pasdedeux.formats.bvh._NUM_SAMPLED", 200)
    head, _, rest = bvh_text(num_frames=3).partition("Frames: 3")
    step, *rows = rest.strip().splitlines()
    lines = [head + "Frames: 900", step, *rows * 300]
    whole = "\n".join(lines).encode()
    assert len(whole) > 50_000
    rest_pose, stated = read_bvh_head("\n".join([head + "Frames: 3", step, *rows]).encode()), read_bvh_head(whole)
    assert stated.num_frames == 900
    np.testing.assert_array_equal(stated.rest.rest_offsets, rest_pose.rest.rest_offsets)
    assert (stated.rest.rate_hz, stated.rest.notes) == (rest_pose.rest.rate_hz, rest_pose.rest.notes)

    def changed(row: str, at: int) -> bytes:
        return "\n".join([*lines[: 2 + at], row, *lines[3 + at :]]).encode()

    line = whole[: whole.index(rows[0].encode())].count(b"\n") + 1
    wrong = changed(rows[0].replace(rows[0].split()[0], "1e999", 1), 432)
    assert read_bvh_head(wrong).num_frames == 900
    with pytest.raises(FormatError, match=rf"line {line + 432}: .*frame 432: '1e999'"):
        read_bvh(wrong)
    for row, at in ((rows[0].replace(" ", " x", 1), 432), (rows[0][:40], 899)):
        with pytest.raises(FormatError) as when_read:
            read_bvh(changed(row, at))
        with pytest.raises(FormatError, match=re.escape(str(when_read.value))):
            read_bvh_head(changed(row, at))
    assert read_bvh_head(changed("# a note", 432)).num_frames == 899
    wrapped = whole.replace(b" ", b"\n")
    assert read_bvh_head(wrapped).num_frames == 900
