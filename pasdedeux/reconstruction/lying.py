"""People on the floor: poses of a database laid down, for those whom the image does not show standing.

Capture is mostly of people on their feet.  Who lies, or stands on hands and feet, bends the joints as others do who
stand, reach or step: their poses are those of a database turned down on the belly or the back.  What bears them tells
which are possible: on the belly anything may bear, on the back the trunk does, so that no limb is far below it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pasdedeux.arrays import Flags
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.reconstruct import Searcher
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

_UPRIGHT = float(np.cos(np.deg2rad(30.0)))
"""Backs of people who stand are as near to the image's vertical."""
_LEG_RANGE = (1.1, 2.6)
"""Height of mid-hip over the lower ankle in the image, as a multiple of the back's length: of who stands."""
_MIN_BACK = 0.7
"""The back's length over the width of the shoulders: of who does not lie towards the camera."""

_MAX_STANDING = 0.3
"""Who stands in a larger part of the frames is not looked for on the floor."""
_MAX_PROJECTIONS = 600_000
"""Projections of poses laid down that are looked through, at most: an even choice."""
ON_BELLY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns somebody who faces +Z and stands down on the belly, head towards +Z; the transpose lays him on his back."""
_MAX_BELOW_M = 0.08
"""Limbs are no further below the trunk of somebody on the back."""
_ANKLES, _SHOULDERS = (OP14.indices([f"left_{name}", f"right_{name}"]) for name in ("ankle", "shoulder"))
_TRUNK = OP14.indices([f"{side}_{name}" for name in ("hip", "shoulder") for side in ("left", "right")])


def stands(track: Track) -> Flags:
    """Tell in which frames somebody is seen to stand: back upright in the image, legs under it."""
    keypoints_px = np.where(track.confidence[..., None] > 0, track.keypoints_px, np.nan)
    hips, neck = mid_hip(keypoints_px), keypoints_px[:, OP14.root]
    back = np.linalg.norm(hips - neck, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        legs = np.fmax(*(keypoints_px[:, _ANKLES, 1] - hips[:, None, 1]).T) / back
        shoulders = np.linalg.norm(np.diff(keypoints_px[:, _SHOULDERS], axis=1)[:, 0], axis=-1)
        is_upright = (hips - neck)[:, 1] > _UPRIGHT * back
        return is_upright & (legs > _LEG_RANGE[0]) & (legs < _LEG_RANGE[1]) & ~(back < _MIN_BACK * shoulders)


def is_on_floor(track: Track) -> bool:
    """Tell whether a track shows somebody who hardly ever stands."""
    return float(stands(track).mean()) < _MAX_STANDING


def with_laid(searcher: Searcher) -> Searcher:
    """Return a searcher that finds poses laid down as well; its rows are those of the poses that were laid down."""
    database = searcher.database
    poses, rows = database.poses_m, np.arange(database.num_rows)
    step = max(1, -(-2 * database.num_projections // _MAX_PROJECTIONS))
    chosen = rows[::step]
    belly, back = (poses[chosen] @ turn for turn in (ON_BELLY.T, ON_BELLY))
    below = back[:, _TRUNK, 1].min(axis=1) - back[..., 1].min(axis=1)
    is_borne = below < _MAX_BELOW_M
    source = np.concatenate([rows, chosen, chosen[is_borne]])
    starts = np.concatenate([[True], np.diff(source) != 1]) | database.is_sequence_start[source]
    laid = replace(
        database,
        poses_m=np.concatenate([poses, belly, back[is_borne]]),
        is_sequence_start=starts,
        body22_unitquat=None,
    )
    return replace(Searcher.of(laid), published=searcher.published, source_row=source)
