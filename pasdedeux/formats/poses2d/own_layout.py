"""A keypoint layout of the user: a few lines of TOML.

`keypoints` are the names of the joints in the order of the file; `joints` maps joints of pair17 to them::

    keypoints = ["head", "neck", "torso", "left hand", "right hand"]

    [joints]
    head = "head"
    left_wrist = "left hand"
    chest = { neck = 0.5, torso = 0.5 }

Joints of pair17 that are not named are missing.
"""

from __future__ import annotations

import tomllib
from typing import Any

from pasdedeux.errors import FormatError
from pasdedeux.formats.text import decode, shorten
from pasdedeux.skeletons import OP14, PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, KeypointLayout
from pasdedeux.skeletons.layouts.keypoints import Recipe

_KEYS = ("keypoints", "joints")


def read_layout(data: bytes | str) -> KeypointLayout:
    """Read a layout.

    Raises:
        FormatError: It is not TOML, lacks a key, has an unknown name, or its weights do not sum to 1.
    """
    try:
        content = tomllib.loads(decode(data, "layout"))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise FormatError(f"this layout is not valid TOML: {error}") from None
    if set(content) != set(_KEYS):
        present = ", ".join(map(shorten, content)) or "nothing"
        raise FormatError(f"a layout has {' and '.join(_KEYS)}, found {present}")
    names, joints = content["keypoints"], content["joints"]
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise FormatError("'keypoints' must be a list of names in the order of the file")
    if len(set(names)) < len(names):
        raise FormatError(f"keypoint '{shorten(next(name for name in names if names.count(name) > 1))}' is there twice")
    if not isinstance(joints, dict) or not joints:
        raise FormatError("'joints' must be a table: a joint of ours = a keypoint, or keypoints with weights")
    recipes: dict[str, Recipe] = {}
    for joint, entry in joints.items():
        if joint not in PAIR17.joint_names:
            raise FormatError(f"joint '{shorten(joint)}' is none of ours: {', '.join(PAIR17.joint_names)}")
        recipes[joint] = (_weights(joint, entry, names),)
    known = KEYPOINT_LAYOUTS[PAIR17.name].recipes
    op14 = {joint: recipes[joint] for joint in known[OP14.name] if joint in recipes}
    return KeypointLayout("own", tuple(names), {PAIR17.name: recipes, OP14.name: op14, "feet4": {}})


def _weights(joint: str, entry: Any, names: list[str]) -> dict[str, float]:
    weights = {entry: 1.0} if isinstance(entry, str) else entry
    if not isinstance(weights, dict) or not all(type(weight) in (int, float) for weight in weights.values()):
        raise FormatError(f"joint '{joint}' must be a keypoint, or keypoints with weights")
    for name in weights:
        if name not in names:
            raise FormatError(f"joint '{joint}': keypoint '{shorten(name)}' is not among 'keypoints'")
    if not abs(sum(weights.values()) - 1.0) <= 1e-6:
        raise FormatError(f"joint '{joint}': its weights sum to {sum(weights.values()):g}, not 1")
    return {name: float(weight) for name, weight in weights.items()}
