"""Speeds of annotated pairs, which widen the steps of the velocity-biased proposal (Yin et al. 2018, eq. 12).

Every annotation has neighbours in its own sequence, seen by the same camera.  Their slope in time gives, per frame, how
fast each bone turns in the image plane against the bone above it (the parameter is a rotation about the parent joint,
in the parent's frame), how fast each person's backbone turns, and how fast each root is displaced against the centre of
the pair (rigid motion of the pair is no parameter of the density).  Depth is not observed: every axis of a rotation
gets the same variance, and each of a root's three axes half the squared displacement, which has two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.sampling.parameters import NUM_BLOCKS
from pasdedeux.skeletons import PAIR17

Indices = npt.NDArray[np.int64]

NEIGHBOUR_FRAMES = 2
"""Frames on each side of an annotation from which its speed is estimated."""

MIN_BONE_M = 0.05
"""Least length of a foreshortened bone in computing its speed, because its direction in the image is uncertain,
metres."""

_PELVIS, _NECK = PAIR17.indices(("pelvis", "neck"))
_PARENTS = np.array([max(parent, 0) for parent in PAIR17.parents])


@dataclass(frozen=True)
class Speeds:
    """Squared speeds of annotated pairs, per frame.

    Args:
        turn: Of each block's rotation (entry, 34), squared radians: for a root that of the backbone, for a bone that
            against its parent bone; NaN where it is not known.
        shift: Of each root along one axis (entry, person=2), squared metres; NaN where it is not known.
    """

    turn: Array
    shift: Array

    def mean(self, entries: Indices) -> tuple[Array, Array]:
        """Return the mean squared speeds, (34,) and (2,), over a set of entries; negative entries are ignored.

        This is the second term of eq. 12: an annotation that is nearest under several views counts once.  Each speed is
        the mean over the entries that show it; 0 where none does.
        """
        slots = np.unique(entries[entries >= 0])
        if not len(slots):
            return np.zeros(NUM_BLOCKS), np.zeros(2)
        return _mean_known(self.turn[slots]), _mean_known(self.shift[slots])


def annotation_speeds(tracks_m: Array) -> Speeds:
    """Return the speeds of annotations from the frames round them.

    Args:
        tracks_m: Image points of the frames round each annotation, (entry, frame, person=2, joint=17, 2), metres, the
            annotation itself in the middle; NaN where a frame or a joint is missing.

    Returns:
        Squared speeds by the least-squares slope over the frames there are; NaN if a joint of the two bones is missing
        in the annotation, or present in fewer than two frames.
    """
    num_frames = tracks_m.shape[1]
    time = np.arange(num_frames) - (num_frames - 1) / 2
    here = tracks_m[:, num_frames // 2]
    drift = _slope(tracks_m, time)
    bones = here - here[:, :, _PARENTS]
    rate = _rate(bones, drift - drift[:, :, _PARENTS])
    backbone = _rate(here[:, :, _NECK] - here[:, :, _PELVIS], drift[:, :, _NECK] - drift[:, :, _PELVIS])
    rate[:, :, _PELVIS] = backbone
    turn = rate - rate[:, :, _PARENTS]
    turn[:, :, _PELVIS] = backbone
    # The centre of the pair moves with the mean of the joints that have a slope.
    is_known = np.isfinite(drift)
    centre = np.where(is_known, drift, 0.0).sum(axis=(1, 2)) / np.maximum(is_known.sum(axis=(1, 2)), 1)
    shift = drift[:, :, _PELVIS] - centre[:, None]
    return Speeds(
        turn=turn.reshape(-1, NUM_BLOCKS) ** 2,
        shift=0.5 * (shift**2).sum(axis=-1),
    )


def _mean_known(squares: Array) -> Array:
    """Return the mean (n,) over the rows that are known; 0 where none is."""
    is_known = np.isfinite(squares)
    return np.asarray(np.where(is_known, squares, 0.0).sum(axis=0) / np.maximum(is_known.sum(axis=0), 1))


def _slope(tracks: Array, time: Array) -> Array:
    """Return the slope over axis 1 by least squares over the frames there are; NaN for fewer than two."""
    is_there = np.isfinite(tracks)
    moment = time.reshape(1, -1, *([1] * (tracks.ndim - 2)))
    count = is_there.sum(axis=1, keepdims=True)
    centre = (moment * is_there).sum(axis=1, keepdims=True) / np.maximum(count, 1)
    offset = np.where(is_there, moment - centre, 0.0)
    spread = (offset**2).sum(axis=1)
    rise = (offset * np.nan_to_num(tracks, nan=0.0)).sum(axis=1)
    return np.where(spread > 0.0, rise / np.where(spread > 0.0, spread, 1.0), np.nan)


def _rate(bone: Array, change: Array) -> Array:
    """Return how fast a bone (..., 2) turns in the image plane, radians per frame."""
    across = bone[..., 0] * change[..., 1] - bone[..., 1] * change[..., 0]
    return np.asarray(across / np.maximum((bone**2).sum(axis=-1), MIN_BONE_M**2))
