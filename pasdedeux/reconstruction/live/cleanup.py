"""Clean-up of a motion in progress, one frame at a time: the live form of `cleanup`.  Poses are never changed later.

A foot that slows down near the floor is planted where it is at that moment, and stays there.  The body follows its
planted feet within a moment, without jumps; the legs reach the rest.  A foot that leaves returns to where it is seen
within the time of a blend.  A person held up by somebody near has no planted feet.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.compiled import compiled
from pasdedeux.interaction.floor import StandingSettings
from pasdedeux.kinematics.rotation_kernels import divide, dot, put_row, row_of, scale, subtract, weighted_sum
from pasdedeux.reconstruction.cleanup import BLEND_S, MAX_BEND_M, bend_one_leg, facing_of
from pasdedeux.skeletons import OP14

_LEGS = np.array(OP14.legs)
_UP = 1
_FLOOR_QUANTILE = 0.1
_LEAVING = 1.5
"""A planted foot is released at this multiple of the speed and the height at which feet are planted."""


_STANDING = StandingSettings(contact_speed_m_s=0.45, away_share=0.25)
_CONTACT_SPEED_M_S, _CONTACT_HEIGHT_M = _STANDING.contact_speed_m_s, _STANDING.contact_height_m
_AWAY_SHARE = _STANDING.away_share
_SHIFT_S = 0.2
"""Time in which the body follows its planted feet."""
_HOLD_S = 2.0
"""Time over which a correction of the path fades while no foot is planted."""
_MAX_DRIFT_M = 0.12
"""Largest distance of a planted foot from where it is seen."""
_CARRYING_M = 0.8
"""Largest level distance between the hips of people who may carry each other, and so share a floor."""


class LiveFloor:
    """The floor under the people of a video as frames arrive.

    A wrong pitch tilts the floor, so its height follows from each person's feet in the last frames; for people who may
    carry each other, from the lower feet.
    """

    def __init__(self, rate_hz: float) -> None:
        self._num_frames = max(2, round(_STANDING.floor_s * rate_hz))
        self._heights: dict[int, Array] = {}
        self._last: dict[int, tuple[int, Array]] = {}

    def under(self, person: int, frame: int, positions_m: Array) -> float:
        """Return the height of the floor under a person (14, 3) in this frame."""
        heights = self._heights.setdefault(person, np.full(self._num_frames, np.nan))
        heights[frame % self._num_frames] = positions_m[_LEGS[:, 2], _UP].min()
        place = positions_m[_LEGS[:, 0]].mean(axis=0)
        self._last[person] = frame, place
        floor = _low_quantile(heights, _FLOOR_QUANTILE)
        for other, (seen, there) in self._last.items():
            is_near = np.hypot(*(there - place)[[0, 2]]) < _CARRYING_M
            if other != person and is_near and abs(frame - seen) < self._num_frames:
                floor = min(floor, _low_quantile(self._heights[other], _FLOOR_QUANTILE))
        return float(floor)

    def forget(self, person: int) -> None:
        """Drop the state of a person who left."""
        self._heights.pop(person, None)
        self._last.pop(person, None)


class LiveCleanUp:
    """Clean-up of the poses of one person as they leave; holds the state of this person.

    Args:
        rate_hz: Frames per second.
        floor: The floor shared with other people; a separate one by default.
        person: Number of the person on that floor.

    Attributes:
        floor_m: Height of standing ankles in the last step.
    """

    def __init__(self, rate_hz: float, *, floor: LiveFloor | None = None, person: int = 0) -> None:
        self._rate_hz = rate_hz
        self._floor = floor or LiveFloor(rate_hz)
        self._person = person
        self._frame: int | None = None
        self.floor_m = 0.0
        self._is_planted = np.zeros(2, dtype=np.bool_)
        self._raw_m = np.zeros((2, 3))
        self._anchor_m = np.zeros((2, 3))
        self._offset_m = np.zeros((2, 3))
        self._shift_m = np.zeros(3)

    @property
    def is_planted(self) -> Flags:
        """Whether the left and the right foot are planted now (2,)."""
        return self._is_planted.copy()

    def step(self, frame: int, positions_m: Array) -> Array:
        """Return a pose (14, 3), upright axes (y up, z towards the camera), cleaned up; bones keep their lengths."""
        passed_s = 0.0 if self._frame is None else (frame - self._frame) / self._rate_hz
        self._frame = frame
        self.floor_m = self._floor.under(self._person, frame, positions_m)
        feet = (self._is_planted, self._raw_m, self._anchor_m, self._offset_m, self._shift_m)
        return _clean_pose(positions_m, passed_s, self.floor_m, *feet)


def _low_quantile(values: Array, share: float) -> float:
    """Return the value below which this share of the finite values lies."""
    known = np.sort(values[np.isfinite(values)])
    return float(known[int(share * (len(known) - 1))])


@compiled()
def _clean_pose(
    pose: Array, passed: float, floor: float, is_planted: Flags, raw: Array, anchor: Array, offset: Array, shift: Array
) -> Array:
    """Return the cleaned pose (14, 3), and update the state of both feet and of the path."""
    legs = _LEGS
    lower = min(pose[legs[0, 2], _UP], pose[legs[1, 2], _UP])
    path, wanted = (shift[0], shift[1], shift[2]), (0.0, 0.0, 0.0)
    count = 0
    for foot in range(2):
        ankle = row_of(pose, legs[foot, 2])
        slack = _LEAVING if is_planted[foot] else 1.0
        is_slow = False
        if passed > 0.0:
            speed = divide(subtract(ankle, row_of(raw, foot)), passed)
            speed = (speed[0], speed[1], _AWAY_SHARE * speed[2])
            is_slow = dot(speed, speed) < (slack * _CONTACT_SPEED_M_S) ** 2
        reach = slack * _CONTACT_HEIGHT_M
        stays = is_slow and ankle[1] < lower + reach and ankle[1] < floor + 2.0 * reach
        if stays and is_planted[foot]:
            drift = subtract(subtract(row_of(anchor, foot), ankle), path)
            stays = dot(drift, drift) < _MAX_DRIFT_M**2
        if stays and not is_planted[foot]:
            put_row(anchor, foot, weighted_sum(1.0, weighted_sum(1.0, ankle, 1.0, path), 1.0, row_of(offset, foot)))
            anchor[foot, _UP] = max(anchor[foot, _UP], floor)
        is_planted[foot] = stays
        put_row(raw, foot, ankle)
        if stays:
            wanted = weighted_sum(1.0, wanted, 1.0, subtract(row_of(anchor, foot), ankle))
        count += stays
    for axis in range(3):
        if count > 0:
            shift[axis] += (1.0 - np.exp(-passed / _SHIFT_S)) * (wanted[axis] / count - shift[axis])
        else:
            shift[axis] *= np.exp(-passed / _HOLD_S)
    cleaned = pose + shift
    facing = facing_of(cleaned)
    for foot in range(2):
        hip, knee, ankle = legs[foot, 0], legs[foot, 1], legs[foot, 2]
        if is_planted[foot]:
            bend = subtract(row_of(anchor, foot), row_of(cleaned, ankle))
            squared = dot(bend, bend)
            if squared > MAX_BEND_M**2:
                bend = scale(MAX_BEND_M / np.sqrt(squared), bend)
            put_row(offset, foot, bend)
        else:
            offset[foot] *= np.exp(-passed / BLEND_S)
        end = row_of(cleaned, ankle)
        target = weighted_sum(1.0, end, 1.0, row_of(offset, foot))
        target = (target[0], max(target[1], floor), target[2])
        new_knee, new_ankle = bend_one_leg(row_of(cleaned, hip), row_of(cleaned, knee), end, target, facing)
        put_row(cleaned, knee, new_knee)
        put_row(cleaned, ankle, new_ankle)
    return cleaned
