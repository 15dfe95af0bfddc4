"""Choosing one candidate a frame: nearest, the paper's window rule, Viterbi with yaw and root rotation in the cost."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import angle_between, multiply
from pasdedeux.projections.database import Database
from pasdedeux.projections.search import Neighbours
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.skeletons import OP14

__all__ = ["TemporalWeights", "choose_nearest", "choose_viterbi", "choose_window", "viterbi_path"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TemporalWeights:
    """How much a change between frames costs against a misfit in the image.

    Args:
        pose: Cost per metre of mean joint distance between where a candidate's motion goes next and the next candidate,
            both turned by their yaw, so yaw and root rotation are part of it; against 1 per metre of 2D misfit.
    """

    pose: float = 0.6

    def __post_init__(self) -> None:
        """Refuse negative weights."""
        if not (np.isfinite(self.pose) and self.pose >= 0):
            raise InputError(f"the weight of a pose change is {self.pose}; it must be finite and not negative")


def choose_nearest(neighbours: Neighbours) -> Integers:
    """Return the rank (frame,) of the best projection of each frame: always 0, or -1 where nothing was seen."""
    return np.where(neighbours.projection[:, 0] >= 0, 0, -1)


def choose_viterbi(
    database: Database,
    neighbours: Neighbours,
    *,
    rate_hz: float,
    weights: TemporalWeights | None = None,
    yaw_steps: Array | None = None,
) -> Integers:
    """Return the ranks (frame,) of the path of least cost through the candidates; -1 where nothing was seen.

    Emission: the 2D distance.  Transition: `TemporalWeights.pose` times the mean joint distance between the turned pose
    of the next candidate and the *continued* pose of the one before, that is its own pose moved on along its motion by
    the time between the frames.  A pose without a successor (draws have no past and no future) continues as itself.
    Frames without candidates are jumped over; the pose goes on for at most one frame, and the cost of a change falls
    with the length of the gap, because more may have happened in it.

    Args:
        database: Database searched.
        neighbours: Candidates (frame, k).
        rate_hz: Frames per second of the sequence.
        weights: Weights of the costs.
        yaw_steps: Yaw of each candidate (frame, k) in steps, where it lies between the steps of the database.
    """
    weights = weights or TemporalWeights()
    ranks = np.full(len(neighbours.projection), -1, dtype=np.int64)
    frames = np.flatnonzero(neighbours.projection[:, 0] >= 0)
    if len(frames) == 0:
        return ranks
    row = np.maximum(neighbours.row[frames], 0)
    yaw = (neighbours.yaw_index if yaw_steps is None else yaw_steps)[frames]
    pose = database.turned(row, yaw)
    following = database.turned(database.successors()[row], yaw)
    gap = np.diff(frames, append=frames[-1] + 1)
    steps = np.minimum(database.rate_hz / rate_hz * gap, 1.0)[:, None, None, None]
    continued = pose + steps * (following - pose)
    path = viterbi_path(
        neighbours.distance_m[frames],
        continued.astype(np.float32),
        pose.astype(np.float32),
        weights.pose / np.sqrt(gap.astype(np.float64)),
    )
    ranks[frames] = path
    return ranks


@numba.njit(cache=True, nogil=True, error_model="numpy")
def viterbi_path(emission: Array, continued: npt.NDArray, pose: npt.NDArray, weight: Array) -> Integers:
    """Return the cheapest path (frame,) through candidates (frame, k); ties go to the lower rank.

    Args:
        emission: Cost of each candidate (frame, k); inf where there is none.
        continued: Where each candidate's pose goes by the next frame (frame, k, joint, 3).
        pose: Each candidate's pose (frame, k, joint, 3).
        weight: Weight of the mean joint distance between frame t and t + 1 (frame,).
    """
    frames, count, joints = pose.shape[0], pose.shape[1], pose.shape[2]
    cost = emission[0].copy()
    back = np.zeros((frames, count), dtype=np.int64)
    new_cost = np.empty(count)
    for frame in range(1, frames):
        for this in range(count):
            new_cost[this] = np.inf
            if not np.isfinite(emission[frame, this]):
                continue
            for before in range(count):
                if cost[before] >= new_cost[this]:
                    continue
                distance = np.float32(0.0)
                for joint in range(joints):
                    dx = pose[frame, this, joint, 0] - continued[frame - 1, before, joint, 0]
                    dy = pose[frame, this, joint, 1] - continued[frame - 1, before, joint, 1]
                    dz = pose[frame, this, joint, 2] - continued[frame - 1, before, joint, 2]
                    distance += np.sqrt(dx * dx + dy * dy + dz * dz)
                total = cost[before] + weight[frame - 1] * distance / joints
                if total < new_cost[this]:
                    new_cost[this] = total
                    back[frame, this] = before
            new_cost[this] += emission[frame, this]
        cost[:] = new_cost
    path = np.zeros(frames, dtype=np.int64)
    path[-1] = np.argmin(cost)
    for frame in range(frames - 1, 0, -1):
        path[frame - 1] = back[frame, path[frame]]
    return path


def choose_window(
    database: Database, neighbours: Neighbours, *, window: int = 4, yaw_steps: Array | None = None
) -> Integers:
    """Return the ranks (frame,) chosen by the paper's rule; -1 where nothing was seen.

    Each candidate's `window` previous frames in its own motion are compared with the `window` previously reconstructed
    poses by eq. 2 of Yiannakides et al. 2019, the sum over joints of |log(q_j^-1 q_i)|^2 on the short arc; the least
    average wins.  The log of a unit quaternion is half its rotation vector.  Each of the window's frames weighs less
    the further back it lies (1/1, 1/2, ...), for the paper weighs them "differently" without saying how.  Candidates
    with fewer previous frames are compared over those they have; with none they keep only the distance of the first.
    Yaw turns the frame of the body of both.  The first frame takes the nearest candidate.
    """
    ranks = np.full(len(neighbours.projection), -1, dtype=np.int64)
    starts = np.flatnonzero(database.is_sequence_start)
    start_of = starts[np.searchsorted(starts, np.arange(database.num_rows), side="right") - 1]
    yaws = neighbours.yaw_index if yaw_steps is None else yaw_steps
    rotations = _Rotations.of(database, neighbours, window=window)
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
            candidates = rotations.turned(rows, yaw[:, None])
            reconstructed = np.stack(chosen[: -past - 1 : -1])
            distance = np.sum((0.5 * angle_between(candidates, reconstructed[None])) ** 2, axis=-1)
            weight = np.where(has_past, 1.0, 0.0) / back
            weight[~has_past.any(axis=1), 0] = 1.0
            rank = int(np.argmin(np.sum(weight * np.sqrt(distance), axis=1) / weight.sum(axis=1)))
        ranks[frame] = rank
        chosen.append(rotations.turned(row[rank], yaw[rank]))
    return ranks


@dataclass(frozen=True)
class _Rotations:
    """Bone rotations of the rows that a choice looks at, facing +Z: computed once, because yaw turns the neck alone.

    Args:
        place: Where a row of the database lies (row,).
        unitquat: (place, 14, 4).
        step_rad: A step of yaw.
    """

    place: Integers
    unitquat: Array
    step_rad: float

    @classmethod
    def of(cls, database: Database, neighbours: Neighbours, *, window: int) -> _Rotations:
        """Compute those of all candidates and of `window` rows before each."""
        is_used = np.zeros(database.num_rows, dtype=bool)
        rows = neighbours.row[neighbours.projection >= 0]
        for back in range(window + 1):
            is_used[np.maximum(rows - back, 0)] = True
        used = np.flatnonzero(is_used)
        place = np.full(database.num_rows, -1)
        place[used] = np.arange(len(used))
        return cls(place, bone_rotations(database.poses_m[used].astype(np.float64)), database.yaw_step_rad)

    def turned(self, rows: Integers, yaw: npt.ArrayLike) -> Array:
        """Return the rotations (*batch, 14, 4) of rows at yaws in steps, which broadcast to them."""
        found = np.array(self.unitquat[self.place[rows]])
        half = np.broadcast_to(0.5 * self.step_rad * np.asarray(yaw, dtype=np.float64), np.shape(rows))
        zero = np.zeros(half.shape)
        turn = np.stack([zero, np.sin(half), zero, np.cos(half)], axis=-1)
        found[..., OP14.root, :] = multiply(turn, found[..., OP14.root, :])
        return found
