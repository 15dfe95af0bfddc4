"""Reconstruction as frames arrive: each pose leaves a fixed number of frames after its image, and is never changed.

Per person: scale and place from the frames of the last moments, exact search, Viterbi over the candidates with a fixed
lag, 1-euro filter on rotations and root.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import conjugate, multiply, rotate, rotvec_from_unitquat, slerp, swing_between
from pasdedeux.projections.bones import bone_rotations, place_bone_rotations
from pasdedeux.projections.database import Database
from pasdedeux.projections.identity import Follower, IdentityOptions
from pasdedeux.projections.proportions import estimate_proportions, retarget_image
from pasdedeux.projections.reconstruct import Searcher, straighten_rays
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.projections.scale import Placement, place_track, refine_placement
from pasdedeux.projections.smoothing import OneEuro
from pasdedeux.projections.temporal import TemporalWeights
from pasdedeux.projections.tracks import Lens
from pasdedeux.skeletons import OP14

__all__ = ["Decision", "FixedLagViterbi", "LiveOptions", "LivePeople", "LivePerson", "LivePose"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_ROOT_BETA = 2.0
"""Growth of the root's cut-off with its speed, Hz per m/s: bodies move slower than limbs turn."""


@dataclass(frozen=True)
class LiveOptions:
    """How people are reconstructed live.

    Args:
        lag: A pose leaves this many frames after its image.
        num_candidates: Projections kept per frame.
        min_joints: Frames with fewer joints of a person give no pose.
        window_s: Scale and proportions are taken from the frames of this time.
        proportions_every: Frames between two estimates of a person's proportions.
        temporal: Costs of the choice over time.
        smoothing: The 1-euro filter.
        identities: How people are followed.
    """

    lag: int = 6
    num_candidates: int = 20
    min_joints: int = 4
    window_s: float = 1.0
    proportions_every: int = 15
    temporal: TemporalWeights = field(default_factory=TemporalWeights)
    smoothing: OneEuro = field(default_factory=OneEuro)
    identities: IdentityOptions = field(default_factory=IdentityOptions)

    def __post_init__(self) -> None:
        """Refuse values without meaning."""
        if self.lag < 0 or min(self.num_candidates, self.min_joints, self.proportions_every) < 1 or self.window_s <= 0:
            raise InputError(f"live reconstruction: counts, lag and window must be positive: {self}")


@dataclass(frozen=True)
class Decision:
    """What the fixed-lag choice settled on: candidate `rank` of frame `frame`."""

    frame: int
    rank: int


@dataclass
class _Step:
    """A frame of the lattice."""

    frame: int
    continued: Array
    cost: Array
    back: Integers


class FixedLagViterbi:
    """Viterbi through candidates as frames arrive; with a lag of the whole sequence it is `choose_viterbi`.

    Args:
        database: Database searched.
        rate_hz: Frames per second of the sequence.
        lag: Frames of the sequence between a frame and its decision.
        weights: Costs.
    """

    def __init__(self, database: Database, *, rate_hz: float, lag: int, weights: TemporalWeights | None = None) -> None:
        self._database = database
        self._successors = database.successors()
        self._rate_hz = rate_hz
        self._lag = lag
        self._weights = weights or TemporalWeights()
        self._steps: deque[_Step] = deque()
        self._num_decided = 0

    def push(self, frame: int, row: Integers, yaw_index: Integers, distance_m: Array) -> list[Decision]:
        """Add a frame's candidates (k,), at least one of finite distance; give what is old enough to be decided."""
        pose = self._database.turned(row, yaw_index)
        following = self._database.turned(self._successors[row], yaw_index)
        back = np.full(len(row), -1, dtype=np.int64)
        cost = np.array(distance_m, dtype=np.float64)
        if self._steps:
            last = self._steps[-1]
            gap = frame - last.frame
            share = min(self._database.rate_hz / self._rate_hz * gap, 1.0)
            ahead = last.continued[0] + share * (last.continued[1] - last.continued[0])
            change = np.linalg.norm(pose[:, None] - ahead[None], axis=-1).mean(axis=-1)
            total = last.cost[None] + self._weights.pose / np.sqrt(gap) * change
            back = np.argmin(total, axis=1)
            cost = cost + total[np.arange(len(row)), back]
        # Only differences count; without this a long night would eat the digits.
        cost -= cost.min()
        self._steps.append(_Step(frame, np.stack([pose, following]), cost, back))
        return self.decide_until(frame - self._lag)

    def decide_until(self, frame: int) -> list[Decision]:
        """Decide every frame up to this one, by the best path to the newest frame."""
        count = sum(step.frame <= frame for step in self._steps)
        if count <= self._num_decided:
            return []
        steps = list(self._steps)
        rank = int(np.argmin(steps[-1].cost))
        ranks = [rank]
        for step in reversed(steps[1:]):
            rank = int(step.back[rank])
            ranks.append(rank)
        ranks.reverse()
        decided = [Decision(steps[i].frame, ranks[i]) for i in range(self._num_decided, count)]
        # The newest decided frame stays: it is where the paths of later frames start from.
        for _ in range(count - 1):
            self._steps.popleft()
        self._num_decided = 1
        return decided


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
    yaw_index: Integers
    distance_m: Array
    root_m: Array
    num_joints_seen: int


@dataclass(frozen=True)
class _Seen:
    """A frame that scale and proportions are taken from."""

    straight_px: Array
    weights: Array
    own_m: Array
    matched_m: Array


class LivePerson:
    """One person's reconstruction as frames arrive.

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
        self._window: deque[_Seen] = deque(maxlen=max(3, round(self._options.window_s * rate_hz)))
        self._waiting: deque[_Waiting] = deque()
        self._proportions = np.ones(OP14.num_joints)
        self._num_seen = 0
        self._scale = float("nan")
        self._rotations = _OneEuroState(self._options.smoothing, rate_hz, _turned_by, slerp)
        root = replace(self._options.smoothing, beta=_ROOT_BETA)
        self._root = _OneEuroState(root, rate_hz, lambda a, b: a - b, lambda a, b, share: a + share * (b - a))

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
                decided = self._viterbi.push(frame, waiting.row, waiting.yaw_index, waiting.distance_m)
                return [self._pose(one) for one in decided]
        return self.advance(frame)

    def advance(self, frame: int) -> list[LivePose]:
        """Give the poses that are due when the sequence is at `frame` and the person is not seen."""
        return [self._pose(one) for one in self._viterbi.decide_until(frame - self._options.lag)]

    def finish(self) -> list[LivePose]:
        """Give all poses that still wait."""
        if not self._waiting:
            return []
        return [self._pose(one) for one in self._viterbi.decide_until(self._waiting[-1].frame)]

    def _match(self, frame: int, points: Array, weights: Array) -> _Waiting | None:
        database, reference = self._searcher.database, self._searcher.reference
        before = list(self._window)
        weight = np.stack([*(one.weights for one in before), weights])
        window = 2 * len(weight) + 1  # the median of all frames at hand
        first = place_track(points[None], weights[None], reference, window=1)
        straight, towards = straighten_rays(points[None], first.mid_hip_px, self._lens.focal_px)
        image = np.stack([*(one.straight_px for one in before), straight[0]])
        placement = place_track(image, weight, reference, window=window)
        matched = np.full(image.shape, np.nan)
        for index, one in enumerate(before):
            matched[index] = one.matched_m
        # The scale of the frame before is better than a first guess, and close enough to find the match by.
        scale = self._scale if before else float(placement.metres_per_pixel[-1])
        own = (image[-1] - placement.mid_hip_px[-1]) * scale
        found = self._searcher.index.search(
            retarget_image(own, self._proportions)[None], weights[None], num_neighbours=1
        )
        if found.projection[0, 0] < 0:
            return None
        matched[-1] = database.camera.project(database.turned(found.row[0, 0], found.yaw_index[0, 0])[None])[0]
        placement = self._refined(image, weight, matched, window, placement)
        own = placement.to_metres(image)[-1]
        found = self._searcher.index.search(
            retarget_image(own, self._proportions)[None], weights[None], num_neighbours=self._options.num_candidates
        )
        is_real = np.asarray(found.projection[0] >= 0)
        self._window.append(_Seen(straight[0], weights, own, matched[-1]))
        self._num_seen += 1
        if self._num_seen % self._options.proportions_every == 0:
            self._proportions = estimate_proportions(
                np.stack([one.own_m for one in self._window]),
                np.stack([one.weights for one in self._window]),
                np.stack([one.matched_m for one in self._window]),
            )
        self._scale = scale = float(placement.metres_per_pixel[-1])
        place = np.append(placement.mid_hip_px[-1] * scale, -scale * self._lens.focal_px)
        turn = swing_between(np.array([0.0, 0.0, 1.0]), towards[0])
        return _Waiting(
            frame,
            found.row[0, is_real],
            found.yaw_index[0, is_real],
            np.asarray(found.distance_m[0, is_real], dtype=np.float64),
            rotate(turn, place),
            int(np.count_nonzero(weights > 0)),
        )

    def _refined(self, image: Array, weight: Array, matched: Array, window: int, previous: Placement) -> Placement:
        own = retarget_image(matched, 1.0 / self._proportions)
        return refine_placement(image, weight, own, window=window, previous=previous)

    def _pose(self, decision: Decision) -> LivePose:
        waiting = self._waiting.popleft()
        assert waiting.frame == decision.frame, "every frame pushed is decided once, in order"
        database = self._searcher.database
        row, yaw = waiting.row[decision.rank], waiting.yaw_index[decision.rank]
        pose = database.turned(row, yaw) @ np.asarray(database.camera.camera_from_upright_rotmat).T
        unitquat = self._rotations.step(waiting.frame, bone_rotations(pose))
        root = self._root.step(waiting.frame, waiting.root_m)
        relative = place_bone_rotations(unitquat, REFERENCE_LENGTHS_M * self._proportions, np.zeros(3))
        towards = -root / np.linalg.norm(root)
        turn = swing_between(np.array([0.0, 0.0, 1.0]), towards)
        positions = rotate(np.broadcast_to(turn, (OP14.num_joints, 4)), relative) + root
        turned = np.array(unitquat)  # bones turn against each other, so only the body's frame turns with the whole
        turned[OP14.root] = multiply(turn, unitquat[OP14.root])
        return LivePose(
            person_id=self.person_id,
            frame=waiting.frame,
            positions_m=positions,
            bone_unitquat=turned,
            root_m=mid_hip(positions),
            yaw_rad=float(yaw * database.yaw_step_rad),
            score_m=float(waiting.distance_m[decision.rank]),
            row=int(row),
            num_joints_seen=waiting.num_joints_seen,
        )


class LivePeople:
    """All people of a video as frames arrive: followed by identity, each reconstructed on their own.

    Args:
        searcher: Database made ready.
        rate_hz: Frames per second.
        image_size_px: Width and height; told from the first people seen when not given.
        options: How.
    """

    def __init__(
        self,
        searcher: Searcher,
        *,
        rate_hz: float,
        image_size_px: tuple[int, int] | None = None,
        options: LiveOptions | None = None,
    ) -> None:
        if not (np.isfinite(rate_hz) and rate_hz > 0):
            raise InputError(f"live reconstruction: the frame rate is {rate_hz}, it must be positive")
        self._options = options or LiveOptions()
        self._searcher = searcher
        self._rate_hz = rate_hz
        self._size = image_size_px
        self._lens: Lens | None = None
        self._follower = Follower(self._options.identities)
        self._people: dict[int, LivePerson] = {}
        self._last_seen: dict[int, int] = {}
        self._last_frame: int | None = None

    def push(self, frame: int, keypoints_px: Array, confidence: Array) -> list[LivePose]:
        """Take the detections of a frame (detection, 14, 2), any order; give the poses that are due, by person.

        Raises:
            InputError: The frame does not come after the one before.
        """
        if self._last_frame is not None and frame <= self._last_frame:
            raise InputError(f"frame {frame} comes after frame {self._last_frame}; frames must come in order")
        self._last_frame = frame
        found = self._follower.step(frame / self._rate_hz, keypoints_px, confidence)
        if self._lens is None and (found.track_id >= 0).any():
            width, height = self._size or (None, None)
            self._lens = Lens.assumed(width, height, found.keypoints_px)
        poses: list[LivePose] = []
        at = {int(person): index for index, person in enumerate(found.track_id) if person >= 0}
        for person in at:
            if person not in self._people and self._lens is not None:
                self._people[person] = LivePerson(
                    person, self._searcher, rate_hz=self._rate_hz, lens=self._lens, options=self._options
                )
        for person in sorted(self._people):
            if person in at:
                self._last_seen[person] = frame
                poses += self._people[person].push(frame, found.keypoints_px[at[person]], found.confidence[at[person]])
            else:
                poses += self._people[person].advance(frame)
        forgotten = frame - self._options.identities.most_absent_s * self._rate_hz - self._options.lag
        for person in [one for one, last in self._last_seen.items() if last < forgotten]:
            del self._people[person], self._last_seen[person]
        return poses

    def finish(self) -> list[LivePose]:
        """Give all poses that still wait."""
        return [pose for person in sorted(self._people) for pose in self._people[person].finish()]


class _OneEuroState:
    """The 1-euro filter of `smoothing.smooth_one_euro`, a frame at a time, where there is a difference and a step."""

    def __init__(
        self,
        parameters: OneEuro,
        rate_hz: float,
        difference: Callable[[Array, Array], Array],
        step: Callable[[Array, Array, Array], Array],
    ) -> None:
        self._parameters = parameters
        self._rate_hz = rate_hz
        self._difference = difference
        self._step = step
        self._frame = 0
        self._value: Array | None = None
        self._speed = np.zeros(())

    def step(self, frame: int, value: Array) -> Array:
        """Give the smoothed value of this frame; after a gap the rate is that of the frames that came."""
        if self._value is None:
            self._value, self._frame = np.array(value), frame
            self._speed = np.zeros(value.shape[:-1])
            return self._value
        rate = self._rate_hz / max(frame - self._frame, 1)
        moved = np.linalg.norm(self._difference(value, self._value), axis=-1) * rate
        cutoff = np.asarray(self._parameters.derivative_cutoff_hz)
        self._speed = self._speed + _share(cutoff, rate) * (moved - self._speed)
        share = _share(self._parameters.min_cutoff_hz + self._parameters.beta * self._speed, rate)
        self._value, self._frame = np.asarray(self._step(self._value, value, share)), frame
        return self._value


def _turned_by(after: Array, before: Array) -> Array:
    return rotvec_from_unitquat(multiply(after, conjugate(before)))


def _share(cutoff_hz: Array, rate_hz: float) -> Array:
    """Give the weight of a new sample in a first-order low-pass."""
    return np.asarray(1.0 / (1.0 + rate_hz / (2.0 * np.pi * cutoff_hz)))
