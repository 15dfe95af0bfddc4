"""Fit of the last few frames to what was seen, as frames arrive: the live form of the fit of whole tracks.

Each frame's candidates vote on the depth of every bone once, when it comes; the signs are chosen over time by Viterbi
with a fixed lag.  When a frame's pose is due, its frame and those that came since are fitted together, after the two
poses given out before, which stay: the image over its noise, less for joints that stay off; bones as the candidates
have them, over the misfit of the match; second differences of the joints; bone lengths exact.  Only the oldest frame's
pose leaves.  Frames of the window that were fitted before start from there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M
from pasdedeux.reconstruction.depth import DepthSettings
from pasdedeux.reconstruction.live.frame_kernels import unify_image
from pasdedeux.reconstruction.live.vote_kernels import (
    NUM_SIGN_STATES,
    bones_of,
    extend_signs,
    flatten_image,
    noise_of,
    residuals_of,
    trace_signs,
    vote_signs,
)
from pasdedeux.reconstruction.live.window_kernels import fit_window, prepare_window
from pasdedeux.skeletons import OP14

__all__ = ["WindowFit", "WindowFitOptions"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")

_NUM_FIXED = 2
_NOISE_FRAMES = 24
_MEAN_OF_RAYLEIGH = float(np.sqrt(np.pi / 2.0))
_NOISE_GAIN = 0.05
"""How fast the noise of a joint follows its residuals."""


@dataclass(frozen=True)
class WindowFitOptions:
    """What the live fit believes.

    Args:
        most_ahead: Frames after the one that is due which are fitted with it, at most.
        least_noise_m: The image is never believed better than this.
        acceleration_m_s2: Standard deviation of a joint's acceleration.
        trust_per_misfit: A bone of the candidates is trusted to this many times the misfit of the match, ...
        trust_m: ... within these bounds.
        equal_noise_m: Noise of the image at which the followed motion and the frame's candidates count the same.
        depth: How candidates vote on depth.
        most_solves: Newton steps of a frame, at most.
        most_solves_missing: The same where a joint of the window is not seen: nothing but the other terms moves it.
        tolerance: A fit ends when a step lowers its energy by less than this share.
    """

    most_ahead: int = 6
    least_noise_m: float = 0.02
    acceleration_m_s2: float = 8.0
    trust_per_misfit: float = 2.0
    trust_m: tuple[float, float] = (0.01, 0.2)
    equal_noise_m: float = 0.03
    depth: DepthSettings = field(default_factory=DepthSettings)
    most_solves: int = 1
    most_solves_missing: int = 4
    tolerance: float = 3e-3

    def __post_init__(self) -> None:
        """Refuse values without meaning."""
        if self.most_ahead < 0 or min(self.most_solves, self.most_solves_missing) < 1:
            raise InputError(f"live fit: frames ahead must not be negative and steps at least 1: {self}")
        if min(self.least_noise_m, self.acceleration_m_s2, self.trust_per_misfit, *self.trust_m) <= 0:
            raise InputError(f"live fit: standard deviations must be positive: {self}")


class WindowFit:
    """One person's live fit; the state is this person's alone.

    Args:
        rate_hz: Frames per second.
        most_waiting: Frames that wait for their pose to be due, at most.
        num_candidates: Candidates of a frame, at most.
        options: How.
    """

    def __init__(
        self, rate_hz: float, most_waiting: int, num_candidates: int, options: WindowFitOptions | None = None
    ) -> None:
        self._options = options or WindowFitOptions()
        self._rate_hz = rate_hz
        joints, ring = OP14.num_joints, most_waiting + 1  # the last one done is needed too
        self._frame = np.zeros(ring, dtype=np.int64)
        self._image_m = np.full((ring, joints, 2), np.nan)
        self._weight = np.zeros((ring, joints))
        self._vector_m = np.zeros((ring, num_candidates, joints, 3))
        self._log_weight = np.full((ring, num_candidates), -np.inf)
        self._size_m, self._deviation_m = np.zeros((ring, joints)), np.zeros((ring, joints))
        self._cost = np.zeros((ring, NUM_SIGN_STATES))
        self._back = np.zeros((ring, NUM_SIGN_STATES), dtype=np.int64)
        self._trust_m, self._distance_m = np.ones(ring), np.ones(ring)
        self._sign, self._fitted_m = np.zeros((ring, joints)), np.zeros((ring, joints, 3))
        self._first = self._num_waiting = 0
        self._has_newest = False
        self._fixed_m, self._fixed_frame = np.zeros((_NUM_FIXED, joints, 3)), np.full(_NUM_FIXED, -1, dtype=np.int64)
        self._num_fixed = 0
        self._recent_m = np.full((_NOISE_FRAMES, joints, 2), np.nan)
        self._recent_frame = np.full(_NOISE_FRAMES, -1, dtype=np.int64)
        self._noise_m = 0.0
        self._joint_noise_m = np.zeros(joints)

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
        options, depth = self._options, self._options.depth
        last, slot = self._slot(self._num_waiting - 1), self._slot(self._num_waiting)
        image = np.where((weights > 0)[:, None], image_m, np.nan)
        self._recent_m = np.concatenate([self._recent_m[1:], image[None]])
        self._recent_frame = np.append(self._recent_frame[1:], frame)
        self._noise_m = noise_of(self._recent_m, self._recent_frame)
        count = len(candidates_m)
        self._vector_m[slot, :count] = bones_of(candidates_m)
        self._log_weight[slot, :count] = (match_m[0] - match_m) / depth.misfit_m
        self._log_weight[slot, count:] = -np.inf
        size, deviation, score = vote_signs(
            unify_image(flatten_image(image, candidates_m[0], distance_m), proportions),
            REFERENCE_LENGTHS_M,
            self._vector_m[slot],
            self._log_weight[slot],
            max(self._noise_m, options.least_noise_m),
            depth.kernel_m,
            depth.floor,
        )
        if self._has_newest:
            way = depth.speed_m_s * (frame - self._frame[last]) / self._rate_hz
            self._cost[slot], self._back[slot] = extend_signs(
                self._cost[last],
                self._size_m[last],
                self._deviation_m[last],
                size,
                deviation,
                score,
                REFERENCE_LENGTHS_M,
                way,
            )
        else:
            self._cost[slot], self._back[slot] = -score, 0
        misfit = np.sqrt(max(float(match_m[0]) ** 2 - (_MEAN_OF_RAYLEIGH * self._noise_m) ** 2, 0.0))
        self._trust_m[slot] = min(max(options.trust_per_misfit * misfit, options.trust_m[0]), options.trust_m[1])
        self._size_m[slot], self._deviation_m[slot] = size, deviation
        self._frame[slot], self._image_m[slot], self._weight[slot] = frame, image, weights
        self._distance_m[slot], self._sign[slot] = distance_m, 0.0
        self._num_waiting += 1
        self._has_newest = True

    def fit(self, ranks: Integers, proportions: Array) -> Array:
        """Return the pose (14, 3) of the oldest frame, about its mid-hip, camera axes; the frame is then done with.

        Args:
            ranks: Candidate that each waiting frame follows by now, the oldest first.
            proportions: Length of each bone (14,) as a multiple of the reference body's.
        """
        options = self._options
        waiting = self._slot(np.arange(self._num_waiting))
        sign = trace_signs(self._cost, self._back, waiting)
        slots = waiting[: options.most_ahead + 1]
        noise = max(self._noise_m, options.least_noise_m)
        joint_noise = np.maximum(self._joint_noise_m, noise)
        share = self._noise_m**2 / (self._noise_m**2 + options.equal_noise_m**2)
        lengths = REFERENCE_LENGTHS_M * proportions
        start, image, weight, bones = prepare_window(
            slots,
            sign,
            ranks,
            self._image_m,
            self._weight,
            self._vector_m,
            self._log_weight,
            self._size_m,
            self._deviation_m,
            self._distance_m,
            self._sign,
            self._fitted_m,
            REFERENCE_LENGTHS_M,
            proportions,
            options.depth.kernel_m,
            share,
            joint_noise,
        )
        count = self._num_fixed
        fixed = slice(_NUM_FIXED - count, None)
        frames = np.concatenate([self._fixed_frame[fixed], self._frame[slots]])
        time_deviation = options.acceleration_m_s2 / self._rate_hz**2
        time_weight = np.zeros(len(frames))
        time_weight[2:] = (frames[2:] == frames[:-2] + 2) / time_deviation**2
        is_whole = bool((self._weight[slots] > 0).all())
        fitted = fit_window(
            np.concatenate([self._fixed_m[fixed], start]),
            count,
            lengths,
            _behind(image, count),
            _behind(weight, count),
            _behind(bones, count),
            _behind(1.0 / self._trust_m[slots] ** 2, count),
            time_weight,
            _behind(self._distance_m[slots], count, 1.0),
            options.tolerance,
            options.most_solves if is_whole else options.most_solves_missing,
        )
        self._fitted_m[slots] = fitted[count:]
        slot = int(slots[0])
        pose = fitted[count]
        noise_of_joint = residuals_of(self._image_m[slot], pose, self._distance_m[slot]) / _MEAN_OF_RAYLEIGH
        known = np.isfinite(noise_of_joint)
        self._joint_noise_m[known] += _NOISE_GAIN * (noise_of_joint[known] - self._joint_noise_m[known])
        self._fixed_m = np.concatenate([self._fixed_m[1:], pose[None]])
        self._fixed_frame = np.append(self._fixed_frame[1:], self._frame[slot])
        self._num_fixed = min(count + 1, _NUM_FIXED)
        self._first, self._num_waiting = self._first + 1, self._num_waiting - 1
        return np.asarray(pose - 0.5 * (pose[_LEFT_HIP] + pose[_RIGHT_HIP]))

    def _slot(self, place: Any) -> Any:
        """Return where the frame of this place in the queue lies in the ring; -1 is the frame last done with."""
        return (self._first + place) % len(self._frame)


def _behind(values: Array, count: int, filling: float = 0.0) -> Array:
    """Return values (n, ...) behind `count` rows that do not matter."""
    return np.concatenate([np.full((count, *values.shape[1:]), filling), values])
