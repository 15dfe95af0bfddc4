"""Feet: plants that do not move and smooth swings between them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import blend, bump, curve_through, facing, turn
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.skeletons import BODY22

_PEEL = 0.22
"""Share of a swing during which the heel rises over the ball of the foot that still stands."""
_CLEARANCE = 0.018
"""Height of the arc of a step, fraction of body height."""
_STANDING_GAP, _PASSING_GAP = 0.085, 0.062
"""Least distance of the ankles where a foot lands, and when one passes the other, fractions of body height."""


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
        land_s: When the foot is flat and still.
        lift_s: When the heel begins to rise.
        bow_m: How far the swing that ends here bows to the left of the foot's path (negative: to the right).
    """

    x_m: float
    z_m: float
    yaw_rad: float
    land_s: float
    lift_s: float
    bow_m: float = 0.0


@dataclass(frozen=True)
class FootPath:
    """A foot over time: ankle (frame, 3), world rotation (frame, 4), yaw (frame,), and its plants in order."""

    ankle_m: Array
    unitquat: Array
    yaw_rad: Array
    plants: tuple[Plant, ...]


@dataclass(frozen=True)
class Walk:
    """Somebody who steps on beats: both feet, the middle of the body (frame, x and z) and its facing (frame,)."""

    feet: tuple[FootPath, FootPath]
    where_m: Array
    yaw_rad: Array


def plan_foot(where_m: Array, yaw_rad: Array, land_s: Iterable[Any], lift_s: Iterable[Any]) -> list[Plant]:
    """Return plants at (n, x and z) or (n, 3), with directions (n,), when the foot lands and lifts off (n,)."""
    rows = zip(where_m[:, 0], where_m[:, -1], yaw_rad, land_s, lift_s, strict=True)
    return [Plant(*map(float, row)) for row in rows]


def walk_on_beats(
    time_s: Array,
    body: Body,
    stations: tuple[Array, Array],
    beats: npt.NDArray[np.int_],
    beat_s: float,
    is_left: npt.NDArray[np.bool_],
    *,
    track: float,
    out_rad: float,
    sway: float,
) -> Walk:
    """Step on every beat with one foot, the body leaning over it some time after it has landed.

    Args:
        time_s: Times (frame,).
        body: Who.
        stations: Where (beat, x and z) and in which direction (beat,) the body is at each beat.
        beats: Numbers of the beats (beat,), well before the first time to well after the last.
        beat_s: Time of a beat.
        is_left: Which beats the left foot steps on (beat,).
        track: Distance of each foot from the middle of the body, fraction of height.
        out_rad: How far the feet point outward.
        sway: How far the body leans over the standing foot, fraction of height.
    """
    where, yaw = stations
    left, right = (
        plan_foot(
            (where + facing(yaw, sign * track * body.height_m, 0.0, -0.01 * body.height_m)[:, [0, 2]])[mask],
            yaw[mask] + sign * out_rad,
            beats[mask] * beat_s,
            (beats[mask] + 1.0 + _DOUBLE_SUPPORT) * beat_s,
        )
        for sign, mask in ((1.0, is_left), (-1.0, ~is_left))
    )
    over = where + facing(yaw, sway * body.height_m * np.where(is_left, 1.0, -1.0), 0.0, 0.0)[:, [0, 2]]
    middle, facing_rad = (over_beats(time_s, keys, beats, beat_s) for keys in (over, yaw))
    return Walk(walk_feet(time_s, body, left, right), middle, facing_rad)


def over_beats(time_s: Array, keys: Array, beats: npt.NDArray[np.int_], beat_s: float) -> Array:
    """Pass through keys (beat, ...), each when the weight is over the foot that has landed on its beat."""
    return curve_through(time_s, float(beats[0] + _MID_STANCE) * beat_s, beat_s, keys)


def walk_foot(time_s: Array, body: Body, plants: Sequence[Plant], *, heel: float = 1.0) -> FootPath:
    """Walk a foot from plant to plant.

    Between plants the heel rises over the standing ball of the foot, which then swings over in an arc.

    Args:
        time_s: Times (frame,).
        body: Whose foot.
        plants: Plants in order of time, at least one; the first holds before, the last after.
        heel: How much the heel rises, 1 for a plain walk.
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
    ankle = position - rotate(unitquat, np.broadcast_to(ankle_to_toe, position.shape))
    return FootPath(ankle_m=ankle, unitquat=unitquat, yaw_rad=yaw, plants=tuple(plants))


def walk_feet(
    time_s: Array, body: Body, left: Sequence[Plant], right: Sequence[Plant], *, heel: float = 1.0
) -> tuple[FootPath, FootPath]:
    """Walk both feet from plant to plant, kept apart from each other where they land and where they pass."""
    left, right = spread_feet(body, left, right)
    return (
        walk_foot(time_s, body, clear_other_foot(body, left, right), heel=heel),
        walk_foot(time_s, body, clear_other_foot(body, right, left), heel=heel),
    )


def _ball(plant: Plant, ankle_to_toe: Array) -> Array:
    forward = ankle_to_toe[2]
    return np.array([plant.x_m + forward * np.sin(plant.yaw_rad), 0.0, plant.z_m + forward * np.cos(plant.yaw_rad)])


def spread_feet(body: Body, left: Sequence[Plant], right: Sequence[Plant]) -> tuple[list[Plant], list[Plant]]:
    """Move plants outward where a foot would land too near the one that stands, each checked against the one before.

    Args:
        body: Whose feet.
        left: Plants of the left foot.
        right: Plants of the right foot.
    """
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


def clear_other_foot(body: Body, plants: Sequence[Plant], other: Sequence[Plant]) -> list[Plant]:
    """Bow swings sideways, away from the foot that stands meanwhile, so that the feet do not touch.

    Args:
        body: Whose feet.
        plants: Plants of one foot.
        other: Plants of the other foot.
    """
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
