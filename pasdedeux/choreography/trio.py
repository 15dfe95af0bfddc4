"""Trio: three people hold hands in a ring that turns, closes and opens again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.duet import BonePoint, Contact, Dance
from pasdedeux.choreography.geometry import on_circle, on_floor
from pasdedeux.choreography.steps import Rhythm

_ROUND = 8
"""Beats in which the ring closes and opens once."""
_TEMPO_BPM = 96.0
"""Beats per minute, a side step each."""
_RADIUS, _CLOSING, _STRIDE, _RISE = 0.35, 0.04, 0.045, 0.07
"""Distance of the pelvises from the middle of the ring, their approach when it closes, length of a side step to the
left, rise of the hands when it is closed; fractions of the mean height."""


class Trio(Dance):
    """Trio: A, B and C face the middle of a ring, B on A's left, and step to the left.

    Contacts, all the time: everybody's left wrist with the right wrist of the next (clasped hands).
    """

    num_people: ClassVar[int] = 3

    def _rhythm(self) -> tuple[Rhythm, Array]:
        """Return the beats, and the degree to which the ring is closed at each (beat,), 0 to 1."""
        rhythm = Rhythm.of(self.time_s, self.duration_s, _TEMPO_BPM * (1.0 + 0.05 * self.vary[0]))
        return rhythm, 0.5 - 0.5 * np.cos(2.0 * np.pi * (rhythm.beats / _ROUND + 0.5 * self.vary[1]))

    def place(self, person: int) -> DancerFrames:
        """Place trunk and feet of one dancer.

        B steps with the other foot, and everybody looks round and bends at a different time.
        """
        body, (rhythm, closed) = self.bodies[person], self._rhythm()
        turn_rad = -_STRIDE * (1.0 - 0.2 * abs(self.vary[3])) / _RADIUS
        angle = np.asarray(np.pi * self.vary[2] + turn_rad * rhythm.beats, dtype=np.float64)
        angle = angle - 2.0 * np.pi * person / self.num_people
        floor = on_circle(self.mean_m * (_RADIUS - _CLOSING * closed), angle)
        yaw = angle - 0.5 * np.pi
        is_left = (rhythm.beats + person) % 2 == 1
        sway = 0.016 * body.height_m * np.where(is_left, 1.0, -1.0)
        phase = np.pi * (self.time_s / rhythm.beat_s + person)
        look = 0.25 * phase + 2.0 * np.pi * person / 3.0
        return DancerFrames(
            body,
            rhythm.walk_feet(body, floor, yaw, is_left, track=0.068, out_rad=0.10),
            floor_m=rhythm.curve(floor + on_floor(yaw, sway, 0.0)),
            height_m=body.standing_m("pelvis") - body.height_m * (0.02 - 0.006 * np.cos(2.0 * phase)),
            pelvis=(rhythm.curve(yaw), 0.02, 0.02 * np.sin(phase)),
            spine=(0.06 + 0.10 * np.sin(0.5 * look), 0.16 * np.sin(look), 0.03 * np.sin(phase)),
            head=(0.05, 0.5 * np.sin(look), 0.0),
        )

    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Clasp hands all round, raised as the ring closes."""
        rhythm, closed = self._rhythm()
        raised_m = self.mean_m * (_RISE * rhythm.curve(closed) - 0.10)
        return [_clasp(figures, person, (person + 1) % len(figures), raised_m) for person in range(len(figures))]


def _clasp(figures: Sequence[DancerFrames], first: int, other: int, raised_m: Array) -> Contact:
    """Join a left and a right wrist between two shoulders so that both arms are equally straight."""
    giver, taker = figures[first], figures[other]
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
    return Contact(BonePoint(first, "left_wrist"), BonePoint(other, "right_wrist"), apart_m)
