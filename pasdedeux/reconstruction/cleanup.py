"""Clean-up of a reconstructed motion: planted feet stand still, nobody sinks into the floor, bones keep their length.

One camera shows the depth of a person badly, so reconstructed people glide.  Feet on the floor show how the body
moved.  First, the path of the whole body is corrected so that planted feet move least; poses are kept.  Then the legs
reach the remaining way: hips and feet are given, and the knee stays in the plane in which it bends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pasdedeux.arrays import Array, Flags, plain
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.errors import InputError
from pasdedeux.interaction.floor import StandingSettings, find_standing, floor_under
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotation_kernels import Vector, divide, dot, length, put_row, row_of, subtract, weighted_sum
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.retarget import retarget_proportions
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.skeletons import OP14

_LEGS = OP14.legs
_ANKLES = np.array([leg[2] for leg in _LEGS])
_LEFT_HIP, _RIGHT_HIP = (leg[0] for leg in _LEGS)
_UP = 1
_STRAIGHT = 1.0 - 1e-6
"""Largest stretch of a leg, as a part of its length; beyond, the plane of the knee is undefined."""

_MIN_BEND_M = 1e-4


BLEND_S = 0.12
"""Time over which the lock of a foot is blended in and out."""
MAX_BEND_M = 0.04
"""Largest displacement of a foot by bending the leg."""
_MIN_CONTACT_S = 0.1
"""Shorter contacts are dropped."""
_SHIFT_STIFFNESS = 1.0
"""Cost of a second difference of the path's correction; the step of a planted foot costs 1."""
_SHIFT_HOLD = 0.01
"""Cost of the correction."""
_FLOOR_PULL = 0.1
"""Cost of the height of a planted foot over the floor."""
_TOUCH_M = 0.05
"""Largest gap between the bodies of people who touch each other."""
_TOUCH_HOLD = 1.0
"""Cost of moving one of two people who touch but not the other."""


@dataclass(frozen=True)
class CleanedMotion:
    """Motions after clean-up.

    Args:
        positions_m: (frame, *person, 14, 3), upright axes, metres.
        is_planted: Left and right foot on the floor (frame, *person, 2).
        shift_m: Correction of the path of the body (frame, *person, 3).
        floor_m: Height of standing ankles, the same for all people.
    """

    positions_m: Array
    is_planted: Flags
    shift_m: Array
    floor_m: float


def clean_up(positions_m: Array, *, rate_hz: float, is_present: Flags | None = None) -> CleanedMotion:
    """Clean up the motion of a person, or of all people of a video.

    All people stand on one floor; people in the air (see `interaction.floor`) are not put on it.  The paths of people
    who touch are corrected together: a carried person follows the feet of the carrier.

    Args:
        positions_m: op14 positions (frame, *person, 14, 3), upright axes (y up, z towards the camera), metres; of
            absent people, any finite values.
        rate_hz: Frames per second.
        is_present: Whether each person is there (frame, *person); everybody by default.
    """
    if positions_m.ndim not in (3, 4) or positions_m.shape[-2:] != (14, 3) or len(positions_m) == 0:
        raise InputError(f"clean-up: positions have shape {positions_m.shape}, expected (frames, *people, 14, 3)")
    people = positions_m.reshape(len(positions_m), -1, OP14.num_joints, 3)
    present = np.ones(people.shape[:2], dtype=bool) if is_present is None else is_present.reshape(people.shape[:2])
    positions = np.stack(
        [
            retarget_proportions(person, np.median(bone_lengths(OP14, person), axis=0))
            for person in people.swapaxes(0, 1)
        ],
        axis=1,
    )
    feet = positions[:, :, _ANKLES]
    is_planted = find_standing(feet, rate_hz=rate_hz, settings=StandingSettings(), is_present=present)
    _drop_short(is_planted, max(2, round(_MIN_CONTACT_S * rate_hz)))
    floor = floor_under(feet, is_planted, present)
    shift = _correct_paths(feet, is_planted, _touching(positions, present), floor)
    positions = positions + shift[:, :, None]
    for person in range(positions.shape[1]):
        pose = positions[:, person]
        facing = _facings(np.ascontiguousarray(pose))
        for side, (hip, knee, ankle) in enumerate(_LEGS):
            target = _targets(pose[:, ankle], is_planted[:, person, side], floor, rate_hz)
            leg = (plain(pose[:, joint]) for joint in (hip, knee, ankle))
            pose[:, knee], pose[:, ankle] = bend_leg(*leg, target, facing)
    batch = positions_m.shape[:-2]
    return CleanedMotion(
        positions.reshape(positions_m.shape), is_planted.reshape(*batch, 2), shift.reshape(*batch, 3), floor
    )


def _drop_short(is_planted: Flags, num_frames: int) -> None:
    """Remove contacts (frame, person, foot) that last fewer frames."""
    for person, side in np.ndindex(is_planted.shape[1:]):
        for first, last in _runs(is_planted[:, person, side]):
            if last - first < num_frames:
                is_planted[first:last, person, side] = False


def _touching(positions: Array, present: Flags) -> list[tuple[int, int, Flags]]:
    """Return for each couple both numbers, and the frames in which they touch (frame,)."""
    radii = capsule_model(OP14).radii_of(positions)
    touching = []
    for first, second in combinations(range(positions.shape[1]), 2):
        both = [first, second]
        near = surface_gaps(positions[:, both], radii[both], OP14).closest_m < _TOUCH_M
        touching.append((first, second, near & present[:, both].all(axis=1)))
    return touching


@compiled()
def bend_leg(hip_m: Array, knee_m: Array, ankle_m: Array, target_m: Array, fallback: Array) -> tuple[Array, Array]:
    """Return knee and ankle (frame, 3) of legs with the ankle at its target and the same lengths of thigh and shank.

    The knee stays in the plane of hip, knee and ankle, on its side of the line between hip and ankle.  A target out of
    reach is approached along its line.  A straight leg bends towards `fallback` (frame, 3).
    """
    knees, ankles = np.empty(hip_m.shape), np.empty(hip_m.shape)
    for at in range(hip_m.shape[0]):
        hip, knee, ankle, target = row_of(hip_m, at), row_of(knee_m, at), row_of(ankle_m, at), row_of(target_m, at)
        knee, ankle = bend_one_leg(hip, knee, ankle, target, row_of(fallback, at))
        put_row(knees, at, knee)
        put_row(ankles, at, ankle)
    return knees, ankles


@inner_kernel()
def bend_one_leg(start: Vector, middle: Vector, end: Vector, target: Vector, fallback: Vector) -> tuple[Vector, Vector]:
    """Return knee and ankle of one leg; see `bend_leg`."""
    above, old_line, line = subtract(middle, start), subtract(end, start), subtract(target, start)
    thigh, shank = length(above), length(subtract(end, middle))
    old_reach, reach = length(old_line), length(line)
    down = (0.0, -1.0, 0.0)
    old_line = divide(old_line, old_reach) if old_reach > 1e-12 else down
    line = divide(line, reach) if reach > 1e-12 else down
    reach = min(max(reach, abs(thigh - shank) + _MIN_BEND_M), _STRAIGHT * (thigh + shank))
    bend = weighted_sum(1.0, above, -dot(above, old_line), old_line)
    if length(bend) <= _MIN_BEND_M:
        bend = fallback
    pole = weighted_sum(1.0, bend, -dot(bend, line), line)
    size = length(pole)
    pole = divide(pole, size) if size > 1e-12 else (0.0, 0.0, 1.0)
    along = (thigh**2 - shank**2 + reach**2) / (2.0 * reach)
    aside = math.sqrt(max(thigh**2 - along**2, 0.0))
    return weighted_sum(1.0, weighted_sum(1.0, start, along, line), aside, pole), weighted_sum(1.0, start, reach, line)


@inner_kernel()
def facing_of(pose: Array) -> Vector:
    """Return the level direction that the body of a pose (14, 3) faces; +Z if its hips coincide."""
    across = subtract(row_of(pose, _LEFT_HIP), row_of(pose, _RIGHT_HIP))
    facing = (-across[2], 0.0, across[0])
    size = length(facing)
    return divide(facing, size) if size > 1e-9 else (0.0, 0.0, 1.0)


@compiled()
def _facings(poses: Array) -> Array:
    """Return `facing_of` for each pose (frame, 14, 3)."""
    facings = np.empty((poses.shape[0], 3))
    for at in range(poses.shape[0]):
        put_row(facings, at, facing_of(poses[at]))
    return facings


def _correct_paths(feet: Array, is_planted: Flags, touching: Sequence[tuple[int, int, Flags]], floor: float) -> Array:
    """Return the corrections of the paths (frame, person, 3) that minimise squared steps of planted feet.

    Stiffness and hold are added as costs.  Two people who touch are also drawn to the same correction, and planted feet
    to the height of the floor.
    """
    frames, people = feet.shape[:2]
    shift = np.zeros((frames, people, 3))
    if frames < 3 or not is_planted.any():
        return shift
    from scipy.sparse import block_diag, coo_array, diags_array, eye_array, hstack  # here: 0.2 s for planning
    from scipy.sparse.linalg import splu

    step = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(frames - 1, frames))
    bend = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(frames - 2, frames))
    normals, pull = [], np.zeros((frames, people, 3))
    for person in range(people):
        stays = (is_planted[1:, person] & is_planted[:-1, person]).astype(np.float64)  # (frame - 1, foot)
        normals.append(
            _SHIFT_HOLD * eye_array(frames)
            + _SHIFT_STIFFNESS * bend.T @ bend
            + step.T @ diags_array(stays.sum(axis=1)) @ step
        )
        pull[:, person] = -step.T @ (stays[..., None] * np.diff(feet[:, person], axis=0)).sum(axis=1)
    normal = block_diag(normals)
    for first, second, touch in touching:
        at = np.flatnonzero(touch)
        rows, ones = np.arange(len(at)), np.ones(len(at))
        apart = hstack(
            [
                sign * coo_array((ones, (rows, at)), shape=(len(at), frames)) if sign else coo_array((len(at), frames))
                for sign in ((person == first) - (person == second) for person in range(people))
            ]
        )
        normal = normal + _TOUCH_HOLD * apart.T @ apart
    planted = is_planted.astype(np.float64)
    drawn = diags_array(_FLOOR_PULL * planted.sum(axis=2).T.ravel())
    pull[..., _UP] += _FLOOR_PULL * (planted * (floor - feet[..., _UP])).sum(axis=2)
    for axes, matrix in (([0, 2], normal), ([_UP], normal + drawn)):
        solved = splu(matrix.tocsc()).solve(pull[..., axes].swapaxes(0, 1).reshape(-1, len(axes)))
        shift[..., axes] = solved.reshape(people, frames, len(axes)).swapaxes(0, 1)
    return shift


def _targets(ankle: Array, is_planted: Flags, floor: float, rate_hz: float) -> Array:
    """Return the targets of a foot (frame, 3): still while planted, blended in and out, never below the floor."""
    frames = len(ankle)
    blend = max(1, round(BLEND_S * rate_hz))
    move, weight = np.zeros(ankle.shape), np.zeros((frames, 1))
    for first, last in _runs(is_planted):
        place = ankle[first:last].mean(axis=0)
        place[_UP] = max(place[_UP], floor)
        moved = np.zeros(ankle.shape)
        share = np.zeros(frames)
        moved[first:last] = place - ankle[first:last]
        share[first:last] = 1.0
        for step in range(1, blend):
            fade = 0.5 + 0.5 * np.cos(np.pi * step / blend)
            if first - step >= 0:
                moved[first - step], share[first - step] = fade * moved[first], fade
            if last - 1 + step < frames:
                moved[last - 1 + step], share[last - 1 + step] = fade * moved[last - 1], fade
        # Where blends of two contacts meet, each counts by its share.
        move += share[:, None] * moved
        weight += share[:, None]
    move = move / np.maximum(weight, 1.0)
    length = np.linalg.norm(move, axis=-1, keepdims=True)
    move *= np.minimum(1.0, MAX_BEND_M / np.maximum(length, 1e-12))
    target = ankle + move
    target[:, _UP] = np.maximum(target[:, _UP], floor)
    return np.asarray(target)


def _runs(values: Flags) -> list[tuple[int, int]]:
    """Return start and stop (exclusive) of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def clean_reconstructions(
    people: Sequence[ReconstructedTrack], origin_m: Array, camera: DatabaseCamera
) -> list[ReconstructedTrack]:
    """Clean up the reconstructed people of a sequence; standing ankles end at the height of the floor.

    Args:
        people: At least one; camera axes.
        origin_m: Origin of the sequence's frame, see `floor_offset`; its height is the floor (3,), camera axes.
        camera: The database's camera, whose pitch gives the upright axis.
    """
    upright = camera.camera_from_upright_rotmat
    tracks = [person.track for person in people]
    frames = np.arange(min(track.first_frame for track in tracks), 1 + max(track.frames[-1] for track in tracks))
    at = [np.clip(frames, track.frames[0], track.frames[-1]) - track.first_frame for track in tracks]
    present = np.stack([np.isin(frames, track.frames) for track in tracks], axis=1)
    seen = np.stack(
        [(person.positions_m[rows] - origin_m) @ upright for person, rows in zip(people, at, strict=True)], axis=1
    )
    cleaned = clean_up(seen, rate_hz=tracks[0].rate_hz, is_present=present)
    positions = (cleaned.positions_m - np.array([0.0, cleaned.floor_m, 0.0])) @ upright.T + origin_m
    return [person.posed(positions[present[:, number], number]) for number, person in enumerate(people)]
