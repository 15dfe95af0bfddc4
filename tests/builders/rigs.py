"""Small rigs of programs and data sets in use, all moved by one person whose joints are known."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
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

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "spine4", "neck", "neck2", "head", "crown")
_ARM = ("collar", "shoulder", "elbow", "wrist", "fingers")
_LEG = ("hip", "knee", "ankle", "toe", "toe_tip")
_SPINE_SHARES = {1: (0.45,), 2: (0.23, 0.68), 3: (0.23, 0.45, 0.68), 4: (0.15, 0.33, 0.5, 0.72)}
"""Places of the joints of a spine between pelvis and neck, by how many there are: as characters have them."""
_SKULL_HEIGHT, _CROWN_HEIGHT = 0.88, 1.0

SMALL_BVH = """HIERARCHY
ROOT Hips { OFFSET 0 95 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT Spine { OFFSET 0 10 0 CHANNELS 0 JOINT Spine1 { OFFSET 0 11 0 CHANNELS 0 JOINT Spine2 { OFFSET 0 12 0 CHANNELS 0
JOINT Neck { OFFSET 0 15 0 CHANNELS 0 JOINT Head { OFFSET 0 9 1 CHANNELS 0 End Site { OFFSET 0 16 0 } } }
JOINT LeftShoulder { OFFSET 5 11 0 CHANNELS 0 JOINT LeftArm { OFFSET 13 0 0 CHANNELS 0
JOINT LeftForeArm { OFFSET 28 0 0 CHANNELS 0 JOINT LeftHand { OFFSET 26 0 0 CHANNELS 0 } } } }
JOINT RightShoulder { OFFSET -5 11 0 CHANNELS 0 JOINT RightArm { OFFSET -13 0 0 CHANNELS 0
JOINT RightForeArm { OFFSET -28 0 0 CHANNELS 0 JOINT RightHand { OFFSET -26 0 0 CHANNELS 0 } } } }
} } }
JOINT LeftUpLeg { OFFSET 9 -4 0 CHANNELS 0 JOINT LeftLeg { OFFSET 0 -42 0 CHANNELS 0
JOINT LeftFoot { OFFSET 0 -41 0 CHANNELS 0 JOINT LeftToeBase { OFFSET 0 -6 13 CHANNELS 0 } } } }
JOINT RightUpLeg { OFFSET -9 -4 0 CHANNELS 0 JOINT RightLeg { OFFSET 0 -42 0 CHANNELS 0
JOINT RightFoot { OFFSET 0 -41 0 CHANNELS 0 JOINT RightToeBase { OFFSET 0 -6 13 CHANNELS 0 } } } }
}
MOTION
Frames: 4
Frame Time: 0.0333333
0 95 0 0 0 0
0 96 1 0 0 0
0 97 2 0 0 0
0 96 3 0 0 0
"""
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
    sides: tuple[str, str] = ("Left", "Right")
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


def _character(name: str, layout: str = "mixamo", prefix: str = "", **told: object) -> Rig:
    """Return a rig with the names of MotionBuilder's characters, a prefix before each."""
    p = prefix
    return Rig(
        name,
        layout,
        f"{p}Hips | {p}Spine {p}Spine1 {p}Spine2 | {p}Neck | {p}Head {p}HeadTop_End",
        f"{p}{{}}Shoulder {p}{{}}Arm {p}{{}}ForeArm {p}{{}}Hand {p}{{}}HandMiddle1",
        f"{p}{{}}UpLeg {p}{{}}Leg {p}{{}}Foot {p}{{}}ToeBase {p}{{}}Toe_End",
        **told,  # type: ignore[arg-type]
    )


_BENDS = ("{}Collar {}Shoulder {}Elbow {}Wrist", "{}Hip {}Knee {}Ankle {}Toe")
_SMALL = ("{}_collar {}_shoulder {}_elbow {}_wrist", "{}_hip {}_knee {}_ankle {}_toe")

RIGS: tuple[Rig, ...] = (
    _character("mixamo"),
    _character("mixamo with a namespace", prefix="mixamorig:"),
    _character("mixamo with a number", prefix="mixamorig12:", pose="A"),
    _character("mixamo without a colon", prefix="mixamorig", axes="+x +z -y"),
    _character("motionbuilder's character", prefix="Character1_", metres_per_unit=1.0),
    _character("optitrack", prefix="subject1:", metres_per_unit=0.001),
    Rig(
        "characters without toes",
        "mixamo",
        "Hips | Spine Spine1 Spine2 | Neck | Head",
        "{}Shoulder {}Arm {}ForeArm {}Hand",
        "{}UpLeg {}Leg {}Foot",
    ),
    Rig(
        "characters without collars, neck and two of the spine",
        "mixamo",
        "Hips | Spine | | Head HeadTop_End",
        "- {}Arm {}ForeArm {}Hand",
        "{}UpLeg {}Leg {}Foot {}ToeBase",
        pose="A",
    ),
    Rig(
        "characters with a neck alone",
        "mixamo",
        "Hips | Spine Spine1 | Neck |",
        "{}Shoulder {}Arm {}ForeArm {}Hand",
        "{}UpLeg {}Leg {}Foot {}ToeBase",
    ),
    Rig(
        "lafan1",
        "lafan",
        "Hips | Spine Spine1 Spine2 | Neck | Head",
        "{}Shoulder {}Arm {}ForeArm {}Hand",
        "{}UpLeg {}Leg {}Foot {}Toe",
        pose="random",
    ),
    Rig(
        "axis neuron",
        "mixamo",
        "Hips | Spine Spine1 Spine2 Spine3 | Neck | Head",
        "{}Shoulder {}Arm {}ForeArm {}Hand {}HandMiddle",
        "{}UpLeg {}Leg {}Foot",
    ),
    Rig(
        "pymo",
        "mixamo",
        "Hips | Spine Spine1 | Neck | Head Head_Nub",
        "{}Shoulder {}Arm {}ForeArm {}Hand",
        "{}UpLeg {}Leg {}Foot {}ToeBase {}ToeBase_Nub",
    ),
    Rig("xsens", "xsens", "Hips | Chest Chest2 Chest3 Chest4 | Neck | Head", *_BENDS),
    Rig("biovision", "xsens", "Hips | Chest | Neck | Head", *_BENDS, metres_per_unit=0.0254),
    Rig("mocapbank", "xsens", "Hips | Chest Chest2 | Neck | Head", *_BENDS, metres_per_unit=0.0254, pose="A"),
    Rig(
        "biovision's other names",
        "biovision",
        "Hips | Chest | Neck | Head",
        "{}Collar {}UpArm {}LowArm {}Hand",
        "{}UpLeg {}LowLeg {}Foot",
    ),
    Rig("openni", "xsens", "waist | torso | neck | head", "- {}_shoulder {}_elbow {}_hand", "{}_hip {}_knee {}_foot"),
    Rig(
        "bandai-namco",
        "bandai_namco",
        "Hips | Spine Chest | Neck | Head",
        "Shoulder_{} UpperArm_{} LowerArm_{} Hand_{}",
        "UpperLeg_{} LowerLeg_{} Foot_{} Toes_{}",
        ("L", "R"),
        axes="+x +z -y",
    ),
    Rig(
        "vrm",
        "bandai_namco",
        "J_Bip_C_Hips | J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest | J_Bip_C_Neck | J_Bip_C_Head",
        "J_Bip_{}_Shoulder J_Bip_{}_UpperArm J_Bip_{}_LowerArm J_Bip_{}_Hand J_Bip_{}_Middle1",
        "J_Bip_{}_UpperLeg J_Bip_{}_LowerLeg J_Bip_{}_Foot J_Bip_{}_ToeBase",
        ("L", "R"),
        metres_per_unit=1.0,
    ),
    Rig(
        "unreal",
        "unreal",
        "pelvis | spine_01 spine_02 spine_03 | neck_01 | head",
        "clavicle_{} upperarm_{} lowerarm_{} hand_{} middle_01_{}",
        "thigh_{} calf_{} foot_{} ball_{}",
        ("l", "r"),
        axes="+x +z -y",
        pose="A",
    ),
    Rig(
        "biped",
        "biped",
        "Bip01~Pelvis | Bip01~Spine Bip01~Spine1 | Bip01~Neck | Bip01~Head Bip01~HeadNub",
        "Bip01~{}~Clavicle Bip01~{}~UpperArm Bip01~{}~Forearm Bip01~{}~Hand Bip01~{}~Finger0",
        "Bip01~{}~Thigh Bip01~{}~Calf Bip01~{}~Foot Bip01~{}~Toe0 Bip01~{}~Toe0Nub",
        ("L", "R"),
        metres_per_unit=0.0254,
    ),
    Rig(
        "rigify",
        "rigify",
        "spine | spine.001 spine.002 spine.003 | spine.004 spine.005 | spine.006",
        "shoulder.{} upper_arm.{} forearm.{} hand.{} f_middle.01.{}",
        "thigh.{} shin.{} foot.{} toe.{}",
        ("L", "R"),
        metres_per_unit=1.0,
        axes="+x +z -y",
    ),
    Rig(
        "rokoko",
        "rokoko",
        "Hips | Spine1 Spine2 Spine3 Spine4 | Neck | Head",
        "{}Shoulder {}Arm {}ForeArm {}Hand",
        "{}Thigh {}Shin {}Foot {}Toe {}ToeTip",
    ),
    Rig(
        "soma77",
        "soma",
        "Hips | Spine1 Spine2 Chest | Neck1 Neck2 | Head HeadEnd",
        "{}Shoulder {}Arm {}ForeArm {}Hand {}HandMiddle1",
        "{}Leg {}Shin {}Foot {}ToeBase {}ToeEnd",
        metres_per_unit=1.0,
    ),
    Rig(
        "mhr",
        "mhr",
        "root | c_spine0 c_spine1 c_spine2 c_spine3 | c_neck | c_head",
        "{}_clavicle {}_uparm {}_lowarm {}_wrist {}_middle1",
        "{}_upleg {}_lowleg {}_foot {}_ball",
        ("l", "r"),
    ),
    Rig(
        "makehuman",
        "makehuman",
        "root | spine05 spine04 spine03 spine02 | neck01 | head",
        "clavicle.{} upperarm01.{} lowerarm01.{} wrist.{} finger3-1.{}",
        "upperleg01.{} lowerleg01.{} foot.{} toe1-1.{}",
        ("L", "R"),
        metres_per_unit=0.1,
        pose="A",
    ),
    Rig(
        "mocapnet",
        "cmu_daz",
        "hip | abdomen chest | neck neck1 | head",
        "{}Collar {}Shldr {}ForeArm {}Hand {}Mid1",
        "{}Thigh {}Shin {}Foot toe1-1.{}",
        ("l", "r"),
    ),
    Rig(
        "daz in capitals",
        "cmu_daz",
        "HIP | ABDOMEN CHEST | NECK | HEAD",
        "{}COLLAR {}SHLDR {}FOREARM {}HAND",
        "{}THIGH {}SHIN {}FOOT",
        ("L", "R"),
        pose="A",
    ),
    Rig("maya", "xsens", "hips_jnt | spine1_jnt spine2_jnt spine3_jnt | neck_jnt | head_jnt", *_SMALL, ("l", "r")),
    Rig(
        "kinect",
        "xsens",
        "SpineBase | SpineMid | Neck | Head",
        "- Shoulder{} Elbow{} Wrist{}",
        "Hip{} Knee{} Ankle{} Foot{}",
    ),
    Rig(
        "points of the augmentation paper",
        "points17",
        "Hip | Chest | | Head",
        "- {}Shoulder {}Hand {}Hand_end",
        "{}Leg {}Knee {}Foot {}Foot_end",
        metres_per_unit=0.0254,
        axes="+x +z -y",
        renamed={"RightHand": "RghtHand", "RightHand_end": "RghtHand_end"},
    ),
    Rig(
        "cmu of 25 joints",
        "mixamo",
        "Hips | Spine Spine1 Spine2 | Neck | Head",
        "{}Shoulder {}Arm {}ForeArm {}Hand {}HandIndex1",
        "{}UpLeg {}Leg {}Foot {}ToeBase",
        metres_per_unit=0.0254 / 0.45,
    ),
    Rig(
        "hdm05",
        "cmu_asf",
        "root | lowerback upperback thorax | lowerneck upperneck | head",
        "{}clavicle {}humerus {}radius {}hand {}fingers",
        "{}femur {}tibia {}foot {}toes",
        ("l", "r"),
        metres_per_unit=0.0254,
    ),
    Rig(
        "cmu in motionbuilder's names",
        "cmu_cgspeed",
        "Hips | LowerBack Spine Spine1 | Neck1 | Head",
        "{}Shoulder {}Arm {}ForeArm {}Hand {}FingerBase",
        "{}UpLeg {}Leg {}Foot {}ToeBase",
        metres_per_unit=0.0254 / 0.45,
    ),
    Rig(
        "mmd",
        "mmd",
        "センター | 上半身 上半身2 | 首 | 頭",
        "{}肩 {}腕 {}ひじ {}手首 {}中指１",
        "{}足 {}ひざ {}足首 {}つま先",
        ("左", "右"),
        metres_per_unit=1.0,
        pose="A",
    ),
    Rig(
        "ipi",
        "mixed",
        "Hip | LowerSpine MiddleSpine Chest | Neck | Head",
        "{}Clavicle {}Shoulder {}Forearm {}Hand",
        "{}Thigh {}Shin {}Foot {}Toe",
        ("L", "R"),
    ),
    Rig(
        "motive",
        "mixed",
        "Skeleton1:Hip | Skeleton1:Ab Skeleton1:Chest | Skeleton1:Neck | Skeleton1:Head",
        "Skeleton1:{}Shoulder Skeleton1:{}UArm Skeleton1:{}FArm Skeleton1:{}Hand",
        "Skeleton1:{}Thigh Skeleton1:{}Shin Skeleton1:{}Foot Skeleton1:{}Toe",
        ("L", "R"),
    ),
    Rig(
        "mvn",
        "mixed",
        "Pelvis | L5 L3 T12 T8 | Neck | Head",
        "{}Shoulder {}UpperArm {}ForeArm {}Hand",
        "{}UpperLeg {}LowerLeg {}Foot {}Toe",
        axes="+y +z +x",
    ),
    Rig(
        "character creator",
        "biped",
        "CC_Base_Hip | CC_Base_Waist CC_Base_Spine01 CC_Base_Spine02 | CC_Base_NeckTwist01 | CC_Base_Head",
        "CC_Base_{}_Clavicle CC_Base_{}_Upperarm CC_Base_{}_Forearm CC_Base_{}_Hand CC_Base_{}_Mid1",
        "CC_Base_{}_Thigh CC_Base_{}_Calf CC_Base_{}_Foot CC_Base_{}_ToeBase",
        ("L", "R"),
        axes="+x +z -y",
    ),
    Rig(
        "vrchat",
        "mixed",
        "Hips | Spine Chest | Neck | Head",
        "{}~shoulder {}~arm {}~elbow {}~wrist",
        "{}~leg {}~knee {}~ankle {}~toe",
        metres_per_unit=1.0,
    ),
    Rig(
        "theia",
        "mixed",
        "pelvis | torso | | head",
        "- {}_uarm {}_larm {}_hand",
        "{}_thigh {}_shank {}_foot {}_toes",
        ("l", "r"),
        metres_per_unit=0.001,
        axes="+y +z +x",
    ),
    Rig(
        "second life",
        "xsens",
        "mPelvis | mTorso mChest | mNeck | mHead",
        "mCollar{} mShoulder{} mElbow{} mWrist{}",
        "mHip{} mKnee{} mAnkle{} mFoot{}",
        metres_per_unit=1.0,
    ),
    Rig(
        "smpl in its own names",
        "xsens",
        "f_avg_Pelvis | f_avg_Spine1 f_avg_Spine2 f_avg_Spine3 | f_avg_Neck | f_avg_Head",
        "f_avg_{}_Collar f_avg_{}_Shoulder f_avg_{}_Elbow f_avg_{}_Wrist f_avg_{}_Hand",
        "f_avg_{}_Hip f_avg_{}_Knee f_avg_{}_Ankle f_avg_{}_Foot",
        ("L", "R"),
    ),
    Rig(
        "valve",
        "biped",
        "ValveBiped.Bip01_Pelvis | ValveBiped.Bip01_Spine ValveBiped.Bip01_Spine1 ValveBiped.Bip01_Spine2"
        " | ValveBiped.Bip01_Neck1 | ValveBiped.Bip01_Head1",
        " ".join(f"ValveBiped.Bip01_{{}}_{part}" for part in ("Clavicle", "UpperArm", "Forearm", "Hand")),
        " ".join(f"ValveBiped.Bip01_{{}}_{part}" for part in ("Thigh", "Calf", "Foot", "Toe0")),
        ("L", "R"),
        metres_per_unit=0.0254,
    ),
    Rig(
        "poser's copies",
        "cmu_daz",
        "hip:1 | abdomen:1 chest:1 | neck:1 | head:1",
        "{}Collar:1 {}Shldr:1 {}ForeArm:1 {}Hand:1",
        "{}Thigh:1 {}Shin:1 {}Foot:1",
        ("l", "r"),
    ),
    Rig(
        "copies of blender",
        "mixamo",
        "Hips.001 | Spine.001 Spine1.001 Spine2.001 | Neck.001 | Head.001",
        "{}Shoulder.001 {}Arm.001 {}ForeArm.001 {}Hand.001",
        "{}UpLeg.001 {}Leg.001 {}Foot.001 {}ToeBase.001",
    ),
    Rig(
        "numbers after the names",
        "mixamo",
        "Hips_01 | Spine_02 Spine1_03 Spine2_04 | Neck_05 | Head_06",
        "{}Shoulder_07 {}Arm_08 {}ForeArm_09 {}Hand_010",
        "{}UpLeg_011 {}Leg_012 {}Foot_013 {}ToeBase_014",
        metres_per_unit=1.0,
    ),
)
"""Rigs as files have them; what they share with real files is names, tree, unit and axes, not the proportions."""
