"""Where up is: the pitch of a sequence's camera, and the floor its people stand on, which may tell their size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.reconstruct import (
    Method,
    Reconstruction,
    ReconstructionOptions,
    Searcher,
    match_track,
    reconstruct_track,
)
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

_STRIDE = 5
_FLOOR_WEIGHT = 0.05
"""Cost of a metre that standing feet leave the floor by, against a metre of misfit."""
_MAX_FLOOR_M = 0.1
"""More than this says only that the floor is wrong: how far away people are who come very near is badly known."""

_LENS_FACTORS = (0.8, 1.0, 1.25, 1.56)
"""Focal lengths over the assumed one under which the floor may be flat: phones to short telephoto lenses."""

_NUM_OF_PARABOLA = 3
_NUM_PARTS = 8
"""Parts of a video that are excluded in turn."""
_OWN_DEVIATION_RAD = float(np.deg2rad(2.0))
"""What is left over where all parts agree: people of the database hold themselves otherwise than those of the video (16
views of four takes of salsa, 5 px of noise, a camera 10 degrees below the level among them: 2.5 degrees in all)."""

_MAX_PROJECTIONS = 1_000_000
"""Projections that a camera is judged by."""

_ANKLE_HEIGHT_M = 0.07
"""Height of the ankle of the reference body over the floor, standing (Winter 2009, fig. 4.1: 0.039 of stature)."""
_STANDING_PERCENT = 10.0
"""Of the frames have the lower ankle no higher than it is when it stands."""
_SIZE_RANGE = (0.5, 2.0)

_ANKLES = OP14.indices(["left_ankle", "right_ankle"])


@dataclass(frozen=True)
class PitchEstimate:
    """The pitch of a sequence's camera.

    Args:
        index: Which of the cameras that were tried suits best.
        pitch_rad: The pitch, between those of the cameras.
        deviation_rad: Standard deviation of it; 0 where it was given.
    """

    index: int
    pitch_rad: float
    deviation_rad: float = 0.0

    @property
    def is_given(self) -> bool:
        """Tell whether it was stated, not estimated."""
        return self.deviation_rad == 0.0

    def in_words(self) -> str:
        """Say it."""
        deviation = "" if self.is_given else f" +- {np.rad2deg(self.deviation_rad):.1f}"
        return f"camera pitch {np.rad2deg(self.pitch_rad):.3g}{deviation} degrees"


def choose_camera(
    databases: Sequence[Database], tracks: Sequence[Track], options: ReconstructionOptions | None = None
) -> PitchEstimate:
    """Return the pitch at which databases (one per camera) suit the tracks of a sequence best; see `choose_pitch`.

    Every camera sees the same poses, so an even choice of the poses of a large database answers, one camera at a time.
    """
    if len(databases) == 1:
        return PitchEstimate(0, databases[0].camera.pitch_rad)
    return choose_pitch((Searcher.of(database.thinned(_MAX_PROJECTIONS)) for database in databases), tracks, options)


def choose_pitch(
    databases: Iterable[Searcher], tracks: Sequence[Track], options: ReconstructionOptions | None = None
) -> PitchEstimate:
    """Return the pitch at which searchers (one per camera pitch) suit the tracks of a sequence best.

    A camera does not change its pitch within a sequence, so every fifth frame of all tracks decides together: by
    the sum over tracks of the mean distance of the matches and `_FLOOR_WEIGHT` times how far the lower ankle leaves its
    median height, up to a bound.  Who comes nearer on a flat floor seems to sink or to climb under a wrong pitch, and
    under a wrong focal length, of which the best counts where it is not known; who stays at one depth does neither, and
    the matches alone decide.  An ankle that is not seen has no say, nor has the other where it is the higher one.

    The pitch is where a parabola through the squares of the best of the searchers and of its neighbours has its least;
    its deviation is what excluding each eighth of the video in turn does to it (jackknife), and what poses of a
    database differ by.  Ties go to the first.
    """
    options = options or ReconstructionOptions()
    thinned = [
        replace(
            track,
            keypoints_px=track.keypoints_px[::_STRIDE],
            confidence=track.confidence[::_STRIDE],
            rate_hz=track.rate_hz / _STRIDE,
        )
        for track in tracks
    ]
    pitches, judged = [], []
    for searcher in databases:
        pitches.append(searcher.database.camera.pitch_rad)
        judged.append([one for track in thinned if (one := _judge(searcher, track, options)) is not None])
    costs = np.array([sum(one.cost() for one in own) for own in judged])
    parts = [np.array([sum(one.without(part).cost() for one in own) for own in judged]) for part in range(_NUM_PARTS)]
    pitch, *others = (_least(np.array(pitches), cost) for cost in (costs, *parts))
    spread = np.sqrt((_NUM_PARTS - 1) * np.var(others))
    between = 0.5 * (pitches[-1] - pitches[0]) if len(pitches) < _NUM_OF_PARABOLA else 0.0
    deviation = np.sqrt(_OWN_DEVIATION_RAD**2 + spread**2 + between**2)
    return PitchEstimate(int(np.argmin(costs)), pitch, float(deviation))


def _least(pitches: Array, cost: Array) -> float:
    """Return the pitch of least cost, by a parabola through three squares, between the ends.

    Away from the right pitch distances grow in proportion, and so their squares as a parabola.
    """
    best = int(np.argmin(cost))
    if len(pitches) < _NUM_OF_PARABOLA:
        return float(pitches[best])
    middle = min(max(best, 1), len(pitches) - 2)
    near = slice(middle - 1, middle + 2)
    curve, slope, _ = np.polyfit(pitches[near], cost[near] ** 2, 2)
    if curve <= 0:
        return float(pitches[best])
    return float(np.clip(-0.5 * slope / curve, pitches[max(best - 1, 0)], pitches[min(best + 1, len(pitches) - 1)]))


def floor_offset(reconstructions: Sequence[Reconstruction], camera: DatabaseCamera) -> Array:
    """Return what to subtract (3,) to put a sequence's people into one frame: lowest ankle at 0, start at x = z = 0.

    The floor of a video is not known, so the lowest ankle of all people is taken to stand on it; heights are measured
    along the upright axis of the pitched camera, camera axes.
    """
    upright = np.asarray(camera.camera_from_upright_rotmat)
    points = [found.positions_m @ upright for found in reconstructions]  # camera axes to upright axes: the transpose
    floor = min(float(np.min(one[:, _ANKLES, 1])) for one in points)
    start = np.mean([mid_hip(one[0]) for one in points], axis=0)
    return np.asarray(upright @ np.array([start[0], floor, start[2]]))


def sized_by_height(found: Reconstruction, camera: DatabaseCamera, camera_height_m: float) -> Reconstruction:
    """Return a reconstruction at the size that puts the floor as far below the camera as it is known to be.

    One camera does not see how large people are: body and path may grow together about the camera.  So does the floor
    below it, which the ankles of standing feet tell; a camera of known height and pitch therefore gives the size.  A
    person whose feet are not below the camera, or who would come out twice or half as large, keeps the size.
    """
    upright = found.positions_m @ np.asarray(camera.camera_from_upright_rotmat)
    lowest = upright[~found.is_bridged][:, _ANKLES, 1].min(axis=1)
    if not len(lowest):
        return found
    below = _ANKLE_HEIGHT_M - float(np.percentile(lowest, _STANDING_PERCENT))
    size = camera_height_m / below if below > 0 else float("nan")
    if not _SIZE_RANGE[0] <= size <= _SIZE_RANGE[1]:
        return found
    return found.scaled(size)


@dataclass(frozen=True)
class _Judged:
    """A track under one pitch.

    Args:
        distance_m: Of the match (frame,), NaN where bridged.
        height_m: Of the lower ankle by each lens (lens, frame), NaN where that is not seen.
    """

    distance_m: Array
    height_m: Array

    def cost(self) -> float:
        is_known = np.isfinite(self.distance_m)
        if not is_known.any():
            return 0.0
        return float(self.distance_m[is_known].mean()) + _FLOOR_WEIGHT * min(self._off_m(), _MAX_FLOOR_M)

    def _off_m(self) -> float:
        """Return how far the ankle leaves its median height under the lens that suits best; 0 where none is seen."""
        is_seen = np.isfinite(self.height_m)
        own = [height[seen] for height, seen in zip(self.height_m, is_seen, strict=True) if seen.any()]
        return min((float(np.median(np.abs(height - np.median(height)))) for height in own), default=0.0)

    def without(self, part: int) -> _Judged:
        """Return the rest without one of the parts of the video."""
        count = len(self.distance_m)
        rest = np.arange(count) * _NUM_PARTS // count != part
        return _Judged(self.distance_m[rest], self.height_m[:, rest])


def _judge(searcher: Searcher, track: Track, options: ReconstructionOptions) -> _Judged | None:
    """Match a track under one pitch; None where it is too thin to be searched and has no say."""
    try:
        matches = match_track(searcher, track, options.model_copy(update={"num_candidates": 1}))
    except InputError:
        return None
    found = reconstruct_track(searcher, track, Method.NEAREST, options, matches=matches)
    upright = np.asarray(searcher.database.camera.camera_from_upright_rotmat)
    is_seen = (track.confidence[:, _ANKLES] > 0) & ~found.is_bridged[:, None]
    heights = []
    for factor in (1.0,) if track.lens.is_known else _LENS_FACTORS:
        # Behind a lens of another focal length everybody is as many times as far away.
        farther = found.root_m * [0.0, 0.0, factor - 1.0]
        height = (found.positions_m[:, _ANKLES] + farther[:, None]) @ upright[:, 1]
        lower = np.argmin(height, axis=1)[:, None]
        seen = np.take_along_axis(is_seen, lower, axis=1)
        heights.append(np.where(seen, np.take_along_axis(height, lower, axis=1), np.nan)[:, 0])
    return _Judged(np.where(found.is_bridged, np.nan, matches.neighbours.distance_m[:, 0]), np.stack(heights))
