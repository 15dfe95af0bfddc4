"""Layouts of motion files: the CMU database, the projection database, body22 itself, and characters' common names."""

from __future__ import annotations

from collections.abc import Mapping

from pasdedeux.skeletons.layouts.layout import AddedPoint, Layout
from pasdedeux.skeletons.skeleton import ARM, LEG, by_side
from pasdedeux.skeletons.working import BODY22

Entry = str | Mapping[str, float]

_LIMB_JOINTS = (*ARM, *LEG, "toe")
_TRUNK_JOINTS = ("pelvis", "spine1", "spine2", "spine3", "neck")


def _layout(
    name: str,
    meaning: str,
    signature: set[str],
    *,
    sides: tuple[str, str],
    limbs: tuple[Entry, ...],
    collar: Entry,
    trunk: tuple[Entry, ...],
    spine: Entry,
    chest: Entry,
    head: Entry,
    nose: AddedPoint | str,
    points: tuple[AddedPoint, ...] = (),
) -> Layout:
    """Return a layout: its tables of the three working skeletons from what the source calls things.

    Args:
        name: Name of the layout.
        meaning: One line for people.
        signature: Joints that recognise it.
        sides: What stands for `{}` in names of the left and of the right side.
        limbs: Sources of shoulder, elbow, wrist, hip, knee, ankle, toe.
        collar: Source of the collars of body22.
        trunk: Sources of pelvis, spine1, spine2, spine3, neck of body22; the neck is the joint at its base.
        spine: Source of the spine of pair17.
        chest: Source of the chest of pair17.
        head: Source of the head of body22 and pair17: ear height, on the neck's line.
        nose: Source of the head of op14.
        points: Further points added to the source.
    """
    named = {**dict(zip(_LIMB_JOINTS, limbs, strict=True)), "collar": collar}
    both: dict[str, Entry] = {
        f"{ours}_{joint}": _on_side(entry, theirs)
        for ours, theirs in zip(("left", "right"), sides, strict=True)
        for joint, entry in named.items()
    }
    shared = {name: both[name] for name in by_side("left", *ARM, *LEG)}
    shoulders, hips = ({str(both[name]): 0.5 for name in by_side("left", joint)} for joint in ("shoulder", "hip"))
    pair17: dict[str, Entry] = {
        "spine": spine,
        "chest": chest,
        "head": head,
        "pelvis": hips,
        "neck": _mix((0.4, trunk[-1]), *((0.3, shoulder) for shoulder in shoulders)),
    }
    op14: dict[str, Entry] = {"head": nose.name if isinstance(nose, AddedPoint) else nose, "neck": shoulders}
    body22: dict[str, Entry] = {**dict(zip(_TRUNK_JOINTS, trunk, strict=True)), "head": head}
    tables: dict[str, dict[str, Entry]] = {"pair17": shared | pair17, "op14": shared | op14, "body22": both | body22}
    added = (nose,) if isinstance(nose, AddedPoint) else ()
    return Layout(name, meaning, frozenset(signature), tables, (*added, *points))


def _mix(*parts: tuple[float, Entry]) -> Entry:
    """Return entries joined, each by its weight."""
    mixed: dict[str, float] = {}
    for weight, entry in parts:
        for source, share in ({entry: 1.0} if isinstance(entry, str) else entry).items():
            mixed[source] = mixed.get(source, 0.0) + weight * share
    return mixed


def _on_side(entry: Entry, side: str) -> Entry:
    if isinstance(entry, str):
        return entry.format(side)
    return {source.format(side): weight for source, weight in entry.items()}


CMU_ASF = _layout(
    "cmu_asf",
    "CMU ASF/AMC: 30 bones, each joint at the start of the bone that names it",
    {"root", "lhipjoint", "lfemur", "ltibia", "lowerback", "thorax", "lclavicle", "lhumerus", "lhand"},
    sides=("l", "r"),
    # The bone called wrist only twists the forearm; the wrist bends at the start of the hand.
    limbs=("{}humerus", "{}radius", "{}hand", "{}femur", "{}tibia", "{}foot", "{}toes"),
    collar={"{}clavicle": 0.75, "{}humerus": 0.25},
    trunk=("root", "upperback", "thorax", {"thorax": 0.55, "lowerneck": 0.45}, "lowerneck"),
    spine={"lowerback": 0.5, "upperback": 0.5},
    chest={"upperback": 0.13, "thorax": 0.87},
    head={"upperneck": -0.3, "head": 1.3},
    nose=AddedPoint("nose", "head", (0.0, 0.0, 1.0), "head_end"),
)

CMU_DAZ = _layout(
    "cmu_daz",
    "CMU motion retargeted to a Daz figure: 43 joints such as rButtock, lShldr, rForeArm",
    {"hip", "abdomen", "chest", "lShldr", "lForeArm", "lHand", "lThigh", "lShin", "lFoot", "leftEye"},
    sides=("l", "r"),
    limbs=("{}Shldr", "{}ForeArm", "{}Hand", "{}Thigh", "{}Shin", "{}Foot", "{}Foot_end"),
    collar="{}Collar",
    trunk=({"hip": 0.7, "abdomen": 0.3}, "abdomen", "chest", {"chest": 0.55, "neck": 0.45}, "neck"),
    spine="abdomen",
    chest={"chest": 0.85, "neck": 0.15},
    head={"neck": -0.7, "head": 1.7},
    nose=AddedPoint("nose", "head", (0.0, 0.45, 0.85), "leftEye"),
)

_CHARACTER_SIDES = ("Left", "Right")
_CHARACTER_LIMBS = ("{}Arm", "{}ForeArm", "{}Hand", "{}UpLeg", "{}Leg", "{}Foot")

CMU_CGSPEED = _layout(
    "cmu_cgspeed",
    "CMU motion converted to BVH for MotionBuilder: 31 joints such as LHipJoint, LowerBack, Neck1",
    {"Hips", "LHipJoint", "LowerBack", "Spine1", "Neck1", "LeftArm", "LeftForeArm", "LeftHand", "LeftLeg"},
    sides=_CHARACTER_SIDES,
    limbs=(*_CHARACTER_LIMBS, "{}ToeBase"),
    collar={"{}Shoulder": 0.7, "{}Arm": 0.3},
    # LowerBack lies on Hips; Neck and both shoulder joints lie on Spine1.
    trunk=("Hips", {"LowerBack": 0.5, "Spine": 0.5}, "Spine", "Spine1", "Neck1"),
    spine={"LowerBack": 0.8, "Spine": 0.2},
    chest={"Spine": 0.68, "Spine1": 0.32},
    head={"Neck1": -0.3, "Head": 1.3},
    nose=AddedPoint("nose", "Head", (0.0, 0.0, 1.0), "Head_end"),
)

YIANNAKIDES = _layout(
    "yiannakides",
    "Template of the projection database of Yiannakides et al. 2019: 17 joints, no feet and no collars",
    {"Root", "Spine", "Spine1", "Neck", "Head", "LeftArm", "LeftForeArm", "LeftUpLeg", "LeftLeg", "LeftFoot"},
    sides=_CHARACTER_SIDES,
    limbs=(*_CHARACTER_LIMBS, "{}Toe"),
    collar={"Spine1": 0.75, "{}Arm": 0.25},
    trunk=("Root", {"Root": 0.5, "Spine": 0.5}, "Spine", "Spine1", "Neck"),
    spine={"Root": 0.65, "Spine": 0.35},
    chest={"Spine": 0.95, "Spine1": 0.05},
    head="Head",
    # In the joint frames of this template the person looks along +Y (right foot: -Y) and up is +X (right foot: -X).
    nose=AddedPoint("nose", "Head", (0.0, 0.6, 0.0), "Head"),
    points=(
        AddedPoint("LeftToe", "LeftFoot", (-0.1, 0.45, 0.0), "LeftFoot"),
        AddedPoint("RightToe", "RightFoot", (0.1, -0.45, 0.0), "RightFoot"),
    ),
)

BODY22_LAYOUT = _layout(
    "body22",
    "The working skeleton body22 itself: built-in duets and exports of this project",
    set(BODY22.joint_names),
    sides=("left", "right"),
    limbs=tuple(f"{{}}_{joint}" for joint in _LIMB_JOINTS),
    collar="{}_collar",
    trunk=_TRUNK_JOINTS,
    spine="spine1",
    chest="spine3",
    head="head",
    nose=AddedPoint("nose", "head", (0.0, -0.1, 0.6), "head"),
)

_HIPS = {"left_hip": 0.5, "right_hip": 0.5}
EXPI_LAYOUT = _layout(
    "expi",
    "ExPI: 18 joints without spine, neck, pelvis and collars, which lie between those that are there",
    {"back", "head", "left_head", "right_head", "left_toe", "right_toe"},
    sides=("left", "right"),
    # Files have heels; the ankle is as `EXPI18_OF_BODY22` has it.
    limbs=(
        *(f"{{}}_{joint}" for joint in (*ARM, "hip", "knee")),
        {"{}_ankle": 0.8, "{}_toe": 0.2},
        "{}_toe",
    ),
    collar={"back": 0.75, "{}_shoulder": 0.25},
    trunk=(
        _HIPS,
        _mix((0.65, _HIPS), (0.35, "back")),
        _mix((0.35, _HIPS), (0.65, "back")),
        "back",
        {"left_shoulder": 0.4, "right_shoulder": 0.4, "left_head": 0.1, "right_head": 0.1},
    ),
    spine=_mix((0.65, _HIPS), (0.35, "back")),
    chest="back",
    head={"left_head": 0.5, "right_head": 0.5},
    nose="head",
)

_CHARACTER_SIGNATURE = {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "LeftShoulder", "LeftArm", "LeftUpLeg"}


def _character(name: str, meaning: str, toe: str, nose: AddedPoint | str) -> Layout:
    return _layout(
        name,
        meaning,
        _CHARACTER_SIGNATURE | {toe.format("Left")},
        sides=_CHARACTER_SIDES,
        limbs=(*_CHARACTER_LIMBS, toe),
        collar="{}Shoulder",
        trunk=("Hips", "Spine", "Spine1", "Spine2", "Neck"),
        spine="Spine",
        chest={"Spine1": 0.5, "Spine2": 0.5},
        head={"Neck": -0.6, "Head": 1.6},
        nose=nose,
    )


MIXAMO = _character(
    "mixamo",
    "Names of Mixamo characters, with or without a namespace: LeftToeBase, Spine2",
    "{}ToeBase",
    AddedPoint("nose", "Head", (0.0, 0.4, 1.0), "Head"),
)
LAFAN = _character(
    "lafan",
    "Names of the LAFAN1 data set: LeftToe, Spine2; its joint frames do not tell where the face is",
    "{}Toe",
    "Head",
)

LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (BODY22_LAYOUT, CMU_ASF, CMU_CGSPEED, CMU_DAZ, EXPI_LAYOUT, LAFAN, MIXAMO, YIANNAKIDES)
}
