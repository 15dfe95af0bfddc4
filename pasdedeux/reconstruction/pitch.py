"""Where up is: the pitch of a sequence's camera, and the floor its people stand on, which may tell their size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

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

__all__ = ["choose_camera", "choose_pitch", "floor_offset", "sized_by_height"]

Array = npt.NDArray[np.float64]

_FLOOR_WEIGHT = 0.05
"""Cost of a metre that standing feet leave the floor by, against a metre of misfit."""
_MAX_FLOOR_M = 0.1
"""More than this says only that the floor is wrong: how far away people are who come very near is badly known."""

_MAX_PROJECTIONS = 1_000_000
"""Projections that a camera is judged by."""

_ANKLE_HEIGHT_M = 0.07
"""Height of the ankle of the reference body over the floor, standing (Winter 2009, fig. 4.1: 0.039 of stature)."""
_STANDING_PERCENT = 10.0
"""Of the frames have the lower ankle no higher than it is when it stands."""
_SIZE_RANGE = (0.5, 2.0)

_ANKLES = OP14.indices(["left_ankle", "right_ankle"])


def choose_camera(
    databases: Sequence[Database], tracks: Sequence[Track], options: ReconstructionOptions | None = None
) -> int:
    """Return the index of the database (one per camera) that suits the tracks of a sequence best; see `choose_pitch`.

    Every camera sees the same poses, so an even choice of the poses of a large database answers, one camera at a time.
    """
    if len(databases) == 1:
        return 0
    return choose_pitch((Searcher.of(database.thinned(_MAX_PROJECTIONS)) for database in databases), tracks, options)


def choose_pitch(
    databases: Iterable[Searcher],
    tracks: Sequence[Track],
    options: ReconstructionOptions | None = None,
    *,
    stride: int = 5,
    floor_weight: float = _FLOOR_WEIGHT,
) -> int:
    """Return the index of the searcher (one per camera pitch) that suits the tracks of a sequence best.

    A camera does not change its pitch within a sequence, so every `stride`-th frame of all tracks decides together: by
    the sum over tracks of the mean distance of the matches and `floor_weight` times how far the lower ankle leaves its
    median height, up to a bound.  Who comes nearer on a flat floor seems to sink or to climb under a wrong pitch; who
    stays at one depth does neither, and the matches alone decide.  Ties go to the first.
    """
    options = options or ReconstructionOptions()
    thinned = [
        replace(
            track,
            keypoints_px=track.keypoints_px[::stride],
            confidence=track.confidence[::stride],
            rate_hz=track.rate_hz / stride,
        )
        for track in tracks
    ]
    costs = []
    for searcher in databases:
        found = [_misfit(searcher, track, options, floor_weight) for track in thinned]
        costs.append(sum(found))
    return int(np.argmin(costs))


def floor_offset(reconstructions: Sequence[Reconstruction], camera: DatabaseCamera | None = None) -> Array:
    """Return what to subtract (3,) to put a sequence's people into one frame: lowest ankle at 0, start at x = z = 0.

    The floor of a video is not known, so the lowest ankle of all people is taken to stand on it; heights are measured
    along the upright axis of the pitched camera, camera axes.
    """
    upright = np.eye(3) if camera is None else np.asarray(camera.camera_from_upright_rotmat)
    points = [found.positions_m @ upright for found in reconstructions]  # camera axes to upright axes: the transpose
    floor = min(float(np.min(one[:, _ANKLES, 1])) for one in points)
    start = np.mean([mid_hip(one[0]) for one in points], axis=0)
    return np.asarray(upright @ np.array([start[0], floor, start[2]]))


def sized_by_height(found: Reconstruction, camera: DatabaseCamera, camera_height_m: float) -> Reconstruction:
    """Return a reconstruction at the size that puts the floor as far below the camera as it is known to be.

    One camera does not see how large people are: body and path may grow together about the camera.  So does the floor
    below it, which the ankles of standing feet tell; a camera of known height and pitch therefore gives the size.  A
    person whose feet are not below the camera, or who would come out twice or half as large, keeps the size.

    Args:
        found: Reconstruction, camera axes, camera at the origin.
        camera: The database's camera, whose pitch says where up is.
        camera_height_m: Height of the camera over the floor, metres.

    Raises:
        InputError: The height is not positive.
    """
    if not (np.isfinite(camera_height_m) and camera_height_m > 0):
        raise InputError(f"the height of the camera over the floor is {camera_height_m} m; it must be positive")
    upright = found.positions_m @ np.asarray(camera.camera_from_upright_rotmat)
    lowest = upright[~found.is_bridged][:, _ANKLES, 1].min(axis=1)
    if not len(lowest):
        return found
    below = _ANKLE_HEIGHT_M - float(np.percentile(lowest, _STANDING_PERCENT))
    size = camera_height_m / below if below > 0 else float("nan")
    if not _SIZE_RANGE[0] <= size <= _SIZE_RANGE[1]:
        return found
    return found.scaled(size)


def _misfit(searcher: Searcher, track: Track, options: ReconstructionOptions, floor_weight: float) -> float:
    try:
        matches = match_track(searcher, track, options.model_copy(update={"num_candidates": 1}))
    except InputError:
        return 0.0  # a track too thin to be searched has no say
    found = reconstruct_track(searcher, track, Method.NEAREST, options, matches=matches)
    upright = np.asarray(searcher.database.camera.camera_from_upright_rotmat)
    height = (found.positions_m @ upright)[~found.is_bridged][:, _ANKLES, 1].min(axis=1)
    off = float(np.median(np.abs(height - np.median(height))))
    return matches.mean_distance_m + floor_weight * min(off, _MAX_FLOOR_M)
