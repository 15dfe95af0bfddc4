"""Push-hands: two people in bow stance, wrists and elbows touching, circle while their weight moves to and fro."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.duet import BonePoint, Contact, Dance, hand_contact
from pasdedeux.choreography.geometry import columns, on_floor, square_to
from pasdedeux.choreography.steps import FootPath, Plant, walk_foot
from pasdedeux.kinematics.rotations import normalise

_FEET = ((0.062, -0.175, 0.75), (-0.062, 0.165, -0.05))
"""Left foot, which stands behind, and right foot: left and forward of the middle of the stance, fractions of height;
and where it points, radians."""
_CIRCLE_S = 2.6
"""Duration of one circle."""
_WIDTH, _DEPTH, _SHIFT, _APART = 0.050, 0.055, 0.050, 0.385
"""Half width and half depth of the circle, amplitude of the pelvis forward and back, distance of the two stances;
fractions of the mean height."""


class PushHands(Dance):
    """Push-hands: right foot in front, the feet never move, right wrists circle, left hands at the right elbows.

    The circle is horizontal at first, upright two circles later, and so on.  Contacts, all the time: right wrist on
    right wrist, A's left wrist at B's right elbow, B's left wrist at A's right elbow.
    """

    @property
    def phase(self) -> Array:
        """Angle on the circle (frame,), radians."""
        vary = self.vary
        phase = 2.0 * np.pi * self.time_s / (_CIRCLE_S * (1.0 + 0.08 * vary[0])) + np.pi * vary[1]
        return phase + 0.15 * (1.0 + vary[2]) * np.sin(0.37 * phase)

    def place(self, person: int) -> DancerFrames:
        """Place trunk and feet: A stands at -Z and looks along +Z, B opposite."""
        body, phase = self.bodies[person], self.phase
        yaw, sign = (0.0, 1.0) if person == 0 else (np.pi, -1.0)
        middle = np.array([0.0, -0.5 * sign * _APART * self.mean_m])
        forward = sign * (_SHIFT * self.mean_m * np.cos(phase - 0.35))
        left, right = (self._stand(body, middle, yaw, *foot) for foot in _FEET)
        waist = 0.24 * np.sin(phase + 0.3) + 0.10
        return DancerFrames(
            body,
            (left, right),
            floor_m=middle + on_floor(yaw, 0.004 * body.height_m * np.sin(phase), forward - 0.01 * body.height_m),
            height_m=body.standing_m("pelvis") - body.height_m * (0.052 + 0.006 * np.cos(phase)),
            pelvis=(yaw + 0.16 + 0.30 * waist, 0.04 + 0.25 * forward, 0.0),
            spine=(0.05 + 0.35 * forward, 0.55 * waist, 0.03 * np.sin(phase)),
            head=(0.05, -0.12 - 0.7 * waist, 0.0),
        )

    def _stand(self, body: Physique, middle: Array, yaw: float, aside: float, ahead: float, out_rad: float) -> FootPath:
        at = middle + on_floor(yaw, aside * body.height_m, ahead * body.height_m)
        # It stands long before the beginning and long after the end.
        return walk_foot(self.time_s, body, Plant.series(at[None], yaw + out_rad, -1.0, 1e3))

    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Move right wrists to the point of contact, then left wrists to the other's right elbow."""
        bodies, phase, mean_m = self.bodies, self.phase, self.mean_m
        # The point of contact, nearer to the shorter arm; horizontal and upright circles alternate.
        upright = (0.5 - 0.5 * np.cos(0.26 * phase)) * (0.85 + 0.15 * self.vary[3])
        size = mean_m * (1.0 - 0.1 * abs(self.vary[4]))
        share = self.heights_m[0] / sum(self.heights_m) - 0.5
        chest_m = 0.5 * (bodies[0].standing_m("spine3") + bodies[1].standing_m("spine3"))
        aside = _WIDTH * size * np.sin(phase)
        point = columns(
            aside * (1.0 - 0.6 * upright),
            chest_m - 0.005 * mean_m + aside * (0.15 + 0.85 * upright),
            share * _APART * mean_m + _DEPTH * size * np.cos(phase),
        )
        wrists_m = bodies[0].rest_distance_m(bodies[1], "left_wrist")
        tilt = 0.5 * np.sin(phase)
        across = columns(np.cos(tilt), np.sin(tilt), 0.0)
        contacts = [Contact(BonePoint(0, "right_wrist"), BonePoint(1, "right_wrist"), wrists_m)]
        for figure, sign in zip(figures, (-1.0, 1.0), strict=True):
            outward, palm = figure.chest_vector(-0.9, -1.0, 0.0), figure.chest_vector(0.6, 0.0, -0.4)
            figure.reach_hand("right", point + 0.5 * sign * wrists_m * across, outward, palm=palm)
        for person, figure in enumerate(figures):
            other = figures[1 - person]
            radius_m = figure.body.rest_distance_m(other.body, "left_elbow")
            elbow = other.joint("right_elbow")
            arm = normalise(elbow - other.joint("right_shoulder"))
            # The outside of the elbow; a much taller partner's arm comes from above and lies higher on it.
            above = max(0.0, figure.body.height_m / other.body.height_m - 1.0)
            target = elbow + radius_m * square_to(arm, other.chest_vector(-0.8, 1.5 * above - 0.3, 0.5))
            figure.reach_hand("left", target, figure.chest_vector(0.8, -1.0, -0.1), palm=elbow - target)
            contacts.append(hand_contact(person, "left", "right_elbow", 1.0, radius_m))
        return contacts
