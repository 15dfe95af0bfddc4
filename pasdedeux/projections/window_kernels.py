"""Kernels of the live fit: votes of a frame's candidates on depth, and the fit of a few frames to what was seen.

The fit minimises what `fitting.observed_pose.fit_observed` minimises, over the frames of a window: Newton steps on bone
directions and roots, each solved by conjugate gradients, which never builds a matrix.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.projections.depth import SIGN_GROUPS
from pasdedeux.skeletons import OP14

__all__ = [
    "NUM_SIGN_STATES",
    "bones_of",
    "extend_signs",
    "fit_window",
    "flatten_image",
    "noise_of",
    "prepare_window",
    "prior_of_frame",
    "residuals_of",
    "trace_signs",
    "vote_signs",
]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Booleans = npt.NDArray[np.bool_]

_JOINTS = OP14.num_joints
_ROOT = OP14.root
_ORDER = np.array(OP14.order[1:])
_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")
_PARENTS = np.array([max(parent, 0) for parent in OP14.parents])

_GROUP_JOINTS = np.array([joint for group in SIGN_GROUPS for joint in group])
_GROUP_SIZES = np.array([len(group) for group in SIGN_GROUPS])
_FIRST_JOINT = np.concatenate([[0], np.cumsum(_GROUP_SIZES)])
_FIRST_STATE = np.concatenate([[0], np.cumsum(2**_GROUP_SIZES)])
NUM_SIGN_STATES = int(_FIRST_STATE[-1])
"""Choices of signs of all groups of bones together, one group after the other."""

_LEAST_WEIGHT = 1e-12
_DEPTH_HOLD = 1e-2
"""Depth of the whole body is free for parallel rays: a light hand keeps it where it was."""

_CG_STEPS = 30
_CG_TOLERANCE = 0.05


@numba.njit(cache=True, nogil=True, error_model="numpy")
def noise_of(images: Array, frames: Integers) -> float:
    """Do `image_noise` for the last images (n, 14, 2), NaN where not seen, of frames in order (n,); 0 for too few."""
    count = 0
    size = np.empty(2 * images.shape[0] * _JOINTS)
    for at in range(3, images.shape[0]):
        if frames[at] != frames[at - 3] + 3:
            continue
        for joint in range(_JOINTS):
            for axis in range(2):
                third = (
                    images[at, joint, axis]
                    - 3.0 * images[at - 1, joint, axis]
                    + 3.0 * images[at - 2, joint, axis]
                    - images[at - 3, joint, axis]
                )
                if np.isfinite(third):
                    size[count] = abs(third)
                    count += 1
    if count < 10:
        return 0.0
    return np.median(size[:count]) / 0.6745 / np.sqrt(20.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def vote_signs(
    image: Array, lengths: Array, vectors: Array, log_weight: Array, noise: float, kernel: float, floor: float
) -> tuple[Array, Array, Array]:
    """Do the votes of `depth.decode_depths` for a frame.

    Args:
        image: Joints (14, 2), metres, in the proportions of the candidates; NaN where not seen.
        lengths: Bone lengths (14,).
        vectors: Bones of the candidates (k, 14, 3).
        log_weight: Log of the weight of each candidate (k,).
        noise: Standard deviation of the image.
        kernel: Width of the kernel over depths.
        floor: Share of the votes that all signs get.

    Returns:
        Size of each bone's depth (14,), its standard deviation, infinite where an end is not seen, and the log
        likelihood of each choice of signs.
    """
    size, deviation = np.zeros(_JOINTS), np.empty(_JOINTS)
    deviation[:] = np.inf
    for joint in _ORDER:
        dx = image[joint, 0] - image[_PARENTS[joint], 0]
        dy = image[joint, 1] - image[_PARENTS[joint], 1]
        if np.isfinite(dx) and np.isfinite(dy):
            size[joint] = np.sqrt(max(lengths[joint] ** 2 - dx * dx - dy * dy, 0.0))
            spread = 2.0 * lengths[joint] * np.sqrt(2.0) * noise
            deviation[joint] = min(spread / (2.0 * max(size[joint], 1e-6)), 0.7 * np.sqrt(spread))
    score = np.zeros(NUM_SIGN_STATES)
    total = 0.0
    for candidate in range(vectors.shape[0]):
        weight = np.exp(log_weight[candidate])
        if weight < _LEAST_WEIGHT:
            continue
        total += weight
        for group in range(_GROUP_SIZES.shape[0]):
            bones = _GROUP_SIZES[group]
            for state in range(1 << bones):
                exponent = 0.0
                for bone in range(bones):
                    joint = _GROUP_JOINTS[_FIRST_JOINT[group] + bone]
                    signed = size[joint] if (state >> bone) & 1 else -size[joint]
                    own = deviation[joint] if np.isfinite(deviation[joint]) else lengths[joint]
                    away = vectors[candidate, joint, 2] - signed
                    exponent += away * away / (kernel * kernel + own * own)
                score[_FIRST_STATE[group] + state] += weight * np.exp(-0.5 * exponent)
    for state in range(NUM_SIGN_STATES):
        score[state] = np.log(score[state] + floor * total) if total > 0 else 0.0
    return size, deviation, score


@numba.njit(cache=True, nogil=True, error_model="numpy")
def extend_signs(
    before_cost: Array,
    before_size: Array,
    before_deviation: Array,
    size: Array,
    deviation: Array,
    score: Array,
    lengths: Array,
    way: float,
) -> tuple[Array, Integers]:
    """Give the cost of each choice of signs of a new frame, and the choice before that it is best come to from.

    What it costs a bone to change sign is `depth._flip_costs`; `way` is what its end moves in depth between the frames.
    """
    cost, back = np.empty(NUM_SIGN_STATES), np.zeros(NUM_SIGN_STATES, dtype=np.int64)
    change = np.empty(1 << _GROUP_SIZES.max())
    for group in range(_GROUP_SIZES.shape[0]):
        bones, first = _GROUP_SIZES[group], _FIRST_STATE[group]
        for state in range(1 << bones):
            change[state] = 0.0
            for bone in range(bones):
                if (state >> bone) & 1:
                    joint = _GROUP_JOINTS[_FIRST_JOINT[group] + bone]
                    own = deviation[joint] if np.isfinite(deviation[joint]) else lengths[joint]
                    old = before_deviation[joint] if np.isfinite(before_deviation[joint]) else lengths[joint]
                    change[state] += 2.0 * size[joint] * before_size[joint] / (way * way + own * own + old * old)
        for state in range(1 << bones):
            least, best = np.inf, 0
            for before in range(1 << bones):
                total = before_cost[first + before] + change[state ^ before]
                if total < least:
                    least, best = total, before
            cost[first + state] = least - score[first + state]
            back[first + state] = best
        # Only differences count; without this a long night would eat the digits.
        cost[first : first + (1 << bones)] -= cost[first : first + (1 << bones)].min()
    return cost, back


@numba.njit(cache=True, nogil=True, error_model="numpy")
def trace_signs(cost: Array, back: Integers, slots: Integers) -> Array:
    """Give the sign of each bone's depth (n, 14) in frames at these places of a ring, by the best path to the last."""
    count = slots.shape[0]
    sign = np.ones((count, _JOINTS))
    for group in range(_GROUP_SIZES.shape[0]):
        first, bones = _FIRST_STATE[group], _GROUP_SIZES[group]
        state = np.argmin(cost[slots[count - 1], first : first + (1 << bones)])
        for at in range(count - 1, -1, -1):
            for bone in range(bones):
                sign[at, _GROUP_JOINTS[_FIRST_JOINT[group] + bone]] = 1.0 if (state >> bone) & 1 else -1.0
            state = back[slots[at], first + state]
    return sign


@numba.njit(cache=True, nogil=True, error_model="numpy")
def prior_of_frame(
    size: Array, deviation: Array, sign: Array, vectors: Array, log_weight: Array, kernel: float, lengths: Array
) -> tuple[Array, Array]:
    """Give each bone as the candidates of its sign have it (14, 3), and its depth as image and candidates say (14,)."""
    mean, depth = np.zeros((_JOINTS, 3)), np.zeros(_JOINTS)
    share = np.empty(vectors.shape[0])
    for joint in _ORDER:
        is_seen = np.isfinite(deviation[joint])
        own = deviation[joint] if is_seen else lengths[joint]
        signed = sign[joint] * size[joint]
        width = kernel * kernel + own * own
        most = -np.inf
        for at in range(vectors.shape[0]):
            share[at] = log_weight[at] - 0.5 * (vectors[at, joint, 2] - signed) ** 2 / width
            most = max(most, share[at])
        total = 0.0
        for at in range(vectors.shape[0]):
            weight = np.exp(share[at] - most)
            total += weight
            for axis in range(3):
                mean[joint, axis] += weight * vectors[at, joint, axis]
        for axis in range(3):
            mean[joint, axis] /= total
        if is_seen:
            # The image says how deep where it is sharp, the candidates where the bone lies in the image.
            by_image, by_votes = 1.0 / max(2.0 * own, 1e-4) ** 2, 1.0 / (kernel * kernel)
            depth[joint] = (signed * by_image + mean[joint, 2] * by_votes) / (by_image + by_votes)
        else:
            depth[joint] = mean[joint, 2]
    return mean, depth


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bones_of(poses: Array) -> Array:
    """Do `depth.bone_vectors` for poses (k, 14, 3)."""
    out = np.zeros(poses.shape)
    for at in range(poses.shape[0]):
        for joint in _ORDER:
            for axis in range(3):
                out[at, joint, axis] = poses[at, joint, axis] - poses[at, _PARENTS[joint], axis]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def flatten_image(image: Array, pose: Array, distance: float) -> Array:
    """Undo perspective in an image (14, 2) at the depths of a pose (14, 3): what is nearer looks larger than it is."""
    out = np.empty(image.shape)
    for joint in range(_JOINTS):
        shrink = 1.0 - pose[joint, 2] / distance
        out[joint, 0] = image[joint, 0] * shrink
        out[joint, 1] = image[joint, 1] * shrink
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def residuals_of(image: Array, pose: Array, distance: float) -> Array:
    """Give how far each joint (14,) of a pose (14, 3) is from its image (14, 2); NaN where not seen."""
    flat = flatten_image(image, pose, distance)
    out = np.empty(_JOINTS)
    for joint in range(_JOINTS):
        out[joint] = np.hypot(flat[joint, 0] - pose[joint, 0], flat[joint, 1] - pose[joint, 1])
    return out


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
    """Give first guesses, images, weights of the image and bones of the candidates for frames at places of a ring.

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
    """Give a pose (14, 3) across as in the image, in depth as given, middle of the hips at z = 0."""
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
    """Give the poses (n, 14, 3) of least energy near a first guess, the first `num_fixed` of them as they are.

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
    """Give positions (n, 14, 3) of bones and roots."""
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
    """Give half the gradient on joints of image (by `off`) and time (by `moved`); none on fixed frames."""
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
    """Give the curvature along each bone and root (n, 14, 3) if nothing else moved."""
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
