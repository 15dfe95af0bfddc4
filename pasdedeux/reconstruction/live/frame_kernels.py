"""One frame at a time, compiled: what live reconstruction does between two images, without the price of array calls.

Each function does for one frame what a function over tracks does elsewhere, which is its oracle in the tests; an array
call costs microseconds whatever its size, and a live frame would make a thousand of them.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.reconstruction.bones import REST_DIRECTIONS
from pasdedeux.skeletons import OP14

__all__ = [
    "filter_rotations",
    "find_bone_rotations",
    "least_squares_scale",
    "metric_of",
    "place_bones",
    "rotate_vector",
    "straighten_frame",
    "transition_costs",
    "turn_from_camera_axis",
    "turn_poses",
    "unify_image",
]

_ORDER = np.array(OP14.order[1:])
_PARENTS = np.array(OP14.parents)
_NECK = OP14.root
_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")
_LEFT_SHOULDER, _RIGHT_SHOULDER = OP14.index("left_shoulder"), OP14.index("right_shoulder")
_REST = np.array(REST_DIRECTIONS)
_JOINTS = OP14.num_joints

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def straighten_frame(points: Array, mid_hip: Array, focal: float) -> tuple[Array, Array]:
    """Do `reconstruct.straighten_rays` for a frame: points (14, 2) as a camera turned to the mid-hip (2,) sees them."""
    towards = (-mid_hip[0], -mid_hip[1], focal)
    towards = _scaled(towards, 1.0 / _length(towards))
    back = _swing(towards, (0.0, 0.0, 1.0))
    straight = np.full(points.shape, np.nan)
    for joint in range(points.shape[0]):
        if np.isfinite(points[joint, 0]) and np.isfinite(points[joint, 1]):
            turned = _rotate(back, (points[joint, 0], points[joint, 1], -focal))
            if -turned[2] > 0.1 * focal:
                straight[joint, 0] = turned[0] / -turned[2] * focal
                straight[joint, 1] = turned[1] / -turned[2] * focal
    return straight, np.array(towards)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turn_from_camera_axis(direction: Array) -> Array:
    """Do `rotations.swing_between` from +Z to a direction (3,): a rotation (4,)."""
    return np.array(_swing((0.0, 0.0, 1.0), (direction[0], direction[1], direction[2])))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rotate_vector(unitquat: Array, vector: Array) -> Array:
    """Do `rotations.rotate` for one vector (3,)."""
    turned = _rotate((unitquat[0], unitquat[1], unitquat[2], unitquat[3]), (vector[0], vector[1], vector[2]))
    return np.array(turned)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unify_image(points: Array, ratio: Array) -> Array:
    """Do `proportions.retarget_image` for a frame: points (14, 2) with every bone divided by its ratio (14,)."""
    moved = points.copy()
    for joint in _ORDER:
        ancestor = _PARENTS[joint]
        while ancestor >= 0 and not (np.isfinite(points[ancestor, 0]) and np.isfinite(points[ancestor, 1])):
            ancestor = _PARENTS[ancestor]
        for axis in range(2):
            old = points[ancestor, axis] if ancestor >= 0 else 0.0
            new = moved[ancestor, axis] if ancestor >= 0 else 0.0
            moved[joint, axis] = new + (points[joint, axis] - old) / ratio[joint]
    for axis in range(2):
        shift = 0.5 * (moved[_LEFT_HIP, axis] + moved[_RIGHT_HIP, axis])
        if not np.isfinite(shift):
            shift = moved[_NECK, axis] * (1.0 - 1.0 / ratio[_LEFT_HIP])
            if not np.isfinite(shift):
                shift = 0.0
        for joint in range(_JOINTS):
            moved[joint, axis] -= shift
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def least_squares_scale(points: Array, weight: Array, match: Array) -> Array:
    """Return what `scale.refine_placement` takes from a frame: metres per pixel, and the weighted means of both images.

    Args:
        points: Joints (14, 2), pixels, y up.
        weight: Weights (14,); 0 where not seen.
        match: Image of the match (14, 2), metres.

    Returns:
        Metres per pixel, mean of the points, mean of the match (5,); NaN for the scale where it cannot be told.
    """
    out = np.zeros(5)
    total, count = 0.0, 0
    for joint in range(points.shape[0]):
        if weight[joint] > 0:
            total += weight[joint]
            count += 1
            for axis in range(2):
                out[1 + axis] += weight[joint] * points[joint, axis]
                out[3 + axis] += weight[joint] * match[joint, axis]
    out[0] = np.nan
    if count < 3:
        return out
    for at in range(1, 5):
        out[at] /= total
    spread_px, spread_m = 0.0, 0.0
    for joint in range(points.shape[0]):
        if weight[joint] > 0:
            for axis in range(2):
                spread_px += weight[joint] * (points[joint, axis] - out[1 + axis]) ** 2
                spread_m += weight[joint] * (match[joint, axis] - out[3 + axis]) ** 2
    if spread_px > 0 and spread_m > 0:
        out[0] = np.sqrt(spread_m / spread_px)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turn_poses(poses: npt.NDArray[np.float32], rows: Integers, yaw_rad: Array) -> Array:
    """Do `Database.turned` for some rows: poses (k, 14, 3) turned by their yaw (k,)."""
    out = np.empty((rows.shape[0], poses.shape[1], 3))
    for at in range(rows.shape[0]):
        cosine, sine = np.cos(yaw_rad[at]), np.sin(yaw_rad[at])
        for joint in range(poses.shape[1]):
            x, z = np.float64(poses[rows[at], joint, 0]), np.float64(poses[rows[at], joint, 2])
            out[at, joint, 0] = cosine * x + sine * z
            out[at, joint, 1] = poses[rows[at], joint, 1]
            out[at, joint, 2] = cosine * z - sine * x
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def metric_of(query: Array, weight: Array, images: Array) -> Array:
    """Return eq. 1 over the joints seen, per unit of weight, of a query (14, 2) to images (k, 14, 2)."""
    out = np.zeros(images.shape[0])
    total = weight.sum()
    for at in range(images.shape[0]):
        for joint in range(query.shape[0]):
            if weight[joint] > 0:
                dx = query[joint, 0] - images[at, joint, 0]
                dy = query[joint, 1] - images[at, joint, 1]
                out[at] += weight[joint] * np.sqrt(dx * dx + dy * dy)
        out[at] /= total
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def transition_costs(pose: Array, ahead: Array, cost: Array, weight: float) -> tuple[Array, Integers]:
    """Return the least cost (k,) of coming to each pose (k, 14, 3), and from which of (j, 14, 3); ties to the lower.

    Args:
        pose: Candidates of this frame.
        ahead: Where those of the last frame go by now.
        cost: Cost of each of those (j,).
        weight: Cost per metre of mean joint distance.
    """
    best = np.full(pose.shape[0], np.inf)
    back = np.zeros(pose.shape[0], dtype=np.int64)
    joints = pose.shape[1]
    for this in range(pose.shape[0]):
        for before in range(ahead.shape[0]):
            if cost[before] >= best[this]:
                continue
            distance = 0.0
            for joint in range(joints):
                dx = pose[this, joint, 0] - ahead[before, joint, 0]
                dy = pose[this, joint, 1] - ahead[before, joint, 1]
                dz = pose[this, joint, 2] - ahead[before, joint, 2]
                distance += np.sqrt(dx * dx + dy * dy + dz * dz)
            total = cost[before] + weight * distance / joints
            if total < best[this]:
                best[this] = total
                back[this] = before
    return best, back


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_bone_rotations(positions: Array) -> Array:
    """Do `bones.bone_rotations` for one pose (14, 3)."""
    local, world = np.empty((_JOINTS, 4)), np.empty((_JOINTS, 4))
    neck, left_hip, right_hip = _at(positions, _NECK), _at(positions, _LEFT_HIP), _at(positions, _RIGHT_HIP)
    hips = _less(left_hip, right_hip)
    shoulders = _less(_at(positions, _LEFT_SHOULDER), _at(positions, _RIGHT_SHOULDER))
    across = (hips[0] + shoulders[0], hips[1] + shoulders[1], hips[2] + shoulders[2])
    up = _less(neck, _scaled(_less(left_hip, _scaled(right_hip, -1.0)), 0.5))
    up = _scaled(up, 1.0 / _length(up)) if _length(up) > 1e-12 else (0.0, 1.0, 0.0)
    across = _less(across, _scaled(up, _dot(across, up)))
    if _length(across) < 1e-9:
        across = (1.0, 0.0, 0.0) if abs(up[0]) < 0.9 else (0.0, 1.0, 0.0)
        across = _less(across, _scaled(up, _dot(across, up)))
    left = _scaled(across, 1.0 / _length(across))
    body = _from_axes(left, up, _cross(left, up))
    _put(local, _NECK, body)
    _put(world, _NECK, body)
    for joint in _ORDER:
        parent = _PARENTS[joint]
        before = _of(world, parent)
        bone = _rotate(_conjugate(before), _less(_at(positions, joint), _at(positions, parent)))
        swing = _swing(_at(_REST, joint), bone)
        _put(local, joint, swing)
        _put(world, joint, _multiply(before, swing))
    return local


@numba.njit(cache=True, nogil=True, error_model="numpy")
def place_bones(unitquat: Array, lengths: Array) -> Array:
    """Do `bones.place_bone_rotations` for one pose: positions (14, 3) about the mid-hip."""
    world, positions = np.empty((_JOINTS, 4)), np.zeros((_JOINTS, 3))
    _put(world, _NECK, _of(unitquat, _NECK))
    for joint in _ORDER:
        parent = _PARENTS[joint]
        turn = _multiply(_of(world, parent), _of(unitquat, joint))
        _put(world, joint, turn)
        bone = _rotate(turn, _at(_REST, joint))
        for axis in range(3):
            positions[joint, axis] = positions[parent, axis] + lengths[joint] * bone[axis]
    for axis in range(3):
        middle = 0.5 * (positions[_LEFT_HIP, axis] + positions[_RIGHT_HIP, axis])
        for joint in range(_JOINTS):
            positions[joint, axis] -= middle
    return positions


@numba.njit(cache=True, nogil=True, error_model="numpy")
def filter_rotations(
    value: Array, velocity: Array, new: Array, rate: float, min_cutoff: float, beta: float, derivative_cutoff: float
) -> tuple[Array, Array]:
    """Do a frame of `smoothing.smooth_one_euro`: the next smoothed rotations (n, 4) and velocities (n, 3), rad/s."""
    smooth, pace = np.empty(value.shape), np.empty(velocity.shape)
    derivative_share = 1.0 / (1.0 + rate / (2.0 * np.pi * derivative_cutoff))
    for at in range(value.shape[0]):
        old = _of(value, at)
        x, y, z, w = _multiply(_of(new, at), _conjugate(old))
        sign = -1.0 if w < 0 else 1.0
        sine = np.sqrt(x * x + y * y + z * z)
        angle = 2.0 * np.arctan2(sine, sign * w)
        axis = _scaled((x, y, z), sign / sine) if sine > 1e-12 else (0.0, 0.0, 0.0)
        for part in range(3):
            pace[at, part] = velocity[at, part] + derivative_share * (axis[part] * angle * rate - velocity[at, part])
        cutoff = min_cutoff + beta * _length(_at(pace, at))
        share = 1.0 / (1.0 + rate / (2.0 * np.pi * cutoff))
        along = _scaled(axis, np.sin(0.5 * share * angle))
        step = (along[0], along[1], along[2], np.cos(0.5 * share * angle))
        _put(smooth, at, _multiply(step, old))
    return smooth, pace


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _at(array: Array, row: int) -> Vector:
    return array[row, 0], array[row, 1], array[row, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _of(array: Array, row: int) -> Quaternion:
    return array[row, 0], array[row, 1], array[row, 2], array[row, 3]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _put(array: Array, row: int, q: Quaternion) -> None:
    array[row, 0], array[row, 1], array[row, 2], array[row, 3] = q


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _less(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scaled(a: Vector, factor: float) -> Vector:
    return a[0] * factor, a[1] * factor, a[2] * factor


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _length(a: Vector) -> float:
    return np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _conjugate(q: Quaternion) -> Quaternion:
    return -q[0], -q[1], -q[2], q[3]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rotate(q: Quaternion, v: Vector) -> Vector:
    axis = (q[0], q[1], q[2])
    twice = _scaled(_cross(axis, v), 2.0)
    third = _cross(axis, twice)
    return v[0] + q[3] * twice[0] + third[0], v[1] + q[3] * twice[1] + third[1], v[2] + q[3] * twice[2] + third[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _swing(start: Vector, end: Vector) -> Quaternion:
    """Do `rotations.swing_between`; the same choices for opposite and empty directions."""
    first, last = _length(start), _length(end)
    if first <= 1e-12 or last <= 1e-12:
        return 0.0, 0.0, 0.0, 1.0
    a, b = _scaled(start, 1.0 / first), _scaled(end, 1.0 / last)
    cosine = _dot(a, b)
    if cosine < -1.0 + 1e-10:
        axis = _cross(a, (1.0, 0.0, 0.0) if abs(a[0]) < 0.9 else (0.0, 1.0, 0.0))
        axis = _scaled(axis, 1.0 / _length(axis))
        return axis[0], axis[1], axis[2], 0.0
    axis = _cross(a, b)
    norm = 1.0 / np.sqrt(_dot(axis, axis) + (1.0 + cosine) ** 2)
    return axis[0] * norm, axis[1] * norm, axis[2] * norm, (1.0 + cosine) * norm


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _from_axes(x: Vector, y: Vector, z: Vector) -> Quaternion:
    """Do `rotations.unitquat_from_rotmat` for the matrix whose columns are these."""
    trace = x[0] + y[1] + z[2]
    most = max(x[0], y[1], z[2], trace)
    if most == x[0]:
        q = (1.0 + 2.0 * x[0] - trace, y[0] + x[1], z[0] + x[2], y[2] - z[1])
    elif most == y[1]:
        q = (y[0] + x[1], 1.0 + 2.0 * y[1] - trace, z[1] + y[2], z[0] - x[2])
    elif most == z[2]:
        q = (z[0] + x[2], z[1] + y[2], 1.0 + 2.0 * z[2] - trace, x[1] - y[0])
    else:
        q = (y[2] - z[1], z[0] - x[2], x[1] - y[0], 1.0 + trace)
    norm = 1.0 / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if q[3] < 0:
        norm = -norm
    return q[0] * norm, q[1] * norm, q[2] * norm, q[3] * norm
