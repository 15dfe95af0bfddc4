"""One person's reconstruction as frames arrive: matched, chosen with a fixed lag, fitted, filtered, cleaned up.

Scale and place come from the frames of the last moments; every frame is searched once, its yaws are refined between the
steps, Viterbi chooses among the candidates, the pose is fitted to a few frames of the image, a 1-euro filter goes over
rotations and root, and planted feet are stilled.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import multiply
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M
from pasdedeux.projections.scale import place_track
from pasdedeux.reconstruction.identity import IdentityOptions
from pasdedeux.reconstruction.live.cleanup import LiveCleanUp, LiveCleanUpOptions
from pasdedeux.reconstruction.live.fixed_lag import Decision, FixedLagViterbi
from pasdedeux.reconstruction.live.frame_kernels import (
    filter_rotations,
    find_bone_rotations,
    least_squares_scale,
    place_bones,
    rotate_vector,
    straighten_frame,
    turn_from_camera_axis,
    turn_poses,
    unify_image,
)
from pasdedeux.reconstruction.live.window_fit import WindowFit, WindowFitOptions
from pasdedeux.reconstruction.proportions import estimate_proportions
from pasdedeux.reconstruction.reconstruct import Searcher
from pasdedeux.reconstruction.smoothing import OneEuro, one_euro_share
from pasdedeux.reconstruction.temporal import TemporalWeights
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.reconstruction.yaw import refine_yaws
from pasdedeux.skeletons import OP14

__all__ = ["LiveOptions", "LivePerson", "LivePose"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")

_FIRST_ROUNDS = 3
"""Searches of a person's first frame, whose scale is only guessed from the bones."""

_SPREAD_FRAMES = 32
"""Frames that proportions are estimated from, at least when as many were seen, and less than twice as many."""


@dataclass(frozen=True)
class LiveOptions:
    """How people are reconstructed live.

    Args:
        lag: A pose leaves this many frames after its image.
        num_candidates: Projections kept per frame.
        min_joints: Frames with fewer joints of a person give no pose.
        window_s: Scale is taken from the frames of this time; with longer ones it lags behind people who walk away.
        proportions_every: Frames between two estimates of a person's proportions.
        temporal: Costs of the choice over time.
        smoothing: The 1-euro filter of rotations.
        root_smoothing: That of the way, whose growth is in Hz per m/s.
        identities: How people are followed.
        search_slack: What the search does not look into holds nothing nearer than 1 / (1 + this) of the farthest
            candidate; 0 is exact.
        metres_per_pixel: Scale of the image at the person where it is known; estimated otherwise.
        has_own_proportions: Bone lengths are estimated per person; the reference body's otherwise.
        is_fitted: Poses are fitted to the images of their window.
        fit: What the fit believes.
        has_clean_up: Planted feet are stilled and the floor is kept.
        clean_up: How.
    """

    lag: int = 6
    num_candidates: int = 20
    min_joints: int = 4
    window_s: float = 0.3
    proportions_every: int = 15
    temporal: TemporalWeights = field(default_factory=TemporalWeights)
    smoothing: OneEuro = field(default_factory=lambda: OneEuro(min_cutoff_hz=6.0, beta=2.0))
    root_smoothing: OneEuro = field(default_factory=lambda: OneEuro(min_cutoff_hz=0.8, beta=2.0))
    identities: IdentityOptions = field(default_factory=IdentityOptions)
    search_slack: float = 0.2
    metres_per_pixel: float | None = None
    has_own_proportions: bool = True
    is_fitted: bool = True
    fit: WindowFitOptions = field(default_factory=WindowFitOptions)
    has_clean_up: bool = True
    clean_up: LiveCleanUpOptions = field(default_factory=LiveCleanUpOptions)

    def __post_init__(self) -> None:
        """Refuse values without meaning."""
        if self.lag < 0 or min(self.num_candidates, self.min_joints, self.proportions_every) < 1:
            raise InputError(f"live reconstruction: counts must be at least 1 and the lag not negative: {self}")
        if self.window_s <= 0 or not (self.metres_per_pixel is None or self.metres_per_pixel > 0):
            raise InputError(f"live reconstruction: windows and scales must be positive: {self}")


@dataclass(frozen=True)
class LivePose:
    """One person's pose in one frame, camera axes (x right, y up, z towards the camera), camera at the origin, metres.

    Args:
        person_id: Person, stable over frames.
        frame: Frame of the image.
        positions_m: op14 positions (14, 3).
        bone_unitquat: Rotations of the bones (14, 4), see `bones.bone_rotations`.
        root_m: Mid-hip (3,).
        yaw_rad: Yaw of the matched projection.
        score_m: Mean distance per seen joint to it.
        row: Database row matched.
        num_joints_seen: Joints seen in the image.
    """

    person_id: int
    frame: int
    positions_m: Array
    bone_unitquat: Array
    root_m: Array
    yaw_rad: float
    score_m: float
    row: int
    num_joints_seen: int


@dataclass(frozen=True)
class _Waiting:
    """A frame that waits for its decision."""

    frame: int
    row: Integers
    yaw_steps: Array
    distance_m: Array
    pose_m: Array
    root_m: Array
    own_m: Array
    weights: Array


@dataclass(frozen=True)
class _Seen:
    """A frame that proportions are taken from: own and matched images, metres."""

    weights: Array
    own_m: Array
    matched_m: Array


class LivePerson:
    """One person's reconstruction as frames arrive.

    A frame is placed by the scale so far, searched once, placed anew by its best match, and its candidates are turned
    to their best yaws at that place.

    Args:
        person_id: Who.
        searcher: Database made ready.
        rate_hz: Frames per second.
        lens: The camera as far as it is known.
        options: How.
    """

    def __init__(
        self, person_id: int, searcher: Searcher, *, rate_hz: float, lens: Lens, options: LiveOptions | None = None
    ) -> None:
        self.person_id = person_id
        self._options = options or LiveOptions()
        self._searcher = searcher
        self._rate_hz = rate_hz
        self._lens = lens
        self._viterbi = FixedLagViterbi(
            searcher.database, rate_hz=rate_hz, lag=self._options.lag, weights=self._options.temporal
        )
        window = max(3, round(self._options.window_s * rate_hz))
        self._spread: list[_Seen] = []
        self._stride = 1
        self._scales: deque[float] = deque(maxlen=window)
        self._waiting: deque[_Waiting] = deque()
        self._index = searcher.index.with_slack(max(searcher.index.slack, self._options.search_slack))
        self._fit = WindowFit(rate_hz, self._options.lag + 1, self._options.num_candidates, self._options.fit)
        self._proportions = np.ones(OP14.num_joints)
        self._num_seen = 0
        self._camera_rotmat: Array = np.asarray(searcher.database.camera.camera_from_upright_rotmat)
        self._rotations = _RotationFilter(self._options.smoothing, rate_hz)
        self._clean_up = LiveCleanUp(rate_hz, self._options.clean_up) if self._options.has_clean_up else None
        self._root = _PointFilter(self._options.root_smoothing, rate_hz)

    def push(self, frame: int, keypoints_px: Array, confidence: Array) -> list[LivePose]:
        """Take this person's op14 keypoints (14, 2) of a frame; give the poses that are due."""
        points = (keypoints_px - np.array(self._lens.principal_point_px)) * np.array([1.0, -1.0])
        weights = np.where(np.isfinite(points).all(axis=-1), np.nan_to_num(confidence), 0.0)
        if np.count_nonzero(weights > 0) >= self._options.min_joints:
            try:
                waiting = self._match(frame, points, weights)
            except InputError:
                waiting = None  # too little of the person to tell the size by; a later frame will do
            if waiting is not None:
                self._waiting.append(waiting)
                if self._options.is_fitted:
                    distance = float(np.linalg.norm(waiting.root_m))
                    self._fit.see(
                        frame,
                        waiting.own_m,
                        waiting.weights,
                        waiting.pose_m,
                        waiting.distance_m,
                        distance,
                        self._proportions,
                    )
                return self._poses(self._viterbi.push(frame, waiting.row, waiting.yaw_steps, waiting.distance_m))
        return self.advance(frame)

    def advance(self, frame: int) -> list[LivePose]:
        """Return the poses that are due when the sequence is at `frame` and the person is not seen."""
        return self._poses(self._viterbi.decide_until(frame - self._options.lag))

    def finish(self) -> list[LivePose]:
        """Return all poses that still wait."""
        if not self._waiting:
            return []
        return self._poses(self._viterbi.decide_until(self._waiting[-1].frame))

    def _match(self, frame: int, points: Array, weights: Array) -> _Waiting | None:
        database, focal = self._searcher.database, self._lens.focal_px
        known = self._options.metres_per_pixel
        if known is not None:
            scale, rounds = known, 1
        elif self._scales:
            scale, rounds = median(self._scales), 1
        else:
            first = place_track(points[None], weights[None], self._searcher.reference, window=1)
            scale, rounds = float(first.metres_per_pixel[0]), _FIRST_ROUNDS
        straight: Array
        straight, towards = straighten_frame(points, self._mid_hip(points, weights, scale), focal)
        weights = np.where(np.isfinite(straight[:, 0]), weights, 0.0)
        centre = self._mid_hip(straight, weights, scale)
        ratio = float("nan")
        for _ in range(rounds):
            query = unify_image((straight - centre) * scale, self._proportions)
            found = self._index.search(query, weights, num_neighbours=self._options.num_candidates)
            if found.projection[0] < 0:
                return None
            yaw_rad = np.array([found.yaw_index[0] * database.yaw_step_rad])
            best = turn_poses(database.poses_m, found.row[:1], yaw_rad)
            matched: Array = np.asarray(database.camera.project(best)[0])
            fit = least_squares_scale(straight, weights, unify_image(matched, 1.0 / self._proportions))
            ratio = float(fit[0])
            if np.isfinite(ratio):
                scale = known or median([*self._scales, ratio])
                centre = fit[1:3] - fit[3:] / scale
        if np.isfinite(ratio):
            self._scales.append(ratio)
        own = (straight - centre) * scale
        if self._options.has_own_proportions:
            self._learn_proportions(_Seen(weights, own, matched))
        refined = refine_yaws(database, found, unify_image(own, self._proportions), weights)
        order = np.argsort(refined.distance_m, kind="stable")[: np.count_nonzero(found.projection >= 0)]
        row, yaw_steps = found.row[order], refined.yaw_steps[order]
        poses = turn_poses(database.poses_m, row, yaw_steps * database.yaw_step_rad) @ self._camera_rotmat.T
        place = np.append(centre * scale, -scale * focal)
        return _Waiting(
            frame,
            row,
            yaw_steps,
            refined.distance_m[order],
            poses,
            rotate_vector(turn_from_camera_axis(towards), place),
            own,
            weights,
        )

    def _mid_hip(self, points: Array, weights: Array, scale: float) -> Array:
        """Return the middle of the hips, or where joints are on average says that it is (2,), as `place_track` does."""
        if weights[_LEFT_HIP] > 0 and weights[_RIGHT_HIP] > 0:
            return np.asarray(0.5 * (points[_LEFT_HIP] + points[_RIGHT_HIP]))
        reference = self._searcher.reference
        share = weights / reference.variance_m2
        off_mean = np.nan_to_num(points) - reference.mean_m / scale
        return np.asarray(share @ off_mean / share.sum())

    def _learn_proportions(self, seen: _Seen) -> None:
        """Estimate the proportions now and then, from frames spread over all that was seen: a body does not change."""
        if self._num_seen % self._stride == 0:
            self._spread.append(seen)
            if len(self._spread) == 2 * _SPREAD_FRAMES:
                self._spread, self._stride = self._spread[::2], 2 * self._stride
        self._num_seen += 1
        if self._num_seen % self._options.proportions_every == 0:
            self._proportions = estimate_proportions(
                np.stack([one.own_m for one in self._spread]),
                np.stack([one.weights for one in self._spread]),
                np.stack([one.matched_m for one in self._spread]),
            )

    def _poses(self, decided: list[Decision]) -> list[LivePose]:
        """Return the poses of frames that were just decided on."""
        path = self._viterbi.path
        return [self._pose(one, path[at:]) for at, one in enumerate(decided)]

    def _pose(self, decision: Decision, path: Integers) -> LivePose:
        """Return the pose of the oldest frame; `path` has the candidates that it and all waiting frames follow."""
        waiting = self._waiting.popleft()
        assert waiting.frame == decision.frame, "every frame pushed is decided once, in order"
        rank = decision.rank
        pose = self._fit.fit(path, self._proportions) if self._options.is_fitted else waiting.pose_m[rank]
        unitquat = self._rotations.step(waiting.frame, find_bone_rotations(pose))
        root = self._root.step(waiting.frame, waiting.root_m)
        # Bones turn against each other, so only the body's frame turns with the whole.
        turned = np.array(unitquat)
        turned[OP14.root] = multiply(turn_from_camera_axis(-root), unitquat[OP14.root])
        positions = place_bones(turned, REFERENCE_LENGTHS_M * self._proportions) + root
        if self._clean_up is not None:
            cleaned = self._clean_up.step(waiting.frame, positions @ self._camera_rotmat)
            positions = cleaned @ self._camera_rotmat.T
            turned, root = find_bone_rotations(positions), 0.5 * (positions[_LEFT_HIP] + positions[_RIGHT_HIP])
        return LivePose(
            person_id=self.person_id,
            frame=waiting.frame,
            positions_m=positions,
            bone_unitquat=turned,
            root_m=root,
            yaw_rad=float(np.mod(waiting.yaw_steps[rank] * self._searcher.database.yaw_step_rad, 2.0 * np.pi)),
            score_m=float(waiting.distance_m[rank]),
            row=int(waiting.row[rank]),
            num_joints_seen=int(np.count_nonzero(waiting.weights > 0)),
        )


class _RotationFilter:
    """The 1-euro filter of `smoothing.smooth_one_euro`, a frame at a time; after a gap its rate is that of the gap."""

    def __init__(self, parameters: OneEuro, rate_hz: float) -> None:
        self._parameters = parameters
        self._rate_hz = rate_hz
        self._frame = 0
        self._value: Array | None = None
        self._velocity = np.zeros((OP14.num_joints, 3))

    def step(self, frame: int, value: Array) -> Array:
        """Return the smoothed rotations (14, 4) of this frame."""
        if self._value is None:
            self._value = value
        else:
            one = self._parameters
            rate = self._rate_hz / max(frame - self._frame, 1)
            self._value, self._velocity = filter_rotations(
                self._value, self._velocity, value, rate, one.min_cutoff_hz, one.beta, one.derivative_cutoff_hz
            )
        self._frame = frame
        return self._value


class _PointFilter:
    """The same for a point (3,): its speed is metres per second."""

    def __init__(self, parameters: OneEuro, rate_hz: float) -> None:
        self._parameters = parameters
        self._rate_hz = rate_hz
        self._frame = 0
        self._value: Array | None = None
        self._velocity = np.zeros(3)

    def step(self, frame: int, value: Array) -> Array:
        """Return the smoothed point of this frame."""
        if self._value is None:
            self._value = value
        else:
            one = self._parameters
            rate = self._rate_hz / max(frame - self._frame, 1)
            moved = (value - self._value) * rate
            self._velocity = self._velocity + one_euro_share(one.derivative_cutoff_hz, rate) * (moved - self._velocity)
            share = one_euro_share(one.min_cutoff_hz + one.beta * float(np.linalg.norm(self._velocity)), rate)
            self._value = self._value + share * (value - self._value)
        self._frame = frame
        return self._value
