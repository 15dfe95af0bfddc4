"""Kernels of what each frame of the live fit says on its own: its noise, and votes of its candidates on depth."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.reconstruction.depth import SIGN_GROUPS
from pasdedeux.skeletons import OP14

__all__ = [
    "NUM_SIGN_STATES",
    "bones_of",
    "extend_signs",
    "flatten_image",
    "noise_of",
    "prior_of_frame",
    "residuals_of",
    "trace_signs",
    "vote_signs",
]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_JOINTS = OP14.num_joints
_ORDER = np.array(OP14.order[1:])
_PARENTS = np.array([max(parent, 0) for parent in OP14.parents])

_GROUP_JOINTS = np.array([joint for group in SIGN_GROUPS for joint in group])
_GROUP_SIZES = np.array([len(group) for group in SIGN_GROUPS])
_FIRST_JOINT = np.concatenate([[0], np.cumsum(_GROUP_SIZES)])
_FIRST_STATE = np.concatenate([[0], np.cumsum(2**_GROUP_SIZES)])
NUM_SIGN_STATES = int(_FIRST_STATE[-1])
"""Choices of signs of all groups of bones together, one group after the other."""

_LEAST_WEIGHT = 1e-12


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
    """Return the cost of each choice of signs of a new frame, and the choice before that it is best come to from.

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
    """Return sign of each bone's depth (n, 14) in frames at these places of a ring, by the best path to the last."""
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
    """Return each bone as candidates of its sign have it (14, 3) and its depth as image and candidates say (14,)."""
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
    """Return how far each joint (14,) of a pose (14, 3) is from its image (14, 2); NaN where not seen."""
    flat = flatten_image(image, pose, distance)
    out = np.empty(_JOINTS)
    for joint in range(_JOINTS):
        out[joint] = np.hypot(flat[joint, 0] - pose[joint, 0], flat[joint, 1] - pose[joint, 1])
    return out
