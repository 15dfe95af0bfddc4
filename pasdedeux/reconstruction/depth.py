"""Depth of every bone from its image and the candidates of a search: which way it points, and how far.

A bone of known length shows how far it leaves the image plane, |dz| = sqrt(L^2 - |dxy|^2), but not to which side.
The candidates vote: for each group of bones (trunk, arms, legs) and each choice of signs s, the likelihood of a frame
is the kernel density of the candidates' depths at s |dz|, weighted by how well they match the image; Viterbi over time
lets a sign change only where |dz| is small enough to pass through zero.  A group has all its signs at once, because
hips and shoulders turn together and a knee bends one way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14

__all__ = ["SIGN_GROUPS", "BoneDepths", "DepthSettings", "bone_vectors", "decode_depths", "place_depths"]

Array = npt.NDArray[np.float64]

_PARENTS = np.array([max(parent, 0) for parent in OP14.parents])
SIGN_GROUPS: tuple[tuple[int, ...], ...] = tuple(
    tuple(OP14.indices(names))
    for names in (
        ("head", "left_shoulder", "right_shoulder", "left_hip", "right_hip"),
        ("left_elbow", "left_wrist", "right_elbow", "right_wrist"),
        ("left_knee", "left_ankle", "right_knee", "right_ankle"),
    )
)


@dataclass(frozen=True)
class DepthSettings:
    """How candidates vote on depth.

    Args:
        misfit_m: Candidates whose image is this much worse than the best count 1/e.
        kernel_m: Width of the kernel over depths; chosen on clips of a database left out in turn.
        speed_m_s: Standard deviation of the speed of a bone's end in depth.
        floor: Share of the votes that is spread over all signs, so that none is impossible.
    """

    misfit_m: float = 0.02
    kernel_m: float = 0.03
    speed_m_s: float = 0.7
    floor: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse widths that are not positive."""
        if not (min(self.misfit_m, self.kernel_m, self.speed_m_s) > 0 and 0 < self.floor < 1):
            raise InputError(f"depth settings must be positive: {self}")


@dataclass(frozen=True)
class BoneDepths:
    """What is known of each bone of a track.

    Args:
        depth_m: Depth of the bone that ends in each joint (frame, 14), towards the camera positive; 0 for the root.
        vector_m: Vector of each bone as the candidates of the same sign have it (frame, 14, 3).
        deviation_m: Standard deviation of that (frame, 14).
    """

    depth_m: Array
    vector_m: Array
    deviation_m: Array


def bone_vectors(positions: Array) -> Array:
    """Return the vector of the bone that ends in each joint (*batch, 14, d) of op14 positions; 0 for the root."""
    vectors = positions - positions[..., _PARENTS, :]
    vectors[..., OP14.root, :] = 0.0
    return np.asarray(vectors)


def place_depths(observed_m: Array, depth_m: Array) -> Array:
    """Return positions (*batch, 14, 3): x and y as observed (*batch, 14, 2), bones of these depths, root at z = 0."""
    depth = np.zeros(depth_m.shape)
    for joint in OP14.order[1:]:
        depth[..., joint] = depth[..., OP14.parents[joint]] + depth_m[..., joint]
    return np.concatenate([observed_m, depth[..., None]], axis=-1)


def decode_depths(
    observed_m: Array,
    is_seen: npt.NDArray[np.bool_],
    candidates_m: Array,
    misfit_m: Array,
    lengths_m: Array,
    *,
    noise_m: float,
    rate_hz: float,
    settings: DepthSettings | None = None,
) -> BoneDepths:
    """Return the depth of every bone of a track.

    Args:
        observed_m: Joints in the image (frame, 14, 2), metres, in the proportions of the candidates.
        is_seen: (frame, 14).
        candidates_m: Candidate poses (frame, k, 14, 3), camera axes, metres.
        misfit_m: How much worse than the best each candidate matches (frame, k), metres; inf where there is none.
        lengths_m: Bone lengths (14,), metres.
        noise_m: Standard deviation of the observed joints.
        rate_hz: Frames per second.
        settings: How candidates vote.
    """
    settings = settings or DepthSettings()
    vectors = bone_vectors(np.where(is_seen[..., None], observed_m, 0.0))
    both_seen = is_seen & is_seen[:, _PARENTS]
    squared = lengths_m**2 - np.sum(vectors**2, axis=-1)
    size = np.where(both_seen, np.sqrt(np.maximum(squared, 0.0)), 0.0)
    # First order in the noise, held back where the bone lies in the image and the root has no slope.
    squared_deviation = 2.0 * lengths_m * np.sqrt(2.0) * noise_m
    deviation = np.minimum(squared_deviation / (2.0 * np.maximum(size, 1e-6)), 0.7 * np.sqrt(squared_deviation))
    deviation = np.where(both_seen, deviation, lengths_m)
    log_weight = -misfit_m / settings.misfit_m
    depths = np.ascontiguousarray(bone_vectors(candidates_m)[..., 2])
    sign = np.ones(size.shape)
    for group in SIGN_GROUPS:
        joints = np.array(group)
        width = np.sqrt(settings.kernel_m**2 + deviation[:, joints] ** 2)
        score = _sign_scores(size[:, joints], width, depths[:, :, joints], log_weight, settings.floor)
        flip = _flip_costs(size[:, joints], deviation[:, joints], settings.speed_m_s / rate_hz)
        states = _decode_signs(score, flip)
        sign[:, joints] = np.where((states[:, None] >> np.arange(len(group))) & 1, 1.0, -1.0)
    signed = sign * size
    width = np.sqrt(settings.kernel_m**2 + deviation**2)
    log_share = log_weight[..., None] - 0.5 * ((depths - signed[:, None]) / width[:, None]) ** 2
    share = np.exp(log_share - log_share.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    all_vectors = bone_vectors(candidates_m)
    mean = np.einsum("tkj,tkjd->tjd", share, all_vectors)
    spread = np.sqrt(np.einsum("tkj,tkj->tj", share, (depths - mean[:, None, :, 2]) ** 2))
    # The image says how deep where it is sharp, the candidates where the bone lies in the image.
    by_image, by_votes = 1.0 / np.maximum(2.0 * deviation, 1e-4) ** 2, 1.0 / settings.kernel_m**2
    depth = (signed * by_image + mean[..., 2] * by_votes) / (by_image + by_votes)
    depth = np.where(both_seen, depth, mean[..., 2])
    depth[:, OP14.root] = 0.0
    return BoneDepths(depth, mean, spread)


def _flip_costs(size: Array, deviation: Array, step_m: float) -> Array:
    """Return what it costs each bone to change sign between a frame and one before (frame, bone); 0 for the first."""
    cost = np.zeros(size.shape)
    variance = 2.0 * (step_m**2 + deviation[1:] ** 2 + deviation[:-1] ** 2)
    # |a + b|^2 - |a - b|^2 = 4 a b: how much further the end moves when the sign flips.
    cost[1:] = 4.0 * size[1:] * size[:-1] / variance
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sign_scores(size: Array, width: Array, depths: Array, log_weight: Array, floor: float) -> Array:
    """Return log likelihood (frame, 2^n) of every choice of signs of n bones; bit i set means bone i is positive."""
    frames, count, bones = depths.shape
    states = 1 << bones
    score = np.empty((frames, states))
    for frame in range(frames):
        total = 0.0
        density = np.zeros(states)
        for candidate in range(count):
            weight = np.exp(log_weight[frame, candidate])
            if weight < 1e-12:
                continue
            total += weight
            for state in range(states):
                exponent = 0.0
                for bone in range(bones):
                    signed = size[frame, bone] if (state >> bone) & 1 else -size[frame, bone]
                    away = (depths[frame, candidate, bone] - signed) / width[frame, bone]
                    exponent += away * away
                density[state] += weight * np.exp(-0.5 * exponent)
        for state in range(states):
            score[frame, state] = np.log(density[state] + floor * total) if total > 0 else 0.0
    return score


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _decode_signs(score: Array, flip: Array) -> npt.NDArray[np.int64]:
    """Return the likeliest path of sign choices (frame,) when changing a bone's sign costs `flip` (frame, bone)."""
    frames, states = score.shape
    bones = flip.shape[1]
    cost = -score[0]
    back = np.zeros((frames, states), dtype=np.int64)
    change = np.empty(states)
    new_cost = np.empty(states)
    for frame in range(1, frames):
        for state in range(states):
            change[state] = 0.0
            for bone in range(bones):
                if (state >> bone) & 1:
                    change[state] += flip[frame, bone]
        for state in range(states):
            best, arg = np.inf, 0
            for before in range(states):
                total = cost[before] + change[state ^ before]
                if total < best:
                    best, arg = total, before
            new_cost[state] = best - score[frame, state]
            back[frame, state] = arg
        cost[:] = new_cost
    path = np.empty(frames, dtype=np.int64)
    path[-1] = np.argmin(cost)
    for frame in range(frames - 1, 0, -1):
        path[frame - 1] = back[frame, path[frame]]
    return path
