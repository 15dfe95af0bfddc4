"""People on the floor: poses of a database laid down, for people whose back is not upright in the image.

Capture mostly shows people on their feet.  People who lie, or stand on hands and feet, bend their joints as standing
people do who reach or step.  So their poses are taken from a database, turned down onto the belly or the back.  On the
belly, any part may bear the body; on the back the trunk does, so poses with a limb far below it are excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

_UPRIGHT = float(np.cos(np.deg2rad(30.0)))
"""Smallest cosine between the back of a standing person and the vertical of the image."""
_LEG_RANGE = (1.1, 2.6)
"""Height of the mid-hip over the lower ankle of a standing person in the image, as a multiple of the back's length."""
_MIN_BACK = 0.7
"""Smallest length of the back over the width of the shoulders of a person who does not lie towards the camera."""

_MAX_UPRIGHT = 0.3
"""Largest share of frames with an upright back for a person on the floor: at most 0.10 for 13 people who do push-ups,
at least 0.40 for 271 who stand, climb, bow or wash (clips of `benchmarks.families`)."""
_MAX_PROJECTIONS = 600_000
"""Largest number of projections of lying poses to search, evenly chosen."""
ON_BELLY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation of a standing person who faces +Z down onto the belly, head towards +Z; the transpose: onto the back."""
_MAX_BELOW_M = 0.08
"""Largest depth of limbs below the trunk of a person on the back.  Both are on the floor: joints of the trunk half the
depth of a chest above it (0.115 m), those of limbs the radius of a wrist (0.034 m; see `plausibility.capsules`)."""
_ANKLES, _SHOULDERS = (OP14.indices([f"left_{name}", f"right_{name}"]) for name in ("ankle", "shoulder"))
_TRUNK = OP14.indices([f"{side}_{name}" for name in ("hip", "shoulder") for side in ("left", "right")])


def stands(track: Track) -> Flags:
    """Tell in which frames a person visibly stands: back upright in the image, legs below it (frame,)."""
    is_upright, legs = _back_and_legs(track)
    return is_upright & (legs > _LEG_RANGE[0]) & (legs < _LEG_RANGE[1])


def is_on_floor(track: Track) -> bool:
    """Tell whether the back of a person is hardly ever upright; False if back and legs are never seen."""
    is_upright, legs = _back_and_legs(track)
    is_seen = np.isfinite(legs)
    return bool(is_seen.any()) and float(is_upright[is_seen].mean()) < _MAX_UPRIGHT


def _back_and_legs(track: Track) -> tuple[Flags, Array]:
    """Return whether the back is upright, and how far legs reach below it over its length (frame,), NaN if not seen."""
    keypoints_px = np.where(track.confidence[..., None] > 0, track.keypoints_px, np.nan)
    hips, neck = mid_hip(keypoints_px), keypoints_px[:, OP14.root]
    back = np.linalg.norm(hips - neck, axis=-1)
    shoulders = np.linalg.norm(np.diff(keypoints_px[:, _SHOULDERS], axis=1)[:, 0], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        legs = np.fmax(*(keypoints_px[:, _ANKLES, 1] - hips[:, None, 1]).T) / back
        return ((hips - neck)[:, 1] > _UPRIGHT * back) & ~(back < _MIN_BACK * shoulders), legs


def searchers_for(searcher: Searcher, tracks: Sequence[Track]) -> list[Searcher]:
    """Return the searcher of each track; for people on the floor it includes lying poses and is prepared once."""
    is_lying = [is_on_floor(track) for track in tracks]
    laid = with_laid(searcher) if any(is_lying) else searcher
    return [laid if lies else searcher for lies in is_lying]


def with_laid(searcher: Searcher) -> Searcher:
    """Return a searcher that also finds lying poses; their rows are those of the original upright poses."""
    database = searcher.database
    laid, source = laid_down(database, _MAX_PROJECTIONS)
    rows = np.concatenate([np.arange(database.num_rows), source])
    ready = searcher_over(database, np.concatenate([database.poses_m, laid]), rows)
    return replace(ready, published=searcher.published, source_row=rows)


def laid_down(database: Database, max_projections: int) -> tuple[npt.NDArray[np.floating], Integers]:
    """Return lying poses (n, 14, 3) and their rows (n,), evenly chosen up to a number of projections."""
    rows = np.arange(0, database.num_rows, max(1, -(-2 * database.num_projections // max_projections)))
    belly, back = (database.poses_m[rows] @ turn for turn in (ON_BELLY.T, ON_BELLY))
    below = back[:, _TRUNK, 1].min(axis=1) - back[..., 1].min(axis=1)
    is_borne = below < _MAX_BELOW_M
    return np.concatenate([belly, back[is_borne]]), np.concatenate([rows, rows[is_borne]])


def searcher_over(database: Database, poses_m: npt.NDArray[np.floating], rows: Integers) -> Searcher:
    """Return the searcher of poses made of these rows of a database."""
    starts = np.concatenate([[True], np.diff(rows) != 1]) | database.is_sequence_start[rows]
    return Searcher.of(replace(database, poses_m=poses_m, is_sequence_start=starts, body22_unitquat=None))
