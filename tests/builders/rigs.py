"""Small rigs of programs and data sets in use, all moved by one person whose joints are known."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import conjugate, multiply, rotate, unitquat_from_rotvec
from pasdedeux.skeletons import Skeleton
from pasdedeux.skeletons.humanoid import t_pose

STATURE_M = 1.7
RATE_HZ = 30.0
NUM_FRAMES = 12

_ARM = ("collar", "shoulder", "elbow", "wrist", "fingers")
_LEG = ("hip", "knee", "ankle", "toe", "toe_tip")
_SPINE_SHARES = {1: (0.45,), 2: (0.23, 0.68), 3: (0.23, 0.45, 0.68), 4: (0.15, 0.33, 0.5, 0.72)}
"""Places of the joints of a spine between pelvis and neck, by how many there are: as characters have them."""
_SKULL_HEIGHT, _CROWN_HEIGHT = 0.88, 1.0

SMALL_BVH = Path(__file__).with_name("samples").joinpath("person.bvh").read_text()
"""A valid file in centimetres: 1.69 m tall, the pelvis between 0.95 and 0.97 m."""


@dataclass(frozen=True)
class Rig:
    """What a kind of file calls the joints of a person, and how it states them.

    Args:
        name: Of the rig, for messages.
        layout: The layout that it belongs to.
        trunk: Its joints from the pelvis up: `pelvis | spine ... | neck ... | head crown`; parts may be empty.
        arm: Collar, shoulder, elbow, wrist and fingers, `{}` for the side, `-` for what it does not have.
        leg: Hip, knee, ankle, toe and its tip, likewise.
        sides: How it writes left and right.
        pose: Rest pose: arms out, arms down by 45 degrees, or every joint's frame turned at random.
        metres_per_unit: Length of its unit.
        axes: The file's axes that are the person's left, up and forward at rest, such as `+x +z -y`.
    """

    name: str
    layout: str
    trunk: str
    arm: str
    leg: str
    sides: Sequence[str] = ("Left", "Right")
    pose: Literal["T", "A", "random"] = "T"
    metres_per_unit: float = 0.01
    axes: str = "+x +y +z"
    renamed: dict[str, str] = field(default_factory=dict)

    @property
    def names(self) -> dict[str, str]:
        """Name in the file of each of the person's parts that it has."""
        pelvis, spine, neck, head = (part.split() for part in self.trunk.split("|"))
        trunk = dict(zip(("pelvis",), pelvis, strict=False))
        trunk |= {f"spine{at}": name for at, name in enumerate(spine, 1)}
        trunk |= dict(zip(("neck", "neck2"), neck, strict=False)) | dict(zip(("head", "crown"), head, strict=False))
        limbs = {
            f"{side}_{part}": name.replace("{}", written)
            for side, written in zip(("left", "right"), self.sides, strict=True)
            for parts, names in ((_ARM, self.arm), (_LEG, self.leg))
            for part, name in zip(parts, names.split(), strict=False)
            if name != "-"
        }
        return {part: self.renamed.get(name, name).replace("~", " ") for part, name in (trunk | limbs).items()}

    @property
    def matrix(self) -> np.ndarray:
        """The file's axes from the person's: left, up and forward as columns (3, 3)."""
        columns = [float(f"{axis[0]}1") * np.eye(3)["xyz".index(axis[1])] for axis in self.axes.split()]
        return np.stack(columns, axis=1)

    def source(self, seed: int = 0) -> SourceMotion:
        """Return the motion as a file of this rig gives it."""
        names, person = self.names, _person(self.pose == "A", len(self.trunk.split("|")[1].split()))
        known = person.skeleton
        kept = [joint for joint in known.order if known.joint_names[joint] in names]
        above = {joint: next((parent for parent in _line(known, joint) if parent in kept), -1) for joint in kept}
        tree = {names[known.joint_names[joint]]: above[joint] for joint in kept}
        parents = {name: names[known.joint_names[parent]] if parent >= 0 else "" for name, parent in tree.items()}
        skeleton = Skeleton.of_tree("bvh", parents)
        positions, world = person.world()
        rest = person.rest_positions_m()
        offsets = np.array([rest[joint] - rest[above[joint]] if above[joint] >= 0 else np.zeros(3) for joint in kept])
        frames = np.random.default_rng(seed).normal(size=(len(kept), 4))
        frames /= np.linalg.norm(frames, axis=-1, keepdims=True)
        if self.pose != "random":
            frames = np.tile([0.0, 0.0, 0.0, 1.0], (len(kept), 1))
        turned = multiply(world[:, kept], np.broadcast_to(frames, (len(world), *frames.shape)))
        at = [kept.index(above[joint]) if above[joint] >= 0 else -1 for joint in kept]
        local = np.stack(
            [
                turned[:, joint] if up < 0 else multiply(conjugate(turned[:, up]), turned[:, joint])
                for joint, up in enumerate(at)
            ],
            axis=1,
        )
        offsets = rotate(conjugate(frames[at]), offsets)
        root = positions[:, kept[0]]
        to_file = self.matrix
        scale = 1.0 / self.metres_per_unit
        return SourceMotion(
            skeleton=skeleton,
            rest_offsets=offsets @ to_file.T * scale,
            root_translation=root @ to_file.T * scale,
            local_unitquat=_in_axes(local, to_file),
            rate_hz=RATE_HZ,
        )

    def bvh(self, seed: int = 0) -> str:
        """Return the motion as BVH text; leaves have End Sites without an offset."""
        source = self.source(seed)
        motion = source.to_motion(metres_per_unit=1.0, rate_hz=RATE_HZ)
        return write_bvh(motion, units_per_metre=1.0)

    def to_person(self, positions: np.ndarray) -> np.ndarray:
        """Return positions (..., 3) in the file's axes, metres, in those in which `truth` is."""
        return np.asarray(positions @ self.matrix)


def truth(rig: Rig) -> dict[str, np.ndarray]:
    """Return where the person's joints are (frame, 3), metres: Y up, facing Z in the first frame.

    `ear` is what `head` of body22 stands for, carried by the skull.
    """
    person = _person(rig.pose == "A", len(rig.trunk.split("|")[1].split()))
    positions, world = person.world()
    places = dict(zip(person.skeleton.joint_names, np.swapaxes(positions, 0, 1), strict=True))
    skull = person.skeleton.index("head")
    up = np.array([0.0, (0.905 - _SKULL_HEIGHT) * STATURE_M, 0.0])
    return places | {"ear": positions[:, skull] + rotate(world[:, skull], np.broadcast_to(up, (len(world), 3)))}


def _line(skeleton: Skeleton, joint: int) -> list[int]:
    """Return the joints above a joint, the nearest first."""
    line = []
    while (joint := skeleton.parents[joint]) >= 0:
        line.append(joint)
    return line


def _in_axes(unitquat: np.ndarray, to_file: np.ndarray) -> np.ndarray:
    """Return rotations in other axes, mirrored ones too."""
    sign = np.linalg.det(to_file)
    return np.concatenate([sign * unitquat[..., :3] @ to_file.T, unitquat[..., 3:]], axis=-1)


@cache
def _person(is_a_pose: bool, num_spine: int) -> Motion:
    """Return somebody who walks, turns a little, swings the arms and looks about."""
    tree = {"pelvis": ""}
    trunk = ["pelvis", *(f"spine{at + 1}" for at in range(num_spine)), "neck", "neck2", "head", "crown"]
    tree |= dict(zip(trunk[1:], trunk[:-1], strict=True))
    chest = trunk[num_spine]
    for side in ("left", "right"):
        for start, parts in ((chest, _ARM), ("pelvis", _LEG)):
            limb = [start, *(f"{side}_{part}" for part in parts)]
            tree |= dict(zip(limb[1:], limb[:-1], strict=True))
    skeleton = Skeleton.of_tree("person", tree)
    places = {name: np.array(_place(name, num_spine, is_a_pose)) * STATURE_M for name in tree}
    offsets = np.array([places[name] - places[parent] if parent else np.zeros(3) for name, parent in tree.items()])
    phase = 2 * np.pi * np.arange(NUM_FRAMES) / NUM_FRAMES
    turns = np.zeros((NUM_FRAMES, len(tree), 3))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        turns[:, skeleton.index(f"{side}_hip"), 0] = -0.4 * sign * np.sin(phase)
        turns[:, skeleton.index(f"{side}_knee"), 0] = 0.35 + 0.3 * sign * np.sin(phase)
        turns[:, skeleton.index(f"{side}_shoulder"), 2] = -sign * (0.9 + 0.2 * np.cos(phase))
        turns[:, skeleton.index(f"{side}_elbow"), 1] = -sign * (0.5 + 0.2 * np.sin(phase))
    turns[:, skeleton.index("pelvis"), 1] = 0.2 * np.sin(phase)
    turns[:, skeleton.index("spine1"), 0] = 0.1 + 0.05 * np.sin(phase)
    turns[:, skeleton.index("head"), 1] = 0.3 * np.sin(phase)
    root = places["pelvis"] + np.stack([0.02 * np.sin(phase), -0.03 + 0.01 * np.cos(phase), 0.1 * phase], axis=-1)
    return Motion(skeleton, offsets, root, unitquat_from_rotvec(turns), RATE_HZ)


def _place(name: str, num_spine: int, is_a_pose: bool) -> tuple[float, float, float]:
    """Return the rest position of a part of the person (left, up, forward), fractions of stature."""
    side, _, part = name.partition("_")
    if side == "right":
        x, y, z = _place(f"left_{part}", num_spine, is_a_pose)
        return (-x, y, z)
    if name.startswith("spine"):
        low, high = np.array(t_pose("pelvis")), np.array(t_pose("neck"))
        share = _SPINE_SHARES[num_spine][int(name[5:]) - 1]
        return tuple((low + share * (high - low)).tolist())
    if name in ("neck2", "head", "crown"):
        return (0.0, {"neck2": 0.857, "head": _SKULL_HEIGHT, "crown": _CROWN_HEIGHT}[name], 0.0)
    if part == "toe_tip":
        x, y, z = t_pose("left_toe")
        return (x, y, z + 0.03)
    if part in ("elbow", "wrist", "fingers"):
        x, y, z = t_pose("left_wrist" if part == "fingers" else name)
        x += 0.1 * (part == "fingers")
        at_x, at_y, _ = t_pose("left_shoulder")
        reach = x - at_x
        return (at_x + reach * np.sqrt(0.5), at_y - reach * np.sqrt(0.5), z) if is_a_pose else (x, y, z)
    return t_pose(name)


RIGS = tuple(Rig(**rig) for rig in tomllib.loads(Path(__file__).with_suffix(".toml").read_text())["rig"])
"""Rigs as files have them; what they share with real files is names, tree, unit and axes, not the proportions."""
