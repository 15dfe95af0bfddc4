"""Fit of the last few frames to what was seen, as frames arrive: the live form of the fit of whole tracks.

Each frame's candidates vote on the depth of every bone once, when it comes; the signs are chosen over time by Viterbi
with a fixed lag.  When a frame's pose is due, its frame and those that came since are fitted together by the fit of
whole tracks, behind the two poses given out before, which are held.  Only the oldest frame's pose leaves.  Frames of
the window that were fitted before start from there, so a step or two are enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import BoneVectorTerm, flatten_image, image_noise, image_term
from pasdedeux.fitting.terms import DifferenceTerm
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.reconstruction.depth import (
    DepthSettings,
    SignStep,
    bone_vectors,
    bones_by_votes,
    place_depths,
    trace_signs,
    vote_on_signs,
)
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import MEAN_OF_RAYLEIGH, bone_deviation_m, share_of_followed
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

Integers = npt.NDArray[np.int64]

_POSE = (OP14.num_joints, 3)
_NUM_HELD = 2
_HOLD = 1e3
"""Weight of poses that were given out, against that of time."""

_NOISE_FRAMES = 24
_NOISE_GAIN = 0.05
"""How fast the noise of a joint follows its residuals."""


class WindowFitOptions(Settings):
    """What the live fit believes."""

    max_ahead: int = Field(6, ge=0, description="Frames after the one that is due which are fitted with it, at most")
    min_noise_m: float = Field(0.02, gt=0, description="The image is never believed better than this")
    acceleration_m_s2: float = Field(8.0, gt=0, description="Standard deviation of a joint's acceleration")
    trust_per_misfit: float = Field(2.0, gt=0, description="A bone is trusted to this many times the match's misfit")
    depth: DepthSettings = Field(DepthSettings(), description="How candidates vote on depth")
    max_steps: int = Field(1, ge=1, description="Steps of a fit, at most")
    max_steps_missing: int = Field(
        4, ge=1, description="The same where a joint of the window is not seen: only the other terms move it"
    )
    tolerance: float = Field(3e-3, ge=0, description="A fit ends when a step lowers its energy by less than this share")


@dataclass
class _Frame:
    """A frame that waits for its pose to be due; its signs and what follows from them, and the pose of its last fit."""

    frame: int
    image_m: Array
    weight: Array
    vectors_m: Array
    log_weight: Array
    step: SignStep
    trust_m: float
    distance_m: float
    sign: Array | None = None
    mean_m: Array = field(default_factory=lambda: np.zeros(_POSE))
    depth_m: Array = field(default_factory=lambda: np.zeros(OP14.num_joints))
    fitted_m: Array = field(default_factory=lambda: np.zeros(_POSE))


class WindowFit:
    """One person's live fit; the state is this person's alone.

    Args:
        rate_hz: Frames per second.
        options: How.
    """

    def __init__(self, rate_hz: float, options: WindowFitOptions | None = None) -> None:
        self._options = options or WindowFitOptions()
        self._rate_hz = rate_hz
        self._waiting: deque[_Frame] = deque()
        self._newest: _Frame | None = None
        self._held: deque[tuple[int, Array]] = deque(maxlen=_NUM_HELD)
        self._recent_m = np.full((_NOISE_FRAMES, OP14.num_joints, 2), np.nan)
        self._noise_m = 0.0
        self._joint_noise_m = np.zeros(OP14.num_joints)

    def see(
        self,
        frame: int,
        image_m: Array,
        weights: Array,
        candidates_m: Array,
        match_m: Array,
        distance_m: float,
        proportions: Array,
    ) -> None:
        """Take a frame whose pose will be due later.

        Args:
            frame: Its number.
            image_m: Joints (14, 2), metres at the depth of the mid-hip about its image; NaN where not seen.
            weights: (14,); 0 where not seen.
            candidates_m: Poses it was matched to (k, 14, 3), camera axes, reference proportions, metres, nearest first.
            match_m: How well each matches (k,), metres.
            distance_m: Distance of the camera from the mid-hip.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        options, before = self._options, self._newest
        passed = 1 if before is None else frame - before.frame
        image = np.where((weights > 0)[:, None], image_m, np.nan)
        # Frames that did not come count as not seen.
        unseen = np.full((min(passed, _NOISE_FRAMES) - 1, *image.shape), np.nan)
        self._recent_m = np.concatenate([self._recent_m, unseen, image[None]])[-_NOISE_FRAMES:]
        self._noise_m = image_noise(self._recent_m, np.isfinite(self._recent_m[..., 0]))
        vectors, log_weight = bone_vectors(candidates_m), (match_m[0] - match_m) / options.depth.misfit_m
        step = vote_on_signs(
            None if before is None else before.step,
            retarget_image(flatten_image(image, candidates_m[0], distance_m), proportions),
            REFERENCE_LENGTHS_M,
            vectors,
            log_weight,
            noise_m=max(self._noise_m, options.min_noise_m),
            passed_s=passed / self._rate_hz,
            settings=options.depth,
        )
        trust = float(bone_deviation_m(match_m[0], self._noise_m, options.trust_per_misfit))
        weight = np.where(np.isfinite(image).all(axis=-1), weights, 0.0)
        self._newest = _Frame(frame, image, weight, vectors, log_weight, step, trust, distance_m)
        self._waiting.append(self._newest)

    def fit(self, ranks: Integers, proportions: Array) -> Array:
        """Return the pose (14, 3) of the oldest frame, about its mid-hip, camera axes; the frame is then done with.

        Args:
            ranks: Candidate that each waiting frame follows by now, the oldest first.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        options = self._options
        signs = trace_signs([one.step for one in self._waiting])
        window = list(self._waiting)[: options.max_ahead + 1]
        share = share_of_followed(self._noise_m)
        noise = np.maximum(self._joint_noise_m, max(self._noise_m, options.min_noise_m))
        image_m = np.stack([one.image_m for one in window])
        distance_m = np.array([one.distance_m for one in window])
        guess_m, bones, is_kept = np.empty((len(window), *_POSE)), np.empty((len(window), *_POSE)), []
        for at, one in enumerate(window):
            followed = one.vectors_m[ranks[at]]
            is_kept.append(one.sign is not None and np.array_equal(one.sign, signs[at]))
            if not is_kept[at]:
                one.sign = signs[at]
                one.mean_m, one.depth_m = bones_by_votes(
                    one.step, one.sign, one.vectors_m, one.log_weight, REFERENCE_LENGTHS_M, options.depth
                )
                one.fitted_m = _first_guess(one, proportions[:, None] * followed, proportions * one.depth_m)
            guess_m[at] = one.fitted_m
            bones[at] = proportions[:, None] * (share * followed + (1.0 - share) * one.mean_m)
        off = np.nan_to_num(_residuals(image_m, guess_m, distance_m)) / (3.0 * noise)
        robust = np.where(np.array(is_kept)[:, None], 1.0 / (1.0 + off**2), 1.0)
        believed = robust / noise**2 * np.stack([one.weight for one in window])
        fitted = self._fit(window, image_m, believed, distance_m, guess_m, bones, REFERENCE_LENGTHS_M * proportions)
        for one, pose in zip(window, fitted, strict=True):
            one.fitted_m = pose
        due = self._waiting.popleft()
        of_joint = _residuals(image_m[0], fitted[0], distance_m[0]) / MEAN_OF_RAYLEIGH
        known = np.isfinite(of_joint)
        self._joint_noise_m[known] += _NOISE_GAIN * (of_joint[known] - self._joint_noise_m[known])
        self._held.append((due.frame, fitted[0]))
        return np.asarray(fitted[0] - mid_hip(fitted[0]))

    def _fit(
        self,
        window: Sequence[_Frame],
        image_m: Array,
        believed: Array,
        distance_m: Array,
        guess_m: Array,
        bones_m: Array,
        lengths_m: Array,
    ) -> Array:
        """Return the poses (n, 14, 3) of a window behind the poses that are held."""
        options, held = self._options, len(self._held)
        start = np.concatenate([np.reshape([pose for _, pose in self._held], (held, *_POSE)), guess_m])
        frames = np.array([*(frame for frame, _ in self._held), *(one.frame for one in window)])
        image, weight = np.zeros((*start.shape[:2], 2)), np.zeros(start.shape[:2])
        image[held:], weight[held:] = image_m, believed
        distance = np.concatenate([np.full(held, np.inf), distance_m])
        per_time = (self._rate_hz**2 / options.acceleration_m_s2) ** 2
        points = image_term(image, weight, start, distance)
        points.targets_m[:held], points.weights[:held] = start[:held], _HOLD * per_time
        vectors, over = np.zeros(start.shape), np.zeros((*start.shape[:2], 1))
        vectors[held:], over[held:, :, 0] = bones_m, np.array([[1.0 / one.trust_m**2] for one in window])
        is_even = frames[2:] == frames[:-2] + 2
        terms = [
            points,
            DifferenceTerm(np.zeros(start.shape), np.where(is_even, per_time, 0.0)[:, None, None], 2),
            BoneVectorTerm(OP14, vectors, over),
        ]
        is_whole = all((one.weight > 0).all() for one in window)
        steps = options.max_steps if is_whole else options.max_steps_missing
        forest = BoneForest((OP14,), lengths_m)
        stop = FitSettings(max_iterations=steps, tolerance=options.tolerance)
        return fit_bones(forest, forest.state_of(start), terms, stop).positions_m[held:]


def _residuals(image_m: Array, pose_m: Array, distance_m: Array) -> Array:
    """Return how far each joint (*batch, 14) of poses is from its image; NaN where not seen."""
    off = flatten_image(image_m, pose_m, distance_m) - pose_m[..., :2]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def _first_guess(one: _Frame, followed_m: Array, depth_m: Array) -> Array:
    """Return a pose (14, 3) across as in the image, or as followed (14, 3) where not seen, of bones of these depths."""
    pose = place_depths(np.zeros((OP14.num_joints, 2)), depth_m)
    pose[:, 2] -= mid_hip(pose)[2]
    pose[:, :2] = flatten_image(one.image_m, pose, one.distance_m)
    for joint in OP14.order:
        if not np.isfinite(pose[joint, 0]):
            parent = OP14.parents[joint]
            pose[joint, :2] = 0.0 if parent < 0 else pose[parent, :2] + followed_m[joint, :2]
    return pose
