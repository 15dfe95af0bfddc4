"""Judo: sleeve and lapel grips, walking steps, a turn-in to the hip, and out again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.curves import halfway, mix, moves, window
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.duet import BonePoint, Contact, Dance
from pasdedeux.choreography.geometry import SIDES, on_floor
from pasdedeux.choreography.steps import Plant, walk_feet

Vector = tuple[float, float, float]

_CYCLE_S = 10.0
"""The whole form; a longer duet repeats it."""
_IN_S, _HELD_S, _OUT_S, _LEAVE_S = 3.1, 4.7, 5.7, 7.2
"""Times: A begins to turn in, is in, begins to turn out, is out."""
_LET_GO_S, _ON_BACK_S, _BACK_S, _REGRIP_S = 3.3, 4.6, 5.8, 7.3
"""Times of A's right hand: it leaves the lapel; it is on B's back, and leaves it; it holds the lapel again."""
_WALK = ((0.25, 1.30), (1.30, 2.35), (7.5, 8.55), (8.55, 9.6))
"""Walking: in each of these the pair moves by one step of both feet; two there and two back."""
_HIP, _ASIDE = 0.205, -0.05
"""Distance of the pelvises when A is turned in, and how far A is then to the left, fractions of the mean height."""
_TRACK = 0.075
"""Distance of each foot from the middle of the body, fraction of height."""
_TURNED_TRACK, _TURNED_SHIFT = 0.060, 0.045
"""The same while A is turned in, and how far both feet then stand away from the partner: the hip comes first."""
_LEAD_S = 0.3
"""Time by which B's left hand leaves A's sleeve earlier, and returns later."""
_LAPEL_DEG = (40.0, 30.0)
"""Angles at which A's and B's right hands hold the other's lapel, from the front over the other's left."""
_SLEEVE_SHARE = 0.75
"""Share of the upper arm at which the sleeve is held."""
_SLEEVE_SIDE = (0.0, 0.6, -0.8)
"""Side of the upper arm, in its rest axes (along the bone, hinge, bend): outside and behind."""
_OVER_RATIO = 1.11
"""If A is taller than B by this factor, A's right arm goes over B's shoulder instead of under the arm."""


@dataclass(frozen=True)
class _BackHold:
    """A hand on the partner's back: its place, the direction of its elbow, and its detour on the way.

    `bone`, `share` and `angle_deg` (from the front over the left) give the place; `pole` and `detour` are left, up and
    forward of B's chest, the detour as a share of B's height.  `haste_s` is the time by which it arrives before, and
    leaves after, the stated contact.
    """

    bone: str
    share: float
    angle_deg: float
    pole: Vector
    detour: Vector
    haste_s: float = 0.0


_UNDER = (
    _BackHold("spine2", 0.6, 120.0, (1.0, -0.75, 0.3), (0.14, -0.09, 0.08)),
    _BackHold("spine3", 0.5, -160.0, (1.0, 0.0, 0.3), (0.08, 0.10, 0.0)),
)
_OVER = (
    _BackHold("neck", 0.5, 150.0, (1.0, 0.6, 0.3), (0.10, 0.25, 0.07)),
    _BackHold("spine2", 0.5, -150.0, (1.0, -0.6, 0.0), (0.14, -0.18, -0.08), haste_s=0.3),
)
"""A's right hand on B's back and B's left hand on A's back."""
_APART, _STRIDE = 0.40, 0.13
"""Distance of the two pelvises in the grip, length of a walking step, fractions of the mean height."""
_CIRCLE_RAD, _TURN_RAD = 0.35, 1.35
"""Turn of the pair in a walking step, and how far A turns in."""


class Judo(Dance):
    """Judo form of 10 s, repeated: A turns in, B is taken onto the hip and set back.

    A's right arm goes under B's left arm round the waist (uki-goshi); when A is more than 11 % taller, over B's left
    shoulder (koshi-guruma).  Contacts: A's left hand on B's right sleeve and B's right hand on A's left lapel all the
    time; A's right hand on B's left lapel and B's left hand on A's right sleeve, but on the other's back while A is
    turned in.
    """

    @property
    def _starts_s(self) -> Array:
        """Times at which the form begins."""
        return np.arange(0.0, max(self.duration_s, _CYCLE_S), _CYCLE_S)

    def _every_cycle(self, time_s: Array, rise_s: float, full_s: float, fade_s: float, stop_s: float) -> Array:
        """Return a window (frame,) that recurs once in every cycle."""
        return np.asarray(sum(window(time_s - start, rise_s, full_s, fade_s, stop_s) for start in self._starts_s))

    def _inside(self, time_s: Array) -> Array:
        """Return the degree to which A is turned in (frame,), 0 to 1."""
        return self._every_cycle(time_s, _IN_S, _HELD_S, _OUT_S, _LEAVE_S)

    def _station(self, person: int, time_s: Array) -> tuple[Array, Array]:
        """Return the place of a person's pelvis, X and Z (frame, 2), and its facing (frame,)."""
        walked = [
            (start + start_s, start + stop_s, share)
            for start in self._starts_s
            for (start_s, stop_s), share in zip(_WALK, (1.0, 2.0, 1.0, 0.0), strict=True)
        ]
        vary, mean_m, heights_m = self.vary, self.mean_m, self.heights_m
        progress = moves(time_s, 0.0, walked)
        yaw = _CIRCLE_RAD * (1.0 + 0.2 * vary[1]) * progress
        centre = on_floor(0.0, 0.0, _STRIDE * (1.0 - 0.2 * abs(vary[0])) * mean_m * progress)
        apart_m = _APART * mean_m * (1.0 - 0.25 * (max(heights_m) / min(heights_m) - 1.0))
        if person == 1:
            return centre + on_floor(yaw, 0.0, 0.5 * apart_m), yaw + np.pi
        inside = self._inside(time_s)
        ahead = -0.5 * apart_m + inside * (apart_m - _HIP * mean_m)
        turned = _TURN_RAD * (1.0 + 0.02 * vary[2]) * inside
        return centre + on_floor(yaw, inside * (_ASIDE * mean_m), ahead), yaw + turned

    def place(self, person: int) -> DancerFrames:
        """Place trunk and feet: A turns in, sinks and leans away with B on the hip; B stoops when taller."""
        time_s, body = self.time_s, self.bodies[person]
        floor, yaw = self._station(person, time_s)
        inside = self._inside(time_s)
        loaded = self._every_cycle(time_s, _HELD_S - 0.7, _HELD_S + 0.2, _OUT_S - 0.2, _OUT_S + 0.7)
        breath = np.sin(2.0 * np.pi * time_s / 2.5)
        if person == 0:
            sunk = 0.035 + 0.025 * inside - 0.008 * loaded
            pelvis = (yaw, 0.10 - 0.02 * inside, -0.10 * inside)
            spine = (0.12 + 0.10 * inside, 0.10 * inside + 0.03 * breath, -0.26 * inside - 0.10 * loaded)
            head = (-0.12 + 0.05 * inside, 0.10 * inside, -0.10 * inside)
        else:
            stoop = 0.5 * max(0.0, self.heights_m[1] / self.heights_m[0] - 1.0)
            sunk = 0.030 - 0.012 * inside
            pelvis = (yaw, 0.10 + 0.04 * loaded, 0.03 * inside)
            spine = (0.10 + 0.06 * loaded + stoop * inside, 0.04 * breath - 0.08 * inside, 0.05 * inside)
            head = (np.full_like(inside, -0.12), -0.25 * inside, 0.0 * inside)
        left, right = (self._plants(person, side, body) for side in SIDES)
        return DancerFrames(
            body,
            walk_feet(time_s, body, left, right, heel=0.8),
            floor_m=floor,
            height_m=body.standing_m("pelvis") - body.height_m * sunk,
            pelvis=pelvis,
            spine=spine,
            head=head,
        )

    def _plants(self, person: int, side: str, body: Physique) -> list[Plant]:
        """Plan a foot: it lands where the pelvis will be when the pair, or A alone, has moved."""
        sign = SIDES[side]
        # Right feet lead for A, left feet for B; the other foot follows half a second later.
        wait_s = 0.0 if (side == "right") == (person == 0) else 0.5
        walked = [(start_s + wait_s, start_s + wait_s + 0.5, stop_s) for start_s, stop_s in _WALK]
        if person == 0 and side == "right":
            walked += [(_IN_S, _IN_S + 0.75, _HELD_S), (_OUT_S + 0.75, _LEAVE_S, _LEAVE_S)]
        elif person == 0:
            walked += [(_IN_S + 0.8, _HELD_S, _HELD_S), (_OUT_S, _OUT_S + 0.7, _LEAVE_S)]
        steps = np.array(sorted(walked))
        lifts, lands, ends = (self._starts_s[:, None, None] + steps).reshape(-1, 3).T
        is_turned = np.append(False, np.tile((person == 0) & (steps[:, 2] == _HELD_S), len(self._starts_s)))
        lateral = np.where(is_turned, sign * _TURNED_TRACK + _TURNED_SHIFT, sign * _TRACK)
        floor, yaw = self._station(person, np.append(0.0, ends))
        floor = floor + on_floor(yaw, lateral * body.height_m, -0.02 * body.height_m)
        return Plant.series(floor, yaw + sign * 0.22, np.append(-1.0, lands), np.append(lifts, 1e6))

    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Move all hands to their places.

        Right hands first: lapels and backs depend on the trunks alone.  Then left hands: sleeves depend on the right
        arms.
        """
        tori, uke = figures
        on_b_back, on_a_back = _OVER if tori.body.height_m > _OVER_RATIO * uke.body.height_m else _UNDER
        holds = {(0, "right"): on_b_back, (1, "left"): on_a_back}
        contacts = []
        for side, (person, figure) in product(("right", "left"), enumerate(figures)):
            other, wrist = figures[1 - person], BonePoint(person, f"{side}_wrist")
            if side == "right":
                target, held = _on_trunk(wrist, figures, *_lapel(figure.body, other.body), _LAPEL_DEG[person])
                pole, palm = figure.chest_vector(-0.7, -1.0, 0.0), other.joint("spine3") - target
            else:
                target, palm, held = _sleeve(wrist, figures)
                pole = figure.chest_vector(0.8, -1.0, -0.2)
                if person == 0:
                    # Turned in, the hand comes to the sleeve from B's right.
                    turned = self._every_cycle(self.time_s, _LET_GO_S, _ON_BACK_S, _BACK_S, _REGRIP_S)
                    pole = mix(pole, uke.chest_vector(-1.0, 0.2, 0.0), turned)
            if (person, side) in holds:
                target, pole, changed = self._to_back(figures, target, pole, held, holds[person, side])
                contacts += changed
            else:
                contacts.append(held)
            figure.reach_hand(side, target, pole, palm=palm)
        return contacts

    def _to_back(
        self, figures: Sequence[DancerFrames], target: Array, pole: Array, held: Contact, hold: _BackHold
    ) -> tuple[Array, Array, list[Contact]]:
        """Return target and elbow pole (frame, 3) of a hand that goes to the other's back and returns, and contacts."""
        uke, wrist = figures[1], held.point_a
        leave_s, again_s = _LET_GO_S - _LEAD_S * wrist.person, _REGRIP_S + _LEAD_S * wrist.person
        share = self._every_cycle(self.time_s, leave_s, _ON_BACK_S - hold.haste_s, _BACK_S + hold.haste_s, again_s)
        back, on_back = _on_trunk(wrist, figures, hold.bone, hold.share, hold.angle_deg)
        detour = halfway(share) * uke.chest_vector(*hold.detour) * uke.body.height_m
        contacts = [replace(held, stop_s=leave_s)]
        for at in self._starts_s.tolist():
            contacts.append(replace(on_back, start_s=at + _ON_BACK_S, stop_s=at + _BACK_S))
            contacts.append(replace(held, start_s=at + again_s, stop_s=at + _CYCLE_S + leave_s))
        return mix(target, back, share) + detour, mix(pole, uke.chest_vector(*hold.pole), share), contacts


def _lapel(body: Physique, other: Physique) -> tuple[str, float]:
    """Return partner's bone and the share of it where the lapel is held: level with the own shoulder if possible."""
    wanted = body.standing_m("left_shoulder") - 0.03 * body.height_m
    return other.trunk_at(float(np.clip(wanted, 0.70 * other.height_m, 0.785 * other.height_m)))


def _on_trunk(
    wrist: BonePoint, figures: Sequence[DancerFrames], bone: str, share: float, angle_deg: float
) -> tuple[Array, Contact]:
    """Return the place of a wrist on the partner's trunk (frame, 3), and the contact without its times."""
    figure, other = figures[wrist.person], figures[1 - wrist.person]
    rest_m = figure.body.rest_distance_m(other.body, bone, "spine3")
    point = other.round_bone(bone, share, rest_m, np.radians(angle_deg))
    return point, Contact(wrist, BonePoint(1 - wrist.person, bone, share), rest_m)


def _sleeve(wrist: BonePoint, figures: Sequence[DancerFrames]) -> tuple[Array, Array, Contact]:
    """Return a left wrist's place on the partner's right sleeve, its palm's direction (frame, 3), and the contact."""
    figure, other = figures[wrist.person], figures[1 - wrist.person]
    rest_m = figure.body.rest_distance_m(other.body, "left_elbow")
    share = _SLEEVE_SHARE + 0.5 * max(0.0, other.body.height_m / figure.body.height_m - 1.0)
    point = other.on_bone("right_elbow", share, np.array(_SLEEVE_SIDE) * rest_m)
    palm = other.on_bone("right_elbow", share) - point
    return point, palm, Contact(wrist, BonePoint(1 - wrist.person, "right_elbow", share), rest_m)
