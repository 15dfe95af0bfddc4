"""Feet: plants that do not move and smooth swings between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from pasdedeux.arrays import Array, Flags
from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.curves import blend, bump, curve_through
from pasdedeux.choreography.geometry import SIDES, Part, on_floor, turn
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.skeletons import BODY22

_PEEL = 0.22
"""Share of a swing in which the heel rises over the ball of the foot, which still stands."""
_CLEARANCE = 0.018
"""Height of the arc of a step, fraction of body height."""
_STANDING_GAP, _PASSING_GAP = 0.085, 0.062
"""Smallest distance of the ankles where a foot lands, and when one passes the other, fractions of body height."""

_DOUBLE_SUPPORT = 0.16
"""Share of a beat during which both feet stand."""
_MID_STANCE = 0.54
"""Beats from landing until the weight is over the foot."""


@dataclass(frozen=True)
class Plant:
    """A foot on the floor: the point under the ankle and the direction of the foot, from landing to lift-off.

    Args:
        x_m: Ankle, world X.
        z_m: Ankle, world Z.
        yaw_rad: Direction of the foot about +Y, 0 along +Z.
        land_s: Time from which the foot is flat and still.
        lift_s: Time at which the heel begins to rise.
        bow_m: Lateral bow of the swing that ends here, to the left of the foot's path (negative: to the right).
    """

    x_m: float
    z_m: float
    yaw_rad: float
    land_s: float
    lift_s: float
    bow_m: float = 0.0

    @classmethod
    def series(cls, floor_m: Array, yaw_rad: Part, land_s: ArrayLike, lift_s: ArrayLike) -> list[Self]:
        """Return the plants of one foot from X and Z of the ankle (plant, 2), directions and times (plant,)."""
        columns = np.broadcast_arrays(floor_m[:, 0], floor_m[:, 1], yaw_rad, land_s, lift_s)
        return [cls(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


@dataclass(frozen=True)
class FootPath:
    """A foot over time: ankle (frame, 3), world rotation (frame, 4), yaw (frame,), and its plants in order."""

    ankle_m: Array
    unitquat: Array
    yaw_rad: Array
    plants: tuple[Plant, ...]


def walk_foot(time_s: Array, body: Physique, plants: Sequence[Plant], *, heel: float = 1.0) -> FootPath:
    """Walk a foot from plant to plant.

    Between plants the heel rises over the standing ball of the foot, which then swings over in an arc.

    Args:
        time_s: Times (frame,).
        body: Whose foot.
        plants: Plants in order of time, at least one; the first holds before, the last after.
        heel: Rise of the heel, 1 for a plain walk.
    """
    ankle_to_toe = body.rest_offsets_m[BODY22.index("left_toe")]  # the right one is the same
    ball = np.array([_ball(plant, ankle_to_toe) for plant in plants])
    position = np.broadcast_to(ball[0], (len(time_s), 3)).copy()
    yaw = np.full(len(time_s), plants[0].yaw_rad)
    pitch = np.zeros(len(time_s))
    position[:, 1] = body.standing_m("left_toe")
    for before, after, start, stop in zip(plants[:-1], plants[1:], ball[:-1], ball[1:], strict=True):
        fraction = (time_s - before.lift_s) / (after.land_s - before.lift_s)
        flight = (fraction - _PEEL) / (1.0 - _PEEL)
        weight = blend(flight, 0.0, 1.0)
        length = float(np.linalg.norm(stop - start)) / body.height_m
        forward = float((stop - start) @ [np.sin(before.yaw_rad), 0.0, np.cos(before.yaw_rad)]) / body.height_m
        position += weight[:, None] * (stop - start)
        position[:, 1] += _CLEARANCE * body.height_m * min(1.0, 0.5 + length) * bump(flight)
        along = (stop - start) / max(float(np.linalg.norm(stop - start)), 1e-9)
        position += (after.bow_m * bump(weight))[:, None] * np.array([along[2], 0.0, -along[0]])
        yaw += weight * (after.yaw_rad - before.yaw_rad)
        pitch += (
            heel * (0.08 + 0.3 * min(length, 0.5) + 0.8 * float(np.clip(forward, 0.0, 0.5))) * bump(fraction, fall=4)
        )
    unitquat = turn(yaw, pitch)
    ankle = position - rotate(unitquat, ankle_to_toe)
    return FootPath(ankle_m=ankle, unitquat=unitquat, yaw_rad=yaw, plants=tuple(plants))


def walk_feet(
    time_s: Array, body: Physique, left: Sequence[Plant], right: Sequence[Plant], *, heel: float = 1.0
) -> tuple[FootPath, FootPath]:
    """Walk both feet from plant to plant, kept apart from each other where they land and where they pass."""
    left, right = spread_feet(body, left, right)
    return (
        walk_foot(time_s, body, clear_other_foot(body, left, right), heel=heel),
        walk_foot(time_s, body, clear_other_foot(body, right, left), heel=heel),
    )


@dataclass(frozen=True)
class Rhythm:
    """Steps to a beat: a foot lands on each beat, and the weight is over it a little later.

    Args:
        time_s: Times of the frames (frame,).
        beats: Numbers of the beats (beat,), from some before the first frame to some after the last.
        beat_s: Length of a beat, seconds; beat 0 is at 0.
    """

    time_s: Array
    beats: npt.NDArray[np.intp]
    beat_s: float

    @classmethod
    def of(cls, time_s: Array, duration_s: float, tempo_bpm: float) -> Self:
        """Return the beats of a tempo."""
        beat_s = 60.0 / tempo_bpm
        return cls(time_s, np.arange(-5, int(np.ceil(duration_s / beat_s)) + 6), beat_s)

    def curve(self, keys: Array) -> Array:
        """Pass through values of the beats (beat, ...) when the weight is over the foot (frame, ...)."""
        return curve_through(self.time_s, float(self.beats[0] + _MID_STANCE) * self.beat_s, self.beat_s, keys)

    def walk_feet(
        self, body: Physique, floor_m: Array, yaw_rad: Array, is_left: Flags, *, track: float, out_rad: float
    ) -> tuple[FootPath, FootPath]:
        """Step with the left or the right foot on each beat.

        Args:
            body: Whose feet.
            floor_m: Middle of the body at each beat, X and Z, (beat, 2).
            yaw_rad: Facing at each beat (beat,).
            is_left: Which foot lands (beat,).
            track: Distance of each foot from the middle of the body, fraction of height.
            out_rad: Angle of the toes outward.
        """
        left, right = (
            Plant.series(
                (floor_m + on_floor(yaw_rad, sign * track * body.height_m, -0.01 * body.height_m))[is_mine],
                yaw_rad[is_mine] + sign * out_rad,
                self.beats[is_mine] * self.beat_s,
                (self.beats[is_mine] + 1.0 + _DOUBLE_SUPPORT) * self.beat_s,
            )
            for sign, is_mine in zip(SIDES.values(), (is_left, ~is_left), strict=True)
        )
        return walk_feet(self.time_s, body, left, right)


def _ball(plant: Plant, ankle_to_toe: Array) -> Array:
    forward = ankle_to_toe[2]
    return np.array([plant.x_m + forward * np.sin(plant.yaw_rad), 0.0, plant.z_m + forward * np.cos(plant.yaw_rad)])


def spread_feet(body: Physique, left: Sequence[Plant], right: Sequence[Plant]) -> tuple[list[Plant], list[Plant]]:
    """Move plants outward where a foot would land too near the one that stands, each against the one before."""
    plants = sorted([(p, 1.0) for p in left] + [(p, -1.0) for p in right], key=lambda item: item[0].land_s)
    moved = plants[:1]
    for plant, sign in plants[1:]:
        before = moved[-1][0]
        yaw = 0.5 * (plant.yaw_rad + before.yaw_rad)
        away = np.array([plant.x_m - before.x_m, plant.z_m - before.z_m])
        outward = sign * np.array([np.cos(yaw), -np.sin(yaw)])
        aside = float(away @ outward)
        ahead = float(np.sqrt(max(float(away @ away) - aside**2, 0.0)))
        wanted = float(np.sqrt(max((_STANDING_GAP * body.height_m) ** 2 - ahead**2, 0.0)))
        shift = max(0.0, wanted - aside) * outward
        moved.append((replace(plant, x_m=plant.x_m + float(shift[0]), z_m=plant.z_m + float(shift[1])), sign))
    return [p for p, sign in moved if sign > 0], [p for p, sign in moved if sign < 0]


def clear_other_foot(body: Physique, plants: Sequence[Plant], other: Sequence[Plant]) -> list[Plant]:
    """Bow swings sideways, away from the foot that stands meanwhile, so that the feet do not touch."""
    result = [plants[0]]
    for before, after in pairwise(plants):
        middle_s = 0.5 * (before.lift_s + after.land_s)
        standing = [plant for plant in other if plant.land_s <= middle_s <= plant.lift_s]
        bow = _bow(before, after, standing[0], _PASSING_GAP * body.height_m) if standing else 0.0
        result.append(replace(after, bow_m=bow))
    return result


def _bow(before: Plant, after: Plant, standing: Plant, clear_m: float) -> float:
    """Return the bow that keeps a straight swing off a standing foot; the swing passes on the side where it begins."""
    start, stop = np.array([before.x_m, before.z_m]), np.array([after.x_m, after.z_m])
    path = stop - start
    length = float(np.linalg.norm(path))
    if length < 1e-6:
        return 0.0
    left = np.array([path[1], -path[0]]) / length
    obstacle = np.array([standing.x_m, standing.z_m])
    share = float(np.clip((obstacle - start) @ path / length**2, 0.0, 1.0))
    aside = float((start + share * path - obstacle) @ left)
    # Which side is free: that of the middle of the two plants, seen from the standing foot.
    side = 1.0 if aside >= 0.0 else -1.0
    reach = float(bump(np.array(share)))
    missing = clear_m - abs(aside)
    if missing <= 0.0 or reach < 0.2:
        return 0.0
    return side * min(missing / reach, 2.0 * clear_m)
