"""Target bodies as distances between joints: reading them, and fitting the bones of a person to them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError, named
from pasdedeux.formats.npz import get_array, is_npz, read_npz
from pasdedeux.formats.rigs.own_skeleton import OwnSkeleton, standing
from pasdedeux.formats.text import Lines, check_range, decode, parse_json, parse_number
from pasdedeux.kinematics import bone_directions, bone_lengths, place_bones
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.skeleton import ARM, LEG, by_side

Distances = Mapping[tuple[int, int], float]
"""Metres between two joints of body22, by their indices."""

NEEDED = by_side("left", *LEG, *ARM)
"""Joints that a body must have; missing other joints are scaled like the rest of the body."""
OTHER_NAMES = {f"{side}_foot": f"{side}_toe" for side in ("left", "right")}
"""Joints of SMPL that have another name in body22."""
DISTANCE_M = (0.01, 2.5)
"""Allowed distances, metres; others are mostly in another unit."""
SIZE = (1.0 / 3.0, 3.0)
"""Allowed overall sizes relative to the source."""

_COLUMNS = ("from", "to", "distance_m")
_TRUNK = [
    BODY22.indices(["spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"]),
    BODY22.indices(["spine2", "spine3", "neck", "head", "left_shoulder", "right_shoulder"]),
]
"""Pairs of neighbouring bones that are scaled alike: the spine with neck and head, each shoulder."""
_HOLD_TRUNK_M, _HOLD_SIDES_M, _HOLD_BODY_M = 0.1, 0.02, 0.002
"""Misfit that is equivalent to a difference of 1 between scales: in the trunk, of both sides, of bone and body."""
_LIMBS = {joint for limb in BODY22.limbs for joint in limb}
_NUM_ROUNDS = 20


@dataclass(frozen=True)
class TargetBody:
    """A body.

    Args:
        name: Its origin, for messages.
        distances_m: Distance between two joints of body22, by their indices, metres, standing with limbs straight.
        layout: Layout whose trunk joints are at the same places as those of the body; empty for none.
        bones_m: Bone lengths, which are fitted instead of `distances_m` for people of that layout.
        checks_m: Distances that are compared but not fitted.
    """

    name: str
    distances_m: Distances
    layout: str = ""
    bones_m: Distances = field(default_factory=dict)
    checks_m: Distances = field(default_factory=dict)

    def of(self, layout: str) -> Distances:
        """Return the distances to fit for people of a layout."""
        return self.bones_m if self.bones_m and layout == self.layout else self.distances_m


@dataclass(frozen=True)
class BodyFit:
    """Bones of a person, fitted to a target body.

    Args:
        bone_scale: Scale of each bone (22,); 1 for the root.
        misfit_m: Excess of each distance of the body with these bones, in the person's T-pose, metres.
        num_guessed: Number of bones that no distance depends on.
    """

    bone_scale: Array
    misfit_m: Distances
    num_guessed: int


def body_of_skeleton(name: str, own_skeleton: OwnSkeleton, layout: str) -> TargetBody:
    """Return the body of a motion file's skeleton with this layout.

    Layouts differ in the places of pelvis and spine.  For people of other layouts, the trunk is therefore measured by
    its width and length, and limbs by their bones.
    """
    with named(name):
        body = _of_positions(name, standing(own_skeleton).rest_body22_m[None], BODY22.joint_names, layout)
    lengths = bone_lengths(BODY22, own_skeleton.rest_body22_m)
    return replace(body, bones_m={bone: float(lengths[bone[1]]) for bone in BODY22.bones})


def read_body(name: str, data: bytes) -> TargetBody:
    """Read a body from a table of joint distances (CSV) or joint positions (npz, JSON), metres.

    The table has the columns `from`, `to`, `distance_m`.  An npz has `positions_m` (joint, 3) or (frame, joint, 3) and
    `joint_names`; a JSON object the same keys, or a joint's name with its three numbers each.
    Joints have the names of body22 or of SMPL; distances of frames are their medians.
    """
    with named(name):
        if is_npz(data):
            return _of_arrays(name, read_npz(data, "archive of joint positions"))
        if decode(data, "body").lstrip()[:1] in ("{", "["):
            return _of_arrays(name, _arrays_of_json(data))
        with Lines(data, "body") as lines:
            return TargetBody(name, _distances_of_table(lines))


def fit_body(target: TargetBody, own_skeleton: OwnSkeleton, lengths_m: Array, *, layout: str, who: str) -> BodyFit:
    """Return the bone scales with which a person has a body's distances.

    Least squares (Gauss-Newton) over the scales of 21 bones, the person standing in a T-pose.  Bones that no distance
    depends on are scaled like those of the other side, the neighbouring bone of the spine, or the whole body.

    Args:
        target: The body.
        own_skeleton: The person.
        lengths_m: Bone lengths of the person (22,), metres.
        layout: Layout of the person's joints.
        who: Name of the person, for messages.
    """
    directions = bone_directions(BODY22, standing(own_skeleton).rest_body22_m)
    asked = target.of(layout)
    pairs, wanted = np.array(list(asked)), np.array(list(asked.values()))
    chains = np.zeros((BODY22.num_joints, BODY22.num_joints))  # row: 1 for the bones between the root and a joint
    for joint in range(BODY22.num_joints):
        chains[joint, BODY22.path(joint)[1:]] = 1.0
    between = chains[pairs[:, 1]] - chains[pairs[:, 0]]
    scale = np.ones(BODY22.num_joints)

    def measured(scale: Array, pairs: Array = pairs) -> tuple[Array, Array]:
        joints = place_bones(BODY22, np.zeros(3), directions, lengths_m * scale)
        vector = joints[pairs[:, 1]] - joints[pairs[:, 0]]
        return np.linalg.norm(vector, axis=-1), vector

    size = float(np.median(wanted / np.maximum(measured(scale)[0], 1e-9)))
    if not SIZE[0] <= size <= SIZE[1]:
        raise InputError(
            f"{target.name}: this body would be {size:.3g} times the size of {who}; "
            f"allowed are {SIZE[0]:.2g} to {SIZE[1]:g}: is it in metres?"
        )
    scale *= size
    every = np.eye(BODY22.num_joints)
    sides, trunk = every[list(BODY22.mirror)] - every, every[_TRUNK[0]] - every[_TRUNK[1]]
    alike = np.concatenate([_HOLD_SIDES_M * sides, _HOLD_TRUNK_M * trunk])
    is_every_bone = set(asked) == set(BODY22.bones)
    for _ in range(0 if is_every_bone else _NUM_ROUNDS):
        distances, vector = measured(scale)
        unit = vector / np.maximum(distances, 1e-9)[:, None]
        slope = between * (unit @ (directions * lengths_m[:, None]).T)
        rows = [slope, alike, _HOLD_BODY_M * every]
        values = [wanted - distances, -alike @ scale, _HOLD_BODY_M * (size - scale)]
        scale += np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    if is_every_bone:
        scale[pairs[:, 1]] = wanted / lengths_m[pairs[:, 1]]
    scale[BODY22.root] = 1.0
    is_measured = np.abs(between).sum(axis=0) > 0
    is_measured |= is_measured[list(BODY22.mirror)]
    compared = {**target.distances_m, **target.checks_m}
    misfit = measured(scale, np.array(list(compared)))[0] - np.array(list(compared.values()))
    misfit_m = dict(zip(compared, misfit.tolist(), strict=True))
    return BodyFit(scale, misfit_m, int((~is_measured[1:]).sum()))


def _arrays_of_json(data: bytes) -> dict[str, npt.NDArray[Any]]:
    tree = parse_json(data, "body")
    if not isinstance(tree, dict):
        raise FormatError("an object of joints is expected, each [x, y, z] in metres")
    if "positions_m" not in tree:
        tree = {"joint_names": list(tree), "positions_m": list(tree.values())}
    try:
        names = {key: np.array(tree[key]) for key in ("joint_names",) if key in tree}
        return names | {"positions_m": np.array(tree["positions_m"]).astype(np.float64)}
    except (ValueError, TypeError, OverflowError):
        raise FormatError("each joint needs three numbers, metres") from None


def _of_arrays(name: str, arrays: dict[str, npt.NDArray[Any]]) -> TargetBody:
    if "positions_m" in arrays and arrays["positions_m"].ndim == 2:
        arrays["positions_m"] = arrays["positions_m"][None]
    positions = get_array(arrays, "positions_m", "fiu", (None, None, 3)).astype(np.float64)
    names = get_array(arrays, "joint_names", "U", positions.shape[1:2])
    joint_names = [OTHER_NAMES.get(str(spelling), str(spelling)) for spelling in names]
    known = [at for at, joint in enumerate(joint_names) if joint in BODY22.joint_names]
    if not np.isfinite(positions[:, known]).all():
        raise FormatError(f"the position of '{joint_names[known[0]]}' or another joint is not finite")
    return _of_positions(name, positions[:, known], [joint_names[at] for at in known], BODY22.name)


def _of_positions(name: str, positions: Array, joint_names: Sequence[str], layout: str) -> TargetBody:
    """Return the body with joints at positions (frame, joint, 3), metres; medians over the frames."""
    missing = [joint for joint in NEEDED if joint not in joint_names]
    if missing:
        raise FormatError(f"joint '{missing[0]}' is missing; needed are {', '.join(NEEDED)}")
    at = {BODY22.index(joint): place for place, joint in enumerate(joint_names)}

    def measured(pairs: Iterable[tuple[int, int]]) -> Distances:
        distances = {}
        for first, second in pairs:
            apart = np.linalg.norm(positions[:, at[first]] - positions[:, at[second]], axis=-1)
            distances[first, second] = _checked(first, second, float(np.median(apart)))
        return distances

    top = "head" if "head" in joint_names else "{side}_shoulder"
    across = [("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")]
    across += [(f"{side}_hip", top.format(side=side)) for side in ("left", "right")]
    trunk = [(BODY22.index(joint), BODY22.index(other)) for joint, other in across]
    limbs = [bone for bone in BODY22.bones if bone[1] in at and bone[0] in _LIMBS]
    is_whole = len(at) == BODY22.num_joints
    shoulders = [(BODY22.index(f"{side}_hip"), BODY22.index(f"{side}_shoulder")) for side in ("left", "right")]
    return TargetBody(
        name, measured(trunk + limbs), layout, measured(BODY22.bones) if is_whole else {}, measured(shoulders)
    )


def _distances_of_table(lines: Lines) -> Distances:
    columns, rows = lines.table(())
    if not set(_COLUMNS) <= set(columns):
        raise FormatError(
            f"no body is recognised: a BVH or ASF file, a table with the columns {', '.join(_COLUMNS)}, or "
            "positions (npz, JSON) with joint names are"
        )
    distances: dict[tuple[int, int], float] = {}
    for row in rows:
        ends = [OTHER_NAMES.get(row[key], row[key]) for key in _COLUMNS[:2]]
        for joint in ends:
            if joint not in BODY22.joint_names:
                raise FormatError(f"joint '{joint}' is not known; known: {', '.join(BODY22.joint_names)}")
        first, second = BODY22.indices(ends)
        if first == second:
            raise FormatError(f"a distance of '{ends[0]}' from itself")
        distances[first, second] = _checked(first, second, parse_number(row["distance_m"], "distance_m"))
    if not distances:
        raise FormatError("the table has no rows")
    return distances


def _checked(first: int, second: int, value: float) -> float:
    ends = f"'{BODY22.joint_names[first]}' to '{BODY22.joint_names[second]}' (in metres?)"
    return check_range(value, f"the distance from {ends}", *DISTANCE_M)
