"""Fit the last few frames to the image as frames arrive: the live form of the fit of whole tracks.

The candidates of a frame vote once on the depth of every bone, when the frame arrives; Viterbi with a fixed lag chooses
the signs over time.  When a pose is due, its frame and the later ones are fitted together, after the last two returned
poses, which are held.  Only the pose of the oldest frame is returned.  Frames that were fitted before start from there,
so one or two steps are enough.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.fitting.levenberg import FitSettings
from pasdedeux.fitting.observed_pose import ACCELERATION_M_S2, flatten_image, noise_of_differences, third_differences
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.reconstruction.depth import SignStep, bones_by_votes, trace_signs, vote_on_signs
from pasdedeux.reconstruction.live.window_kernels import fit_window, guess_pose
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import MEAN_OF_RAYLEIGH, bone_deviation_m, share_of_followed
from pasdedeux.skeletons import OP14

_POSE = (OP14.num_joints, 3)
_NUM_HELD = 2

_NOISE_FRAMES = 24
_NOISE_GAIN = 0.05
"""Gain with which the noise of a joint follows its residuals."""


MIN_NOISE_M = 0.02
"""Smallest noise assumed of the image."""
MAX_AHEAD = 6
"""Largest number of later frames that are fitted with the due one."""
TRUST_PER_MISFIT = 2.0
"""Standard deviation of a retrieved bone over the misfit of the match."""
STOP = FitSettings(max_iterations=1, tolerance=3e-3)
STOP_MISSING = FitSettings(max_iterations=4, tolerance=3e-3)
"""Steps of a fit, and of one with an unseen joint in the window, which only the other terms move."""


@dataclass
class LiveFrame:
    """A frame of one person that waits for its pose to be due.

    Args:
        frame: Its number.
        row: Matched rows of the database (k,), nearest first.
        yaw_steps: Their yaws (k,).
        match_m: Their distances in the image (k,), metres.
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
    """State of a waiting frame: its votes, its signs with their bones and depths, and the pose of its last fit."""

    seen: LiveFrame
    step: SignStep
    trust_m: float
    distance_m: float
    is_whole: bool
    sign: Array = field(default_factory=lambda: np.zeros(OP14.num_joints))
    mean_m: Array = field(default_factory=lambda: np.zeros(_POSE))
    depth_m: Array = field(default_factory=lambda: np.zeros(OP14.num_joints))
    fitted_m: Array = field(default_factory=lambda: np.zeros(_POSE))


class WindowFit:
    """Live fit of one person; holds the state of this person."""

    def __init__(self, rate_hz: float, *, min_noise_m: float = MIN_NOISE_M) -> None:
        self._rate_hz = rate_hz
        self._min_noise_m = min_noise_m
        self._waiting: deque[_Fitted] = deque()
        self._newest: _Fitted | None = None
        self._held_frames: list[int] = []
        self._held_m = np.zeros((0, *_POSE))
        self._recent_m = np.full((4, OP14.num_joints, 2), np.nan)
        self._differences: deque[Array] = deque(maxlen=_NOISE_FRAMES - 3)
        self._noise_m = 0.0
        self._joint_noise_m = np.zeros(OP14.num_joints)

    def see(self, new: LiveFrame, proportions: Array) -> None:
        """Add a frame whose pose will be due later.

        Args:
            new: The frame.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        before = self._newest
        passed = 1 if before is None else new.frame - before.seen.frame
        image = np.where((new.weights > 0)[:, None], new.image_m, np.nan)
        for came in [np.full(image.shape, np.nan)] * (min(passed, _NOISE_FRAMES) - 1) + [image]:
            self._recent_m = np.array([*self._recent_m[1:], came])
            self._differences.append(third_differences(self._recent_m, np.isfinite(self._recent_m[..., 0])))
        self._noise_m = noise_of_differences(np.concatenate(self._differences))
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
        is_whole = bool((weights > 0).all())
        self._newest = _Fitted(replace(new, image_m=image, weights=weights), step, trust, distance, is_whole)
        self._waiting.append(self._newest)

    def fit(self, ranks: Integers, proportions: Array) -> Array:
        """Return the pose (14, 3) of the oldest frame, about its mid-hip, camera axes, and remove the frame.

        Args:
            ranks: Rank of the candidate of each waiting frame, the oldest first.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        signs = trace_signs([waiting.step for waiting in self._waiting])
        window = list(islice(self._waiting, MAX_AHEAD + 1))
        # A new frame has signs of 0, so that it counts as changed.
        is_kept = np.array([bool((waiting.sign == signs[at]).all()) for at, waiting in enumerate(window)])
        followed_m = np.array([waiting.step.vectors_m[rank] for waiting, rank in zip(window, ranks, strict=False)])
        for at in np.flatnonzero(~is_kept):
            waiting = window[at]
            waiting.sign = signs[at]
            waiting.mean_m, waiting.depth_m = bones_by_votes(waiting.step, waiting.sign)
            depth_and_bones = proportions * waiting.depth_m, proportions[:, None] * followed_m[at]
            waiting.fitted_m = guess_pose(waiting.seen.image_m, waiting.distance_m, *depth_and_bones)
        share = share_of_followed(self._noise_m)
        bones_m = share * followed_m + (1.0 - share) * np.array([waiting.mean_m for waiting in window])
        frames = np.array([*self._held_frames, *(waiting.seen.frame for waiting in window)])
        stop = STOP if all(waiting.is_whole for waiting in window) else STOP_MISSING
        fitted = fit_window(
            self._held_m,
            np.array([waiting.fitted_m for waiting in window]),
            np.array([waiting.seen.image_m for waiting in window]),
            np.array([waiting.distance_m for waiting in window]),
            np.array([waiting.seen.weights for waiting in window]),
            np.maximum(self._joint_noise_m, max(self._noise_m, self._min_noise_m)),
            is_kept,
            proportions[:, None] * bones_m,
            np.array([1.0 / waiting.trust_m**2 for waiting in window]),
            (frames[2:] == frames[:-2] + 2) * (self._rate_hz**2 / ACCELERATION_M_S2) ** 2,
            REFERENCE_LENGTHS_M * proportions,
            stop.max_iterations,
            stop.tolerance,
        )
        for waiting, pose in zip(window, fitted, strict=True):
            waiting.fitted_m = pose
        due = self._waiting.popleft()
        off = flatten_image(due.seen.image_m, fitted[0], due.distance_m) - fitted[0, :, :2]
        more = np.hypot(off[:, 0], off[:, 1]) / MEAN_OF_RAYLEIGH - self._joint_noise_m
        self._joint_noise_m += _NOISE_GAIN * np.where(np.isfinite(more), more, 0.0)
        self._held_frames = [*self._held_frames, due.seen.frame][-_NUM_HELD:]
        self._held_m = np.array([*self._held_m, fitted[0]])[-_NUM_HELD:]
        return np.asarray(fitted[0] - mid_hip(fitted[0]))
