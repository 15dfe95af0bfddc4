"""Hug with sway: two people walk up to each other, embrace, sway from foot to foot, let go and step back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.curves import halfway, mix, moves, window
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.duet import Contact, Dance, hand_contact
from pasdedeux.choreography.geometry import SIDES, on_floor
from pasdedeux.choreography.steps import FootPath, Plant, walk_foot

_ARRIVE_S, _HOLD_S, _LEAVE_S = 2.5, 3.3, 3.0
"""Times: both have arrived; the arms are closed; time before the end at which the arms begin to open."""
_MIN_HOLD_S = 1.0
_ALIKE_LIFT = 1.05
"""Additional upward direction of the upper person's elbows when both are equally tall."""
_TRACK, _NEAR, _LEFT = 0.062, 0.097, 0.035
"""Distance of each foot from the middle of the body, fraction of height; how far either body is before and to the left
of the middle in the embrace, fractions of the mean height."""
_SWAY, _SWAY_S, _APPROACH = 0.022, 2.4, 0.95
"""Amplitude of the pelvises' sway, fraction of the mean height; period of the sway; distance of the two at the
beginning, fraction of the mean height."""


class Hug(Dance):
    """Hug: the taller one's arms go over the shoulders, the other's round the waist.

    Contacts while the arms are closed: the four wrists on the partner's back.  The arms open 3 s before the end; a hug
    of less than 7 s is the beginning of a longer one.
    """

    @property
    def open_s(self) -> float:
        """Time at which the arms begin to open."""
        return max(self.duration_s - _LEAVE_S, _HOLD_S + _MIN_HOLD_S)

    @property
    def stops_m(self) -> tuple[float, float, float]:
        """Positions of either person in front of the middle at the beginning, in the embrace and at the end."""
        far = -0.5 * (_APPROACH * (1.0 + 0.08 * self.vary[0]) * self.mean_m)
        near = -_NEAR * self.mean_m
        return far, near, near + 0.5 * (far - near)

    def place(self, person: int) -> DancerFrames:
        """Place trunk and feet: A comes along +Z, B along -Z; each keeps to its own left."""
        body, other, time_s, vary = self.bodies[person], self.bodies[1 - person], self.time_s, self.vary
        height = body.height_m
        yaw, sign = (0.0, 1.0) if person == 0 else (np.pi, -1.0)
        far, near, back = self.stops_m
        leave = self.open_s + 0.9
        ahead = moves(time_s, far, [(0.15, _ARRIVE_S + 0.1, near), (leave, leave + 1.9, back)])
        closed = window(time_s, 1.6, _HOLD_S, self.open_s - 0.2, self.open_s + 1.0)
        sway_s = _SWAY_S * (1.0 + 0.1 * vary[2])
        sway_m = _SWAY * (1.0 - 0.2 * abs(vary[1])) * self.mean_m
        sway = sway_m * np.sin(2.0 * np.pi * (time_s - _HOLD_S) / sway_s + np.pi * vary[3])
        sway = sway * window(time_s, _HOLD_S - 0.6, _HOLD_S + 0.8, self.open_s - 1.2, self.open_s + 0.2)
        # Weight over the standing foot while walking: a sideways curve through the steps.
        step = window(time_s, 0.4, 1.0, 1.6, 2.3) + window(time_s, leave + 0.1, leave + 0.6, leave + 1.2, leave + 1.8)
        weight = 0.016 * height * step * np.sin(2.0 * np.pi * (time_s - 0.35) / 1.3)
        lean = 0.10 + 0.45 * max(0.0, height / other.height_m - 1.0)
        walking = 0.05 * (1.0 - closed)
        nod = 0.05 * np.sin(2.0 * np.pi * time_s / sway_s) * closed
        left, right = (self._foot(side, body, yaw) for side in SIDES)
        return DancerFrames(
            body,
            (left, right),
            floor_m=on_floor(yaw, _LEFT * self.mean_m + sign * sway + weight, ahead),
            height_m=np.full(len(time_s), body.standing_m("pelvis") - 0.009 * height),
            pelvis=(yaw + 0.06 * step * np.sin(2.0 * np.pi * (time_s - 0.2) / 1.3), walking + lean * closed, 0.0),
            spine=(walking * 0.4 + 0.6 * lean * closed, -0.02 * closed, 1.1 * sign * sway / height),
            head=(-0.05 - (0.9 * lean + 0.1) * closed + nod, 0.30 * closed, -0.20 * closed),
        )

    def _foot(self, side: str, body: Physique, yaw: float) -> FootPath:
        """Walk up in three steps (right, left, right), stand through the embrace, and step back (left, right)."""
        sign = SIDES[side]
        far, near, back = self.stops_m
        leave = self.open_s + 1.0
        if side == "left":
            stops = [(-1.0, 0.84, far), (1.42, leave, near), (leave + 0.60, 1e3, back)]
        else:
            first = far + 0.6 * (near - far)
            stops = [(-1.0, 0.22, far), (0.78, 1.5, first), (2.1, leave + 0.66, near), (leave + 1.26, 1e3, back)]
        land_s, lift_s, ahead = np.array(stops).T
        left_m = _LEFT * self.mean_m + sign * _TRACK * body.height_m
        floor = on_floor(yaw, left_m, ahead - 0.02 * body.height_m)
        return walk_foot(self.time_s, body, Plant.series(floor, yaw + sign * 0.14, land_s, lift_s), heel=1.15)

    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Swing the arms, open them, close them round the partner, and let go again."""
        contacts, time_s, open_s = [], self.time_s, self.open_s
        for person, figure in enumerate(figures):
            other, height = figures[1 - person], figure.body.height_m
            is_over = person == (0 if self.heights_m[0] >= self.heights_m[1] else 1)
            bone, share, angle = _resting_place(figure.body, other.body, is_over=is_over)
            rest_m = figure.body.rest_distance_m(other.body, bone)
            # Arms of equal people go over the shoulders; a taller one's may stay lower.
            alike = float(np.clip(1.0 - (height / other.body.height_m - 1.0) / 0.10, 0.0, 1.0))
            up = 0.02 + 0.07 * alike if is_over else -0.11
            sink_s = open_s + (1.5 if is_over else 0.8)
            opened = window(time_s, 0.7 if is_over else 1.1, 2.0 if is_over else 2.4, sink_s, sink_s + 1.2)
            closed = window(time_s, 2.0, _HOLD_S, open_s, open_s + 1.1)
            swing = 0.05 * height * np.sin(2.0 * np.pi * (time_s - 0.25) / 1.3) * window(time_s, 0.2, 0.8, 1.4, 2.0)
            for side, sign in SIDES.items():
                shoulder = figure.joint(f"{side}_shoulder")
                hanging = figure.chest_vector(sign * 0.030 * height, -0.305 * height, 0.03 * height - sign * swing)
                wide = figure.chest_vector(sign * 0.15 * height, up * height, (0.19 if is_over else 0.20) * height)
                # The partner faces us: our left is the right side of the partner.
                resting = other.round_bone(bone, share, rest_m, -sign * angle)
                detour = (sign * 0.10 * height, (0.06 if is_over else -0.03) * height, 0.02 * height)
                target = mix(mix(shoulder + hanging, shoulder + wide, opened), resting, closed)
                target = target + halfway(closed) * figure.chest_vector(*detour)
                high = figure.chest_vector(sign * 1.0, 0.3 + _ALIKE_LIFT * alike if is_over else -0.3, -0.1)
                pole = mix(figure.chest_vector(sign * 0.35, -0.3, -1.0), high, np.maximum(opened, closed))
                figure.reach_hand(side, target, pole, palm=other.joint("spine3") - target)
                contacts.append(hand_contact(person, side, bone, share, rest_m, _HOLD_S, open_s))
        return contacts


def _resting_place(body: Physique, other: Physique, *, is_over: bool) -> tuple[str, float, float]:
    """Return the partner's bone, the share of it, and how far round the back (radians from the front) a wrist rests."""
    if is_over:
        return *other.trunk_at(0.79 * other.height_m), np.radians(150.0)
    low, high = other.standing_m("spine1"), other.standing_m("spine2")
    wanted = body.standing_m("left_shoulder") - 0.12 * body.height_m
    return "spine2", float(np.clip((wanted - low) / (high - low), 0.0, 1.0)), np.radians(145.0)
