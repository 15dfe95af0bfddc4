"""Trio: three people hold hands in a ring that turns, closes and opens again."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import turn
from pasdedeux.choreography.duet import BonePoint, Contact, Duet, DuetStyle, finish
from pasdedeux.choreography.figure import Figure, Trunk
from pasdedeux.choreography.steps import over_beats, walk_on_beats

_TRACK = 0.068
"""Distance of each foot from the middle of the body, fraction of body height."""
_ROUND = 8
"""Beats in which the ring closes and opens once."""


class TrioStyle(DuetStyle):
    """Style of the trio; lengths are fractions of the mean height."""

    num_people: ClassVar[int] = 3

    tempo_bpm: float = Field(96.0, ge=60.0, le=110.0, description="Beats per minute, a side step each")
    radius: float = Field(0.35, ge=0.33, le=0.36, description="Distance of the pelvises from the middle of the ring")
    closing: float = Field(0.04, ge=0.0, le=0.06, description="How much nearer they come when the ring closes")
    stride: float = Field(0.045, ge=0.0, le=0.05, description="Length of a side step, to the left")
    rise: float = Field(0.07, ge=0.0, le=0.08, description="How much higher the hands are when the ring is closed")


def make_trio(style: TrioStyle) -> Duet:
    """Make a trio: A, B and C face the middle of a ring, B on A's left, and step to the left.

    Contacts, all the time: everybody's left wrist with the right wrist of the next (clasped hands).
    """
    vary, mean_m, time_s, bodies = style.vary(4), style.mean_m, style.time_s, style.bodies
    beat_s = 60.0 / (style.tempo_bpm * (1.0 + 0.05 * vary[0]))
    beats = np.arange(-5, int(np.ceil(style.duration_s / beat_s)) + 6)
    closed = 0.5 - 0.5 * np.cos(2.0 * np.pi * (beats / _ROUND + 0.5 * vary[1]))
    radius_m = np.asarray(mean_m * (style.radius - style.closing * closed))
    turn_rad = -style.stride * (1.0 - 0.2 * abs(float(vary[3]))) / style.radius
    angle = np.asarray(np.pi * float(vary[2]) + turn_rad * beats, dtype=np.float64)
    figures = tuple(
        _dancer(person, body, angle - 2.0 * np.pi * person / len(bodies), radius_m, beats, beat_s, time_s)
        for person, body in enumerate(bodies)
    )
    raised_m = mean_m * (style.rise * over_beats(time_s, closed, beats, beat_s) - 0.10)
    contacts = [
        _clasp(figures, person, (person + 1) % len(figures), raised_m, style.duration_s)
        for person in range(len(figures))
    ]
    return finish("trio", style, figures, contacts)


def _dancer(
    person: int, body: Body, angle: Array, radius_m: Array, beats: npt.NDArray[np.int_], beat_s: float, time_s: Array
) -> Figure:
    """Place trunk and feet of one dancer, whose place on the ring at each beat is given by angle and radius (beat,).

    B steps with the other foot, and everybody looks round and bends at another time.
    """
    is_left = (beats + person) % 2 == 1
    stations = radius_m[:, None] * np.stack([np.cos(angle), -np.sin(angle)], axis=-1), angle - 0.5 * np.pi
    walk = walk_on_beats(time_s, body, stations, beats, beat_s, is_left, track=_TRACK, out_rad=0.10, sway=0.016)
    phase = np.pi * (time_s / beat_s + person)
    look = 0.25 * phase + 2.0 * np.pi * person / 3.0
    trunk = Trunk.at(
        walk.where_m,
        body.standing_m("pelvis") - body.height_m * (0.02 - 0.006 * np.cos(2.0 * phase)),
        turn(walk.yaw_rad, 0.02, 0.02 * np.sin(phase)),
        (0.06 + 0.10 * np.sin(0.5 * look), 0.16 * np.sin(look), 0.03 * np.sin(phase)),
        (0.05, 0.5 * np.sin(look), 0.0),
    )
    return Figure(body=body, trunk=trunk, feet=walk.feet)


def _clasp(figures: tuple[Figure, ...], one: int, other: int, raised_m: Array, duration_s: float) -> Contact:
    """Bring a left and a right wrist together between two shoulders, so that both arms are as straight."""
    giver, taker = figures[one], figures[other]
    shoulders = giver.joint("left_shoulder"), taker.joint("right_shoulder")
    across = (shoulders[1] - shoulders[0]) * [1.0, 0.0, 1.0]
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    share = giver.body.height_m / (giver.body.height_m + taker.body.height_m)
    point = shoulders[0] + share * (shoulders[1] - shoulders[0])
    point[:, 1] += raised_m
    apart_m = 0.024 * (giver.body.height_m + taker.body.height_m)
    for figure, side, sign in ((giver, "left", 1.0), (taker, "right", -1.0)):
        pole = figure.chest_vector(0.6 * sign, -1.0, -0.5)
        figure.reach_hand(side, point - 0.5 * sign * apart_m * across, pole, palm=sign * across)
    ends = BonePoint(one, "left_wrist"), BonePoint(other, "right_wrist")
    return Contact(f"{'ABC'[one]}'s left hand in {'ABC'[other]}'s right", *ends, 0.0, duration_s, apart_m)
