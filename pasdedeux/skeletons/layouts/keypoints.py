"""Keypoint layouts of 2D detectors and annotations, and how they become pair17, op14 and the points of feet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError
from pasdedeux.skeletons.mapping import Weights
from pasdedeux.skeletons.skeleton import ARM, LEG, by_joint, by_side
from pasdedeux.skeletons.working import OP14, PAIR17, WORKING_SKELETONS

Recipe = tuple[Weights, ...]
"""Weighted means of keypoints, best first; the first whose keypoints are all seen is taken."""

_LIMBS = by_side("left", *ARM, *LEG)

FEET4 = by_side("left", "heel", "toe")
"""What `feet4` gives of feet: the back of the heel and body22's toe, the ball of the foot."""
_BALL_OF_FOOT = 0.73
"""Where the ball lies from the heel to the tip of the big toe: a usual proportion, not measured here."""


@dataclass(frozen=True)
class Keypoints:
    """Keypoints (*batch, K, 2) and their confidences (*batch, K); NaN and 0 where missing."""

    positions: Array
    confidence: Array


@dataclass(frozen=True)
class KeypointLayout:
    """Names of a detector's keypoints and what they stand for.

    Args:
        name: Name of the layout.
        keypoint_names: Keypoints in the detector's order.
        recipes: For pair17, op14 and feet4, for each joint its weighted means of keypoints, best first; none for a
            joint that the layout does not have.
    """

    name: str
    keypoint_names: tuple[str, ...]
    recipes: Mapping[str, Mapping[str, Recipe]] = field(repr=False)

    @property
    def num_keypoints(self) -> int:
        """Number of keypoints."""
        return len(self.keypoint_names)

    def derive(self, skeleton_name: str, positions: Array, confidence: Array) -> Keypoints:
        """Derive the joints of pair17 or op14, or the points of `FEET4`, from keypoints.

        A joint is missing where a keypoint of each of its means is missing; its confidence is the minimum of theirs.

        Args:
            skeleton_name: pair17, op14 or feet4.
            positions: (*batch, K, 2); missing where not finite or where the confidence is 0.
            confidence: (*batch, K).
        """
        if positions.shape[-2] != self.num_keypoints:
            raise InputError(
                f"layout '{self.name}' has {self.num_keypoints} keypoints, the data has {positions.shape[-2]}"
            )
        joint_names = FEET4 if skeleton_name == "feet4" else WORKING_SKELETONS[skeleton_name].joint_names
        is_seen = np.isfinite(positions).all(axis=-1) & (confidence > 0)
        known = np.where(is_seen[..., None], positions, 0.0)
        result = np.full((*positions.shape[:-2], len(joint_names), 2), np.nan)
        result_confidence = np.zeros((*positions.shape[:-2], len(joint_names)))
        for row, joint in enumerate(joint_names):
            for weights in reversed(self.recipes[skeleton_name].get(joint, ())):
                columns = [self.keypoint_names.index(name) for name in weights]
                is_used = np.asarray(is_seen[..., columns].all(axis=-1))
                mean = np.einsum("k,...kd->...d", np.array(list(weights.values())), known[..., columns, :])
                np.copyto(result[..., row, :], mean, where=is_used[..., None])
                np.copyto(result_confidence[..., row], confidence[..., columns].min(axis=-1), where=is_used)
        return Keypoints(positions=result, confidence=result_confidence)

    def derive_status(self, skeleton_name: str, status: Integers) -> Integers:
        """Return the least status (*batch, joint) of the keypoints (*batch, K) that each joint is a mean of."""
        joint_names = WORKING_SKELETONS[skeleton_name].joint_names
        result = np.zeros((*status.shape[:-1], len(joint_names)), dtype=np.int64)
        for row, joint in enumerate(joint_names):
            for weights in self.recipes[skeleton_name].get(joint, ())[:1]:
                result[..., row] = status[..., [self.keypoint_names.index(name) for name in weights]].min(axis=-1)
        return result


_MID_SHOULDER = {"left_shoulder": 0.5, "right_shoulder": 0.5}
_MID_HIP = {"left_hip": 0.5, "right_hip": 0.5}


def _own(joints: Iterable[str]) -> dict[str, Recipe]:
    """Return the recipes of joints that are keypoints of the same name."""
    return {joint: ({joint: 1.0},) for joint in joints}


def _mix(low: Weights, low_weight: float, high: Weights, high_weight: float) -> Weights:
    return {name: weight * low_weight for name, weight in low.items()} | {
        name: weight * high_weight for name, weight in high.items()
    }


def _detector(name: str, keypoint_names: tuple[str, ...]) -> KeypointLayout:
    """Describe a detector that reports limbs, nose, eyes, ears, and perhaps neck, middle of the hips and feet."""
    # The middle of both hips is what the 3D layouts call pelvis; a keypoint of that name serves when a hip is hidden.
    pelvis: Recipe = (_MID_HIP, {"mid_hip": 1.0}) if "mid_hip" in keypoint_names else (_MID_HIP,)
    neck: Recipe = ({"neck": 1.0}, _MID_SHOULDER) if "neck" in keypoint_names else (_MID_SHOULDER,)

    def between(fraction: float) -> Recipe:
        return tuple(_mix(low, 1.0 - fraction, high, fraction) for low in pelvis for high in neck)

    trunk = {"pelvis": pelvis, "spine": between(1.0 / 3.0), "chest": between(2.0 / 3.0), "neck": neck}
    feet: dict[str, Recipe] = {}
    for side in ("left", "right") if "left_heel" in keypoint_names else ():
        heel, tip = f"{side}_heel", f"{side}_big_toe"
        feet |= {heel: ({heel: 1.0},), f"{side}_toe": ({heel: 1.0 - _BALL_OF_FOOT, tip: _BALL_OF_FOOT},)}
    return KeypointLayout(
        name,
        keypoint_names,
        {
            PAIR17.name: _own(_LIMBS) | trunk | {"head": ({"left_ear": 0.5, "right_ear": 0.5}, {"nose": 1.0})},
            OP14.name: {**_own(_LIMBS), "neck": neck, "head": ({"nose": 1.0},)},
            "feet4": feet,
        },
    )


_FEET = by_side("left", "big_toe", "small_toe", "heel")

COCO18 = _detector(
    "coco18", ("nose", "neck", *by_side("right", *ARM), *by_side("right", *LEG), *by_joint("right", "eye", "ear"))
)
"""OpenPose's COCO model."""

BODY25 = _detector(
    "body25",
    (
        *("nose", "neck", *by_side("right", *ARM), "mid_hip", *by_side("right", *LEG)),
        *(*by_joint("right", "eye", "ear"), *_FEET),
    ),
)
"""OpenPose's BODY_25 model."""

COCO17 = _detector("coco17", ("nose", *by_joint("left", "eye", "ear", *ARM, *LEG)))
"""The COCO keypoint annotations."""

COCO23 = _detector("coco23", (*COCO17.keypoint_names, *_FEET))
"""COCO-WholeBody without face and hands: the first 23 of its 133 keypoints."""

HALPE26 = _detector(
    "halpe26",
    (*COCO17.keypoint_names, "head_top", "neck", "mid_hip", *by_joint("left", "big_toe", "small_toe", "heel")),
)
"""The 26 body keypoints of Halpe Full-Body, the first of its 136; its "head" is the crown, its "hip" the middle."""

MEDIAPIPE33 = _detector(
    "mediapipe33",
    (
        *("nose", *by_side("left", "eye_inner", "eye", "eye_outer"), *by_joint("left", "ear")),
        *("mouth_left", "mouth_right", *by_joint("left", *ARM, "pinky", "index", "thumb", *LEG, "heel", "big_toe")),
    ),
)
"""MediaPipe's (BlazePose's) landmarks; what it calls foot index is the tip of the big toe here."""

_PAIR17_2D = KeypointLayout(
    "pair17",
    PAIR17.joint_names,
    # The nose is not among the joints of pair17; its head is the nearest there is.
    {PAIR17.name: _own(PAIR17.joint_names), OP14.name: _own(OP14.joint_names), "feet4": {}},
)

_OP14_2D = KeypointLayout(
    "op14",
    OP14.joint_names,
    {
        PAIR17.name: {
            **_own((*_LIMBS, "neck", "head")),
            "pelvis": (_MID_HIP,),
            "spine": (_mix(_MID_HIP, 2.0 / 3.0, {"neck": 1.0}, 1.0 / 3.0),),
            "chest": (_mix(_MID_HIP, 1.0 / 3.0, {"neck": 1.0}, 2.0 / 3.0),),
        },
        OP14.name: _own(OP14.joint_names),
        "feet4": {},
    },
)

KEYPOINT_LAYOUTS: dict[str, KeypointLayout] = {
    layout.name: layout for layout in (COCO18, BODY25, COCO17, COCO23, HALPE26, MEDIAPIPE33, _PAIR17_2D, _OP14_2D)
}
LAYOUT_OF_COUNT: dict[int, KeypointLayout] = {
    **{layout.num_keypoints: layout for layout in (COCO17, COCO18, COCO23, BODY25, HALPE26, MEDIAPIPE33)},
    133: COCO23,
    136: HALPE26,
}
"""The layout that detectors mean by a number of keypoints; of more keypoints than it has, its first ones."""
