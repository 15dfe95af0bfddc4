"""Read ASF/AMC: axes and degrees of freedom, faults by line, agreement with an independent conversion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pasdedeux.errors import FormatError
from pasdedeux.formats.asf_amc import ASF_AMC, read_amc, read_asf
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.registry import recognise_format
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.kinematics import Motion
from pasdedeux.skeletons import BODY22, PAIR17
from pasdedeux.skeletons.layouts import LAYOUTS
from tasks.ingest.takes.resolution import find_companion
from tests.builders.source_samples import AMC, ASF

UNIT_M = 0.0254 / 0.45
THIGH = np.array([0.34202, -0.939693, 0.0]) / np.linalg.norm([0.34202, -0.939693, 0.0])
"""Where the bones of the leg point in `ASF`."""


def world(text: str = AMC) -> tuple[dict[str, int], np.ndarray]:
    motion = read_amc(text, read_asf(ASF)).to_motion(metres_per_unit=1.0, rate_hz=120.0)
    return {name: i for i, name in enumerate(motion.skeleton.joint_names)}, motion.world()[0]


def test_units_bones_and_ends_are_read() -> None:
    asf = read_asf(ASF)
    assert asf.metres_per_unit == pytest.approx(UNIT_M)
    assert asf.skeleton.joint_names == (
        "root", "lowerback", "lowerback_end", "lhipjoint", "lfemur", "ltibia", "ltibia_end",
    )  # fmt: skip
    assert asf.dof[0] == "xyzXYZ"
    assert read_amc(AMC, asf).rate_hz is None


def test_with_all_angles_zero_bones_lie_along_their_directions() -> None:
    index, positions = world()
    np.testing.assert_allclose(positions[0, index["root"]], (1, 2, 3))
    np.testing.assert_allclose(positions[0, index["lowerback_end"]], (1, 4, 3))
    np.testing.assert_allclose(positions[0, index["lfemur"]], (2.5, 2, 3))
    np.testing.assert_allclose(positions[0, index["ltibia"]], np.array([2.5, 2, 3]) + 7 * THIGH)


def test_a_bone_turns_by_c_m_c_inverse_in_its_parent() -> None:
    index, positions = world()
    root = Rotation.from_euler("y", 90, degrees=True)
    c = Rotation.from_euler("z", 20, degrees=True)
    femur = c * Rotation.from_euler("x", -90, degrees=True) * c.inv()
    tibia = c * Rotation.from_euler("x", 45, degrees=True) * c.inv()
    hip = np.array([1, 2, 3.5]) + root.apply([1.5, 0, 0])
    knee = hip + (root * femur).apply(7 * THIGH)
    ankle = knee + (root * femur * tibia).apply(7.2 * THIGH)
    np.testing.assert_allclose(positions[1, index["lfemur"]], hip, atol=1e-9)
    np.testing.assert_allclose(positions[1, index["ltibia"]], knee, atol=1e-9)
    np.testing.assert_allclose(positions[1, index["ltibia_end"]], ankle, atol=1e-9)


def test_the_first_angle_turns_first() -> None:
    text = AMC.replace("lfemur -90 0 0", "lfemur 30 40 50").replace("0 90 0", "10 20 30")
    motion = read_amc(text, read_asf(ASF))
    root = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)  # extrinsic: x first
    np.testing.assert_allclose(np.abs(np.dot(motion.local_unitquat[1, 0], root.as_quat())), 1.0, atol=1e-12)
    c = Rotation.from_euler("z", 20, degrees=True)
    femur = c * Rotation.from_euler("xyz", [30, 40, 50], degrees=True) * c.inv()
    joint = motion.skeleton.index("lfemur")
    np.testing.assert_allclose(np.abs(np.dot(motion.local_unitquat[1, joint], femur.as_quat())), 1.0, atol=1e-12)


def test_radians_are_read_as_radians() -> None:
    text = AMC.replace(":DEGREES", ":RADIANS").replace("-90 0 0", f"{-np.pi / 2} 0 0").replace("45", f"{np.pi / 4}")
    text = text.replace("0 90 0", f"0 {np.pi / 2} 0").replace("lowerback 10", f"lowerback {np.deg2rad(10)}")
    np.testing.assert_allclose(world(text)[1], world()[1], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "skeletons"),
    [
        ("walk.amc", ["walk.asf"]),
        ("60_01.amc", ["60_01.asf", "60.asf"]),
        ("HDM_bd_01-01_01_120.amc", [*("HDM_bd_01-01_01_120.asf", "HDM_bd_01-01_01.asf", "HDM_bd_01-01.asf")]),
        ("HDM_bd_01-01_01_120.amc", ["HDM_bd.asf"]),
        ("a dance.amc", ["a dance.asf", "a.asf"]),
        ("WALK_2.AMC", ["WALK_2.ASF", "WALK.ASF"]),
    ],
)
def test_a_skeleton_is_sought_under_what_the_motion_begins_with(name: str, skeletons: list[str]) -> None:
    names = list(ASF_AMC.companion_names(name))
    assert [place for place in names if place in skeletons] == skeletons
    assert names[0].upper() == name.upper().replace(".AMC", ".ASF")


def test_a_fault_of_a_skeleton_has_the_name_of_the_skeleton(tmp_path: Path) -> None:
    (tmp_path / "walk.asf").write_text(ASF.replace("length 7.0", "length seven"))
    with pytest.raises(FormatError, match=r"^walk\.asf: line 38: length of 'lfemur': 'seven' is not a number"):
        find_companion(tmp_path / "walk.amc", ASF_AMC)
    (tmp_path / "other.asf").write_text(ASF)
    stated = find_companion(tmp_path / "walk.amc", ASF_AMC, tmp_path / "other.asf")
    assert stated.path.endswith("other.asf")


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_an_amc_without_a_header_is_read_in_the_angles_of_its_skeleton(unit: str) -> None:
    bare = AMC.partition(":DEGREES\n")[2]
    asf = read_asf(ASF.replace("angle deg", f"angle {unit}"))
    assert recognise_format(bare.encode()) is recognise_format(f"# by hand\n\n{bare}".encode()) is ASF_AMC
    source = read_amc(bare, asf)
    wanted = read_amc(AMC.replace(":DEGREES", ":DEGREES" if unit == "deg" else ":RADIANS"), asf)
    np.testing.assert_array_equal(source.local_unitquat, wanted.local_unitquat)
    assert wanted.notes == ()
    assert source.notes == (
        "it has no header with the unit of its angles: they are in "
        f"{'degrees' if unit == 'deg' else 'radians'}, as the skeleton says",
    )


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("ltibia 45\n", "", "frame 2 ends without bone 'ltibia'"),
        ("ltibia 0\n2", "ltibia 0\n4", "line 9: frame 4 follows frame 1; 2 is expected"),
        ("lfemur -90 0 0", "lfemur -90 0", "line 12: bone 'lfemur' needs 3 numbers, found 2"),
        ("lfemur -90 0 0", "rfemur -90 0 0", "line 12: bone 'rfemur' is not in the ASF skeleton"),
        ("ltibia 45", "ltibia nan", "line 13: bone 'ltibia': 'nan' is not a finite number"),
        ("ltibia 45", "lfemur 1 2 3", "line 13: bone 'lfemur' twice in frame 2"),
        ("1\nroot", "x\nroot", "line 4: a frame number is expected: 'x' is not a whole number"),
    ],
)
def test_a_fault_of_an_amc_file_is_named_with_its_line(old: str, new: str, sentence: str) -> None:
    assert old in AMC
    with pytest.raises(FormatError, match=sentence):
        read_amc(AMC.replace(old, new, 1), read_asf(ASF))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("lfemur ltibia\n", "lfemur\n", "bone 'ltibia' has no parent"),
        ("lfemur ltibia\n", "lfemur rtibia\n", "bone 'rtibia' is not in ':bonedata'"),
        ("root lowerback lhipjoint", "root lowerback", "bone 'lhipjoint' has no parent"),
        ("lhipjoint lfemur\n", "lhipjoint lfemur\n    ltibia lhipjoint\n", "a second parent"),
        ("length 7.0", "length seven", "line 38: length of 'lfemur': 'seven' is not a number"),
        ("axis 0 0 20  XYZ", "axis 0 0 20 XYX", "the axis order is 'XYX'"),
        ("dof rx\n", "dof rx rq\n", "the degree of freedom 'rq'"),
        ("length 0.45", "length 0", "the length unit is 0"),
        (":hierarchy", ":nothing", "has no section ':hierarchy'"),
        ("limits (-10.0 170.0)", "limits (-10.0)", "1 numbers in its limits"),
    ],
)
def test_a_fault_of_an_asf_file_is_named(old: str, new: str, sentence: str) -> None:
    assert old in ASF
    with pytest.raises(FormatError, match=sentence):
        read_asf(ASF.replace(old, new, 1))


def cmu(data_dir: Path, subject: str, take: str, rate_hz: float) -> Motion:
    folder = data_dir / "cmu_asfamc"
    source = read_amc(
        (folder / f"{subject}_{take}.amc").read_bytes(), read_asf((folder / f"{subject}.asf").read_bytes())
    )
    return source.to_motion(metres_per_unit=source.metres_per_unit, rate_hz=rate_hz)


def test_the_original_amc_agrees_with_its_conversion_to_bvh(data_dir: Path) -> None:
    amc = cmu(data_dir, "60", "01", 60.0)
    bvh = read_bvh((data_dir / "cmu_salsa_bvh" / "60_01.bvh").read_bytes()).to_motion(metres_per_unit=1.263, rate_hz=60)
    ours = derive_working_poses(amc, LAYOUTS["cmu_asf"]).pair17_m
    theirs = derive_working_poses(bvh, LAYOUTS["cmu_daz"]).pair17_m
    median = np.median(np.linalg.norm(ours - theirs, axis=-1), axis=0)
    # The conversion moved the figure to other bone lengths: legs stay within 4 cm, arms were widened by 12-14 cm.
    for joint in ("pelvis", "spine", "chest", "neck", "left_hip", "right_hip", "left_knee", "right_knee"):
        assert median[PAIR17.index(joint)] < 0.05, joint
    assert median[PAIR17.indices(["left_ankle", "right_ankle"])].max() < 0.02
    assert median.max() < 0.15
    # A mirrored reading would put left limbs where right ones are: far worse than the right reading.
    mirrored = ours[:, PAIR17.mirror]
    assert np.median(np.linalg.norm(mirrored - theirs, axis=-1)) > 2 * np.median(median)


def test_a_walking_person_walks_forward_on_the_floor_with_the_left_side_on_the_left(data_dir: Path) -> None:
    poses = derive_working_poses(cmu(data_dir, "02", "01", 120.0), LAYOUTS["cmu_asf"]).body22_m
    feet = poses[:, BODY22.indices(["left_toe", "right_toe"]), 1].min(axis=1)
    assert 0.0 < np.percentile(feet, 5) < 0.06
    travel = poses[-1, 0] - poses[0, 0]
    left, right = (poses[:, BODY22.index(f"{side}_hip")] for side in ("left", "right"))
    facing = np.cross(left - right, [0.0, 1.0, 0.0]).mean(axis=0)
    assert np.dot(travel, facing) / np.linalg.norm(travel) / np.linalg.norm(facing) > 0.95
    toes = poses[:, BODY22.index("left_toe")] - poses[:, BODY22.index("left_ankle")]
    assert np.dot(toes.mean(axis=0), facing) > 0
    # Knees bend forward of the line from hip to ankle.
    hip, knee, ankle = (poses[:, BODY22.index(f"left_{name}")] for name in ("hip", "knee", "ankle"))
    assert ((knee - (hip + ankle) / 2) @ facing).mean() > 0
