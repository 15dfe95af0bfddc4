"""Conversion between motions and parameters of SMPL, SMPL-H and SMPL-X, as in AMASS, InterHuman and others.

A pose is a rotation vector for each joint of the body model, a translation of its root, and betas, which shape the body
(Loper et al. 2015, "SMPL: a skinned multi-person linear model", eq. 8 to 10).  The model is a file of the user, an npz
with `J_regressor`, `v_template`, `shapedirs` and `kintree_table`, from which the rest joints for betas are computed.
Its 22 body joints are those of body22, whose toes are called feet there.  Nothing else of the model is read, and no
pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.file_format import FileStart, MotionFormat
from pasdedeux.formats.npz import array_names, get_array, read_npz
from pasdedeux.formats.poses2d.annotated_frames import RATE_HZ
from pasdedeux.formats.rates import plain_rate
from pasdedeux.formats.rigs.guess import guess_up_axis
from pasdedeux.formats.source_motion import SourceMotion, upright_from_file
from pasdedeux.formats.text import MAX_MAGNITUDE, check_range
from pasdedeux.kinematics import (
    Motion,
    best_rotation,
    bone_directions,
    bone_lengths,
    forward_kinematics,
    local_rotations,
)
from pasdedeux.kinematics.rotations import (
    conjugate,
    identity_unitquat,
    multiply,
    rotate,
    rotvec_from_unitquat,
    unitquat_from_rotmat,
    unitquat_from_rotvec,
)
from pasdedeux.skeletons import BODY22, Skeleton
from pasdedeux.skeletons.skeleton import by_joint

_TRUNK = ("spine1", "spine2", "spine3")
BODY = (
    "pelvis",
    *(joint for at, part in enumerate(("hip", "knee", "ankle")) for joint in (*by_joint("left", part), _TRUNK[at])),
    *by_joint("left", "toe"),
    "neck",
    *by_joint("left", "collar"),
    "head",
    *by_joint("left", "shoulder", "elbow", "wrist"),
)
"""The 22 body joints in the order of the parameters."""
_FINGERS = tuple(
    f"{side}_{finger}{knuckle}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for knuckle in (1, 2, 3)
)
JOINTS = {
    "SMPL": (*BODY, "left_hand", "right_hand"),
    "SMPL-H": (*BODY, *_FINGERS),
    "SMPL-X": (*BODY, "jaw", "left_eye", "right_eye", *_FINGERS),
}
"""Joints of each kind of model, in the order of its parameters."""
_KIND_OF_COUNT = {len(joints): kind for kind, joints in JOINTS.items()}
_SHAPES = {400: 300, 20: 10}
"""Number of shape directions by the number of all directions: in SMPL-X those of the face follow."""
_MODEL = ("J_regressor", "v_template", "shapedirs", "kintree_table")
_ALIASES = {
    "poses": ("poses",),
    "root_orient": ("root_orient", "global_orient"),
    "pose_body": ("pose_body", "body_pose"),
    "pose_hand": ("pose_hand",),
    "pose_lhand": ("pose_lhand", "left_hand_pose"),
    "pose_rhand": ("pose_rhand", "right_hand_pose"),
    "trans": ("trans", "transl"),
    "betas": ("betas",),
    "mocap_framerate": ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps", "rate_hz"),
}
"""Names of parameters in data sets; separate jaw and eyes, which move no body joint, are not read."""
_CALLED = {alias: name for name, aliases in _ALIASES.items() for alias in aliases}
_RATE = "mocap_framerate"
_HOLD = 1e-4
"""Weight of betas in their fit, relative to metres of bone length, so that they are fixed by bones if possible."""


@dataclass(frozen=True)
class BodyModel:
    """Rest joints of a body model.

    Args:
        skeleton: Its joints; body joints have the names of body22.
        joints_m: Positions for zero betas (J, 3), metres, Y up, facing +Z.
        shape_m: Displacement of the joints per unit of each of B betas (J, 3, B), metres.
    """

    skeleton: Skeleton
    joints_m: Array
    shape_m: Array

    @property
    def kind(self) -> str:
        """SMPL, SMPL-H or SMPL-X."""
        return _KIND_OF_COUNT[self.skeleton.num_joints]

    def rest_m(self, betas: Array) -> Array:
        """Return the joints (J, 3) of a body, metres; an InputError if it has more betas than the model."""
        count = self.shape_m.shape[-1]
        if np.any(betas[count:]):
            raise InputError(f"the parameters have {len(betas)} betas, the body model has {count}: it is another one")
        return np.asarray(self.joints_m + self.shape_m[..., : len(betas)] @ betas[:count])

    def offsets_m(self, rest_m: Array) -> Array:
        """Return the offset (J, 3) of each joint from its parent, zero for the root."""
        return rest_m - rest_m[[max(parent, 0) for parent in self.skeleton.parents]]

    def fit_betas(self, lengths_m: Mapping[str, float]) -> tuple[Array, dict[str, float]]:
        """Return the betas (B,) that fit these bone lengths best, and the excess of each bone, metres.

        Least squares over the bones that end in these joints, by Gauss-Newton; betas that no bone depends on stay 0.
        """
        bones = self.skeleton.indices(lengths_m)
        parents = [self.skeleton.parents[joint] for joint in bones]
        wanted, betas = np.array(list(lengths_m.values())), np.zeros(self.shape_m.shape[-1])
        slope = self.shape_m[bones] - self.shape_m[parents]
        for _ in range(20):
            bone = (self.joints_m[bones] - self.joints_m[parents]) + slope @ betas
            length = np.linalg.norm(bone, axis=-1)
            rows = np.einsum("kx,kxb->kb", bone / np.maximum(length, 1e-9)[:, None], slope)
            matrix = np.concatenate([rows, _HOLD * np.eye(len(betas))])
            step = np.linalg.lstsq(matrix, np.concatenate([wanted - length, -_HOLD * betas]), rcond=None)[0]
            betas = betas + step
        lengths = bone_lengths(self.skeleton, self.rest_m(betas))[bones]
        return betas, dict(zip(lengths_m, (lengths - wanted).tolist(), strict=True))


@lru_cache(maxsize=2)
def read_body_model(data: bytes) -> BodyModel:
    """Read the joints of a body model; opens only the needed arrays of an npz.

    Raises:
        FormatError: It is not npz, lacks an array, or its arrays do not fit each other or any kind of model.
    """
    arrays = read_npz(data, "body model", _MODEL.__contains__)
    template = get_array(arrays, "v_template", "f", (None, 3)).astype(np.float64)
    regressor = get_array(arrays, "J_regressor", "f", (None, len(template))).astype(np.float64)
    count = len(regressor)
    if count not in _KIND_OF_COUNT:
        known = ", ".join(f"{kind} {number}" for number, kind in _KIND_OF_COUNT.items())
        raise FormatError(f"array 'J_regressor' has {count} joints; allowed: {known}")
    directions = get_array(arrays, "shapedirs", "f", (len(template), 3, None))
    directions = directions[..., : _SHAPES.get(directions.shape[-1], directions.shape[-1])].astype(np.float64)
    table = get_array(arrays, "kintree_table", "iu", (2, count))[0].astype(np.int64)
    parents = tuple(-1 if not 0 <= parent < count else parent for parent in table.tolist())
    names = JOINTS[_KIND_OF_COUNT[count]]
    joints, shape = regressor @ template, np.einsum("jv,vxb->jxb", regressor, directions)
    if not (np.isfinite(joints).all() and np.isfinite(shape).all()):
        raise FormatError("array 'v_template', 'shapedirs' or 'J_regressor' is not finite")
    return BodyModel(Skeleton(_KIND_OF_COUNT[count], names, parents), joints, shape)


def read_smpl(data: bytes, companion: bytes = b"", person: int = 0) -> SourceMotion:
    """Read the parameters of one person; in a file of two people arrays are named `person1_trans`, `person2_trans`, ...

    The rest pose stands along the up axis of the file, Y or Z, so that rest pose and motion are turned alike later.

    Raises:
        FormatError: An array is missing or has another shape, a value is not finite (the frame is named), or the body
            model is of another kind.
    """
    model = read_body_model(companion)
    arrays = _arrays_of(read_npz(data, "archive of body parameters", _is_parameter), person)
    rotvecs = _rotvecs(arrays, model)
    check_range(len(rotvecs), "the number of frames of array 'poses' or 'root_orient'", 1, np.inf)
    trans = get_array(arrays, "trans", "f", (len(rotvecs), 3)).astype(np.float64)
    numbers = np.abs(np.concatenate([rotvecs, trans[:, None]], axis=1))
    for frame in np.flatnonzero(~(numbers <= MAX_MAGNITUDE).all(axis=(1, 2))):
        raise FormatError(f"frame {frame}: a parameter is not finite or absurdly large")
    rest, rate_hz = model.rest_m(_betas(arrays, len(rotvecs))), None
    if _RATE in arrays:
        rate_hz = check_range(plain_rate(float(get_array(arrays, _RATE, "fiu", ()))), "the frame rate", *RATE_HZ)
    return _standing_in_file(
        SourceMotion(
            skeleton=model.skeleton,
            rest_offsets=model.offsets_m(rest),
            root_translation=trans + rest[0],
            local_unitquat=unitquat_from_rotvec(rotvecs),
            rate_hz=rate_hz,
            metres_per_unit=1.0,
        )
    )


def _standing_in_file(source: SourceMotion) -> SourceMotion:
    """Return the same motion with a rest pose along the file's up axis; that of the model is along Y."""
    axis = guess_up_axis(source).axis
    if axis == "y":
        return source
    upright = upright_from_file(axis)
    down = np.broadcast_to(conjugate(upright), source.local_unitquat.shape)
    local = multiply(source.local_unitquat, np.broadcast_to(upright, source.local_unitquat.shape))
    local[:, 1:] = multiply(down[:, 1:], local[:, 1:])
    return replace(
        source,
        rest_offsets=rotate(np.broadcast_to(conjugate(upright), (len(source.rest_offsets), 4)), source.rest_offsets),
        local_unitquat=local,
    )


def _base(name: str) -> tuple[int, str]:
    """Return person and bare name of an array: `person2_trans` is `trans` of person 1, `trans` that of person 0."""
    for person in (0, 1):
        if name.startswith(f"person{person + 1}_"):
            return person, name[len("person1_") :]
    return 0, name


def _is_parameter(name: str) -> bool:
    return _base(name)[1] in _CALLED


def _arrays_of(arrays: Mapping[str, Any], person: int) -> dict[str, Any]:
    """Return the arrays of one person under the names of `_ALIASES`; the rate is common."""
    by_name: dict[str, Any] = {}
    for name, values in arrays.items():
        who, bare = _base(name)
        if who == person or _CALLED[bare] == _RATE:
            by_name[_CALLED[bare]] = values
    return by_name


def _count_people(data: bytes) -> int:
    """Return 2 if there are arrays of a second person, else 1."""
    return 1 + any(_base(name)[0] for name in array_names(data) if _is_parameter(name))


def _rotvecs(arrays: Mapping[str, Any], model: BodyModel) -> Array:
    """Return the rotation vectors (frame, J, 3) of a model's joints; zero for joints that are not stated."""
    count = model.skeleton.num_joints
    if "poses" in arrays:
        poses = get_array(arrays, "poses", "f", (None, None)).astype(np.float64)
        stated = _KIND_OF_COUNT.get(poses.shape[1] // 3, "") if poses.shape[1] % 3 == 0 else ""
        if stated != model.kind:
            what = f"of {stated}" if stated else "of no known kind"
            raise FormatError(
                f"array 'poses' has {poses.shape[1]} numbers a frame, parameters {what}; the body model is "
                f"{model.kind}, which has {3 * count}"
            )
        return poses.reshape(-1, count, 3)
    root = get_array(arrays, "root_orient", "f", (None, 3)).astype(np.float64)
    body = _flat(arrays, "pose_body", len(root))
    allowed = {3 * (len(BODY) - 1)} | ({3 * (count - 1)} if model.kind == "SMPL" else set())
    if body.shape[1] not in allowed:
        raise FormatError(
            f"array 'pose_body' has {body.shape[1]} numbers a frame; with a body model of {model.kind} allowed: "
            f"{', '.join(map(str, sorted(allowed)))}"
        )
    rotvecs = np.zeros((len(root), count, 3))
    rotvecs[:, 0] = root
    rotvecs[:, 1 : 1 + body.shape[1] // 3] = body.reshape(len(root), -1, 3)
    hands = [_flat(arrays, key, len(root)) for key in ("pose_hand", "pose_lhand", "pose_rhand") if key in arrays]
    if hands:
        turned = np.concatenate(hands, axis=1)
        if model.kind == "SMPL" or turned.shape[1] != 3 * len(_FINGERS):
            raise FormatError(
                f"array 'pose_hand' (or both hands together) has {turned.shape[1]} numbers a frame; {model.kind} has "
                f"{0 if model.kind == 'SMPL' else 3 * len(_FINGERS)}"
            )
        rotvecs[:, -len(_FINGERS) :] = turned.reshape(len(root), -1, 3)
    return rotvecs


def _flat(arrays: Mapping[str, Any], key: str, num_frames: int) -> Array:
    """Return rotation vectors as (frame, n), also if the array is (frame, joint, 3)."""
    values = arrays.get(key)
    shape = (num_frames, None) if values is None or values.ndim != 3 else (num_frames, None, 3)
    return get_array(arrays, key, "f", shape).astype(np.float64).reshape(num_frames, -1)


def _betas(arrays: Mapping[str, Any], num_frames: int) -> Array:
    """Return betas (n,); if the array has a row per frame, their median."""
    given = arrays.get("betas")
    rows = 1 if given is not None and given.ndim == 2 and len(given) == 1 else num_frames
    values = get_array(arrays, "betas", "f", (None,) if given is None or given.ndim == 1 else (rows, None))
    betas = np.asarray(np.median(np.atleast_2d(values), axis=0), dtype=np.float64)
    if not (np.abs(betas) <= MAX_MAGNITUDE).all():
        raise FormatError("array 'betas' is not finite or absurdly large")
    return betas


def _is_smpl(start: FileStart) -> bool:
    names = {_base(name)[1] for name in start.array_names}
    return bool(names & {"trans", "transl"}) and bool(names & {"poses", "root_orient", "global_orient"})


SMPL = MotionFormat(
    name="smpl",
    suffixes=(".npz",),
    recognises=_is_smpl,
    read=read_smpl,
    companion="body model",
    companion_names=lambda name: ("body_model.npz", "../body_model.npz", "../../body_model.npz"),
    is_companion=lambda start: set(_MODEL) <= start.array_names,
    read_other=read_smpl,
    count_people=_count_people,
    check_companion=read_body_model,
)
"""Parameters of SMPL, SMPL-H and SMPL-X in metres; some files state the rate."""


@dataclass(frozen=True)
class SmplMotion:
    """A motion as parameters of a body model.

    Args:
        rotvecs: Rotation vectors of the model's joints (frame, J, 3).
        trans_m: Translation (frame, 3), metres.
        betas: Shape (B,), fitted to the bone lengths.
        misfit_m: Excess length of each bone, metres.
        away_m: Distance of the 22 body joints from their true positions (frame, 22), metres.
    """

    rotvecs: Array
    trans_m: Array
    betas: Array
    misfit_m: Mapping[str, float]
    away_m: Array


def smpl_of_motion(model: BodyModel, motion: Motion, body22_m: Array, *, up_axis: str) -> SmplMotion:
    """Return the parameters of a motion that has the joints of a model, Y up; its rest pose may have another up axis.

    Args:
        model: The body model.
        motion: The motion; no body of the model need have its bone lengths.
        body22_m: Positions of the body joints (frame, 22, 3), metres.
        up_axis: Axis that points up in the parameters.
    """
    betas, misfit = _fit(model, body22_m)
    rest = model.rest_m(betas)
    theirs = bone_directions(model.skeleton, rest)[1:]
    turn = unitquat_from_rotmat(best_rotation(theirs, bone_directions(motion.skeleton, motion.rest_positions_m())[1:]))
    turns = np.broadcast_to(turn, motion.local_unitquat.shape)
    local = multiply(motion.local_unitquat, turns)
    local[:, 1:] = multiply(conjugate(turns[:, 1:]), local[:, 1:])
    return _parameters(model, betas, misfit, local, body22_m, up_axis)


def smpl_of_body22(model: BodyModel, body22_m: Array, world_unitquat: Array) -> SmplMotion:
    """Return the parameters of a body22: swing from its bones, twist from its rotations; hands and face at rest.

    Args:
        model: The body model.
        body22_m: Positions (frame, 22, 3), metres, Y up.
        world_unitquat: World rotations from a standing T-pose (frame, 22, 4).
    """
    betas, misfit = _fit(model, body22_m)
    rest = model.rest_m(betas)
    order = model.skeleton.indices(BODY22.joint_names)
    local = identity_unitquat(len(body22_m), model.skeleton.num_joints)
    local[:, order] = local_rotations(BODY22, rest[order], body22_m, world_unitquat)
    return _parameters(model, betas, misfit, local, body22_m, "y")


def _fit(model: BodyModel, body22_m: Array) -> tuple[Array, dict[str, float]]:
    lengths = np.median(bone_lengths(BODY22, body22_m), axis=0)
    return model.fit_betas({BODY22.joint_names[joint]: float(lengths[joint]) for _, joint in BODY22.bones})


def _parameters(
    model: BodyModel, betas: Array, misfit: dict[str, float], local: Array, body22_m: Array, up_axis: str
) -> SmplMotion:
    """Return the parameters of local rotations (frame, J, 4), Y up, with the pelvis at its true position."""
    rest, pelvis = model.rest_m(betas), body22_m[:, BODY22.root]
    posed, _ = forward_kinematics(model.skeleton, model.offsets_m(rest), pelvis, local)
    away_m = np.linalg.norm(posed[:, model.skeleton.indices(BODY22.joint_names)] - body22_m, axis=-1)
    down = np.broadcast_to(conjugate(upright_from_file(up_axis)), (len(local), 4))
    local[:, 0] = multiply(down, local[:, 0])
    return SmplMotion(rotvec_from_unitquat(local), rotate(down, pelvis) - rest[0], betas, misfit, away_m)
