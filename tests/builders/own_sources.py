"""What a user brings: motion of known layouts, a walk as ASF/AMC, and a filmed duet as 2D poses of detectors."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.formats.bvh import read_bvh, read_rotation_rows
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.kinematics import Motion
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, LAYOUTS

Array = npt.NDArray[np.float64]

_BONES = {
    "lhipjoint": ("root", (0.09, -0.08, 0.0)),
    "lfemur": ("lhipjoint", (0.0, -0.42, 0.0)),
    "ltibia": ("lfemur", (0.0, -0.42, 0.0)),
    "lfoot": ("ltibia", (0.0, -0.06, 0.12)),
    "ltoes": ("lfoot", (0.0, 0.0, 0.07)),
    "rhipjoint": ("root", (-0.09, -0.08, 0.0)),
    "rfemur": ("rhipjoint", (0.0, -0.42, 0.0)),
    "rtibia": ("rfemur", (0.0, -0.42, 0.0)),
    "rfoot": ("rtibia", (0.0, -0.06, 0.12)),
    "rtoes": ("rfoot", (0.0, 0.0, 0.07)),
    "lowerback": ("root", (0.0, 0.11, 0.0)),
    "upperback": ("lowerback", (0.0, 0.11, 0.0)),
    "thorax": ("upperback", (0.0, 0.11, 0.0)),
    "lowerneck": ("thorax", (0.0, 0.09, 0.0)),
    "upperneck": ("lowerneck", (0.0, 0.08, 0.0)),
    "head": ("upperneck", (0.0, 0.09, 0.02)),
    "lclavicle": ("thorax", (0.16, 0.06, 0.0)),
    "lhumerus": ("lclavicle", (0.28, 0.0, 0.0)),
    "lradius": ("lhumerus", (0.22, 0.0, 0.0)),
    "lwrist": ("lradius", (0.05, 0.0, 0.0)),
    "lhand": ("lwrist", (0.08, 0.0, 0.0)),
    "lfingers": ("lhand", (0.07, 0.0, 0.0)),
    "lthumb": ("lwrist", (0.05, 0.0, 0.04)),
    "rclavicle": ("thorax", (-0.16, 0.06, 0.0)),
    "rhumerus": ("rclavicle", (-0.28, 0.0, 0.0)),
    "rradius": ("rhumerus", (-0.22, 0.0, 0.0)),
    "rwrist": ("rradius", (-0.05, 0.0, 0.0)),
    "rhand": ("rwrist", (-0.08, 0.0, 0.0)),
    "rfingers": ("rhand", (-0.07, 0.0, 0.0)),
    "rthumb": ("rwrist", (-0.05, 0.0, 0.04)),
}
"""Parent and vector in metres of each bone of a CMU skeleton; a standing person with arms out who faces +Z."""

_METRES_PER_UNIT = 0.0254 / 0.45
_TURNING = {
    "root": "pelvis",
    "lowerback": "spine1",
    "upperback": "spine2",
    "thorax": "spine3",
    "lowerneck": "neck",
    **{
        f"{side[0]}{bone}": f"{side}_{joint}"
        for side in ("left", "right")
        for bone, joint in {
            "femur": "hip",
            "tibia": "knee",
            "foot": "ankle",
            "humerus": "shoulder",
            "radius": "elbow",
        }.items()
    },
}
"""What turns of it, by the joint of the built-in duets that turns alike."""


def asf_text(subject: str) -> str:
    """Return the skeleton of a subject as CMU writes it."""
    lines = [":version 1.10", f":name {subject}", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":root"]
    lines += ["   order TX TY TZ RX RY RZ", "   axis XYZ", "   position 0 0 0", "   orientation 0 0 0", ":bonedata"]
    for number, (name, (_, vector)) in enumerate(_BONES.items(), start=1):
        length = float(np.linalg.norm(vector))
        direction = " ".join(f"{value / length:.9f}" for value in vector)
        lines += ["  begin", f"     id {number}", f"     name {name}", f"     direction {direction}"]
        lines += [f"     length {length / _METRES_PER_UNIT:.9f}", "     axis 0 0 0  XYZ"]
        if name in _TURNING:
            lines += ["    dof rx ry rz", "    limits (-180 180)", "           (-180 180)", "           (-180 180)"]
        lines.append("  end")
    lines += [":hierarchy", "  begin"]
    for parent in ("root", *_BONES):
        children = [name for name, (other, _) in _BONES.items() if other == parent]
        if children:
            lines.append(f"    {parent} {' '.join(children)}")
    return "\n".join([*lines, "  end"]) + "\n"


def amc_text(root: Array, turns_deg: Mapping[str, Array]) -> str:
    """Return motion as CMU writes it: the root's place (frame, 3), metres, and angles (frame, 3) of what turns."""
    frames = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    place = root / _METRES_PER_UNIT
    columns = {bone: place if bone == "root" else place[:, :0] for bone in _TURNING}
    rows = {bone: np.concatenate([columns[bone], turns_deg[bone]], axis=1) for bone in _TURNING}
    for frame in range(len(root)):
        frames += [str(frame + 1), *(" ".join([bone, *map("{:.6f}".format, rows[bone][frame])]) for bone in _TURNING)]
    return "\n".join(frames) + "\n"


def danced_amc(motion: Motion) -> str:
    """Return the motion of a person of a built-in duet on CMU's skeleton."""
    turns = {
        bone: Rotation.from_quat(motion.local_unitquat[:, BODY22.index(joint)]).as_euler("xyz", degrees=True)
        for bone, joint in _TURNING.items()
    }
    return amc_text(motion.root_translation_m, turns)


def write_walk(folder: Path, *, num_frames: int = 120, rate_hz: float = 120.0) -> Path:
    """Write 90.asf and 90_01.amc: a person who walks along +Z with swinging arms; gives the AMC file."""
    (folder / "90.asf").write_text(asf_text("90"))
    time = np.arange(num_frames) / rate_hz
    swing, none = np.sin(2 * np.pi * time), np.zeros(num_frames)
    turns = {bone: np.zeros((num_frames, 3)) for bone in _TURNING} | {
        "lfemur": np.stack([-25 * swing, none, none], axis=1),
        "rfemur": np.stack([25 * swing, none, none], axis=1),
        "ltibia": np.stack([15 - 15 * swing, none, none], axis=1),
        "rtibia": np.stack([15 + 15 * swing, none, none], axis=1),
        "lhumerus": np.stack([none, -20 * swing, none - 75], axis=1),
        "rhumerus": np.stack([none, -20 * swing, none + 75], axis=1),
        "lradius": np.stack([none, none - 15, none], axis=1),
        "rradius": np.stack([none, none + 15, none], axis=1),
    }
    path = folder / "90_01.amc"
    path.write_text(amc_text(np.stack([none, none + 0.99, 1.2 * time], axis=1), turns))
    return path


@dataclass(frozen=True)
class FilmedDuet:
    """A duet before a camera.

    Args:
        camera: The camera.
        rate_hz: Frames per second.
        op14_m: World positions (frame, person, 14, 3).
        body22_m: World positions (frame, person, 22, 3).
    """

    camera: PinholeCamera
    rate_hz: float
    op14_m: Array
    body22_m: Array

    def keypoints_px(self, layout: str) -> Array:
        """Return the keypoints (frame, person, K, 2) of a layout; NaN for those that the bodies have not got: eyes."""
        names = KEYPOINT_LAYOUTS[layout].keypoint_names
        keypoints = np.full((*self.op14_m.shape[:2], len(names), 2), np.nan)
        for column, name in enumerate(names):
            point = self._point(name)
            if point is not None:
                keypoints[:, :, column] = self.camera.project(point).px
        return keypoints

    def _point(self, name: str) -> Array | None:
        op14 = {"nose": "head"}.get(name, name)
        body22 = {"mid_hip": "pelvis"}.get(name, name.replace("_big_toe", "_toe"))
        if op14 in OP14.joint_names:
            return self.op14_m[:, :, OP14.index(op14)]
        return self.body22_m[:, :, BODY22.index(body22)] if body22 in BODY22.joint_names else None


def real_motions(data_dir: Path) -> dict[str, Motion]:
    """Return a real motion of each layout that there is data of."""
    salsa, database = data_dir / "cmu_salsa_bvh", data_dir / "projection_db_yiannakides"
    asf = read_asf((data_dir / "cmu_asfamc" / "03.asf").read_bytes())
    amc = read_amc((data_dir / "cmu_asfamc" / "03_01.amc").read_bytes(), asf)
    rows = read_rotation_rows((database / "rotations" / "3").read_bytes(), (database / "template.bvh").read_bytes())
    return {
        "cmu_daz": read_bvh((salsa / "61_10.bvh").read_bytes()).to_motion(metres_per_unit=1.191, rate_hz=60),
        "cmu_cgspeed": read_bvh((database / "91_13.bvh").read_bytes()).to_motion(
            metres_per_unit=_METRES_PER_UNIT, rate_hz=120
        ),
        "cmu_asf": amc.to_motion(metres_per_unit=_METRES_PER_UNIT, rate_hz=120),
        "yiannakides": rows.to_motion(metres_per_unit=0.0645, rate_hz=24),
    }


def first_frames(motion: Motion, count: int) -> Motion:
    """Return the first frames of a motion."""
    roots, rotations = motion.root_translation_m[:count], motion.local_unitquat[:count]
    return replace(motion, root_translation_m=roots, local_unitquat=rotations)


def film_duet(name: str, *, duration_s: float, rate_hz: float, yaw_rad: float = 0.5) -> FilmedDuet:
    """Film a built-in duet from 4.5 m."""
    duet = make_duet(name, duration_s=duration_s, rate_hz=rate_hz)
    poses = [derive_working_poses(motion, LAYOUTS["body22"]) for motion in duet.motions]
    target = np.stack([pose.body22_m[:, BODY22.root] for pose in poses]).mean(axis=(0, 1))
    return FilmedDuet(
        camera=look_at_camera(target, distance_m=4.5, yaw_rad=yaw_rad, pitch_rad=0.15, focal_px=1200.0),
        rate_hz=rate_hz,
        op14_m=np.stack([pose.op14_m for pose in poses], axis=1),
        body22_m=np.stack([pose.body22_m for pose in poses], axis=1),
    )


def write_openpose(folder: Path, duet: FilmedDuet, layout: str) -> None:
    """Write a JSON file per frame as OpenPose does: not detected is (0, 0, 0)."""
    folder.mkdir()
    for frame, people in enumerate(duet.keypoints_px(layout)):
        content = {
            "version": 1.3,
            "people": [{"person_id": [-1], "pose_keypoints_2d": _numbers(points, seen=0.9)} for points in people],
        }
        (folder / f"{folder.name}_{frame:012d}_keypoints.json").write_text(json.dumps(content))


def write_coco(path: Path, duet: FilmedDuet) -> None:
    """Write COCO keypoints with an image per frame and a track per person."""
    keypoints = duet.keypoints_px("coco17")
    images = [{"id": frame, "width": 1920, "height": 1080, "frame_id": frame} for frame in range(len(keypoints))]
    annotations = [
        {"image_id": frame, "track_id": person, "keypoints": _numbers(points, seen=2)}
        for frame, people in enumerate(keypoints)
        for person, points in enumerate(people)
    ]
    path.write_text(json.dumps({"images": images, "annotations": annotations}))


def write_csv(path: Path, duet: FilmedDuet, layout: str = "op14") -> None:
    """Write our own table, and a third person of whom three joints are seen."""
    names = KEYPOINT_LAYOUTS[layout].keypoint_names
    with path.open("w", newline="") as file:
        file.write(f"# layout: {layout}\n# rate_hz: {duet.rate_hz:g}\n")
        writer = csv.writer(file)
        writer.writerow(["frame", "person", "joint", "x", "y"])
        for frame, people in enumerate(duet.keypoints_px(layout)):
            for person, points in enumerate([*people, people[0][:3] + 300.0]):
                for name, (x, y) in zip(names, points, strict=False):
                    writer.writerow([frame, person, name, f"{x:.2f}", f"{y:.2f}"])


def _numbers(points: Array, *, seen: float) -> list[float]:
    rows = [[0.0, 0.0, 0] if np.isnan(point).any() else [*np.round(point, 2).tolist(), seen] for point in points]
    return [number for row in rows for number in row]
