"""Layouts of the CMU motion capture database: original ASF/AMC and the two common conversions to BVH."""

from __future__ import annotations

from pasdedeux.skeletons.layouts.layout import AddedPoint, Layout, working_tables

CMU_ASF = Layout(
    name="cmu_asf",
    meaning="CMU ASF/AMC: 30 bones, each joint at the start of the bone that names it",
    signature=frozenset(
        {"root", "lhipjoint", "lfemur", "ltibia", "lowerback", "thorax", "lclavicle", "lhumerus", "lhand"}
    ),
    points=(AddedPoint(name="nose", joint="head", offset=(0.0, 0.0, 1.0), unit_bone="head_end"),),
    tables=working_tables(
        # The bone called wrist only twists the forearm; the wrist bends at the start of the hand.
        limbs=("lhumerus", "lradius", "lhand", "lfemur", "ltibia", "lfoot", "ltoes"),
        trunk={
            "pelvis": "root",
            "spine1": "upperback",
            "spine2": "thorax",
            "spine3": {"thorax": 0.55, "lowerneck": 0.45},
            "neck": "lowerneck",
        },
        collar={"lclavicle": 0.75, "lhumerus": 0.25},
        spine={"spine": {"lowerback": 0.5, "upperback": 0.5}, "chest": {"upperback": 0.13, "thorax": 0.87}},
        head={"upperneck": -0.3, "head": 1.3},
        nose="nose",
    ),
)

CMU_DAZ = Layout(
    name="cmu_daz",
    meaning="CMU motion retargeted to a Daz figure: 43 joints such as rButtock, lShldr, rForeArm",
    signature=frozenset(
        {"hip", "abdomen", "chest", "lShldr", "lForeArm", "lHand", "lThigh", "lShin", "lFoot", "leftEye"}
    ),
    points=(AddedPoint(name="nose", joint="head", offset=(0.0, 0.45, 0.85), unit_bone="leftEye"),),
    tables=working_tables(
        limbs=("lShldr", "lForeArm", "lHand", "lThigh", "lShin", "lFoot", "lFoot_end"),
        trunk={
            "pelvis": {"hip": 0.7, "abdomen": 0.3},
            "spine1": "abdomen",
            "spine2": "chest",
            "spine3": {"chest": 0.55, "neck": 0.45},
            "neck": "neck",
        },
        collar="lCollar",
        spine={"spine": "abdomen", "chest": {"chest": 0.85, "neck": 0.15}},
        head={"neck": -0.7, "head": 1.7},
        nose="nose",
    ),
)

CMU_CGSPEED = Layout(
    name="cmu_cgspeed",
    meaning="CMU motion converted to BVH for MotionBuilder: 31 joints such as LHipJoint, LowerBack, Neck1",
    signature=frozenset(
        {"Hips", "LHipJoint", "LowerBack", "Spine1", "Neck1", "LeftArm", "LeftForeArm", "LeftHand", "LeftLeg"}
    ),
    points=(AddedPoint(name="nose", joint="Head", offset=(0.0, 0.0, 1.0), unit_bone="Head_end"),),
    tables=working_tables(
        limbs=("LeftArm", "LeftForeArm", "LeftHand", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
        # LowerBack lies on Hips; Neck and both shoulder joints lie on Spine1.
        trunk={
            "pelvis": "Hips",
            "spine1": {"LowerBack": 0.5, "Spine": 0.5},
            "spine2": "Spine",
            "spine3": "Spine1",
            "neck": "Neck1",
        },
        collar={"LeftShoulder": 0.7, "LeftArm": 0.3},
        spine={"spine": {"LowerBack": 0.8, "Spine": 0.2}, "chest": {"Spine": 0.68, "Spine1": 0.32}},
        head={"Neck1": -0.3, "Head": 1.3},
        nose="nose",
    ),
)
