"""Keypoint layouts of 2D detectors and annotations, and how they become pair17, op14 and the points of feet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.skeletons.working import OP14, PAIR17, WORKING_SKELETONS

Recipe = tuple[Mapping[str, float], ...]
"""Weighted means of keypoints, best first; the first whose keypoints are all seen is taken."""

_LIMBS = tuple(
    f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
)

FEET4 = ("left_heel", "left_toe", "right_heel", "right_toe")
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

        A joint is missing where a keypoint of each of its means is missing; its confidence is the least of its sources.

        Args:
            skeleton_name: pair17, op14 or feet4.
            positions: (*batch, K, 2); missing where not finite or where the confidence is 0.
            confidence: (*batch, K).

        Raises:
            InputError: The skeleton is not derived from 2D, or the number of keypoints is not the layout's.
        """
        if skeleton_name not in self.recipes:
            raise InputError(f"layout '{self.name}' gives {', '.join(self.recipes)}, not '{skeleton_name}'")
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
            is_open = np.ones(positions.shape[:-2], dtype=bool)
            for weights in self.recipes[skeleton_name].get(joint, ()):
                columns = [self.keypoint_names.index(name) for name in weights]
                is_used = is_open & is_seen[..., columns].all(axis=-1)
                mean = np.einsum("k,...kd->...d", np.array(list(weights.values())), known[..., columns, :])
                result[..., row, :] = np.where(is_used[..., None], mean, result[..., row, :])
                result_confidence[..., row] = np.where(
                    is_used, confidence[..., columns].min(axis=-1), result_confidence[..., row]
                )
                is_open &= ~is_used
        return Keypoints(positions=result, confidence=result_confidence)


def _detector(name: str, keypoint_names: tuple[str, ...]) -> KeypointLayout:
    """Describe a detector that reports limbs, nose, eyes, ears, and perhaps neck and the middle of the hips."""
    mid_shoulder = {"left_shoulder": 0.5, "right_shoulder": 0.5}
    mid_hip = {"left_hip": 0.5, "right_hip": 0.5}
    # The middle of both hips is what the 3D layouts call pelvis; a keypoint of that name serves when a hip is hidden.
    pelvis: Recipe = (mid_hip, {"mid_hip": 1.0}) if "mid_hip" in keypoint_names else (mid_hip,)
    neck: Recipe = ({"neck": 1.0}, mid_shoulder) if "neck" in keypoint_names else (mid_shoulder,)

    def between(fraction: float) -> Recipe:
        return tuple(_mix(low, 1.0 - fraction, high, fraction) for low in pelvis for high in neck)

    limbs: dict[str, Recipe] = {joint: ({joint: 1.0},) for joint in _LIMBS}
    return KeypointLayout(
        name=name,
        keypoint_names=keypoint_names,
        recipes={
            PAIR17.name: {
                **limbs,
                "pelvis": pelvis,
                "spine": between(1.0 / 3.0),
                "chest": between(2.0 / 3.0),
                "neck": neck,
                "head": ({"left_ear": 0.5, "right_ear": 0.5}, {"nose": 1.0}),
            },
            OP14.name: {**limbs, "neck": neck, "head": ({"nose": 1.0},)},
            "feet4": _feet(keypoint_names),
        },
    )


def _feet(keypoint_names: tuple[str, ...]) -> dict[str, Recipe]:
    """Return the recipes of those points of `FEET4` that a layout has keypoints for."""
    recipes: dict[str, Recipe] = {}
    for side in ("left", "right"):
        heel, tip = f"{side}_heel", f"{side}_big_toe"
        if heel in keypoint_names:
            recipes |= {heel: ({heel: 1.0},), f"{side}_toe": ({heel: 1.0 - _BALL_OF_FOOT, tip: _BALL_OF_FOOT},)}
    return recipes


def _mix(
    low: Mapping[str, float], low_weight: float, high: Mapping[str, float], high_weight: float
) -> dict[str, float]:
    return {name: weight * low_weight for name, weight in low.items()} | {
        name: weight * high_weight for name, weight in high.items()
    }


_RIGHT_THEN_LEFT_ARMS = ("right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist")
_RIGHT_THEN_LEFT_LEGS = ("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle")
_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")

COCO18 = _detector("coco18", ("nose", "neck", *_RIGHT_THEN_LEFT_ARMS, *_RIGHT_THEN_LEFT_LEGS, *_FACE))
"""OpenPose's COCO model."""

BODY25 = _detector(
    "body25",
    (
        "nose",
        "neck",
        *_RIGHT_THEN_LEFT_ARMS,
        "mid_hip",
        *_RIGHT_THEN_LEFT_LEGS,
        *_FACE,
        "left_big_toe",
        "left_small_toe",
        "left_heel",
        "right_big_toe",
        "right_small_toe",
        "right_heel",
    ),
)
"""OpenPose's BODY_25 model."""

_LEFT_AND_RIGHT_ARMS = ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist")
_LEFT_AND_RIGHT_LEGS = ("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
_COCO17_NAMES = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear"),
    *_LEFT_AND_RIGHT_ARMS,
    *_LEFT_AND_RIGHT_LEGS,
)

COCO17 = _detector("coco17", _COCO17_NAMES)
"""The COCO keypoint annotations."""

COCO23 = _detector(
    "coco23",
    (
        *_COCO17_NAMES,
        *("left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel"),
    ),
)
"""COCO-WholeBody without face and hands: the first 23 of its 133 keypoints."""

HALPE26 = _detector(
    "halpe26",
    (
        *_COCO17_NAMES,
        *("head_top", "neck", "mid_hip"),
        *("left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel", "right_heel"),
    ),
)
"""The 26 body keypoints of Halpe Full-Body, the first of its 136; its "head" is the crown, its "hip" the middle."""

MEDIAPIPE33 = _detector(
    "mediapipe33",
    (
        "nose",
        *("left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer"),
        *("left_ear", "right_ear", "mouth_left", "mouth_right"),
        *_LEFT_AND_RIGHT_ARMS,
        *("left_pinky", "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb"),
        *_LEFT_AND_RIGHT_LEGS,
        *("left_heel", "right_heel", "left_big_toe", "right_big_toe"),
    ),
)
"""MediaPipe's (BlazePose's) landmarks; what it calls foot index is the tip of the big toe here."""

_PAIR17_2D = KeypointLayout(
    name="pair17",
    keypoint_names=PAIR17.joint_names,
    recipes={
        PAIR17.name: {joint: ({joint: 1.0},) for joint in PAIR17.joint_names},
        # The nose is not among the joints of pair17; its head is the nearest there is.
        OP14.name: {joint: ({joint: 1.0},) for joint in OP14.joint_names},
        "feet4": {},
    },
)

_OP14_MID_HIP = {"left_hip": 0.5, "right_hip": 0.5}
_OP14_2D = KeypointLayout(
    name="op14",
    keypoint_names=OP14.joint_names,
    recipes={
        PAIR17.name: {
            **{joint: ({joint: 1.0},) for joint in (*_LIMBS, "neck", "head")},
            "pelvis": (_OP14_MID_HIP,),
            "spine": (_mix(_OP14_MID_HIP, 2.0 / 3.0, {"neck": 1.0}, 1.0 / 3.0),),
            "chest": (_mix(_OP14_MID_HIP, 1.0 / 3.0, {"neck": 1.0}, 2.0 / 3.0),),
        },
        OP14.name: {joint: ({joint: 1.0},) for joint in OP14.joint_names},
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
