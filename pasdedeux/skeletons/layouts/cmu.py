"""Layouts of the CMU motion capture database: original ASF/AMC and the two common conversions to BVH."""

from __future__ import annotations

from pasdedeux.skeletons.layouts.layout import AddedPoint, Layout
from pasdedeux.skeletons.layouts.table_building import working_tables

CMU_ASF = Layout(
    name="cmu_asf",
    meaning="CMU ASF/AMC: 30 bones, each joint at the start of the bone that names it",
    signature=frozenset(
        {"root", "lhipjoint", "lfemur", "ltibia", "lowerback", "thorax", "lclavicle", "lhumerus", "lhand"}
    ),
    points=(AddedPoint(name="nose", joint="head", offset=(0.0, 0.0, 1.0), unit_bone="head_end"),),
    tables=working_tables(
        limbs={
            "shoulder": ("lhumerus", "rhumerus"),
            "elbow": ("lradius", "rradius"),
            # The bone called wrist only twists the forearm; the wrist bends at the start of the hand.
            "wrist": ("lhand", "rhand"),
            "hip": ("lfemur", "rfemur"),
            "knee": ("ltibia", "rtibia"),
            "ankle": ("lfoot", "rfoot"),
            "toe": ("ltoes", "rtoes"),
        },
        trunk={
            "pelvis": "root",
            "spine1": "upperback",
            "spine2": "thorax",
            "spine3": {"thorax": 0.55, "lowerneck": 0.45},
            "neck": "lowerneck",
            "left_collar": {"lclavicle": 0.75, "lhumerus": 0.25},
            "right_collar": {"rclavicle": 0.75, "rhumerus": 0.25},
        },
        spine={"spine": {"lowerback": 0.5, "upperback": 0.5}, "chest": {"upperback": 0.13, "thorax": 0.87}},
        neck_base="lowerneck",
        head={"head": {"upperneck": -0.3, "head": 1.3}},
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
        limbs={
            "shoulder": ("lShldr", "rShldr"),
            "elbow": ("lForeArm", "rForeArm"),
            "wrist": ("lHand", "rHand"),
            "hip": ("lThigh", "rThigh"),
            "knee": ("lShin", "rShin"),
            "ankle": ("lFoot", "rFoot"),
            "toe": ("lFoot_end", "rFoot_end"),
        },
        trunk={
            "pelvis": {"hip": 0.7, "abdomen": 0.3},
            "spine1": "abdomen",
            "spine2": "chest",
            "spine3": {"chest": 0.55, "neck": 0.45},
            "neck": "neck",
            "left_collar": "lCollar",
            "right_collar": "rCollar",
        },
        spine={"spine": "abdomen", "chest": {"chest": 0.85, "neck": 0.15}},
        neck_base="neck",
        head={"head": {"neck": -0.7, "head": 1.7}},
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
        limbs={
            "shoulder": ("LeftArm", "RightArm"),
            "elbow": ("LeftForeArm", "RightForeArm"),
            "wrist": ("LeftHand", "RightHand"),
            "hip": ("LeftUpLeg", "RightUpLeg"),
            "knee": ("LeftLeg", "RightLeg"),
            "ankle": ("LeftFoot", "RightFoot"),
            "toe": ("LeftToeBase", "RightToeBase"),
        },
        # LowerBack lies on Hips; Neck and both shoulder joints lie on Spine1.
        trunk={
            "pelvis": "Hips",
            "spine1": {"LowerBack": 0.5, "Spine": 0.5},
            "spine2": "Spine",
            "spine3": "Spine1",
            "neck": "Neck1",
            "left_collar": {"LeftShoulder": 0.7, "LeftArm": 0.3},
            "right_collar": {"RightShoulder": 0.7, "RightArm": 0.3},
        },
        spine={"spine": {"LowerBack": 0.8, "Spine": 0.2}, "chest": {"Spine": 0.68, "Spine1": 0.32}},
        neck_base="Neck1",
        head={"head": {"Neck1": -0.3, "Head": 1.3}},
        nose="nose",
    ),
)
