"""Viterbi through candidates as frames arrive: each frame is decided a fixed number of frames later, once."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.projections.database import Database
from pasdedeux.reconstruction.live.frame_kernels import transition_costs, turn_poses
from pasdedeux.reconstruction.temporal import TemporalWeights

__all__ = ["Decision", "FixedLagViterbi"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


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
        self.path: Integers = np.zeros(0, dtype=np.int64)
        """Candidates, by the best path to the newest frame, from the first frame that was just decided on."""

    def push(self, frame: int, row: Integers, yaw_steps: Array, distance_m: Array) -> list[Decision]:
        """Add a frame's candidates (k,), at least one of finite distance; give what is old enough to be decided.

        Args:
            frame: Its number, after that of the frame before.
            row: Database rows.
            yaw_steps: Their yaws in steps of the database, also between them.
            distance_m: Their distances in the image.
        """
        poses, yaw_rad = self._database.poses_m, yaw_steps * self._database.yaw_step_rad
        pose = turn_poses(poses, row, yaw_rad)
        following = turn_poses(poses, self._successors[row], yaw_rad)
        back = np.full(len(row), -1, dtype=np.int64)
        cost = np.array(distance_m, dtype=np.float64)
        if self._steps:
            last = self._steps[-1]
            gap = frame - last.frame
            share = min(self._database.rate_hz / self._rate_hz * gap, 1.0)
            ahead = last.continued[0] + share * (last.continued[1] - last.continued[0])
            coming, back = transition_costs(pose, ahead, last.cost, self._weights.pose / np.sqrt(gap))
            cost = cost + coming
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
        self.path = np.array(ranks[self._num_decided :], dtype=np.int64)
        decided = [Decision(steps[i].frame, ranks[i]) for i in range(self._num_decided, count)]
        # The newest decided frame stays: it is where the paths of later frames start from.
        for _ in range(count - 1):
            self._steps.popleft()
        self._num_decided = 1
        return decided
