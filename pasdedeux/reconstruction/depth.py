"""Depth of every bone from its image and the candidates of a search.

The image of a bone of known length shows how far it leaves the image plane, |dz| = sqrt(L^2 - |dxy|^2), but not to
which side.  The candidates vote: for each group of bones (trunk, arms, legs) and each choice of signs s, the likelihood
of a frame is the kernel density of the candidates' depths at s |dz|, weighted by how well they match the image.
Viterbi over time lets a sign change only where |dz| is small enough to pass through zero.  The signs of a group are
chosen together, because hips and shoulders turn together and a knee bends one way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers, plain
from pasdedeux.compiled import compiled
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M
from pasdedeux.skeletons import OP14

_PARENTS = np.array([max(parent, 0) for parent in OP14.parents])
_SIGN_GROUPS = tuple(
    tuple(OP14.indices(names))
    for names in (
        ("head", "left_shoulder", "right_shoulder", "left_hip", "right_hip"),
        ("left_elbow", "left_wrist", "right_elbow", "right_wrist"),
        ("left_knee", "left_ankle", "right_knee", "right_ankle"),
    )
)
_JOINTS = OP14.num_joints
_LENGTHS_M = REFERENCE_LENGTHS_M
_ORDER = np.array(OP14.order[1:])
_GROUP_JOINTS = np.array([joint for group in _SIGN_GROUPS for joint in group])
_GROUP_SIZES = np.array([len(group) for group in _SIGN_GROUPS])
_FIRST_JOINT = np.concatenate([[0], np.cumsum(_GROUP_SIZES)])
_FIRST_STATE = np.concatenate([[0], np.cumsum(2**_GROUP_SIZES)])
_NUM_SIGN_STATES = int(_FIRST_STATE[-1])
_MOST_STATES = int(2 ** _GROUP_SIZES.max())
"""Number of choices of signs of all groups; states list one group after the other."""

_MIN_WEIGHT = 1e-12
_MISFIT_M = 0.02
"""Candidates whose image is this much worse than the best have weight 1/e."""
_KERNEL_M = 0.03
"""Width of the kernel over depths, chosen by leave-one-out on clips of a database."""
_SPEED_M_S = 0.7
"""Standard deviation of the speed of a bone's end in depth."""
_FLOOR = 1e-4
"""Share of the votes given to every choice of signs, so that none is impossible."""


@dataclass(frozen=True)
class SignStep:
    """One frame in the choice of signs over time.

    Args:
        vectors_m: Bones of the candidates (k, 14, 3).
        log_weight: Log of the weight of each (k,).
        size_m: Size of each bone's depth by the image (14,).
        deviation_m: Its standard deviation (14,), infinite where an end is not seen.
        cost: Least cost of a path to each choice of signs (state,), one group after the other.
        back: Predecessor of each choice on that path (state,).
    """

    vectors_m: Array
    log_weight: Array
    size_m: Array
    deviation_m: Array
    cost: Array
    back: Integers


def bone_vectors(positions: Array) -> Array:
    """Return the vector of the bone that ends in each joint (*batch, 14, d) of op14 positions; 0 for the root."""
    vectors = positions - positions[..., _PARENTS, :]
    vectors[..., OP14.root, :] = 0.0
    return np.ascontiguousarray(vectors)


def place_depths(observed_m: Array, depth_m: Array) -> Array:
    """Return positions (*batch, 14, 3): x and y as observed (*batch, 14, 2), bones of these depths, root at z = 0."""
    depth = np.zeros(depth_m.shape)
    for joint in OP14.order[1:]:
        depth[..., joint] = depth[..., OP14.parents[joint]] + depth_m[..., joint]
    return np.concatenate([observed_m, depth[..., None]], axis=-1)


def vote_on_signs(
    before: SignStep | None, image_m: Array, candidates_m: Array, misfit_m: Array, *, noise_m: float, passed_s: float
) -> SignStep:
    """Let the candidates of one frame vote on the signs of depths.

    Args:
        before: The frame before; None for the first.
        image_m: Joints (14, 2), metres, in the proportions of the reference; NaN where not seen.
        candidates_m: Candidate poses (k, 14, 3), camera axes, reference proportions, metres.
        misfit_m: Distance of each candidate, less that of the best (k,), metres; inf where there is none.
        noise_m: Standard deviation of the joints.
        passed_s: Time since the frame before.
    """
    vectors, log_weight = bone_vectors(candidates_m), -misfit_m / _MISFIT_M
    size, deviation, score = _vote_signs(plain(image_m), vectors, log_weight, noise_m)
    if before is None:
        cost, back = -score, np.zeros(_NUM_SIGN_STATES, dtype=np.int64)
    else:
        old, moved = (before.cost, before.size_m, before.deviation_m), _SPEED_M_S * passed_s
        cost, back = _extend_signs(*old, size, deviation, score, moved)
    return SignStep(vectors, log_weight, size, deviation, cost, back)


def trace_signs(steps: Sequence[SignStep]) -> Array:
    """Return the sign of each bone's depth (frame, 14) by the best path to the last of these frames."""
    return _trace_signs(steps[-1].cost, np.stack([step.back for step in steps]))


def bones_by_votes(step: SignStep, sign: Array) -> tuple[Array, Array]:
    """Return each bone by the candidates of its sign (14, 3), and its depth by image and candidates (14,)."""
    return _prior_of_frame(step.size_m, step.deviation_m, sign, step.vectors_m, step.log_weight)


def decode_depths(
    observed_m: Array, candidates_m: Array, misfit_m: Array, *, noise_m: float, rate_hz: float
) -> tuple[Array, Array]:
    """Return the bones of a track by candidates and image.

    Args:
        observed_m: Joints in the image (frame, 14, 2), metres, reference proportions; NaN where not seen.
        candidates_m: Candidate poses (frame, k, 14, 3), camera axes, reference proportions, metres.
        misfit_m: Distance of each candidate, less that of the best (frame, k), metres; inf where there is none.
        noise_m: Standard deviation of the observed joints.
        rate_hz: Frames per second.

    Returns:
        Vector of each bone by the candidates of the same sign (frame, 14, 3), and depth of the bone that ends in each
        joint (frame, 14), towards the camera positive; 0 for the root.
    """
    steps: list[SignStep] = []
    for seen, candidates, misfit in zip(observed_m, candidates_m, misfit_m, strict=True):
        before = steps[-1] if steps else None
        steps.append(vote_on_signs(before, seen, candidates, misfit, noise_m=noise_m, passed_s=1.0 / rate_hz))
    bones = [bones_by_votes(step, sign) for step, sign in zip(steps, trace_signs(steps), strict=True)]
    return np.stack([vector for vector, _ in bones]), np.stack([depth for _, depth in bones])


@compiled()
def _vote_signs(image: Array, vectors: Array, log_weight: Array, noise: float) -> tuple[Array, Array, Array]:
    """Return the size of each bone's depth by the image (14,), its deviation, and the votes of the candidates.

    The deviation is infinite where an end is not seen.  Votes are the log likelihood of each choice of signs (state,).
    """
    size, deviation = np.zeros(_JOINTS), np.empty(_JOINTS)
    deviation[:] = np.inf
    for joint in _ORDER:
        dx = image[joint, 0] - image[_PARENTS[joint], 0]
        dy = image[joint, 1] - image[_PARENTS[joint], 1]
        if np.isfinite(dx) and np.isfinite(dy):
            size[joint] = np.sqrt(max(_LENGTHS_M[joint] ** 2 - dx * dx - dy * dy, 0.0))
            spread = 2.0 * _LENGTHS_M[joint] * np.sqrt(2.0) * noise
            deviation[joint] = min(spread / (2.0 * max(size[joint], 1e-6)), 0.7 * np.sqrt(spread))
    score = np.zeros(_NUM_SIGN_STATES)
    total = 0.0
    for candidate in range(vectors.shape[0]):
        weight = np.exp(log_weight[candidate])
        if weight < _MIN_WEIGHT:
            continue
        total += weight
        for group in range(_GROUP_SIZES.shape[0]):
            bones = _GROUP_SIZES[group]
            for state in range(1 << bones):
                exponent = 0.0
                for bone in range(bones):
                    joint = _GROUP_JOINTS[_FIRST_JOINT[group] + bone]
                    signed = size[joint] if (state >> bone) & 1 else -size[joint]
                    width = deviation[joint] if np.isfinite(deviation[joint]) else _LENGTHS_M[joint]
                    away = vectors[candidate, joint, 2] - signed
                    exponent += away * away / (_KERNEL_M * _KERNEL_M + width * width)
                score[_FIRST_STATE[group] + state] += weight * np.exp(-0.5 * exponent)
    for state in range(_NUM_SIGN_STATES):
        score[state] = np.log(score[state] + _FLOOR * total) if total > 0 else 0.0
    return size, deviation, score


@compiled()
def _extend_signs(
    old_cost: Array, old_size: Array, old_deviation: Array, size: Array, deviation: Array, score: Array, moved: float
) -> tuple[Array, Integers]:
    """Return the least cost of each choice of signs of a new frame, and its predecessor on the best path.

    A change of sign costs how much further the end of the bone moves when it flips, |a + b|^2 - |a - b|^2 = 4 a b;
    `moved` is the usual motion of the end in depth between the frames.
    """
    cost, back = np.empty(_NUM_SIGN_STATES), np.zeros(_NUM_SIGN_STATES, dtype=np.int64)
    change = np.empty(_MOST_STATES)
    for group in range(_GROUP_SIZES.shape[0]):
        bones, first = _GROUP_SIZES[group], _FIRST_STATE[group]
        for state in range(1 << bones):
            change[state] = 0.0
            for bone in range(bones):
                if (state >> bone) & 1:
                    joint = _GROUP_JOINTS[_FIRST_JOINT[group] + bone]
                    spread = deviation[joint] if np.isfinite(deviation[joint]) else _LENGTHS_M[joint]
                    old = old_deviation[joint] if np.isfinite(old_deviation[joint]) else _LENGTHS_M[joint]
                    change[state] += 2.0 * size[joint] * old_size[joint] / (moved * moved + spread * spread + old * old)
        for state in range(1 << bones):
            least, best = np.inf, 0
            for before in range(1 << bones):
                total = old_cost[first + before] + change[state ^ before]
                if total < least:
                    least, best = total, before
            cost[first + state] = least - score[first + state]
            back[first + state] = best
        # Only differences count; without this, costs of long videos would lose digits.
        cost[first : first + (1 << bones)] -= cost[first : first + (1 << bones)].min()
    return cost, back


@compiled()
def _trace_signs(cost: Array, back: Integers) -> Array:
    """Return the sign of each bone's depth (n, 14) on the best path to the last frame, whose choices cost `cost`."""
    count = back.shape[0]
    sign = np.ones((count, _JOINTS))
    for group in range(_GROUP_SIZES.shape[0]):
        first, bones = _FIRST_STATE[group], _GROUP_SIZES[group]
        state = np.argmin(cost[first : first + (1 << bones)])
        for at in range(count - 1, -1, -1):
            for bone in range(bones):
                sign[at, _GROUP_JOINTS[_FIRST_JOINT[group] + bone]] = 1.0 if (state >> bone) & 1 else -1.0
            state = back[at, first + state]
    return sign


@compiled()
def _prior_of_frame(
    size: Array, deviation: Array, sign: Array, vectors: Array, log_weight: Array
) -> tuple[Array, Array]:
    """Return each bone by the candidates of its sign (14, 3), and its depth by image and candidates (14,)."""
    mean, depth = np.zeros((_JOINTS, 3)), np.zeros(_JOINTS)
    share = np.empty(vectors.shape[0])
    for joint in _ORDER:
        is_seen = np.isfinite(deviation[joint])
        spread = deviation[joint] if is_seen else _LENGTHS_M[joint]
        signed = sign[joint] * size[joint]
        width = _KERNEL_M * _KERNEL_M + spread * spread
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
            # The image determines depths that it shows sharply; candidates determine those of bones in the image plane.
            by_image, by_votes = 1.0 / max(2.0 * spread, 1e-4) ** 2, 1.0 / (_KERNEL_M * _KERNEL_M)
            depth[joint] = (signed * by_image + mean[joint, 2] * by_votes) / (by_image + by_votes)
        else:
            depth[joint] = mean[joint, 2]
    return mean, depth
