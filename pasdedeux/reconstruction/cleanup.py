"""Clean-up of a reconstructed motion: planted feet stand still, nobody sinks into the floor, bones keep their length.

One camera sees the depth of a person badly, so reconstructed people glide.  Feet on the floor tell how the body really
moved: first the path of the whole body is corrected (poses stay as they are) so that planted feet move least, then what
is left is taken up by the legs: hips and feet are given, and the knee keeps the plane it bends in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.retarget import mid_hip, retarget_proportions
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.reconstruct import Reconstruction
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

__all__ = [
    "CleanUpOptions",
    "CleanedMotion",
    "ContactOptions",
    "bend_leg",
    "bend_one_leg",
    "clean_reconstruction",
    "clean_up",
    "find_contacts",
]

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

_LEGS = OP14.legs
_ANKLES = np.array([leg[2] for leg in _LEGS])
_UP, _AWAY = 1, 2
_FLOOR_QUANTILE = 0.1
_NEAR_QUANTILE = 0.2
_STRAIGHT = 1.0 - 1e-6
"""A leg is never stretched beyond this part of its length, where the knee's plane would be lost."""

_MIN_BEND_M = 1e-4


class ContactOptions(Settings):
    """What counts as a planted foot, and how far the legs may move it."""

    contact_speed_m_s: float = Field(0.3, gt=0, description="Feet slower than this may be planted")
    away_share: float = Field(
        0.5, ge=0, description="Part of the speed along z, away from the camera, that counts: one camera sees it badly"
    )
    contact_height_m: float = Field(
        0.05,
        gt=0,
        description="Feet lower than this over the lower foot and, twice this, over the floor may be planted",
    )
    floor_s: float = Field(
        1.5, gt=0, description="The floor that contacts are judged by is that of this time: a wrong pitch tilts it"
    )
    blend_s: float = Field(0.12, gt=0, description="A foot comes into its lock and out of it over this time")
    max_bend_m: float = Field(0.04, ge=0, description="The legs move a foot by at most this")


class CleanUpOptions(ContactOptions):
    """The same of a whole motion."""

    min_contact_s: float = Field(0.1, ge=0, description="Shorter contacts are none")
    shift_stiffness: float = Field(
        1.0,
        gt=0,
        description="Cost of a second difference of the correction of the path, against 1 for a planted foot's step",
    )
    shift_hold: float = Field(1e-4, gt=0, description="Cost of the correction itself")
    floor_pull: float = Field(0.1, gt=0, description="Cost of the height of a planted foot over the floor")


@dataclass(frozen=True)
class CleanedMotion:
    """A motion after clean-up.

    Args:
        positions_m: (frame, 14, 3), upright axes, metres.
        is_planted: Left and right foot on the floor (frame, 2).
        shift_m: What the body's path was corrected by (frame, 3).
        floor_m: Height of ankles that stand.
    """

    positions_m: Array
    is_planted: Booleans
    shift_m: Array
    floor_m: float


def clean_up(positions_m: Array, *, rate_hz: float, options: CleanUpOptions | None = None) -> CleanedMotion:
    """Clean a motion up.

    Args:
        positions_m: op14 positions (frame, 14, 3), upright axes (y up, z towards the camera), metres.
        rate_hz: Frames per second.
        options: How.

    Raises:
        InputError: Positions that are not finite or of another shape, or a rate that is not positive.
    """
    options = options or CleanUpOptions()
    if positions_m.ndim != 3 or positions_m.shape[1:] != (14, 3) or len(positions_m) == 0:
        raise InputError(f"clean-up: positions have shape {positions_m.shape}, expected (frames, 14, 3)")
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise InputError(f"clean-up: the frame rate is {rate_hz}, it must be positive")
    lengths = np.median(bone_lengths(OP14, positions_m), axis=0)
    positions = retarget_proportions(positions_m, lengths)
    floor = float(np.quantile(positions[:, _ANKLES, _UP].min(axis=1), _FLOOR_QUANTILE))
    is_planted = find_contacts(positions, rate_hz=rate_hz, options=options)
    shift = _correct_path(positions[:, _ANKLES], is_planted, floor, options)
    positions = positions + shift[:, None]
    for side, (hip, knee, ankle) in enumerate(_LEGS):
        target = _targets(positions[:, ankle], is_planted[:, side], floor, rate_hz, options)
        positions[:, knee], positions[:, ankle] = bend_leg(
            positions[:, hip], positions[:, knee], positions[:, ankle], target, fallback=_forward(positions)
        )
    return CleanedMotion(positions, is_planted, shift, floor)


def find_contacts(positions_m: Array, *, rate_hz: float, options: CleanUpOptions) -> Booleans:
    """Tell which feet are planted (frame, 2): slow, low over the floor, and not much higher than the other foot."""
    from scipy.ndimage import percentile_filter  # here: 0.3 s that planning does not need

    ankles = positions_m[:, _ANKLES]
    if len(ankles) < 3:
        return np.zeros(ankles.shape[:2], dtype=bool)
    velocity = np.gradient(ankles, axis=0) * rate_hz
    velocity[..., _AWAY] *= options.away_share
    speed = np.linalg.norm(velocity, axis=-1)
    height = ankles[..., _UP]
    is_low = height < height.min(axis=1, keepdims=True) + options.contact_height_m
    window = max(1, round(options.floor_s * rate_hz)) | 1
    floor = percentile_filter(height.min(axis=1), 100.0 * _NEAR_QUANTILE, window)
    is_near = height < floor[:, None] + 2.0 * options.contact_height_m
    planted = (speed < options.contact_speed_m_s) & is_low & is_near
    least = max(2, round(options.min_contact_s * rate_hz))
    for side in range(2):
        for first, last in _runs(planted[:, side]):
            if last - first < least:
                planted[first:last, side] = False
    return planted


def bend_leg(hip_m: Array, knee_m: Array, ankle_m: Array, target_m: Array, *, fallback: Array) -> tuple[Array, Array]:
    """Return knee and ankle (frame, 3) of legs with the ankle at its target and the same lengths of thigh and shank.

    The knee stays in the plane of hip, knee and ankle, on its side of the line between them.  A target that is out of
    reach is approached along its line.  A leg that is straight bends towards `fallback` (frame, 3).
    """
    knees, ankles = np.empty(hip_m.shape), np.empty(hip_m.shape)
    for at, leg in enumerate(zip(hip_m, knee_m, ankle_m, target_m, fallback, strict=True)):
        knees[at], ankles[at] = bend_one_leg(*leg)
    return knees, ankles


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bend_one_leg(start: Array, middle: Array, end: Array, target: Array, fallback: Array) -> tuple[Array, Array]:
    """Do `bend_leg` for one leg, each argument (3,)."""
    thigh, shank = np.sqrt(((middle - start) ** 2).sum()), np.sqrt(((end - middle) ** 2).sum())
    old_line, line = end - start, target - start
    old_reach, reach = np.sqrt((old_line**2).sum()), np.sqrt((line**2).sum())
    down = np.array([0.0, -1.0, 0.0])
    old_line = old_line / old_reach if old_reach > 1e-12 else down
    line = line / reach if reach > 1e-12 else down
    reach = min(max(reach, abs(thigh - shank) + _MIN_BEND_M), _STRAIGHT * (thigh + shank))
    bend = (middle - start) - ((middle - start) * old_line).sum() * old_line
    if np.sqrt((bend**2).sum()) <= _MIN_BEND_M:
        bend = fallback
    pole = bend - (bend * line).sum() * line
    length = np.sqrt((pole**2).sum())
    pole = pole / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
    along = (thigh**2 - shank**2 + reach**2) / (2.0 * reach)
    aside = np.sqrt(max(thigh**2 - along**2, 0.0))
    return start + along * line + aside * pole, start + reach * line


def _forward(positions: Array) -> Array:
    """Return where the body faces (frame, 3)."""
    left, right = (positions[:, leg[0]] for leg in _LEGS)
    up = np.broadcast_to(np.array([0.0, 1.0, 0.0]), left.shape)
    return normalise(np.cross(left - right, up), fallback=np.array([0.0, 0.0, 1.0]))


def _correct_path(ankles: Array, is_planted: Booleans, floor: float, options: CleanUpOptions) -> Array:
    """Return the correction of the path (frame, 3): sum of squared steps of planted feet + stiffness + hold, least.

    Upwards, planted feet are also drawn to the floor.
    """
    frames = len(ankles)
    shift = np.zeros((frames, 3))
    if frames < 3 or not is_planted.any():
        return shift
    stays = (is_planted[1:] & is_planted[:-1]).astype(np.float64)  # (frame - 1, foot)
    steps = np.diff(ankles, axis=0)
    from scipy.linalg import solveh_banded  # here: 0.2 s that planning does not need

    for axis in range(3):
        # Upper bands of the symmetric pentadiagonal normal matrix, as solveh_banded takes them.
        bands = np.zeros((3, frames))
        bands[2] += options.shift_hold
        rhs = np.zeros(frames)
        weight = stays.sum(axis=1)
        bands[2, :-1] += weight
        bands[2, 1:] += weight
        bands[1, 1:] -= weight
        pull = (stays * steps[..., axis]).sum(axis=1)
        rhs[:-1] += pull
        rhs[1:] -= pull
        stiff = options.shift_stiffness
        bands[2, :-2] += stiff
        bands[2, 1:-1] += 4.0 * stiff
        bands[2, 2:] += stiff
        bands[1, 1:-1] -= 2.0 * stiff
        bands[1, 2:] -= 2.0 * stiff
        bands[0, 2:] += stiff
        if axis == _UP:
            planted = is_planted.astype(np.float64)
            bands[2] += options.floor_pull * planted.sum(axis=1)
            rhs += options.floor_pull * (planted * (floor - ankles[..., _UP])).sum(axis=1)
        shift[:, axis] = solveh_banded(bands, rhs)
    return shift


def _targets(ankle: Array, is_planted: Booleans, floor: float, rate_hz: float, options: CleanUpOptions) -> Array:
    """Return where a foot goes (frame, 3): still while planted, blended in and out, never below the floor."""
    frames = len(ankle)
    blend = max(1, round(options.blend_s * rate_hz))
    move, weight = np.zeros(ankle.shape), np.zeros((frames, 1))
    for first, last in _runs(is_planted):
        place = ankle[first:last].mean(axis=0)
        place[_UP] = max(place[_UP], floor)
        own = np.zeros(ankle.shape)
        share = np.zeros(frames)
        own[first:last] = place - ankle[first:last]
        share[first:last] = 1.0
        for step in range(1, blend):
            fade = 0.5 + 0.5 * np.cos(np.pi * step / blend)
            if first - step >= 0:
                own[first - step], share[first - step] = fade * own[first], fade
            if last - 1 + step < frames:
                own[last - 1 + step], share[last - 1 + step] = fade * own[last - 1], fade
        # Where blends of two contacts meet, each counts by its share.
        move += share[:, None] * own
        weight += share[:, None]
    move = move / np.maximum(weight, 1.0)
    length = np.linalg.norm(move, axis=-1, keepdims=True)
    move *= np.minimum(1.0, options.max_bend_m / np.maximum(length, 1e-12))
    target = ankle + move
    target[:, _UP] = np.maximum(target[:, _UP], floor)
    return np.asarray(target)


def _runs(values: Booleans) -> list[tuple[int, int]]:
    """Return first and last + 1 of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def clean_reconstruction(
    found: Reconstruction,
    origin_m: Array,
    camera: DatabaseCamera,
    *,
    rate_hz: float,
    options: CleanUpOptions | None = None,
) -> Reconstruction:
    """Return a reconstruction after clean-up, standing ankles at the height of the floor.

    Args:
        found: Reconstruction, camera axes.
        origin_m: Origin of the sequence's frame, see `floor_offset`; its height is the floor (3,), camera axes.
        camera: The database's camera, whose pitch says where up is.
        rate_hz: Frames per second.
        options: How.
    """
    upright = np.asarray(camera.camera_from_upright_rotmat)
    cleaned = clean_up((found.positions_m - origin_m) @ upright, rate_hz=rate_hz, options=options)
    standing = cleaned.positions_m - np.array([0.0, cleaned.floor_m, 0.0])
    positions = standing @ upright.T + origin_m
    return replace(found, positions_m=positions, bone_unitquat=bone_rotations(positions), root_m=mid_hip(positions))
