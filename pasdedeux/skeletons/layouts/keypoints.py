"""Keypoint layouts of 2D detectors and annotations, and their mappings to pair17, op14 and points of feet."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError
from pasdedeux.skeletons.layouts.joint_names import find_keypoints
from pasdedeux.skeletons.layouts.layout import mixed
from pasdedeux.skeletons.mapping import Weights
from pasdedeux.skeletons.skeleton import ARM, LEG, by_side
from pasdedeux.skeletons.working import OP14, PAIR17, WORKING_SKELETONS

Recipe = tuple[Weights, ...]
"""Weighted means of keypoints, best first; the first one whose keypoints are all seen is taken."""

_LIMBS = by_side("left", *ARM, *LEG)

FEET4 = by_side("left", "heel", "toe")
"""Points of `feet4`: the back of the heel, and body22's toe, the ball of the foot."""
_BALL_OF_FOOT = 0.73
"""Position of the ball between the heel and the tip of the big toe: a common proportion, not measured here."""
_EAR_ABOVE_CHIN, _EAR_ABOVE_NECK = 0.4, 0.55
"""Height of ears and nose between the upper neck, or the base of the neck, and the crown: common proportions."""


_SIDED = (
    ("{}_ankle", "{}_knee", "{}_hip", "mid_hip", "pelvis", "belly"),
    ("{}_wrist", "{}_elbow", "{}_shoulder", "neck"),
    ("{}_hip", "{}_shoulder"),
    ("{}_heel", "{}_ankle", "{}_big_toe", "{}_small_toe"),
    ("{}_ankle", "{}_toe"),
    ("{}_shoulder", "{}_ear", "{}_eye", "nose"),
    ("{}_pinky", "{}_wrist", "{}_index"),
    ("{}_wrist", "{}_thumb"),
)
_CHAINS = (
    *(tuple(name.format(side) for name in chain) for chain in _SIDED for side in ("left", "right")),
    ("left_hip", "right_hip"),
    ("left_shoulder", "right_shoulder"),
    ("pelvis", "spine", "chest", "neck"),
    ("mid_hip", "neck", "upper_neck", "head", "head_top"),
    ("neck", "nose"),
    ("mouth_left", "mouth_right"),
)
"""Chains of keypoints that are connected in drawings; keypoints that a layout lacks are skipped."""


@dataclass(frozen=True)
class Keypoints:
    """Keypoints (*batch, K, 2) and their confidences (*batch, K); NaN and 0 where missing."""

    positions: Array
    confidence: Array


@dataclass(frozen=True)
class KeypointLayout:
    """Names of a detector's keypoints and their meaning.

    Args:
        name: Name of the layout.
        keypoint_names: Keypoints in the detector's order.
        recipes: For pair17, op14 and feet4, the recipe of each joint; joints that the layout lacks have none.
        also: Other names of keypoints in files with this order.
    """

    name: str
    keypoint_names: tuple[str, ...]
    recipes: Mapping[str, Mapping[str, Recipe]] = field(repr=False)
    also: Mapping[str, Sequence[str]] = field(default_factory=dict, repr=False)

    @property
    def num_keypoints(self) -> int:
        """Number of keypoints."""
        return len(self.keypoint_names)

    def links(self, *, first: int = 0) -> list[list[int]]:
        """Return pairs of keypoints to connect in drawings, by their numbers, counted from `first`.

        >>> KEYPOINT_LAYOUTS["op14"].links()[:3]
        [[13, 12], [12, 11], [10, 9]]
        """
        place = {name: at for at, name in enumerate(self.keypoint_names, start=first)}
        lines = [[name for name in chain if name in place] for chain in _CHAINS]
        ends = [pair for line in lines for pair in pairwise(line)]
        return [[place[name] for name in pair] for pair in dict.fromkeys(ends)]

    def find_keypoints(self, names: Sequence[str]) -> list[int | None]:
        """Return for each keypoint the index of its name; None if it has none."""
        return find_keypoints(self.keypoint_names, names, self.also)

    def num_named(self, names: Sequence[str], *, is_strict: bool = False) -> int:
        """Return how many keypoints have a name; if strict, names in the layout's data set do not count."""
        keypoints = find_keypoints(self.keypoint_names, names, {} if is_strict else self.also)
        return sum(place is not None for place in keypoints)

    def derive(self, skeleton_name: str, positions: Array, confidence: Array) -> Keypoints:
        """Derive the joints of pair17 or op14, or the points of `FEET4`, from keypoints.

        A joint is missing if each of its means lacks a keypoint.  Its confidence is the minimum of those of the mean.

        Args:
            skeleton_name: pair17, op14 or feet4.
            positions: (*batch, K, 2); missing if not finite or if the confidence is 0.
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
        """Return for each joint the lowest status (*batch, joint) of the keypoints (*batch, K) of its best mean."""
        joint_names = WORKING_SKELETONS[skeleton_name].joint_names
        result = np.zeros((*status.shape[:-1], len(joint_names)), dtype=np.int64)
        for row, joint in enumerate(joint_names):
            for weights in self.recipes[skeleton_name].get(joint, ())[:1]:
                result[..., row] = status[..., [self.keypoint_names.index(name) for name in weights]].min(axis=-1)
        return result


_MID_SHOULDER = {"left_shoulder": 0.5, "right_shoulder": 0.5}
_MID_HIP = {"left_hip": 0.5, "right_hip": 0.5}


def _own(joints: Iterable[str]) -> dict[str, Recipe]:
    """Return recipes for joints that are keypoints of the same name."""
    return {joint: ({joint: 1.0},) for joint in joints}


def _layout(name: str, table: Mapping[str, Any]) -> KeypointLayout:
    """Return the layout of a table: limbs, points of the head, optionally neck, middle of the hips, and feet."""
    names = tuple(table["keypoints"].split())
    # In 3D layouts the pelvis is the middle of the hips; the keypoint mid_hip replaces it if a hip is hidden.
    pelvis: Recipe = (_MID_HIP, {"mid_hip": 1.0}) if "mid_hip" in names else (_MID_HIP,)
    neck: Recipe = ({"neck": 1.0}, _MID_SHOULDER) if "neck" in names else (_MID_SHOULDER,)

    def between(fraction: float) -> Recipe:
        return tuple(mixed([(low, 1.0 - fraction), (high, fraction)]) for low in pelvis for high in neck)

    trunk = {"pelvis": pelvis, "spine": between(1.0 / 3.0), "chest": between(2.0 / 3.0), "neck": neck}
    # Data sets without a face mark the base of the neck; op14's neck is the middle of the shoulders.
    op14_neck = neck if "nose" in names else (_MID_SHOULDER, *neck[:-1])
    nose: Recipe = ({"nose": 1.0},)
    if "nose" not in names:
        end, share = ("upper_neck", _EAR_ABOVE_CHIN) if "upper_neck" in names else ("neck", _EAR_ABOVE_NECK)
        nose = ({end: 1.0 - share, "head_top": share},)
    ears: Recipe = ({"left_ear": 0.5, "right_ear": 0.5},) if "left_ear" in names else ()
    feet: dict[str, Recipe] = {}
    for side in ("left", "right") if "left_heel" in names else ():
        heel, tip = f"{side}_heel", f"{side}_big_toe"
        feet |= {heel: ({heel: 1.0},), f"{side}_toe": ({heel: 1.0 - _BALL_OF_FOOT, tip: _BALL_OF_FOOT},)}
    return KeypointLayout(
        name,
        names,
        {
            PAIR17.name: _own(_LIMBS) | trunk | {"head": (*ears, *nose)},
            OP14.name: {**_own(_LIMBS), "neck": op14_neck, "head": nose},
            "feet4": feet,
        },
        table.get("also", {}),
    )


_PAIR17_2D = KeypointLayout(
    "pair17",
    PAIR17.joint_names,
    # pair17 has no nose; its head is the nearest joint.
    {PAIR17.name: _own(PAIR17.joint_names), OP14.name: _own(OP14.joint_names), "feet4": {}},
)

_OP14_2D = KeypointLayout(
    "op14",
    OP14.joint_names,
    {
        PAIR17.name: {
            **_own((*_LIMBS, "neck", "head")),
            "pelvis": (_MID_HIP,),
            "spine": (mixed([(_MID_HIP, 2.0 / 3.0), ("neck", 1.0 / 3.0)]),),
            "chest": (mixed([(_MID_HIP, 1.0 / 3.0), ("neck", 2.0 / 3.0)]),),
        },
        OP14.name: _own(OP14.joint_names),
        "feet4": {},
    },
)

_TABLES = tomllib.loads(resources.files(__package__).joinpath("keypoints.toml").read_text(encoding="utf-8"))
KEYPOINT_LAYOUTS: dict[str, KeypointLayout] = {
    **{name: _layout(name, table) for name, table in _TABLES.items()},
    **{layout.name: layout for layout in (_PAIR17_2D, _OP14_2D)},
}
"""All layouts of 2D keypoints by name; add one as a table of `keypoints.toml`."""


def _by_count() -> dict[int, tuple[KeypointLayout, ...]]:
    by_count: dict[int, list[KeypointLayout]] = {}
    for layout in KEYPOINT_LAYOUTS.values():
        table = _TABLES.get(layout.name, {})
        for count in () if table.get("named_only") else (layout.num_keypoints, *table.get("first_of", ())):
            by_count.setdefault(count, []).append(layout)
    return {count: tuple(by_count[count]) for count in sorted(by_count)}


LAYOUTS_OF_COUNT: dict[int, tuple[KeypointLayout, ...]] = _by_count()
"""Possible layouts of unnamed keypoints by their number; some layouts are the first of more keypoints."""
USUAL_LAYOUTS = frozenset({"coco17", "coco18", "coco23", "body25", "halpe26", "mediapipe33"})
"""Layouts that are assumed for a number of keypoints if nothing contradicts."""


def layout_of_names(names: Sequence[str]) -> KeypointLayout:
    """Return the layout that has names of joints in this order, else the one that has most of them.

    Of several equal ones a usual one, then the smallest, is taken; a keypoint means the same in all layouts.
    """
    in_order = list(range(len(names)))

    def fits(layout: KeypointLayout) -> tuple[bool, int, int, bool, int]:
        is_ordered = layout.num_keypoints == len(names) and layout.find_keypoints(names) == in_order
        counts = layout.num_named(names), layout.num_named(names, is_strict=True)
        return is_ordered, *counts, layout.name in USUAL_LAYOUTS, -layout.num_keypoints

    return max(KEYPOINT_LAYOUTS.values(), key=fits)
