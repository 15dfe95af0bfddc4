"""Choose one candidate per frame: the nearest, by the paper's window rule, or by Viterbi with yaws in the cost.

Viterbi decides each frame once, a fixed number of frames later; with the whole sequence as lag, it is the usual form.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Floats32, Integers
from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotations import angle_between, multiply
from pasdedeux.projections.database import Database
from pasdedeux.projections.search import Neighbours
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.skeletons import OP14

POSE_WEIGHT = 0.5
"""Cost per metre of mean joint distance between the continued motion of a candidate and the next candidate, both at
their yaws; a metre of misfit in the image costs 1."""


class FixedLagViterbi:
    """Viterbi through candidates as frames arrive: each frame is decided `lag` frames later, once.

    Emission: the 2D distance.  Transition: `POSE_WEIGHT` times the mean joint distance between the turned pose of the
    next candidate and the *continued* pose of the candidate before: its pose moved along its motion by the time between
    the frames, for at most one frame.  A pose without a successor (draws have neither past nor future) stays as it is.
    The cost falls with the length of the gap between two frames, because more may have happened in it.

    Args:
        database: Database searched.
        rate_hz: Frames per second of the sequence.
        lag: Frames of the sequence between a frame and its decision.
    """

    def __init__(self, database: Database, *, rate_hz: float, lag: int) -> None:
        self._database = database
        self._successors = database.successors()
        self._rate_hz = rate_hz
        self._lag = lag
        self._frames: deque[int] = deque()
        self._back: deque[Integers] = deque()
        self._cost: Array = np.zeros(0)
        self._motion = np.zeros((2, 0, OP14.num_joints, 3), dtype=np.float32)
        self._num_decided = 0
        self.path: Integers = np.zeros(0, dtype=np.int64)
        """Ranks on the best path to the newest frame, from the first frame of the last decision on."""

    def push(self, frames: Integers, row: Integers, yaw_steps: Array, distance_m: Array) -> list[int]:
        """Add the candidates of frames (n, k), at least one of finite distance each; return the ranks that are due.

        Args:
            frames: Their numbers (n,), larger than those before.
            row: Database rows (n, k).
            yaw_steps: Their yaws in steps of the database, also between them.
            distance_m: Their distances in the image; inf where there is no candidate.
        """
        last = self._frames[-1] if self._frames else int(frames[0]) - 1
        gap = np.diff(frames, prepend=last).astype(np.float64)
        pose = self._database.turned(row, yaw_steps).astype(np.float32)
        following = self._database.turned(self._successors[row], yaw_steps).astype(np.float32)
        self._cost, self._motion, back = _extend_paths(
            pose,
            following,
            distance_m,
            np.minimum(self._database.rate_hz / self._rate_hz * gap, 1.0),
            POSE_WEIGHT / np.sqrt(gap),
            self._cost,
            self._motion,
        )
        self._frames.extend(frames.tolist())
        self._back.extend(back)
        return self.decide_until(self._frames[-1] - self._lag)

    def decide_until(self, frame: int) -> list[int]:
        """Decide all frames up to this one by the best path to the newest frame; return their ranks in order."""
        if len(self._frames) <= self._num_decided or self._frames[self._num_decided] > frame:
            return []
        ranks = [int(np.argmin(self._cost))]
        for back in list(self._back)[:0:-1]:
            ranks.append(int(back[ranks[-1]]))
        self.path = np.array(ranks[::-1][self._num_decided :], dtype=np.int64)
        waiting = list(self._frames)[self._num_decided :]
        decided = self.path[: bisect_right(waiting, frame)].tolist()
        # Keep the newest decided frame: the paths of later frames start from it.
        for _ in range(self._num_decided + len(decided) - 1):
            self._frames.popleft()
            self._back.popleft()
        self._num_decided = 1
        return decided


def choose_nearest(neighbours: Neighbours) -> Integers:
    """Return the rank (frame,) of the best projection of each frame: always 0, or -1 where nothing was seen."""
    return np.where(neighbours.projection[:, 0] >= 0, 0, -1)


def choose_viterbi(
    database: Database, neighbours: Neighbours, *, rate_hz: float, yaw_steps: Array | None = None
) -> Integers:
    """Return the ranks (frame,) of the path of least cost through the candidates; -1 where nothing was seen.

    See `FixedLagViterbi` for the costs.  Frames without candidates are skipped.

    Args:
        database: Database searched.
        neighbours: Candidates (frame, k).
        rate_hz: Frames per second of the sequence.
        yaw_steps: Yaw of each candidate (frame, k) in steps, where it lies between the steps of the database.
    """
    ranks = np.full(len(neighbours.projection), -1, dtype=np.int64)
    frames = np.flatnonzero(neighbours.projection[:, 0] >= 0)
    if len(frames) == 0:
        return ranks
    yaw = (neighbours.yaw_index if yaw_steps is None else yaw_steps)[frames].astype(np.float64)
    viterbi = FixedLagViterbi(database, rate_hz=rate_hz, lag=len(ranks))
    viterbi.push(frames, np.maximum(neighbours.row[frames], 0), yaw, neighbours.distance_m[frames])
    ranks[frames] = viterbi.decide_until(int(frames[-1]))
    return ranks


def choose_window(
    database: Database, neighbours: Neighbours, *, window: int = 4, yaw_steps: Array | None = None
) -> Integers:
    """Return the ranks (frame,) chosen by the paper's rule; -1 where nothing was seen.

    Each candidate's `window` previous frames in its own motion are compared with the `window` previously reconstructed
    poses by eq. 2 of Yiannakides et al. 2019, the sum over joints of |log(q_j^-1 q_i)|^2 on the short arc; the least
    average wins.  The log of a unit quaternion is half its rotation vector.  Each of the window's frames weighs less
    the further back it lies (1/1, 1/2, ...), for the paper weighs them "differently" without saying how.  Candidates
    with fewer previous frames are compared over those they have; with none they keep only the distance of the first.
    Yaw turns the frame of the body in both.  The first frame takes the nearest candidate.
    """
    ranks = np.full(len(neighbours.projection), -1, dtype=np.int64)
    starts = np.flatnonzero(database.is_sequence_start)
    start_of = starts[np.searchsorted(starts, np.arange(database.num_rows), side="right") - 1]
    yaws = neighbours.yaw_index if yaw_steps is None else yaw_steps
    candidates = neighbours.row[neighbours.projection >= 0]
    used = np.unique(np.maximum(candidates[:, None] - np.arange(window + 1), 0))
    # Facing +Z; computed once, because a yaw changes only the rotation of the neck.
    unitquat = bone_rotations(database.poses_m[used].astype(np.float64))

    def turned(rows: Integers, yaw: npt.ArrayLike) -> Array:
        """Return the bone rotations (*batch, 14, 4) of rows at yaws in steps, which broadcast to them."""
        rotations = np.array(unitquat[np.searchsorted(used, rows)])
        half = np.broadcast_to(0.5 * database.yaw_step_rad * np.asarray(yaw, dtype=np.float64), np.shape(rows))
        zero = np.zeros(half.shape)
        turn = np.stack([zero, np.sin(half), zero, np.cos(half)], axis=-1)
        rotations[..., OP14.root, :] = multiply(turn, rotations[..., OP14.root, :])
        return rotations

    chosen: list[Array] = []
    for frame in range(len(ranks)):
        is_real = neighbours.projection[frame] >= 0
        if not is_real.any():
            continue
        row, yaw = neighbours.row[frame, is_real], yaws[frame, is_real]
        past = min(window, len(chosen))
        if past == 0:
            rank = 0
        else:
            back = np.arange(1, past + 1)
            rows = row[:, None] - back
            has_past = rows >= start_of[row][:, None]
            rows = np.where(has_past, rows, start_of[row][:, None])
            candidates_past = turned(rows, yaw[:, None])
            reconstructed = np.stack(chosen[: -past - 1 : -1])
            distance = np.sum((0.5 * angle_between(candidates_past, reconstructed[None])) ** 2, axis=-1)
            weight = np.where(has_past, 1.0, 0.0) / back
            weight[~has_past.any(axis=1), 0] = 1.0
            rank = int(np.argmin(np.sum(weight * np.sqrt(distance), axis=1) / weight.sum(axis=1)))
        ranks[frame] = rank
        chosen.append(turned(row[rank], yaw[rank]))
    return ranks


@compiled()
def _extend_paths(
    pose: Floats32, following: Floats32, emission: Array, share: Array, weight: Array, cost: Array, motion: Floats32
) -> tuple[Array, Floats32, Integers]:
    """Return the least costs (k,) of paths to the last new frame, its motion, and the predecessors on the paths (n, k).

    Ties go to the lower rank.  Only differences of costs matter, so the least cost of each frame is subtracted.

    Args:
        pose: Candidates of the new frames (n, k, 14, 3).
        following: Their poses in the next frame of the database.
        emission: Cost of each candidate; inf where there is none.
        share: Part of a frame of the database that passes before each new frame (n,).
        weight: Cost per metre of mean joint distance to the frame before (n,).
        cost: Costs of the frame before the new ones (j,); empty for the first.
        motion: Its candidates, and their poses in the next frame of the database (2, j, 14, 3).
    """
    frames, count, joints = pose.shape[0], pose.shape[1], pose.shape[2]
    back = np.full((frames, count), -1, dtype=np.int64)
    for frame in range(frames):
        new_cost = emission[frame].copy()
        if cost.shape[0] > 0:
            part = np.float32(share[frame])
            ahead = motion[0] + part * (motion[1] - motion[0])
            for this in range(count):
                if not np.isfinite(emission[frame, this]):
                    continue
                best = np.inf
                for before in range(cost.shape[0]):
                    if cost[before] >= best:
                        continue
                    distance = np.float32(0.0)
                    for joint in range(joints):
                        dx = pose[frame, this, joint, 0] - ahead[before, joint, 0]
                        dy = pose[frame, this, joint, 1] - ahead[before, joint, 1]
                        dz = pose[frame, this, joint, 2] - ahead[before, joint, 2]
                        distance += np.sqrt(dx * dx + dy * dy + dz * dz)
                    total = cost[before] + weight[frame] * distance / joints
                    if total < best:
                        best = total
                        back[frame, this] = before
                new_cost[this] += best
        cost = new_cost - new_cost.min()
        motion = np.stack((pose[frame], following[frame]))
    return cost, motion, back
