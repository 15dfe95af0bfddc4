"""Lift: A takes B by the waist, lifts B off the floor, turns and walks with B in the air, and sets B down."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.curves import halfway, mix, moves, window
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.duet import Contact, Dance, hand_contact
from pasdedeux.choreography.geometry import OTHER_SIDE, SIDES, on_floor, square_to, turn
from pasdedeux.choreography.steps import FootPath, Plant, walk_feet, walk_foot
from pasdedeux.kinematics.rotations import normalise

_HOLD_S, _OPEN_S = 1.6, 8.3
"""Times: both hands of both lie on the partner; they let go."""
_RISE_S, _UP_S, _SINK_S, _DOWN_S = 2.0, 3.2, 6.8, 8.0
"""Times: B begins to leave the floor, is up, begins to come down, stands again."""
_STEPS = ((3.2, 4.35), (4.35, 5.5), (5.5, 6.65))
"""A walks: in each of these both feet move."""
_BENT_S = (0.9, _RISE_S - 0.1, _DOWN_S, 9.2)
"""Times: both begin to bend towards each other, are bent, begin to come up, stand upright."""
_APART = 0.235
"""Distance of the two pelvises, fraction of the mean height."""
_TRACK, _NARROW_TRACK = 0.075, 0.055
"""Distance of each foot of A and of B from the middle of the body, fraction of height."""
_WAIST = 0.20
"""Distance below A's shoulders at which A holds B, fraction of A's height, if B's trunk is there."""
_REACH = 0.96
"""Share of the arms' reach used by the highest lift, and by the lowest of an upright A."""
_LIFT, _STRIDE = 0.20, 0.12
"""Height to which B is lifted, within the arms' reach, and length of A's steps; fractions of the mean height."""
_TURN_RAD = 1.2
"""Angle by which A turns to the left with B in the air."""


class Lift(Dance):
    """Lift of 10 s: contacts are A's hands on B's waist and B's hands on A's upper arms, from 1.6 to 8.3 s.

    B's feet stand until 2 s and from 8 s on, and hang in between.  The height of B is limited by the arms of both.  A
    longer lift ends standing.
    """

    @property
    def _taller(self) -> float:
        """Difference of heights, A minus B, as a share of B's height."""
        return self.heights_m[0] / self.heights_m[1] - 1.0

    @cached_property
    def _waist(self) -> tuple[float, float]:
        """Height of A's hands on B's waist while B stands, and their share of B's `spine2`."""
        lifter, lifted = self.bodies
        low, high = lifted.standing_m("spine1"), lifted.standing_m("spine2")
        waist_m = float(np.clip(lifter.standing_m("left_shoulder") - _WAIST * lifter.height_m, low, high))
        return waist_m, (waist_m - low) / (high - low)

    @cached_property
    def _lift_m(self) -> tuple[float, float]:
        """Height to which B is lifted, and how far A rises with B in the air, 0 to 1: B must be high enough for A."""
        lifter, lifted = self.bodies

        def reach_m(body: Physique, across_m: float) -> float:
            arm_m = _REACH * (body.length_m("left_elbow") + body.length_m("left_wrist"))
            return float(np.sqrt(max(arm_m**2 - across_m**2, 0.0)))

        apart_m, shoulder_m = _APART * self.mean_m, lifter.standing_m("left_shoulder")
        own_m, own_reach_m = shoulder_m - self._waist[0], reach_m(lifter, apart_m)
        other_m = shoulder_m - 0.02 * lifter.height_m - lifted.standing_m("left_shoulder")
        low_m = own_m - own_reach_m
        high_m = max(0.03, min(own_m + own_reach_m, other_m + reach_m(lifted, 0.75 * apart_m)))
        lift_m = min(_LIFT * (1.0 - 0.15 * abs(self.vary[0])) * self.mean_m, high_m)
        return lift_m, min(1.0, lift_m / low_m) if low_m > 0.0 else 1.0

    def _station(self, person: int, time_s: Array) -> tuple[Array, Array]:
        """Return the place of a person's pelvis, X and Z (frame, 2), and its facing (frame,)."""
        progress = moves(time_s, 0.0, [(*span, float(step)) for step, span in enumerate(_STEPS, start=1)])
        yaw = _TURN_RAD * (1.0 + 0.1 * self.vary[1]) * progress / len(_STEPS)
        # The middle of an arc walked forward, in the direction faced half way.
        stride_m = _STRIDE * (1.0 - 0.2 * abs(self.vary[2])) * self.mean_m
        floor = on_floor(0.5 * yaw, 0.0, stride_m * progress)
        return (floor, yaw) if person == 0 else (floor + on_floor(yaw, 0.0, _APART * self.mean_m), yaw + np.pi)

    def place(self, person: int) -> DancerFrames:
        """Place trunk and feet.

        A bends to take B, comes up with the load and walks leaning back.  B stands before A, hangs in A's hands with
        loose legs, and stands again.
        """
        body, time_s = self.bodies[person], self.time_s
        floor, yaw = self._station(person, time_s)
        up, bent = window(time_s, _RISE_S, _UP_S, _SINK_S, _DOWN_S), window(time_s, *_BENT_S)
        lift_m, upright = self._lift_m
        if person == 1:
            stoop = (0.06 + 0.5 * max(0.0, -self._taller)) * bent
            left, right = (self._hanging(side, body, floor, yaw, up) for side in SIDES)
            return DancerFrames(
                body,
                (left, right),
                floor_m=floor,
                height_m=body.standing_m("pelvis") - 0.010 * body.height_m + lift_m * up,
                pelvis=(yaw, 0.3 * stoop, 0.0),
                spine=(stoop, 0.0, 0.0),
                head=(0.10 * up - 0.5 * stoop, 0.0, 0.0),
            )
        bent = bent * (1.0 - upright * up)
        # A much taller A leans more.
        lean = 0.10 + 0.6 * max(0.0, self._taller)
        left_plants, right_plants = (self._plants(side, body) for side in SIDES)
        return DancerFrames(
            body,
            walk_feet(time_s, body, left_plants, right_plants, heel=0.7),
            floor_m=floor,
            height_m=body.standing_m("pelvis") - body.height_m * (0.012 + 0.028 * bent),
            pelvis=(yaw, lean * bent - 0.03 * up, 0.0),
            spine=((0.02 + lean) * bent - 0.02 * up, 0.0, 0.0),
            head=(-0.5 * lean * bent - 0.08 * up, 0.0, 0.0),
        )

    def _plants(self, side: str, body: Physique) -> list[Plant]:
        """Plan a foot of A: it lands where the pelvis will be; the foot on the inside of the turn leads."""
        sign = SIDES[side]
        wait_s = 0.0 if side == "left" else 0.55
        lifts = [start + wait_s for start, _ in _STEPS]
        floor, yaw = self._station(0, np.array([0.0, *(stop for _, stop in _STEPS)]))
        floor = floor + on_floor(yaw, sign * _TRACK * body.height_m, -0.02 * body.height_m)
        return Plant.series(floor, yaw + sign * 0.2, [-1.0, *(lift + 0.55 for lift in lifts)], [*lifts, 1e6])

    def _hanging(self, side: str, body: Physique, floor: Array, yaw: Array, up: Array) -> FootPath:
        """Return a foot of B: it stands, hangs below the hips with the toes down, and stands at A's new place."""
        sign = SIDES[side]
        aside, ahead = sign * _NARROW_TRACK * body.height_m, -0.02 * body.height_m
        turned = sign * 0.12
        places, yaws = self._station(1, np.array([0.0, _DOWN_S]))
        plants = Plant.series(places + on_floor(yaws, aside, ahead), yaws + turned, (-1.0, _DOWN_S), (_RISE_S, 1e6))
        height = walk_foot(self.time_s, body, plants[:1]).ankle_m[:, 1]
        drawn = (0.010 + 0.014 * (sign > 0)) * body.height_m * up
        x, z = (floor + on_floor(yaw, aside, ahead - 0.045 * body.height_m * up)).T
        ankle = np.stack([x, self._lift_m[0] * up + drawn + height, z], axis=-1)
        return FootPath(ankle, turn(yaw + turned, 0.55 * up), yaw + turned, tuple(plants))

    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Raise the arms, lay A's hands on B's waist and B's on A's upper arms, and let go."""
        contacts = []
        for person, figure in enumerate(figures):
            other, height = figures[1 - person], figure.body.height_m
            # B's arms lie on A's: they come first and leave last.
            early_s = 0.3 * person
            closed = window(self.time_s, 0.6 - early_s, _HOLD_S - early_s, _OPEN_S + early_s, 9.3 + early_s)
            for side, sign in SIDES.items():
                # The partner faces us: our left is the right side of the partner.
                if person == 0:
                    bone, share = "spine2", self._waist[1]
                    rest_m = figure.body.rest_distance_m(other.body, bone)
                    resting = other.round_bone(bone, share, rest_m, -sign * np.radians(95.0))
                    palm = other.joint("spine2") - resting
                    pole = figure.chest_vector(sign * 0.9, -1.0, -0.2)
                else:
                    bone, share = f"{OTHER_SIDE[side]}_elbow", 0.30 + 1.0 * max(0.0, self._taller)
                    rest_m = figure.body.rest_distance_m(other.body, bone)
                    along = normalise(other.on_bone(bone, 1.0) - other.on_bone(bone, 0.0))
                    above = square_to(along, other.chest_vector(sign * -0.35, 1.0, 0.6))
                    resting = other.on_bone(bone, share) + rest_m * above
                    palm = -above
                    pole = figure.chest_vector(sign * 1.0, -0.5, -0.3)
                hang = figure.chest_vector(sign * 0.03 * height, -0.305 * height, 0.03 * height)
                aside = sign * (0.06 if person == 0 else 0.10) * height
                detour = halfway(closed) * figure.chest_vector(aside, 0.02 * height, 0.05 * height)
                target = mix(figure.joint(f"{side}_shoulder") + hang, resting, closed) + detour
                pole = mix(figure.chest_vector(sign * 0.35, -0.3, -1.0), pole, closed)
                figure.reach_hand(side, target, pole, palm=palm)
                contacts.append(hand_contact(person, side, bone, share, rest_m, _HOLD_S, _OPEN_S))
        return contacts
