"""Fit poses to the 2D joints of a whole track: exact bone lengths, depths near the retrieved ones, smooth.

Camera axes, metres about the mid-hip: x right, y up, z towards the camera.  Each term is divided by its measured
standard deviation:

- image: distance of seen joints from the observation, over the noise of the track, with less weight for outliers;
- bones: difference of each bone's vector from the retrieved one, which decides where the image does not;
- time: second differences of all joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.fitting.bones import BoneForest, topology_of
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.terms import AccelerationTerm, Normal, PointTerm, Term
from pasdedeux.skeletons import Skeleton

DEPTH_HOLD = 1e-2
_FEWEST_DIFFERENCES = 5
"""Smallest number of third differences that determine the noise."""
ACCELERATION_M_S2 = 8.0
"""Standard deviation of a joint's acceleration."""
HALF_WEIGHT = 3.0
"""Joints count half at this many standard deviations of the noise from their image."""
_NUM_ROUNDS = 2
"""Number of fits; between them the weights of the image follow the residuals."""
_STOP = FitSettings(max_iterations=6, tolerance=3e-3)


@dataclass(frozen=True)
class BoneVectorTerm(Term):
    """sum w |(p_child - p_parent) - target|^2 per axis: the vector of each bone.

    Args:
        skeleton: Tree of N joints.
        targets_m: Vector of the bone that ends in each joint (T, N, 3), metres; the root's is ignored.
        weights: (T, N, 3) or broadcasts to it; the root's are ignored.
    """

    skeleton: Skeleton
    targets_m: Array
    weights: Array

    def __post_init__(self) -> None:
        """Clear weights of the root, and targets without weight."""
        weights = np.array(np.broadcast_to(self.weights, self.targets_m.shape), dtype=np.float64)
        weights[:, self.skeleton.root] = 0.0
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "targets_m", np.where(weights > 0, self.targets_m, 0.0))

    def _residual(self, positions_m: Array) -> Array:
        # The row of the root reads another joint, with weight 0.
        return np.asarray(positions_m - positions_m[:, topology_of((self.skeleton,)).parents] - self.targets_m)

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        return float((self.weights * self._residual(positions_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        pull = self.weights * self._residual(positions_m)
        normal.gradient += pull - self._children @ pull

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the curvature."""
        weights = self.weights.transpose(2, 0, 1)
        parents, children = np.array(self.skeleton.bones).T
        normal.diagonal[...] += weights + weights @ self._children.T
        normal.matrix[:, :, children, parents] -= weights[..., children]
        normal.matrix[:, :, parents, children] -= weights[..., children]

    @property
    def _children(self) -> Array:
        """1 where the joint of the row is the parent of that of the column (N, N)."""
        parents = topology_of((self.skeleton,)).parents
        return (parents == np.arange(len(parents))[:, None]).astype(np.float64)


def image_noise(observed_m: Array, is_seen: Flags) -> float:
    """Return the standard deviation of the noise of observed joints (T, N, 2) from third differences; 0 for too few.

    The third difference of white noise has 20 times its variance, and little of a motion; the median of its size over
    all joints (0.6745 of the standard deviation) is not moved by outliers.
    """
    return noise_of_differences(third_differences(observed_m, is_seen))


def third_differences(observed_m: Array, is_seen: Flags) -> Array:
    """Return the third differences (m, 2) of joints (T, N, 2) that are seen in four frames which follow each other."""
    all_seen = is_seen[3:] & is_seen[2:-1] & is_seen[1:-2] & is_seen[:-3]
    return np.asarray(np.diff(observed_m, n=3, axis=0)[all_seen])


def noise_of_differences(third: Array) -> float:
    """Return the noise by third differences (m, 2), see `image_noise`."""
    if len(third) < _FEWEST_DIFFERENCES:
        return 0.0
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))


def fit_observed(
    skeleton: Skeleton,
    lengths_m: Array,
    start_m: Array,
    observed_m: Array,
    confidence: Array,
    bone_m: Array,
    bone_deviation_m: Array,
    *,
    rate_hz: float,
    distance_m: Array,
    min_noise_m: float,
) -> Array:
    """Return a track of poses fitted to its image (T, N, 3), metres; x and y as observed, z about the first guess's.

    Args:
        skeleton: Tree of N joints.
        lengths_m: Bone lengths (N,), metres, kept exactly.
        start_m: First guess (T, N, 3), camera axes, metres.
        observed_m: Observed joints (T, N, 2), metres at the depth of z = 0; NaN where not seen.
        confidence: (T, N), 0 where not seen; a weight relative to a clearly seen joint.
        bone_m: Vector of each bone as retrieved (T, N, 3), metres.
        bone_deviation_m: Standard deviation of that (T, N), metres.
        rate_hz: Frames per second.
        distance_m: Distance (T,) of z = 0 from a pinhole.
        min_noise_m: Smallest noise assumed of the image.
    """
    frames, joints = start_m.shape[:2]
    is_seen = np.isfinite(observed_m).all(axis=-1) & (confidence > 0)
    weight = np.where(is_seen, confidence, 0.0)
    noise = np.full(joints, max(image_noise(observed_m, is_seen), min_noise_m))
    robust = np.ones((frames, joints))
    forest = BoneForest((skeleton,), np.asarray(lengths_m, dtype=np.float64))
    state = forest.state_of(start_m)
    positions = forest.positions(state)
    time_deviation = ACCELERATION_M_S2 / rate_hz**2
    smooth = AccelerationTerm(np.array(1.0 / time_deviation**2))
    bones = BoneVectorTerm(skeleton, bone_m, (1.0 / bone_deviation_m**2)[..., None])
    for round_number in range(_NUM_ROUNDS):
        image = image_term(observed_m, weight * robust / noise**2, positions, distance_m)
        result = fit_bones(forest, state, [image, smooth, bones], _STOP)
        state, positions = result.state, result.positions_m
        if round_number < _NUM_ROUNDS - 1:
            residual = np.linalg.norm(flatten_image(observed_m, positions, distance_m) - positions[..., :2], axis=-1)
            residual = np.where(is_seen, residual, np.nan)
            noise = np.maximum(noise, _joint_noise(residual))
            robust = 1.0 / (1.0 + (np.nan_to_num(residual) / (HALF_WEIGHT * noise)) ** 2)
    return positions


def flatten_image(observed_m: Array, positions_m: Array, distance_m: Array | float) -> Array:
    """Remove perspective from images (*batch, N, 2) at the depths of poses (*batch, N, 3).

    Args:
        observed_m: Observed joints, metres at the depth of z = 0.
        positions_m: Poses, camera axes.
        distance_m: Distance (*batch,) of z = 0 from a pinhole; infinite for parallel rays.
    """
    depth = positions_m[..., 2]
    return np.asarray(observed_m * (1.0 - depth / np.asarray(distance_m)[..., None])[..., None])


def image_term(observed_m: Array, weights: Array, positions_m: Array, distance_m: Array) -> PointTerm:
    """Return the term that draws joints to their image (T, N, 2), with weights (T, N), perspective removed.

    Parallel rays leave the depth of the whole body free; a small weight holds it.
    """
    flat = flatten_image(observed_m, positions_m, distance_m)
    over = np.full(positions_m.shape, DEPTH_HOLD)
    over[..., :2] = weights[..., None]
    return PointTerm(np.concatenate([flat, positions_m[..., 2:]], axis=-1), over)


def _joint_noise(residual: Array) -> Array:
    """Return the standard deviation of each joint's residuals (N,), per axis, from their median; 0 where never seen."""
    noise = np.zeros(residual.shape[1])
    for joint, column in enumerate(residual.T):
        seen = column[np.isfinite(column)]
        if len(seen):
            noise[joint] = np.median(seen) / 1.1774  # median of a Rayleigh distribution
    return noise
