"""The 108 parameters of a pair: what they mean, the pose they give, and the gauge that fixes rigid motion.

Per person 54 numbers: root rotation (rotation vector, 3), root position (3), then for each of the 16 other joints of
pair17 two rotations of its bone about its parent joint and one relative change of the bone's length (Yin et al. 2018,
sections 3 and 6).  A joint's rotation moves everything beyond it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.kinematics import align_rigid, best_rotation, bone_directions, bone_lengths
from pasdedeux.kinematics.rotation_kernels import (
    conjugate,
    dot,
    put_row,
    put_unitquat,
    row_of,
    swing_between,
    unitquat_of,
    weighted_sum,
)
from pasdedeux.kinematics.rotation_kernels import multiply as turned_by
from pasdedeux.kinematics.rotation_kernels import rotate as carried_by
from pasdedeux.kinematics.rotation_kernels import rotvec_from_unitquat as rotvec_of_unitquat
from pasdedeux.kinematics.rotation_kernels import unitquat_from_rotvec as unitquat_of_rotvec
from pasdedeux.kinematics.rotations import (
    multiply,
    rotvec_from_unitquat,
    unitquat_from_rotmat,
    unitquat_from_rotvec,
    yaw_rotmat,
)
from pasdedeux.skeletons import PAIR17

NUM_JOINTS = PAIR17.num_joints
NUM_PER_PERSON = 6 + 3 * (NUM_JOINTS - 1)
NUM_PARAMETERS = 2 * NUM_PER_PERSON
NUM_BLOCKS = 2 * NUM_JOINTS
"""Blocks that a proposal moves as a whole: 0..16 are person A's root and joints 1..16, 17..33 person B's."""

ROTATION_INDICES = np.array([[NUM_PER_PERSON * p + k for k in range(3)] for p in range(2)])
POSITION_INDICES = ROTATION_INDICES + 3
LENGTH_INDICES = np.array([[NUM_PER_PERSON * p + 3 + 3 * j + 2 for j in range(1, NUM_JOINTS)] for p in range(2)])
"""Index of the length change of joints 1..16 of each person, (2, 16)."""
MIRRORED_LENGTH = LENGTH_INDICES[:, [PAIR17.mirror[j] - 1 for j in range(1, NUM_JOINTS)]]
"""Index of the length change of the left/right counterpart of joints 1..16, (2, 16)."""

_PELVIS = PAIR17.root
_ORDER = np.array(PAIR17.order)
_PARENTS = np.array(PAIR17.parents)
_OF_ROOT = list(PAIR17.children(_PELVIS))


@dataclass(frozen=True)
class PairChart:
    """Parameters round a seed: rotations and length changes are measured from it, so the seed's own are zero.

    Args:
        seed_m: The seed, gauge-fixed or not, (person=2, joint=17, 3), metres.

    Raises:
        InputError: The seed is not finite or a bone has length zero.
    """

    seed_m: Array

    def __post_init__(self) -> None:
        """Check shape, finiteness and bones."""
        if self.seed_m.shape != (2, NUM_JOINTS, 3):
            raise InputError(f"a seed has shape {self.seed_m.shape}, expected (2, {NUM_JOINTS}, 3)")
        if not np.isfinite(self.seed_m).all():
            raise InputError("the seed has a position that is not finite")
        is_empty = self.lengths_m[:, 1:] < 1e-6
        if is_empty.any():
            person, joint = np.argwhere(is_empty)[0]
            raise InputError(
                f"the seed's bone to '{PAIR17.joint_names[joint + 1]}' of person {'AB'[person]} has length zero"
            )

    @cached_property
    def lengths_m(self) -> Array:
        """Bone lengths of the seed (2, 17), metres; 0 for the roots."""
        return bone_lengths(PAIR17, self.seed_m)

    @cached_property
    def directions(self) -> Array:
        """Unit bone directions of the seed (2, 17, 3); 0 for the roots."""
        return bone_directions(PAIR17, self.seed_m)

    @cached_property
    def axes(self) -> Array:
        """Two unit axes square to each bone of the seed and to each other, (2, 17, 2, 3): the bone turns about them."""
        directions = self.directions
        helper = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
        first = np.cross(directions, helper)
        first /= np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
        return np.stack([first, np.cross(directions, first)], axis=-2)

    def seed_parameters(self) -> Array:
        """Return the parameters (108,) of the seed: zeros but for the positions of the roots."""
        parameters = np.zeros(NUM_PARAMETERS)
        for person in range(2):
            parameters[POSITION_INDICES[person]] = self.seed_m[person, _PELVIS]
        return parameters

    def positions(self, parameters: Array) -> Array:
        """Return the positions (*batch, person=2, joint=17, 3), metres, of parameters (*batch, 108)."""
        positions = np.empty((*parameters.shape[:-1], 2, NUM_JOINTS, 3))
        flat = np.ascontiguousarray(parameters).reshape(-1, NUM_PARAMETERS)
        _place(flat, self.directions, self.axes, self.lengths_m, positions.reshape(-1, 2, NUM_JOINTS, 3))
        return positions

    def parameters_of(self, pairs_m: Array, *, length_tolerance: float = 0.05) -> Array:
        """Return the parameters (*batch, 108) of pairs (*batch, person=2, joint=17, 3), metres: inverse of `positions`.

        A root takes the rotation that fits its bones best, a bone the shortest turn, so bones never twist.  Lengths are
        those of both sides of a body together and change by `length_tolerance` at most: a body with other proportions
        keeps its directions and gets those of the seed.
        """
        flat = np.ascontiguousarray(pairs_m, dtype=np.float64).reshape(-1, 2, NUM_JOINTS, 3)
        lengths, directions = bone_lengths(PAIR17, flat), bone_directions(PAIR17, flat)
        seeds = np.broadcast_to(self.directions[:, _OF_ROOT], directions[:, :, _OF_ROOT].shape)
        roots = unitquat_from_rotmat(best_rotation(seeds, directions[:, :, _OF_ROOT]))
        parameters = np.zeros((len(flat), NUM_PARAMETERS))
        parameters[:, ROTATION_INDICES] = rotvec_from_unitquat(roots)
        parameters[:, POSITION_INDICES] = flat[:, :, _PELVIS]
        _turn_bones(directions, self.directions, self.axes, roots, parameters)
        parameters[:, LENGTH_INDICES] = lengths[..., 1:] / self.lengths_m[:, 1:] - 1.0
        tied = 0.5 * (parameters[..., LENGTH_INDICES] + parameters[..., MIRRORED_LENGTH])
        parameters[..., LENGTH_INDICES] = tied.clip(-length_tolerance, length_tolerance)
        return parameters.reshape(*pairs_m.shape[:-3], NUM_PARAMETERS)

    @staticmethod
    def log_measure(parameters: Array) -> float:
        """Return the log of the volume of directions per volume of parameters (108,); 0 at the seed.

        A bone turned by r from the seed's direction takes sin r / r of the sphere for each unit of its two rotations: a
        density over poses, flat in the directions of bones, is multiplied by it to be one over the parameters.  It is
        -inf if a bone is turned by half a turn or more, because directions would then count twice.
        """
        return float(_log_measure(parameters, NUM_JOINTS))

    def gauge_fixed(self, parameters: Array) -> Array:
        """Return the parameters (108,) of the same pair, moved rigidly into the gauge of `gauge_fix`."""
        positions = self.positions(parameters)
        rotmat, shift = _gauge(positions, self.seed_m)
        quaternion = unitquat_from_rotmat(rotmat)
        fixed = parameters.copy()
        for person in range(2):
            turned = multiply(quaternion, unitquat_from_rotvec(parameters[ROTATION_INDICES[person]]))
            fixed[ROTATION_INDICES[person]] = rotvec_from_unitquat(turned)
            fixed[POSITION_INDICES[person]] = rotmat @ parameters[POSITION_INDICES[person]] + shift
        return fixed


def gauge_fix(pair_m: Array, reference_m: Array | None = None) -> Array:
    """Return the same pair (2, 17, 3), metres, moved rigidly into the gauge.

    The pair's centroid is at the origin and the line between the roots has yaw 0 (it points along +X where the
    horizontal plane shows it; a vertical line is left as it is).  Tilt, which does not affect the density either, is
    that of the best rigid fit to `reference_m` if given, and otherwise unchanged.
    """
    rotmat, shift = _gauge(pair_m, reference_m)
    return np.asarray(pair_m @ rotmat.T + shift)


def _gauge(pair_m: Array, reference_m: Array | None) -> tuple[Array, Array]:
    points = pair_m.reshape(-1, 3)
    tilt = np.eye(3) if reference_m is None else align_rigid(points, reference_m.reshape(-1, 3)).rotmat
    line = tilt @ (pair_m[1, _PELVIS] - pair_m[0, _PELVIS])
    is_vertical = np.hypot(line[0], line[2]) < 1e-9
    yaw = 0.0 if is_vertical else float(np.arctan2(-line[2], line[0]))
    rotmat = yaw_rotmat(-yaw) @ tilt
    return rotmat, -(rotmat @ points.mean(axis=0))


@compiled()
def _place(parameters, directions, axes, lengths, positions):  # type: ignore[no-untyped-def]
    frames = np.empty((NUM_JOINTS, 4))
    for row in range(parameters.shape[0]):
        vector, placed = parameters[row], positions[row]
        for person in range(2):
            start = person * NUM_PER_PERSON
            for joint in _ORDER:
                parent, first = _PARENTS[joint], start + 3 + 3 * joint
                if parent < 0:
                    put_unitquat(
                        frames, joint, unitquat_of_rotvec((vector[start], vector[start + 1], vector[start + 2]))
                    )
                    put_row(placed[person], joint, (vector[first], vector[first + 1], vector[first + 2]))
                    continue
                first_axis, second_axis = row_of(axes[person, joint], 0), row_of(axes[person, joint], 1)
                turn = unitquat_of_rotvec(weighted_sum(vector[first], first_axis, vector[first + 1], second_axis))
                frame = turned_by(unitquat_of(frames, parent), turn)
                put_unitquat(frames, joint, frame)
                length = lengths[person, joint] * (1.0 + vector[first + 2])
                bone = carried_by(frame, row_of(directions[person], joint))
                put_row(placed[person], joint, weighted_sum(1.0, row_of(placed[person], parent), length, bone))


@compiled()
def _turn_bones(directions, seed, axes, roots, parameters):  # type: ignore[no-untyped-def]
    frames = np.empty((NUM_JOINTS, 4))
    for row in range(parameters.shape[0]):
        for person in range(2):
            put_unitquat(frames, _PELVIS, unitquat_of(roots[row], person))
            for joint in _ORDER[1:]:
                first, frame = person * NUM_PER_PERSON + 3 + 3 * joint, unitquat_of(frames, _PARENTS[joint])
                bone = carried_by(conjugate(frame), row_of(directions[row, person], joint))
                turn = swing_between(row_of(seed[person], joint), bone)
                put_unitquat(frames, joint, turned_by(frame, turn))
                rotvec = rotvec_of_unitquat(turn)
                for axis in range(2):
                    parameters[row, first + axis] = dot(rotvec, row_of(axes[person, joint], axis))


@compiled()
def _log_measure(parameters, num_joints):  # type: ignore[no-untyped-def]
    total = 0.0
    for person in range(2):
        start = person * (3 + 3 * num_joints) + 3
        for joint in range(1, num_joints):
            square = parameters[start + 3 * joint] ** 2 + parameters[start + 3 * joint + 1] ** 2
            if square >= math.pi**2:
                return -math.inf
            if square > 1e-8:
                turn = math.sqrt(square)
                total += math.log(math.sin(turn) / turn)
    return total
