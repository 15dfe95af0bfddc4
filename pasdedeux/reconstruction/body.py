"""From op14 to a whole body: `body22` with constant bones, through the joints of the fit, posed as the match elsewhere.

Hips, shoulders, elbows, wrists, knees and ankles of op14 are joints of the body and stay in place.  The tilt of the
pelvis, the bend of the spine, the turn of the head and the direction of the feet, which op14 lacks, come from the
matched frame of the database.  They are adjusted where they do not fit the joints: the chain from hips to shoulders is
closed by the smallest turns of its joints.  Every rotation is relative to the standing T-pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags
from pasdedeux.formats.humanoid import HumanoidMotion
from pasdedeux.kinematics import Motion, bone_lengths, local_rotations
from pasdedeux.kinematics.rotations import conjugate, multiply, normalise, rotate, unitquat_from_rotmat
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, REFERENCE_STATURE_M
from pasdedeux.reconstruction.body_kernels import held_hips, pose_bodies
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.smoothing import bridge_gaps, smooth_savitzky_golay
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.skeletons.humanoid import t_pose

_NECK, _NOSE = OP14.root, OP14.index("head")
_HIPS = OP14.indices(["left_hip", "right_hip"])
_PARENTS = np.array(BODY22.parents)
_PELVIS, _NECK22, _HEAD22 = BODY22.indices(["pelvis", "neck", "head"])
_LEGS = np.array(BODY22.legs)
SHARED = [name for name in OP14.joint_names if name in BODY22.joint_names and name not in ("neck", "head")]
"""Joints that op14 and body22 share; their necks and heads are different points."""

_ANKLE_HEIGHT = t_pose("left_ankle")[1]
_TOE_HEIGHT = t_pose("left_toe")[1]
_SHOULDER_LINE = t_pose("left_shoulder")[1] - t_pose("left_hip")[1]
"""Heights of ankle and toe over the floor, and of shoulders over hips, in the T-pose; fractions of stature."""
_COLLAR = (0.018, 0.812, 0.016)
"""Where the collar bones begin (left, up, forward), inside the shoulders, which can then rise, sink and close."""


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
    """Return the height of standing ankles for legs of this length from hip to ankle, metres."""
    return float(leg_m * _ANKLE_HEIGHT / (t_pose("left_hip")[1] - _ANKLE_HEIGHT))


@dataclass(frozen=True)
class BodyBones:
    """The bones of a person's whole body.

    Args:
        rest_m: The T-pose (22, 3), metres, mid-hip at the origin.
        ankle_height_m: Height of standing ankles.
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
        """Height of the balls of the feet of a standing person, metres."""
        return self.ankle_height_m * _TOE_HEIGHT / _ANKLE_HEIGHT


def body_with_bones(lengths_m: Array, hip_width_m: float) -> BodyBones:
    """Return the body of a person with these op14 bones (14,) and this distance between the hip joints, metres."""
    of = dict(zip(OP14.joint_names, np.asarray(lengths_m, dtype=np.float64), strict=True))
    leg = 0.5 * sum(of[f"{side}_{joint}"] for side in ("left", "right") for joint in ("knee", "ankle"))
    return BodyBones(_rest(lengths_m, hip_width_m), _ankle_height(leg))


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
        # The turns from the T-pose to the rest pose of the source.
        local = local_rotations(BODY22, REFERENCE_REST_M, source_rest_m)
        rest = Motion(BODY22, np.zeros((BODY22.num_joints, 3)), np.zeros((1, 3)), local[None], 1.0).world()[1][0]
        twisted = multiply(world_unitquat, np.broadcast_to(rest, world_unitquat.shape))
    return local_rotations(BODY22, REFERENCE_REST_M, body22_m, twisted)


def hold_hips(track: ReconstructedTrack) -> ReconstructedTrack:
    """Return a reconstruction with a constant distance between the hips, the median; see `held_hips`."""
    positions = np.array(track.positions_m, dtype=np.float64, order="C")
    positions = held_hips(positions, np.median(bone_lengths(OP14, positions), axis=0), _hip_width(positions))
    return track.posed(positions)


def _hip_width(positions_m: Array) -> float:
    return float(np.median(np.linalg.norm(positions_m[:, _HIPS[0]] - positions_m[:, _HIPS[1]], axis=-1)))


@dataclass(frozen=True)
class Bends:
    """The pose, by the match, of the joints that op14 lacks.

    Args:
        unitquat: Local rotations (frame, 22, 4) from the T-pose; that of the pelvis is relative to the frame of the
            trunk, see `bones.bone_rotations`.
        nose_unitquat: Rotation of the direction from neck to nose, from rest, in that frame (frame, 4).
    """

    unitquat: Array
    nose_unitquat: Array

    @classmethod
    def none(cls, count: int) -> Bends:
        """Return the default pose: a straight back, feet at right angles to the shanks, eyes ahead."""
        unitquat = np.zeros((count, BODY22.num_joints, 4))
        unitquat[..., 3] = 1.0
        return cls(unitquat, unitquat[:, 0].copy())


def bends_of(database: Database, rows: npt.ArrayLike) -> Bends:
    """Return the bends of rows of a database (frame,); the default pose if it has no whole bodies."""
    rows = np.asarray(rows, dtype=np.int64)
    if database.body22_unitquat is None:
        return Bends.none(len(rows))
    bones = bone_rotations(database.poses_m[rows])
    unitquat = database.body22_unitquat[rows].astype(np.float64)
    unitquat[:, _PELVIS] = multiply(conjugate(bones[:, _NECK]), unitquat[:, _PELVIS])
    return Bends(unitquat, bones[:, _NOSE])


def _bends_of_track(database: Database, track: ReconstructedTrack, window: int) -> Bends:
    """Return the bends of the matches of a track, interpolated like its poses and smoothed over a window of frames."""
    bends = bends_of(database, np.maximum(track.row, 0))
    both = np.concatenate([bends.unitquat, bends.nose_unitquat[:, None]], axis=1)
    both = normalise(bridge_gaps(both, ~track.is_bridged))
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

    body: BodyBones
    pelvis_m: Array
    unitquat: Array

    def motion(self, rate_hz: float) -> Motion:
        """Return the motion on body22."""
        return Motion(BODY22, self.body.offsets_m, self.pelvis_m, self.unitquat, rate_hz)

    def turned(self, rotmat: Array) -> EmbodiedMotion:
        """Return the motion in other axes (3, 3)."""
        unitquat = np.array(self.unitquat)
        unitquat[:, _PELVIS] = multiply(unitquat_from_rotmat(rotmat)[None], unitquat[:, _PELVIS])
        return replace(self, pelvis_m=self.pelvis_m @ rotmat.T, unitquat=unitquat)


def body_from_joints(body22_m: Array, unitquat: Array) -> EmbodiedMotion:
    """Return the motion of joints (frame, 22, 3) and local rotations (frame, 22, 4) as `motions` has them."""
    joints, local = np.asarray(body22_m, dtype=np.float64), normalise(np.asarray(unitquat, dtype=np.float64))
    still = np.zeros((BODY22.num_joints, 3))
    world = Motion(BODY22, still, joints[:, _PELVIS], local, 1.0).world()[1]
    rest = np.zeros((BODY22.num_joints, 3))
    for joint in BODY22.order[1:]:
        parent = _PARENTS[joint]
        bones = rotate(conjugate(world[:, parent]), joints[:, joint] - joints[:, parent])
        rest[joint] = rest[parent] + np.median(bones, axis=0)
    rest -= 0.5 * (rest[_LEGS[0, 0]] + rest[_LEGS[1, 0]])
    knee, ankle = (np.mean([np.linalg.norm(rest[leg[at]] - rest[leg[at - 1]]) for leg in _LEGS]) for at in (1, 2))
    return EmbodiedMotion(BodyBones(rest, _ankle_height(knee + ankle)), joints[:, _PELVIS], local)


def body_through(positions_m: Array) -> BodyBones:
    """Return the body with the median bone lengths of op14 positions (frame, 14, 3), metres."""
    return body_with_bones(np.median(bone_lengths(OP14, positions_m), axis=0), _hip_width(positions_m))


def embody(database: Database, track: ReconstructedTrack, positions_m: Array, *, window: int) -> EmbodiedMotion:
    """Return the whole body of a reconstruction.

    Args:
        database: Database of its matches.
        track: The reconstruction.
        positions_m: Its positions (frame, 14, 3) in upright axes, metres, standing ankles at y = 0.
        window: Frames over which the bends of the matches are smoothed; 1 for no smoothing.
    """
    body = body_through(positions_m)
    bends = _bends_of_track(database, track, window)
    pelvis, unitquat = pose_body(body, positions_m, bends, floor_m=-body.ankle_height_m)
    return EmbodiedMotion(body, pelvis, unitquat)


def pose_body(
    body: BodyBones, positions_m: Array, bends: Bends | None = None, *, floor_m: float = -np.inf
) -> tuple[Array, Array]:
    """Return the pelvis (frame, 3) and local rotations (frame, 22, 4) of a body through op14 joints.

    If shoulders are further from the hips than the spine reaches, the spine is stretched towards them, and the arms
    bend so that the wrists stay in place.

    Args:
        body: The person's bones.
        positions_m: op14 positions (frame, 14, 3), bones and hips of the body's lengths; upright axes, metres.
        bends: Pose of the other joints by the match; the default pose if not given.
        floor_m: Height of the floor, below which the balls of the feet do not sink.
    """
    poses = np.array(positions_m, dtype=np.float64, order="C")
    trunk = np.ascontiguousarray(bone_rotations(poses)[:, _NECK])
    bends = bends or Bends.none(len(poses))
    bent = np.ascontiguousarray(bends.unitquat)
    nose = np.ascontiguousarray(bends.nose_unitquat)
    return pose_bodies(poses, trunk, bent, nose, body.offsets_m, body.rest_m, floor_m + body.toe_height_m)


def soles_m(bodies: Sequence[EmbodiedMotion]) -> float:
    """Return the mean height of standing ankles over the soles, over all people, metres."""
    return float(np.mean([body.body.ankle_height_m for body in bodies]))


def motions_together(people: Sequence[tuple[int, EmbodiedMotion, Flags]], *, rate_hz: float) -> list[HumanoidMotion]:
    """Return the motions of the people of one video, soles at y = 0, all over the frames from anybody's first to last.

    Args:
        people: For each person the first frame, the body in every frame from there on (upright, standing ankles at
            y = 0), and which of these frames (frame,) are interpolated.
        rate_hz: Frames per second.
    """
    starts, bodies, _ = zip(*people, strict=True)
    ends = [start + len(body.pelvis_m) for start, body in zip(starts, bodies, strict=True)]
    frames = np.arange(min(starts), max(ends))
    soles = soles_m(bodies)
    motions = []
    for first, body, is_bridged in people:
        at = np.clip(frames - first, 0, len(is_bridged) - 1)
        whole = replace(body, pelvis_m=body.pelvis_m[at] + [0.0, soles, 0.0], unitquat=body.unitquat[at])
        is_seen = (frames - first == at) & ~is_bridged[at]
        motions.append(HumanoidMotion(whole.motion(rate_hz), int(frames[0]), is_seen))
    return motions
