"""From op14 to a whole body: `body22` with constant bones, through the joints of the fit, posed as the match elsewhere.

Hips, shoulders, elbows, wrists, knees and ankles of op14 are joints of the body and stay where they are.  What op14
does not have - how the pelvis tilts, the spine bends, the head looks, the feet point - comes from the matched frame of
the database and gives way where the two do not meet: of all ways to close the chain from the hips to the shoulders the
one that turns its joints least is taken.  Every rotation is relative to the standing T-pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics import Motion, bone_lengths, local_rotations
from pasdedeux.kinematics.rotation_kernels import (
    conjugate,
    cross,
    dot,
    length,
    mix,
    multiply,
    normalise,
    rotate,
    row_of,
    scale,
    subtract,
    swing_between,
    unitquat_from_rotvec,
)
from pasdedeux.kinematics.rotations import conjugate as conjugate_rotations
from pasdedeux.kinematics.rotations import multiply as multiply_rotations
from pasdedeux.kinematics.rotations import normalise as normalise_vectors
from pasdedeux.kinematics.rotations import rotate as rotate_vectors
from pasdedeux.kinematics.rotations import unitquat_from_rotmat
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, REFERENCE_STATURE_M, mid_hip
from pasdedeux.reconstruction.bones import REST_DIRECTIONS, bone_rotations
from pasdedeux.reconstruction.cleanup import bend_one_leg
from pasdedeux.reconstruction.reconstruct import Reconstruction
from pasdedeux.reconstruction.smoothing import bridge_gaps, smooth_savitzky_golay
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.skeletons.humanoid import t_pose

__all__ = [
    "REFERENCE_HIP_WIDTH_M",
    "REFERENCE_REST_M",
    "SHARED",
    "Bends",
    "Body",
    "EmbodiedMotion",
    "bends_of",
    "body_from_joints",
    "body_of",
    "body_through",
    "embody",
    "held_hips",
    "hold_hips",
    "pose_body",
    "rotations_from_t_pose",
]

Array = npt.NDArray[np.float64]

_NECK, _NOSE = OP14.root, OP14.index("head")
_HIPS = OP14.indices(["left_hip", "right_hip"])
_SHOULDERS = OP14.indices(["left_shoulder", "right_shoulder"])
_HIPS_AT, _SHOULDERS_AT = np.array(_HIPS), np.array(_SHOULDERS)
_PARENTS = np.array(BODY22.parents)
_ORDER = np.array(BODY22.order[1:])
_PELVIS, _SPINE1, _SPINE2, _SPINE3, _NECK22, _HEAD22 = BODY22.indices(
    ["pelvis", "spine1", "spine2", "spine3", "neck", "head"]
)
_COLLARS = np.array(BODY22.indices(["left_collar", "right_collar"]))
_ARMS = np.array(BODY22.arms)
_LEGS = np.array(BODY22.legs)
_TOES = np.array(BODY22.indices(["left_toe", "right_toe"]))
_OP14_ARMS = np.array(OP14.arms)
_OP14_LEGS = np.array(OP14.legs)
_REST_NOSE = tuple(REST_DIRECTIONS[_NOSE].tolist())
SHARED = [name for name in OP14.joint_names if name in BODY22.joint_names and name not in ("neck", "head")]
"""Joints that op14 and body22 have in common; neck and head are other points."""

_ANKLE_HEIGHT = t_pose("left_ankle")[1]
_TOE_HEIGHT = t_pose("left_toe")[1]
_SHOULDER_LINE = t_pose("left_shoulder")[1] - t_pose("left_hip")[1]
"""Heights over the floor, and of the shoulders over the hips, of who stands in the T-pose; fractions of stature."""
_COLLAR = (0.018, 0.812, 0.016)
"""Where the collar bones begin (left, up, forward), before the shoulders: so they can rise, sink and close in."""

_LEAST_WIDTH_M = 1e-3
_MAX_ROUNDS = 30
_CLOSED_M = 1e-10
_MAX_STEP = 0.5
"""Radians, all joints together, of one step; further the tangent says nothing."""
_DAMPING = 1e-9
_GIVES = np.array([0.7, 1.0, 1.0, 1.0, 1.0, 1.0])
"""How much pelvis tilt, three spine joints and two collars give, against each other, when the chain is closed."""


def _rest(lengths_m: Array, hip_width_m: float) -> Array:
    """Return the T-pose (22, 3), metres, mid-hip at the origin, of a person with these op14 bones (14,)."""
    of = dict(zip(OP14.joint_names, np.asarray(lengths_m, dtype=np.float64), strict=True))
    half = 0.5 * hip_width_m
    rise = np.sqrt(max(0.25 * (of["left_hip"] + of["right_hip"]) ** 2 - half**2, 1e-6)) / _SHOULDER_LINE
    wide = 0.5 * (of["left_shoulder"] + of["right_shoulder"]) / t_pose("left_shoulder")[0]
    head = of["head"] * REFERENCE_STATURE_M / REFERENCE_LENGTHS_M[_NOSE]
    rest = np.zeros((BODY22.num_joints, 3))
    hip_height = t_pose("left_hip")[1]
    for joint, name in enumerate(BODY22.joint_names):
        x, y, z = _COLLAR if name.endswith("_collar") else t_pose(name)
        rest[joint] = [x * wide, (y - hip_height) * rise, z * rise]
    rest[_HEAD22] = rest[_NECK22] + head * (np.array(t_pose("head")) - t_pose("neck"))
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        shoulder, elbow, wrist, hip, knee, ankle, toe, collar = BODY22.indices(
            f"{side}_{part}" for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe", "collar")
        )
        rest[collar, 0] = sign * _COLLAR[0] * wide
        rest[shoulder, 0] = sign * of[f"{side}_shoulder"]
        rest[elbow] = rest[shoulder] + [sign * of[f"{side}_elbow"], 0.0, 0.0]
        rest[wrist] = rest[elbow] + [sign * of[f"{side}_wrist"], 0.0, 0.0]
        rest[hip] = [sign * half, 0.0, 0.0]
        rest[knee] = rest[hip] - [0.0, of[f"{side}_knee"], 0.0]
        rest[ankle] = rest[knee] - [0.0, of[f"{side}_ankle"], 0.0]
        foot = np.subtract(t_pose("left_toe"), t_pose("left_ankle")) / _ANKLE_HEIGHT
        rest[toe] = rest[ankle] + _ankle_height(of[f"{side}_knee"] + of[f"{side}_ankle"]) * foot
    return rest


def _ankle_height(leg_m: float) -> float:
    """Return the height of the ankles of who stands on legs of this length from hip to ankle, metres."""
    return float(leg_m * _ANKLE_HEIGHT / (t_pose("left_hip")[1] - _ANKLE_HEIGHT))


@dataclass(frozen=True)
class Body:
    """A person's own bones.

    Args:
        rest_m: The T-pose (22, 3), metres, mid-hip at the origin.
        ankle_height_m: Height of the ankles of who stands.
    """

    rest_m: Array
    ankle_height_m: float

    @cached_property
    def offsets_m(self) -> Array:
        """Offset of each joint from its parent in the T-pose (22, 3); zero for the pelvis."""
        offsets = self.rest_m - self.rest_m[np.maximum(_PARENTS, 0)]
        return np.asarray(offsets)

    @property
    def toe_height_m(self) -> float:
        """Height of the balls of the feet of who stands."""
        return self.ankle_height_m * _TOE_HEIGHT / _ANKLE_HEIGHT


def body_of(lengths_m: Array, hip_width_m: float) -> Body:
    """Return the body of a person with these op14 bones (14,) and this distance between the hip joints, metres."""
    of = dict(zip(OP14.joint_names, np.asarray(lengths_m, dtype=np.float64), strict=True))
    leg = 0.5 * sum(of[f"{side}_{joint}"] for side in ("left", "right") for joint in ("knee", "ankle"))
    return Body(_rest(lengths_m, hip_width_m), _ankle_height(leg))


REFERENCE_HIP_WIDTH_M = 2.0 * t_pose("left_hip")[0] * REFERENCE_STATURE_M
REFERENCE_REST_M: Array = _rest(REFERENCE_LENGTHS_M, REFERENCE_HIP_WIDTH_M)
"""The T-pose (22, 3) of the reference body, mid-hip at the origin, metres."""
REFERENCE_REST_M.flags.writeable = False


def rotations_from_t_pose(
    body22_m: Array, world_unitquat: Array | None = None, source_rest_m: Array | None = None
) -> Array:
    """Return local rotations (frame, 22, 4) that turn the standing T-pose into poses of another body.

    Args:
        body22_m: Positions (frame, 22, 3), metres; only the directions of the bones count.
        world_unitquat: World rotations (frame, 22, 4) of the joints from the source's rest pose, whose twist is kept;
            without them bones only swing.
        source_rest_m: That rest pose (22, 3).
    """
    twisted = None
    if world_unitquat is not None and source_rest_m is not None:
        # How the source's rest pose comes from the T-pose.
        local = local_rotations(BODY22, REFERENCE_REST_M, source_rest_m)
        rest = Motion(BODY22, np.zeros((BODY22.num_joints, 3)), np.zeros((1, 3)), local[None], 1.0).world()[1][0]
        twisted = multiply_rotations(world_unitquat, np.broadcast_to(rest, world_unitquat.shape))
    return local_rotations(BODY22, REFERENCE_REST_M, body22_m, twisted)


def hold_hips(found: Reconstruction) -> Reconstruction:
    """Return a reconstruction whose hips keep their distance, its median; see `held_hips`."""
    positions = np.array(found.positions_m, dtype=np.float64, order="C")
    positions = held_hips(positions, np.median(bone_lengths(OP14, positions), axis=0), _hip_width(positions))
    return replace(found, positions_m=positions, bone_unitquat=bone_rotations(positions), root_m=mid_hip(positions))


def _hip_width(positions_m: Array) -> float:
    return float(np.median(np.linalg.norm(positions_m[:, _HIPS[0]] - positions_m[:, _HIPS[1]], axis=-1)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def held_hips(positions: Array, lengths: Array, width: float) -> Array:
    """Return op14 positions (frame, 14, 3) of bones (14,) whose hips are `width` apart under the neck; the ankles stay.

    The two bones from the neck to the hips of op14 turn on their own, so that hips come apart and close in.
    """
    held = positions.copy()
    left, right = lengths[_HIPS_AT[0]], lengths[_HIPS_AT[1]]
    width = min(max(width, abs(left - right) + _LEAST_WIDTH_M), left + right - _LEAST_WIDTH_M)
    out = (left * left - right * right + width * width) / (2.0 * width)
    drop = np.sqrt(left * left - out * out)
    for at in range(positions.shape[0]):
        pose = held[at]
        neck, first, second = row_of(pose, _NECK), row_of(pose, _HIPS_AT[0]), row_of(pose, _HIPS_AT[1])
        across = normalise(subtract(first, second))
        if dot(across, across) == 0.0:
            across = (1.0, 0.0, 0.0)
        down = subtract(mix(0.5, first, 0.5, second), neck)
        down = normalise(subtract(down, scale(dot(down, across), across)))
        ahead = cross(down, across)
        facing = np.array([ahead[0], ahead[1], ahead[2]])
        for side in range(2):
            hip, knee, ankle = _OP14_LEGS[side, 0], _OP14_LEGS[side, 1], _OP14_LEGS[side, 2]
            aside = out if side == 0 else out - width
            place, end = np.empty(3), pose[ankle].copy()
            for axis in range(3):
                place[axis] = neck[axis] + drop * down[axis] + aside * across[axis]
            shift = place - pose[hip]
            pose[knee], pose[ankle] = bend_one_leg(place, pose[knee] + shift, end + shift, end, facing)
            pose[hip] = place
    return held


@dataclass(frozen=True)
class Bends:
    """How the match poses what op14 does not have.

    Args:
        unitquat: Local rotations (frame, 22, 4) from the T-pose; that of the pelvis is against the frame of the trunk,
            see `bones.bone_rotations`.
        nose_unitquat: Turns the direction from neck to nose from rest into that frame (frame, 4).
    """

    unitquat: Array
    nose_unitquat: Array

    @classmethod
    def none(cls, count: int) -> Bends:
        """Return what is taken where nothing is known: a straight back, feet square to the shanks, eyes ahead."""
        unitquat = np.zeros((count, BODY22.num_joints, 4))
        unitquat[..., 3] = 1.0
        return cls(unitquat, unitquat[:, 0].copy())


def bends_of(database: Database, rows: npt.ArrayLike) -> Bends:
    """Return what rows of a database (frame,) say; nothing where it has no whole bodies."""
    rows = np.asarray(rows, dtype=np.int64)
    if database.body22_unitquat is None:
        return Bends.none(len(rows))
    bones = bone_rotations(database.poses_m[rows])
    unitquat = database.body22_unitquat[rows].astype(np.float64)
    unitquat[:, _PELVIS] = multiply_rotations(conjugate_rotations(bones[:, _NECK]), unitquat[:, _PELVIS])
    return Bends(unitquat, bones[:, _NOSE])


def _bends_of_track(database: Database, found: Reconstruction, window: int) -> Bends:
    """Return what the matches of a track say, bridged as its poses are, and smooth over a window of frames."""
    bends = bends_of(database, np.maximum(found.row, 0))
    both = np.concatenate([bends.unitquat, bends.nose_unitquat[:, None]], axis=1)
    both = normalise_vectors(bridge_gaps(both, ~found.is_bridged))
    if window > 2:
        both = smooth_savitzky_golay(both, num_frames=window)
    return Bends(both[:, :-1], both[:, -1])


@dataclass(frozen=True)
class EmbodiedMotion:
    """A person's whole body over time, metres.

    Args:
        body: The bones.
        pelvis_m: (frame, 3).
        unitquat: Local rotations (frame, 22, 4) from the T-pose.
    """

    body: Body
    pelvis_m: Array
    unitquat: Array

    def motion(self, rate_hz: float) -> Motion:
        """Return it as a motion on body22."""
        return Motion(BODY22, self.body.offsets_m, self.pelvis_m, self.unitquat, rate_hz)

    def turned(self, rotmat: Array) -> EmbodiedMotion:
        """Return it in other axes (3, 3)."""
        unitquat = np.array(self.unitquat)
        unitquat[:, _PELVIS] = multiply_rotations(unitquat_from_rotmat(rotmat)[None], unitquat[:, _PELVIS])
        return replace(self, pelvis_m=self.pelvis_m @ rotmat.T, unitquat=unitquat)


def body_from_joints(body22_m: Array, unitquat: Array) -> EmbodiedMotion:
    """Return the motion of joints (frame, 22, 3) and local rotations (frame, 22, 4) as `motions` has them."""
    joints, local = np.asarray(body22_m, dtype=np.float64), normalise_vectors(np.asarray(unitquat, dtype=np.float64))
    still = np.zeros((BODY22.num_joints, 3))
    world = Motion(BODY22, still, joints[:, _PELVIS], local, 1.0).world()[1]
    rest = np.zeros((BODY22.num_joints, 3))
    for joint in _ORDER:
        parent = _PARENTS[joint]
        bones = rotate_vectors(conjugate_rotations(world[:, parent]), joints[:, joint] - joints[:, parent])
        rest[joint] = rest[parent] + np.median(bones, axis=0)
    rest -= 0.5 * (rest[_LEGS[0, 0]] + rest[_LEGS[1, 0]])
    knee, ankle = (np.mean([np.linalg.norm(rest[leg[at]] - rest[leg[at - 1]]) for leg in _LEGS]) for at in (1, 2))
    return EmbodiedMotion(Body(rest, _ankle_height(knee + ankle)), joints[:, _PELVIS], local)


def body_through(positions_m: Array) -> Body:
    """Return the body whose bones are those of op14 positions (frame, 14, 3), metres: the median over the frames."""
    return body_of(np.median(bone_lengths(OP14, positions_m), axis=0), _hip_width(positions_m))


def embody(database: Database, found: Reconstruction, positions_m: Array, *, window: int) -> EmbodiedMotion:
    """Return the whole body of a reconstruction.

    Args:
        database: What it was matched to.
        found: The reconstruction.
        positions_m: Its positions (frame, 14, 3) in upright axes, metres, standing ankles at y = 0.
        window: Frames that what the matches say is smoothed over; 1 leaves it as it is.
    """
    body = body_through(positions_m)
    bends = _bends_of_track(database, found, window)
    pelvis, unitquat = pose_body(body, positions_m, bends, floor_m=-body.ankle_height_m)
    return EmbodiedMotion(body, pelvis, unitquat)


def pose_body(
    body: Body, positions_m: Array, bends: Bends | None = None, *, floor_m: float = -np.inf
) -> tuple[Array, Array]:
    """Return the pelvis (frame, 3) and local rotations (frame, 22, 4) of a body through op14 joints.

    Where joints cannot be reached - shoulders further from the hips than the spine is long - the chain is stretched
    towards them, and the arm bends so that its wrist is where it was.

    Args:
        body: The person's bones.
        positions_m: op14 positions (frame, 14, 3), bones and hips of the body's lengths; upright axes, metres.
        bends: What the match says of the rest; nothing if not given.
        floor_m: Height of the floor: the balls of the feet do not sink into it.
    """
    poses = np.array(positions_m, dtype=np.float64, order="C")
    trunk = np.ascontiguousarray(bone_rotations(poses)[:, _NECK])
    bends = bends or Bends.none(len(poses))
    bent = np.ascontiguousarray(bends.unitquat)
    nose = np.ascontiguousarray(bends.nose_unitquat)
    return _pose_bodies(poses, trunk, bent, nose, body.offsets_m, body.rest_m, floor_m + body.toe_height_m)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pose_bodies(
    poses: Array, trunk: Array, bent: Array, nose: Array, offsets: Array, rest: Array, least_toe: float
) -> tuple[Array, Array]:
    """Do `pose_body`; `rest` has the mid-hip at the origin, `least_toe` is the least height of the toes."""
    count = poses.shape[0]
    local, pelvis = np.empty((count, offsets.shape[0], 4)), np.empty((count, 3))
    world, points = np.empty((offsets.shape[0], 4)), np.empty((offsets.shape[0], 3))
    for at in range(count):
        pose = poses[at]
        _put(world, _PELVIS, multiply(_of(trunk, at), _of(bent[at], _PELVIS)))
        _hang_on_hips(pose, world, points, rest)
        _bend(bent[at], world, points, offsets, _SPINE1)
        _close_spine(pose, bent[at], world, points, offsets, rest)
        _face(pose, bent[at], _of(trunk, at), rotate(_of(nose, at), _REST_NOSE), world, points, offsets)
        for side in range(2):
            _reach(pose, _OP14_ARMS[side], bent[at], _ARMS[side], world, points, offsets, _COLLARS[side])
            _reach(pose, _OP14_LEGS[side], bent[at], _LEGS[side], world, points, offsets, _PELVIS)
            _put_down(_LEGS[side, 2], _TOES[side], bent[at], world, points, offsets, least_toe)
        for axis in range(3):
            pelvis[at, axis] = points[_PELVIS, axis]
        _put(local[at], _PELVIS, _of(world, _PELVIS))
        for joint in _ORDER:
            _put(local[at], joint, multiply(conjugate(_of(world, _PARENTS[joint])), _of(world, joint)))
    return pelvis, local


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hang_on_hips(pose: Array, world: Array, points: Array, rest: Array) -> None:
    """Turn the pelvis so that the line of its hips is that of the pose, and put it there."""
    left, right = row_of(pose, _HIPS_AT[0]), row_of(pose, _HIPS_AT[1])
    turn = _of(world, _PELVIS)
    across = rotate(turn, subtract(row_of(rest, _LEGS[0, 0]), row_of(rest, _LEGS[1, 0])))
    _put(world, _PELVIS, _unit(multiply(swing_between(across, subtract(left, right)), turn)))
    _place_pelvis(mix(0.5, left, 0.5, right), world, points, rest)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place_pelvis(middle: tuple[float, float, float], world: Array, points: Array, rest: Array) -> None:
    """Put the pelvis where its hips have this middle."""
    up = rotate(_of(world, _PELVIS), row_of(rest, _PELVIS))
    for axis in range(3):
        points[_PELVIS, axis] = middle[axis] + up[axis]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bend(bent: Array, world: Array, points: Array, offsets: Array, first: int) -> None:
    """Turn and place the trunk from a joint on as the match has it: spine, and collars with the shoulders."""
    if first == _SPINE1:
        for joint in (_SPINE1, _SPINE2, _SPINE3, _COLLARS[0], _COLLARS[1]):
            _put(world, joint, multiply(_of(world, _PARENTS[joint]), _of(bent, joint)))
    for joint in (_SPINE1, _SPINE2, _SPINE3, _COLLARS[0], _COLLARS[1], _ARMS[0, 0], _ARMS[1, 0]):
        _place(joint, world, points, offsets)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place(joint: int, world: Array, points: Array, offsets: Array) -> None:
    parent = _PARENTS[joint]
    bone = rotate(_of(world, parent), row_of(offsets, joint))
    for axis in range(3):
        points[joint, axis] = points[parent, axis] + bone[axis]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _close_spine(pose: Array, bent: Array, world: Array, points: Array, offsets: Array, rest: Array) -> None:
    """Turn pelvis, spine and collars until the shoulders are where they are: Newton steps of least weighted turning."""
    left, right = row_of(pose, _HIPS_AT[0]), row_of(pose, _HIPS_AT[1])
    middle, hinge = mix(0.5, left, 0.5, right), normalise(subtract(left, right))
    turning = (_PELVIS, _SPINE1, _SPINE2, _SPINE3, _COLLARS[0], _COLLARS[1])
    jacobian, error = np.empty((6, 18)), np.empty(6)
    for _ in range(_MAX_ROUNDS):
        worst = 0.0
        for side in range(2):
            for axis in range(3):
                error[3 * side + axis] = pose[_SHOULDERS_AT[side], axis] - points[_ARMS[side, 0], axis]
                worst = max(worst, abs(error[3 * side + axis]))
        if worst < _CLOSED_M:
            break
        jacobian[:] = 0.0
        for number in range(6):
            joint = turning[number]
            for side in range(2):
                if number >= 4 and number - 4 != side:
                    continue
                shoulder = row_of(points, _ARMS[side, 0])
                arm = subtract(shoulder, middle if number == 0 else row_of(points, joint))
                if number == 0:
                    moved = cross(hinge, arm)
                    for axis in range(3):
                        jacobian[3 * side + axis, 0] = _GIVES[0] * moved[axis]
                    continue
                # Turning by w moves the shoulder by w x arm.
                for axis in range(3):
                    ahead, behind = (axis + 1) % 3, (axis + 2) % 3
                    jacobian[3 * side + axis, 3 * number + ahead] = _GIVES[number] * arm[behind]
                    jacobian[3 * side + axis, 3 * number + behind] = -_GIVES[number] * arm[ahead]
        normal = jacobian @ jacobian.T
        for row in range(6):
            normal[row, row] += _DAMPING
        turns = jacobian.T @ np.linalg.solve(normal, error)
        largest = np.sqrt((turns**2).sum())
        if largest > _MAX_STEP:
            turns *= _MAX_STEP / largest
        for number in range(6):
            joint, give = turning[number], _GIVES[number]
            if number == 0:
                turn = scale(give * turns[0], hinge)
            else:
                turn = (give * turns[3 * number], give * turns[3 * number + 1], give * turns[3 * number + 2])
            # What a joint turns by carries all that hangs on it.
            for carried in range(number, 6 if number < 4 else number + 1):
                turned = multiply(unitquat_from_rotvec(turn), _of(world, turning[carried]))
                _put(world, turning[carried], _unit(turned))
        _place_pelvis(middle, world, points, rest)
        _bend(bent, world, points, offsets, _PELVIS)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _face(
    pose: Array,
    bent: Array,
    trunk: tuple[float, float, float, float],
    nose: tuple[float, float, float],
    world: Array,
    points: Array,
    offsets: Array,
) -> None:
    """Hold the head to the trunk as the match does, turned by what the nose is away from where the match has it."""
    turn = swing_between(rotate(trunk, nose), subtract(row_of(pose, _NOSE), row_of(pose, _NECK)))
    held = multiply(turn, trunk)
    for joint in (_PELVIS, _SPINE1, _SPINE2, _SPINE3, _NECK22, _HEAD22):
        held = multiply(held, _of(bent, joint))
        if joint in (_NECK22, _HEAD22):
            _put(world, joint, _unit(held))
            _place(joint, world, points, offsets)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reach(
    pose: Array,
    wanted: npt.NDArray[np.int64],
    bent: Array,
    limb: npt.NDArray[np.int64],
    world: Array,
    points: Array,
    offsets: Array,
    above: int,
) -> None:
    """Turn a limb (its joint, hinge and end) that hangs on `above` until it is where the pose has it."""
    start, hinge, end = limb
    _place(start, world, points, offsets)
    first, second = pose[wanted[1]].copy(), pose[wanted[2]].copy()
    away = 0.0
    for axis in range(3):
        away = max(away, abs(points[start, axis] - pose[wanted[0], axis]))
    if away > _CLOSED_M:
        shift = points[start] - pose[wanted[0]]
        aside = rotate(_of(world, above), (0.0, 0.0, 1.0))
        first, second = bend_one_leg(
            points[start].copy(), first + shift, second + shift, second, np.array([aside[0], aside[1], aside[2]])
        )
    for joint, child, target in ((start, hinge, first), (hinge, end, second)):
        turn = multiply(_of(world, _PARENTS[joint]), _of(bent, joint))
        bone = rotate(turn, row_of(offsets, child))
        aim = (target[0] - points[joint, 0], target[1] - points[joint, 1], target[2] - points[joint, 2])
        _put(world, joint, _unit(multiply(swing_between(bone, aim), turn)))
        _place(child, world, points, offsets)
    _put(world, end, multiply(_of(world, hinge), _of(bent, end)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _put_down(ankle: int, toe: int, bent: Array, world: Array, points: Array, offsets: Array, least_toe: float) -> None:
    """Tilt the foot until its ball is not below `least_toe`."""
    _place(toe, world, points, offsets)
    if points[toe, 1] < least_toe:
        foot = subtract(row_of(points, toe), row_of(points, ankle))
        size = length(foot)
        rise = min(max(least_toe - points[ankle, 1], -size), size)
        level = np.sqrt(max(size * size - rise * rise, 0.0))
        ahead = normalise((foot[0], 0.0, foot[2]))
        aim = (level * ahead[0], rise, level * ahead[2])
        _put(world, ankle, _unit(multiply(swing_between(foot, aim), _of(world, ankle))))
        _place(toe, world, points, offsets)
    _put(world, toe, multiply(_of(world, ankle), _of(bent, toe)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _of(rotations: Array, row: int) -> tuple[float, float, float, float]:
    return rotations[row, 0], rotations[row, 1], rotations[row, 2], rotations[row, 3]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _put(rotations: Array, row: int, q: tuple[float, float, float, float]) -> None:
    rotations[row, 0], rotations[row, 1], rotations[row, 2], rotations[row, 3] = q


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = 1.0 / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return q[0] * norm, q[1] * norm, q[2] * norm, q[3] * norm
