"""Fit of the last few frames to what was seen, as frames arrive: the live form of the fit of whole tracks.

Each frame's candidates vote on the depth of every bone once, when it comes; the signs are chosen over time by Viterbi
with a fixed lag.  When a frame's pose is due, its frame and those that came since are fitted together by the fit of
whole tracks, behind the two poses given out before, which are held.  Only the oldest frame's pose leaves.  Frames of
the window that were fitted before start from there, so a step or two are enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import ACCELERATION_M_S2, BoneVectorTerm, flatten_image, image_noise, image_term
from pasdedeux.fitting.terms import AccelerationTerm
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.reconstruction.depth import SignStep, bones_by_votes, place_depths, trace_signs, vote_on_signs
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import MEAN_OF_RAYLEIGH, bone_deviation_m, share_of_followed
from pasdedeux.skeletons import OP14

_POSE = (OP14.num_joints, 3)
_NUM_HELD = 2
_HOLD = 1e3
"""Weight of poses that were given out, against that of time."""

_NOISE_FRAMES = 24
_NOISE_GAIN = 0.05
"""How fast the noise of a joint follows its residuals."""


MIN_NOISE_M = 0.02
"""The image is never believed better than this."""
MAX_AHEAD = 6
"""Frames after the one that is due which are fitted with it, at most."""
TRUST_PER_MISFIT = 2.0
"""A bone is trusted to this many times the match's misfit."""
STOP = FitSettings(max_iterations=1, tolerance=3e-3)
STOP_MISSING = FitSettings(max_iterations=4, tolerance=3e-3)
"""Steps of a fit, and those where a joint of the window is not seen: only the other terms move it."""


@dataclass
class LiveFrame:
    """A frame of one person that waits for its pose to be due.

    Args:
        frame: Its number.
        row: Database rows it was matched to (k,), nearest first.
        yaw_steps: Their yaws (k,).
        match_m: How well each matches (k,), metres.
        candidates_m: Their poses (k, 14, 3), camera axes, reference proportions, metres.
        root_m: Mid-hip (3,), camera axes.
        image_m: Joints (14, 2), metres at the depth of the mid-hip about its image; NaN where not seen.
        weights: (14,); 0 where not seen.
    """

    frame: int
    row: Integers
    yaw_steps: Array
    match_m: Array
    candidates_m: Array
    root_m: Array
    image_m: Array
    weights: Array


@dataclass
class _Fitted:
    """What is known of a frame that waits; its signs and what follows from them, and the pose of its last fit."""

    seen: LiveFrame
    step: SignStep
    trust_m: float
    distance_m: float
    sign: Array | None = None
    mean_m: Array = field(default_factory=lambda: np.zeros(_POSE))
    depth_m: Array = field(default_factory=lambda: np.zeros(OP14.num_joints))
    fitted_m: Array = field(default_factory=lambda: np.zeros(_POSE))


class WindowFit:
    """One person's live fit; the state is this person's alone."""

    def __init__(self, rate_hz: float, *, min_noise_m: float = MIN_NOISE_M) -> None:
        self._rate_hz = rate_hz
        self._min_noise_m = min_noise_m
        self._waiting: deque[_Fitted] = deque()
        self._newest: _Fitted | None = None
        self._held: deque[tuple[int, Array]] = deque(maxlen=_NUM_HELD)
        self._recent_m = np.full((_NOISE_FRAMES, OP14.num_joints, 2), np.nan)
        self._noise_m = 0.0
        self._joint_noise_m = np.zeros(OP14.num_joints)

    def see(self, new: LiveFrame, proportions: Array) -> None:
        """Take a frame whose pose will be due later.

        Args:
            new: The frame.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        before = self._newest
        passed = 1 if before is None else new.frame - before.seen.frame
        image = np.where((new.weights > 0)[:, None], new.image_m, np.nan)
        # Frames that did not come count as not seen.
        unseen = np.full((min(passed, _NOISE_FRAMES) - 1, *image.shape), np.nan)
        self._recent_m = np.concatenate([self._recent_m, unseen, image[None]])[-_NOISE_FRAMES:]
        self._noise_m = image_noise(self._recent_m, np.isfinite(self._recent_m[..., 0]))
        distance = float(np.linalg.norm(new.root_m))
        step = vote_on_signs(
            None if before is None else before.step,
            retarget_image(flatten_image(image, new.candidates_m[0], distance), proportions),
            new.candidates_m,
            new.match_m - new.match_m[0],
            noise_m=max(self._noise_m, self._min_noise_m),
            passed_s=passed / self._rate_hz,
        )
        trust = float(bone_deviation_m(new.match_m[0], self._noise_m, TRUST_PER_MISFIT))
        weights = np.where(np.isfinite(image).all(axis=-1), new.weights, 0.0)
        self._newest = _Fitted(replace(new, image_m=image, weights=weights), step, trust, distance)
        self._waiting.append(self._newest)

    def fit(self, ranks: Integers, proportions: Array) -> Array:
        """Return the pose (14, 3) of the oldest frame, about its mid-hip, camera axes; the frame is then done with.

        Args:
            ranks: Candidate that each waiting frame follows by now, the oldest first.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        signs = trace_signs([one.step for one in self._waiting])
        window = list(self._waiting)[: MAX_AHEAD + 1]
        share = share_of_followed(self._noise_m)
        noise = np.maximum(self._joint_noise_m, max(self._noise_m, self._min_noise_m))
        image_m = np.stack([one.seen.image_m for one in window])
        distance_m = np.array([one.distance_m for one in window])
        guess_m, bones, is_kept = np.empty((len(window), *_POSE)), np.empty((len(window), *_POSE)), []
        for at, one in enumerate(window):
            followed = one.step.vectors_m[ranks[at]]
            is_kept.append(one.sign is not None and np.array_equal(one.sign, signs[at]))
            if not is_kept[at]:
                one.sign = signs[at]
                one.mean_m, one.depth_m = bones_by_votes(one.step, one.sign)
                one.fitted_m = _first_guess(one, proportions[:, None] * followed, proportions * one.depth_m)
            guess_m[at] = one.fitted_m
            bones[at] = proportions[:, None] * (share * followed + (1.0 - share) * one.mean_m)
        off = np.nan_to_num(_residuals(image_m, guess_m, distance_m)) / (3.0 * noise)
        robust = np.where(np.array(is_kept)[:, None], 1.0 / (1.0 + off**2), 1.0)
        believed = robust / noise**2 * np.stack([one.seen.weights for one in window])
        fitted = self._fit(window, image_m, believed, distance_m, guess_m, bones, REFERENCE_LENGTHS_M * proportions)
        for one, pose in zip(window, fitted, strict=True):
            one.fitted_m = pose
        due = self._waiting.popleft()
        of_joint = _residuals(image_m[0], fitted[0], distance_m[0]) / MEAN_OF_RAYLEIGH
        known = np.isfinite(of_joint)
        self._joint_noise_m[known] += _NOISE_GAIN * (of_joint[known] - self._joint_noise_m[known])
        self._held.append((due.seen.frame, fitted[0]))
        return np.asarray(fitted[0] - mid_hip(fitted[0]))

    def _fit(
        self,
        window: Sequence[_Fitted],
        image_m: Array,
        believed: Array,
        distance_m: Array,
        guess_m: Array,
        bones_m: Array,
        lengths_m: Array,
    ) -> Array:
        """Return the poses (n, 14, 3) of a window behind the poses that are held."""
        held = len(self._held)
        start = np.concatenate([np.reshape([pose for _, pose in self._held], (held, *_POSE)), guess_m])
        frames = np.array([*(frame for frame, _ in self._held), *(one.seen.frame for one in window)])
        image, weight = np.zeros((*start.shape[:2], 2)), np.zeros(start.shape[:2])
        image[held:], weight[held:] = image_m, believed
        distance = np.concatenate([np.full(held, np.inf), distance_m])
        per_time = (self._rate_hz**2 / ACCELERATION_M_S2) ** 2
        points = image_term(image, weight, start, distance)
        points.targets_m[:held], points.weights[:held] = start[:held], _HOLD * per_time
        vectors, over = np.zeros(start.shape), np.zeros((*start.shape[:2], 1))
        vectors[held:], over[held:, :, 0] = bones_m, np.array([[1.0 / one.trust_m**2] for one in window])
        is_even = frames[2:] == frames[:-2] + 2
        terms = [
            points,
            AccelerationTerm(np.where(is_even, per_time, 0.0)[:, None, None]),
            BoneVectorTerm(OP14, vectors, over),
        ]
        is_whole = all((one.seen.weights > 0).all() for one in window)
        forest = BoneForest((OP14,), lengths_m)
        return fit_bones(forest, forest.state_of(start), terms, STOP if is_whole else STOP_MISSING).positions_m[held:]


def _residuals(image_m: Array, pose_m: Array, distance_m: Array) -> Array:
    """Return how far each joint (*batch, 14) of poses is from its image; NaN where not seen."""
    off = flatten_image(image_m, pose_m, distance_m) - pose_m[..., :2]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def _first_guess(one: _Fitted, followed_m: Array, depth_m: Array) -> Array:
    """Return a pose (14, 3) across as in the image, or as followed (14, 3) where not seen, of bones of these depths."""
    pose = place_depths(np.zeros((OP14.num_joints, 2)), depth_m)
    pose[:, 2] -= mid_hip(pose)[2]
    pose[:, :2] = flatten_image(one.seen.image_m, pose, one.distance_m)
    for joint in OP14.order:
        if not np.isfinite(pose[joint, 0]):
            parent = OP14.parents[joint]
            pose[joint, :2] = 0.0 if parent < 0 else pose[parent, :2] + followed_m[joint, :2]
    return pose
