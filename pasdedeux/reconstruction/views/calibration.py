"""Calibrate several cameras by the people they see: rays to a joint meet, and bones keep their lengths.

Everything is in the axes of the first camera (x right, y up, z towards it), metres.  For given cameras, each joint is
the point nearest to its rays, so that only cameras are unknown (variable projection, Golub and Pereyra 1973): the focal
length of each, and rotation, place and clock of all but the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.terms.prior import KNOWN_DEVIATION, STATURE_DEVIATION
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.skeletons import OP14
from pasdedeux.spread import evenly_spread

_RAY_DEVIATION_M = 0.015
"""Standard deviation of a joint from its ray; detectors place a joint differently from different sides."""
_MIN_DEPTH_M = 0.1
_BONE_DEVIATION = 0.08
"""Standard deviation of the log of a bone's length in a frame from its mean over time and both sides."""
_LENS_DEVIATION, _CLOCK_DEVIATION_S = 0.3, 0.1
_ALIKE_S = 0.7
"""Errors of frames within this time are alike."""
_MIN_SHARED = 5
"""Smallest number of joints of a person that two cameras see at one time."""
_MAX_FRAMES = 60
"""Largest number of frames for the calibration, evenly chosen."""


@dataclass(frozen=True)
class View:
    """A camera, and its keypoints at the times of the first camera.

    Args:
        lens: Its lens, where known; exact for a calibrated camera.
        rotmat: Rotation from the first camera's axes to its own (3, 3).
        position_m: Its place in the first camera's axes (3,).
        offset_s: Offset of its clock from that of the first camera.
        px: Keypoints (frame, person, 14, 2), pixels, NaN where not seen.
        speed_px_s: Their velocities.
        confidence: (frame, person, 14), 0 where not seen.
        is_calibrated: Whether lens, rotation and place are given.
    """

    lens: Lens
    rotmat: Array
    position_m: Array
    offset_s: float
    px: Array
    speed_px_s: Array
    confidence: Array
    is_calibrated: bool = False

    def moved(self, change: Array) -> View:
        """Return the view after a change of log focal length, rotation vector (3), displacement (3), and clock."""
        turn = rotmat_from_unitquat(unitquat_from_rotvec(change[1:4]))
        return replace(
            self,
            lens=replace(self.lens, focal_px=float(np.exp(change[0])) * self.lens.focal_px),
            rotmat=turn @ self.rotmat,
            position_m=self.position_m + change[4:7],
            offset_s=self.offset_s + float(change[7]),
            px=self.px + change[7] * self.speed_px_s,
        )

    @property
    def plane(self) -> Array:
        """Keypoints in the image one focal length away (frame, person, 14, 2), y up."""
        return np.asarray((self.px - np.array(self.lens.principal_point_px)) * [1.0, -1.0] / self.lens.focal_px)

    @property
    def rays(self) -> Array:
        """Unit directions of the keypoints (frame, person, 14, 3), first camera's axes."""
        plane = self.plane
        rays = np.concatenate([plane, -np.ones((*plane.shape[:-1], 1))], axis=-1) @ self.rotmat
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def off_px(self, points_m: Array) -> Array:
        """Return the offsets in the image (..., 2) of points (frame, person, 14, 3) from the keypoints, pixels."""
        seen = (points_m - self.position_m) @ self.rotmat.T
        depth = np.maximum(-seen[..., 2:], _MIN_DEPTH_M)
        return np.asarray(self.lens.focal_px * (seen[..., :2] / depth - self.plane))

    def deviation_px(self, points_m: Array) -> float:
        """Return the standard deviation in the image of joints at the depth of these points, pixels."""
        depth = -((points_m - self.position_m) @ self.rotmat.T)[..., 2]
        return self.lens.focal_px * _RAY_DEVIATION_M / max(float(np.nanmedian(depth)), _MIN_DEPTH_M)

    def chosen(self, frames: Integers) -> View:
        """Return some frames."""
        return replace(self, px=self.px[frames], speed_px_s=self.speed_px_s[frames], confidence=self.confidence[frames])


def meet(views: Sequence[View]) -> Array:
    """Return the points nearest to the rays of the views (frame, person, 14, 3); NaN for fewer than two rays."""
    count = np.zeros(views[0].confidence.shape, dtype=int)
    total, moment = np.zeros((*count.shape, 3, 3)), np.zeros((*count.shape, 3))
    for view in views:
        is_seen = view.confidence > 0
        rays = np.where(is_seen[..., None], view.rays, 0.0)
        across = view.confidence[..., None, None] * (np.eye(3) - rays[..., :, None] * rays[..., None, :])
        across = np.where(is_seen[..., None, None], across, 0.0)
        total, moment = total + across, moment + across @ view.position_m
        count += is_seen
    known = count > 1
    points = np.full((*count.shape, 3), np.nan)
    points[known] = np.linalg.solve(total[known] + 1e-9 * np.eye(3), moment[known][..., None])[..., 0]
    return points


def lengths_of(points_m: Array) -> tuple[Array, Array]:
    """Return lengths of bones (frame, person, 14) over their typical ones, and these: medians over time, sides tied."""
    each = bone_lengths(OP14, points_m)
    with np.errstate(all="ignore"):
        both = np.stack([np.nanmedian(part, axis=0) for part in (each, each[..., OP14.mirror])])
    lengths = np.nanmean(both, axis=0)
    return each / np.where(lengths > 0, lengths, np.nan), lengths


def calibrate(
    views: Sequence[View], statures_m: Array, rate_hz: float, *, is_stated: Flags | None = None
) -> list[View]:
    """Return the views with lens, rotation, place and clock from the people that they see.

    Args:
        views: Initial views; the first one keeps place, rotation and clock.
        statures_m: Stature of each person (person,), which sets the scale.
        rate_hz: Frames per second of the first camera.
        is_stated: Whether each stature is stated (person,), not estimated; None if none is.

    Raises:
        InputError: At no time two views see enough of the same joints of a person.
    """
    from scipy.optimize import least_squares  # here: planning does not need it

    shown = _frames_of_several(views)
    if not len(shown):
        raise InputError(f"no two cameras see the same {_MIN_SHARED} joints of a person at one time")
    part = [view.chosen(shown) for view in views]
    free = _free(views)
    is_scaled = any(view.is_calibrated for view in views[1:])
    # Errors of near frames are alike, so that they count as one; instead, give priors a larger weight.
    scale = np.sqrt(max(1.0, _ALIKE_S * rate_hz * len(shown) / (shown[-1] - shown[0] + 1)))

    size_deviations = np.where(
        np.zeros(len(statures_m)) if is_stated is None else is_stated, KNOWN_DEVIATION, STATURE_DEVIATION
    )
    guess_m = meet(part)
    # In pixels of the initial views: in metres, small people before short lenses would be nearer to their rays.
    deviations = [view.deviation_px(guess_m) for view in part]

    def unpacked(unknowns: Array) -> Array:
        changes = np.zeros((len(views), 8))
        changes[free] = unknowns
        return changes

    def residual(unknowns: Array) -> Array:
        changes = unpacked(unknowns)
        moved = [view.moved(change) for view, change in zip(part, changes, strict=True)]
        points = meet(moved)
        shares, lengths = lengths_of(points)
        rays = [
            np.where((view.confidence > 0)[..., None], np.sqrt(view.confidence)[..., None] * view.off_px(points), 0.0)
            / deviation
            for view, deviation in zip(moved, deviations, strict=True)
        ]
        bones = np.log(np.clip(shares, 0.2, 5.0)) / _BONE_DEVIATION
        sizes = np.log(np.maximum(body_height_m(OP14, lengths), _MIN_DEPTH_M) / statures_m) / size_deviations
        known = [KNOWN_DEVIATION if view.lens.is_known else _LENS_DEVIATION for view in views]
        parts = (
            np.concatenate([part.ravel() for part in rays]),
            bones.ravel(),
            scale * (0.0 if is_scaled else 1.0) * sizes,
            scale * changes[:, 0] / np.array(known),
            scale * changes[:, 7] / _CLOCK_DEVIATION_S,
        )
        return np.nan_to_num(np.concatenate(parts))

    best = least_squares(residual, np.zeros(int(free.sum())), loss="soft_l1", x_scale=0.1, max_nfev=60).x
    return [view.moved(change) for view, change in zip(views, unpacked(best), strict=True)]


def _free(views: Sequence[View]) -> Flags:
    """Tell which unknowns of each view (view, 8) are estimated, see `View.moved`."""
    free = np.ones((len(views), 8), dtype=bool)
    free[0, 1:] = False
    for number, view in enumerate(views):
        if view.is_calibrated:
            free[number, :7] = False
    return free


def _frames_of_several(views: Sequence[View]) -> Integers:
    """Return frames in which two views or more show the same joints of a person, evenly chosen."""
    is_shared = np.sum([view.confidence > 0 for view in views], axis=0) > 1
    several = np.flatnonzero((is_shared.sum(axis=2) >= _MIN_SHARED).any(axis=1))
    return np.asarray(several[evenly_spread(len(several), _MAX_FRAMES)])
