"""Kernels of the live fit: a few frames fitted together to what was seen of them.

The fit minimises what `fitting.observed_pose.fit_observed` minimises, over the frames of a window: Newton steps on bone
directions and roots, each solved by conjugate gradients, which never builds a matrix.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.reconstruction.live.vote_kernels import flatten_image, prior_of_frame, residuals_of
from pasdedeux.skeletons import OP14

__all__ = ["fit_window", "prepare_window"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_JOINTS = OP14.num_joints
_ROOT = OP14.root
_ORDER = np.array(OP14.order[1:])
_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")
_PARENTS = np.array([max(parent, 0) for parent in OP14.parents])

_DEPTH_HOLD = 1e-2
"""Depth of the whole body is free for parallel rays: a light hand keeps it where it was."""

_CG_STEPS = 30
_CG_TOLERANCE = 0.05


@numba.njit(cache=True, nogil=True, error_model="numpy")
def prepare_window(
    slots: Integers,
    sign: Array,
    ranks: Integers,
    image: Array,
    weight: Array,
    vectors: Array,
    log_weight: Array,
    size: Array,
    deviation: Array,
    distance: Array,
    last_sign: Array,
    fitted: Array,
    lengths: Array,
    proportions: Array,
    kernel: float,
    followed_share: float,
    joint_noise: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return first guesses, images, weights of the image and bones of the candidates for frames at places of a ring.

    A frame that was fitted before starts from there, if its signs are still the same; another one from the image, its
    depths, and the followed candidate where nothing was seen.
    """
    count = slots.shape[0]
    start, bones = np.empty((count, _JOINTS, 3)), np.empty((count, _JOINTS, 3))
    seen, over = np.zeros((count, _JOINTS, 2)), np.zeros((count, _JOINTS))
    for at in range(count):
        slot = slots[at]
        followed = vectors[slot, ranks[at]]
        mean, depth = prior_of_frame(
            size[slot], deviation[slot], sign[at], vectors[slot], log_weight[slot], kernel, lengths
        )
        for joint in range(_JOINTS):
            for axis in range(3):
                one = followed_share * followed[joint, axis] + (1.0 - followed_share) * mean[joint, axis]
                bones[at, joint, axis] = proportions[joint] * one
        is_same = True
        for joint in _ORDER:
            is_same = is_same and last_sign[slot, joint] == sign[at, joint]
        if is_same:
            start[at] = fitted[slot]
            residual = residuals_of(image[slot], fitted[slot], distance[slot])
        else:
            start[at] = _guess(image[slot], followed, depth, proportions, distance[slot])
            residual = np.zeros(_JOINTS)
        for joint in range(_JOINTS):
            last_sign[slot, joint] = sign[at, joint]
            if weight[slot, joint] > 0.0 and np.isfinite(image[slot, joint, 0]):
                seen[at, joint] = image[slot, joint]
                off = residual[joint] / (3.0 * joint_noise[joint])
                over[at, joint] = weight[slot, joint] / (1.0 + off * off) / joint_noise[joint] ** 2
    return start, seen, over, bones


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _guess(image: Array, followed: Array, depth: Array, proportions: Array, distance: float) -> Array:
    """Return a pose (14, 3) across as in the image, in depth as given, middle of the hips at z = 0."""
    pose = np.zeros((_JOINTS, 3))
    for joint in _ORDER:
        pose[joint, 2] = pose[_PARENTS[joint], 2] + proportions[joint] * depth[joint]
    middle = 0.5 * (pose[_LEFT_HIP, 2] + pose[_RIGHT_HIP, 2])
    for joint in range(_JOINTS):
        pose[joint, 2] -= middle
    flat = flatten_image(image, pose, distance)
    for place in range(-1, _ORDER.shape[0]):
        joint = _ROOT if place < 0 else _ORDER[place]
        for axis in range(2):
            pose[joint, axis] = flat[joint, axis]
            if not np.isfinite(flat[joint, axis]):
                pose[joint, axis] = 0.0
                if place >= 0:
                    pose[joint, axis] = pose[_PARENTS[joint], axis] + proportions[joint] * followed[joint, axis]
    return pose


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_window(
    start: Array,
    num_fixed: int,
    lengths: Array,
    image: Array,
    weight: Array,
    bones: Array,
    bone_weight: Array,
    time_weight: Array,
    distance: Array,
    tolerance: float,
    most_solves: int,
) -> Array:
    """Return the poses (n, 14, 3) of least energy near a first guess, the first `num_fixed` of them as they are.

    Args:
        start: First guess (n, 14, 3), camera axes, metres.
        num_fixed: Poses that were given out already.
        lengths: Bone lengths (14,), kept.
        image: Observed joints (n, 14, 2), metres at z = 0.
        weight: Over the variance of each (n, 14); 0 where not seen.
        bones: Bones as retrieved (n, 14, 3).
        bone_weight: Over their variance (n,).
        time_weight: Over the variance of the second difference that ends in each frame (n,); 0 where there is none.
        distance: Distance of the camera from z = 0 (n,).
        tolerance: Ends when a step lowers the energy by less than this share.
        most_solves: Steps at most.
    """
    count = start.shape[0]
    vector, root = np.zeros((count, _JOINTS, 3)), np.empty((count, 3))
    for at in range(count):
        root[at] = start[at, _ROOT]
        for joint in _ORDER:
            squared = 0.0
            for axis in range(3):
                vector[at, joint, axis] = start[at, joint, axis] - start[at, _PARENTS[joint], axis]
                squared += vector[at, joint, axis] ** 2
            for axis in range(3):
                vector[at, joint, axis] *= lengths[joint] / np.sqrt(squared)
    position = _placed(vector, root)
    diagonal = _diagonal(weight, bone_weight, time_weight, num_fixed)
    damping = 1e-4
    for _ in range(most_solves):
        target = np.empty((count, _JOINTS, 3))
        for at in range(count):
            for joint in range(_JOINTS):
                shrink = 1.0 - position[at, joint, 2] / distance[at]
                target[at, joint, 0] = image[at, joint, 0] * shrink
                target[at, joint, 1] = image[at, joint, 1] * shrink
                target[at, joint, 2] = position[at, joint, 2]
        energy = _energy(position, vector, target, weight, bones, bone_weight, time_weight, num_fixed)
        off = position.copy()
        _move(off, -1.0, target)
        joint_pull = _pull(off, weight, time_weight, position, num_fixed)
        pull = _carried(joint_pull)
        for at in range(num_fixed, count):
            for joint in _ORDER:
                for axis in range(3):
                    pull[at, joint, axis] += bone_weight[at] * (vector[at, joint, axis] - bones[at, joint, axis])
        bend = np.zeros((count, _JOINTS))
        for at in range(num_fixed, count):
            for joint in _ORDER:
                along = 0.0
                for axis in range(3):
                    along += pull[at, joint, axis] * vector[at, joint, axis]
                bend[at, joint] = max(-along / lengths[joint] ** 2, 0.0)
        _flatten(pull, vector, lengths)
        is_lower = False
        for _ in range(4):
            step = _solve(pull, vector, lengths, weight, bone_weight, time_weight, bend, diagonal, damping, num_fixed)
            new_vector, new_root = np.zeros(vector.shape), root.copy()
            for at in range(count):
                if at < num_fixed:
                    new_vector[at] = vector[at]
                    continue
                for axis in range(3):
                    new_root[at, axis] -= step[at, _ROOT, axis]
                for joint in _ORDER:
                    squared = 0.0
                    for axis in range(3):
                        new_vector[at, joint, axis] = vector[at, joint, axis] - step[at, joint, axis]
                        squared += new_vector[at, joint, axis] ** 2
                    for axis in range(3):
                        new_vector[at, joint, axis] *= lengths[joint] / np.sqrt(squared)
            new_position = _placed(new_vector, new_root)
            new_energy = _energy(new_position, new_vector, target, weight, bones, bone_weight, time_weight, num_fixed)
            if new_energy <= energy:
                is_lower = True
                break
            damping *= 10.0
        if not is_lower:
            break
        vector, root, position = new_vector, new_root, new_position
        damping = max(0.1 * damping, 1e-6)
        if energy - new_energy <= tolerance * energy:
            break
    return position


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _placed(vector: Array, root: Array) -> Array:
    """Return positions (n, 14, 3) of bones and roots."""
    position = np.empty(vector.shape)
    for at in range(vector.shape[0]):
        for axis in range(3):
            position[at, _ROOT, axis] = root[at, axis]
        for joint in _ORDER:
            for axis in range(3):
                position[at, joint, axis] = position[at, _PARENTS[joint], axis] + vector[at, joint, axis]
    return position


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carried(pull: Array) -> Array:
    """Sum what pulls on joints (n, 14, 3) over the joints that each bone carries; the root carries all."""
    out = pull.copy()
    for at in range(pull.shape[0]):
        for place in range(_ORDER.shape[0] - 1, -1, -1):
            joint = _ORDER[place]
            for axis in range(3):
                out[at, _PARENTS[joint], axis] += out[at, joint, axis]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pull(off: Array, weight: Array, time_weight: Array, moved: Array, num_fixed: int) -> Array:
    """Return half the gradient on joints of image (by `off`) and time (by `moved`); none on fixed frames."""
    out = np.zeros(off.shape)
    count = off.shape[0]
    for at in range(num_fixed, count):
        for joint in range(_JOINTS):
            out[at, joint, 0] = weight[at, joint] * off[at, joint, 0]
            out[at, joint, 1] = weight[at, joint] * off[at, joint, 1]
            out[at, joint, 2] = _DEPTH_HOLD * off[at, joint, 2]
    for at in range(2, count):
        if time_weight[at] <= 0.0:
            continue
        for joint in range(_JOINTS):
            for axis in range(3):
                second = moved[at, joint, axis] - 2.0 * moved[at - 1, joint, axis] + moved[at - 2, joint, axis]
                second *= time_weight[at]
                if at >= num_fixed:
                    out[at, joint, axis] += second
                if at - 1 >= num_fixed:
                    out[at - 1, joint, axis] -= 2.0 * second
                if at - 2 >= num_fixed:
                    out[at - 2, joint, axis] += second
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _energy(
    position: Array,
    vector: Array,
    target: Array,
    weight: Array,
    bones: Array,
    bone_weight: Array,
    time_weight: Array,
    num_fixed: int,
) -> float:
    total = 0.0
    for at in range(position.shape[0]):
        for joint in range(_JOINTS):
            if at >= num_fixed:
                for axis in range(3):
                    own = weight[at, joint] if axis < 2 else _DEPTH_HOLD
                    total += own * (position[at, joint, axis] - target[at, joint, axis]) ** 2
                    if joint != _ROOT:
                        total += bone_weight[at] * (vector[at, joint, axis] - bones[at, joint, axis]) ** 2
            if at >= 2 and time_weight[at] > 0.0:
                for axis in range(3):
                    second = (
                        position[at, joint, axis] - 2.0 * position[at - 1, joint, axis] + position[at - 2, joint, axis]
                    )
                    total += time_weight[at] * second * second
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _diagonal(weight: Array, bone_weight: Array, time_weight: Array, num_fixed: int) -> Array:
    """Return the curvature along each bone and root (n, 14, 3) if nothing else moved."""
    count = weight.shape[0]
    out = np.zeros((count, _JOINTS, 3))
    for at in range(num_fixed, count):
        over_time = time_weight[at]
        if at + 1 < count:
            over_time += 4.0 * time_weight[at + 1]
        if at + 2 < count:
            over_time += time_weight[at + 2]
        for joint in range(_JOINTS):
            out[at, joint, 0] = weight[at, joint] + over_time
            out[at, joint, 1] = weight[at, joint] + over_time
            out[at, joint, 2] = _DEPTH_HOLD + over_time
    out = _carried(out)
    for at in range(num_fixed, count):
        for joint in _ORDER:
            for axis in range(3):
                out[at, joint, axis] += bone_weight[at]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flatten(change: Array, vector: Array, lengths: Array) -> None:
    """Take out of a change of bones (n, 14, 3) what is along them, in place; roots are free."""
    for at in range(change.shape[0]):
        for joint in _ORDER:
            along = 0.0
            for axis in range(3):
                along += change[at, joint, axis] * vector[at, joint, axis]
            along /= lengths[joint] ** 2
            for axis in range(3):
                change[at, joint, axis] -= along * vector[at, joint, axis]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(
    pull: Array,
    vector: Array,
    lengths: Array,
    weight: Array,
    bone_weight: Array,
    time_weight: Array,
    bend: Array,
    diagonal: Array,
    damping: float,
    num_fixed: int,
) -> Array:
    """Solve curvature x step = pull by conjugate gradients on the tangents, to a twentieth of the pull."""
    count = pull.shape[0]
    step = np.zeros(pull.shape)
    rest = pull.copy()
    for at in range(num_fixed):
        for joint in range(_JOINTS):
            for axis in range(3):
                rest[at, joint, axis] = 0.0
    ready = _eased(rest, diagonal, bend, vector, lengths, damping, num_fixed)
    way = ready.copy()
    product = _inner(rest, ready)
    goal = _CG_TOLERANCE**2 * product
    for _ in range(_CG_STEPS):
        if product <= goal or product <= 0.0:
            break
        root = np.empty((count, 3))
        for at in range(count):
            for axis in range(3):
                root[at, axis] = way[at, _ROOT, axis]
        moved = _placed(way, root)
        curved = _carried(_pull(moved, weight, time_weight, moved, num_fixed))
        for at in range(num_fixed, count):
            for joint in range(_JOINTS):
                own = 0.0 if joint == _ROOT else bone_weight[at] + bend[at, joint]
                for axis in range(3):
                    curved[at, joint, axis] += (own + damping * diagonal[at, joint, axis]) * way[at, joint, axis]
        _flatten(curved, vector, lengths)
        against = _inner(way, curved)
        if against <= 0.0:
            break
        length = product / against
        _move(step, length, way)
        _move(rest, -length, curved)
        ready = _eased(rest, diagonal, bend, vector, lengths, damping, num_fixed)
        new_product = _inner(rest, ready)
        _move(ready, new_product / product, way)
        way = ready
        product = new_product
    return step


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inner(a: Array, b: Array) -> float:
    total = 0.0
    for at in range(a.shape[0]):
        for joint in range(a.shape[1]):
            for axis in range(a.shape[2]):
                total += a[at, joint, axis] * b[at, joint, axis]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move(a: Array, share: float, b: Array) -> None:
    """Add a share of another array, in place."""
    for at in range(a.shape[0]):
        for joint in range(a.shape[1]):
            for axis in range(a.shape[2]):
                a[at, joint, axis] += share * b[at, joint, axis]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _eased(
    rest: Array, diagonal: Array, bend: Array, vector: Array, lengths: Array, damping: float, num_fixed: int
) -> Array:
    """Precondition by the diagonal, on the tangents."""
    out = np.zeros(rest.shape)
    for at in range(num_fixed, rest.shape[0]):
        for joint in range(_JOINTS):
            for axis in range(3):
                out[at, joint, axis] = rest[at, joint, axis] / (
                    (1.0 + damping) * diagonal[at, joint, axis] + bend[at, joint]
                )
    _flatten(out, vector, lengths)
    return out
