"""Lift: A takes B by the waist, lifts B off the floor, turns and walks with B in the air, and sets B down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import facing, mix, moves, turn, window
from pasdedeux.choreography.duet import Contact, Duet, DuetStyle, finish, rest_distance_m, wrist_contact
from pasdedeux.choreography.figure import SIDES, Figure, Trunk
from pasdedeux.choreography.reach import square_to
from pasdedeux.choreography.steps import FootPath, Plant, plan_foot, walk_feet, walk_foot
from pasdedeux.kinematics.rotations import normalise

_HOLD_S, _OPEN_S = 1.6, 8.3
"""When both hands of both lie on the partner, and when they let go."""
_RISE_S, _UP_S, _SINK_S, _DOWN_S = 2.0, 3.2, 6.8, 8.0
"""When B begins to leave the floor, is up, begins to come down, stands again."""
_STEPS = ((3.2, 4.35), (4.35, 5.5), (5.5, 6.65))
"""A walks: in each of these both feet move."""
_APART = 0.235
"""Distance of the two pelvises, fraction of the mean height."""
_TRACK = 0.075
_WAIST = 0.20
"""A takes B so far below A's own shoulders, fraction of A's height, if B's trunk is there."""
_REACH = 0.96
"""Share of the arms that the highest lift asks for, and the lowest of an upright A."""


class LiftStyle(DuetStyle):
    """Style of the lift; lengths are fractions of the mean height.  It lasts 10 s; a longer one ends standing."""

    lift: float = Field(0.20, ge=0.05, le=0.22, description="How high B is lifted, as far as the arms reach")
    turn_rad: float = Field(1.2, ge=-1.5, le=1.5, description="How far A turns with B in the air")
    stride: float = Field(0.12, ge=0.0, le=0.15, description="How far A goes in a step with B in the air")


@dataclass(frozen=True)
class _Plan:
    """Where the two stand over time, seconds and metres.

    Args:
        apart_m: Distance of the pelvises.
        lift_m: How high B is lifted.
        upright: How far A comes up with B in the air, 0 to 1; B must be high enough for A's arms.
        waist: Bone of B where A's hands are, and the share of it.
        sleeve: Share of A's upper arms where B's hands are.
        turn_rad: Turn of A over all steps.
        stride_m: Way of A in a step.
        lean_rad: How far A leans to B; a much taller A leans more.
        stoop_rad: The same of B.
    """

    apart_m: float
    lift_m: float
    upright: float
    waist: tuple[str, float]
    sleeve: float
    turn_rad: float
    stride_m: float
    lean_rad: float
    stoop_rad: float

    def place(self, time_s: Array) -> tuple[Array, Array]:
        """Return where A's pelvis is (frame, 3), height 0, and A's facing (frame,)."""
        count = len(_STEPS)
        progress = moves(time_s, 0.0, [(*span, float(step)) for step, span in enumerate(_STEPS, start=1)])
        yaw = self.turn_rad * progress / count
        # The middle of an arc walked forward, in the direction faced half way.
        return facing(0.5 * yaw, 0.0, 0.0, self.stride_m * progress), yaw

    def up(self, time_s: Array) -> Array:
        """Return how far B is up (frame,), 0 to 1."""
        return window(time_s, _RISE_S, _UP_S, _SINK_S, _DOWN_S)


def make_lift(style: LiftStyle) -> Duet:
    """Make a lift: contacts are A's hands on B's waist and B's hands on A's upper arms, from 1.6 to 8.3 s.

    B's feet stand until 2 s and from 8 s on, and hang in between.  How high B comes is limited by the arms of both.
    """
    vary, mean_m, time_s = style.vary(3), style.mean_m, style.time_s
    lifter, lifted = style.bodies
    taller = lifter.height_m / lifted.height_m - 1.0
    apart_m = _APART * mean_m
    wanted = lifter.standing_m("left_shoulder") - _WAIST * lifter.height_m
    low, high = lifted.standing_m("spine1"), lifted.standing_m("spine2")
    waist_m = float(np.clip(wanted, low, high))
    low_m, high_m = _within_reach(lifter, lifted, apart_m, waist_m)
    lift_m = min(style.lift * (1.0 - 0.15 * abs(float(vary[0]))) * mean_m, high_m)
    plan = _Plan(
        apart_m=apart_m,
        lift_m=lift_m,
        upright=min(1.0, lift_m / low_m) if low_m > 0.0 else 1.0,
        waist=("spine2", (waist_m - low) / (high - low)),
        sleeve=0.30 + 1.0 * max(0.0, taller),
        turn_rad=style.turn_rad * (1.0 + 0.1 * float(vary[1])) if style.turn_rad else 0.0,
        stride_m=style.stride * (1.0 - 0.2 * abs(float(vary[2]))) * mean_m,
        lean_rad=0.10 + 0.6 * max(0.0, taller),
        stoop_rad=0.06 + 0.5 * max(0.0, -taller),
    )
    figures = (_lifter(lifter, plan, time_s), _lifted(lifted, plan, time_s))
    return finish("lift", style, figures, _hold(figures, plan, time_s))


def _within_reach(lifter: Body, lifted: Body, apart_m: float, waist_m: float) -> tuple[float, float]:
    """Return how high B must be for an upright A and how high the arms of both allow B to come, metres."""
    reaches = []
    for body, start_m, end_m in (
        (lifter, waist_m, lifter.standing_m("left_shoulder")),
        (lifted, lifted.standing_m("left_shoulder"), lifter.standing_m("left_shoulder") - 0.02 * lifter.height_m),
    ):
        arm = _REACH * (body.length_m("left_elbow") + body.length_m("left_wrist"))
        across = apart_m if body is lifter else 0.75 * apart_m
        along = float(np.sqrt(max(arm**2 - across**2, 0.0)))
        reaches.append((end_m - start_m - along, end_m - start_m + along))
    (low, high), (_, high_of_lifted) = reaches
    return low, max(0.03, min(high, high_of_lifted))


def _lifter(body: Body, plan: _Plan, time_s: Array) -> Figure:
    """Place trunk and feet of A, who bends to take B, comes up with the load and walks leaning back."""
    where, yaw = plan.place(time_s)
    up = plan.up(time_s)
    taken = window(time_s, 0.9, _RISE_S - 0.1, _DOWN_S, 9.2)
    bent = taken * (1.0 - plan.upright * up)
    trunk = Trunk.at(
        where,
        body.standing_m("pelvis") - body.height_m * (0.012 + 0.028 * bent),
        turn(yaw, plan.lean_rad * bent - 0.03 * up),
        ((0.02 + plan.lean_rad) * bent - 0.02 * up, 0.0, 0.0),
        (-0.5 * plan.lean_rad * bent - 0.08 * up, 0.0, 0.0),
    )
    feet = walk_feet(time_s, body, _plants("left", body, plan), _plants("right", body, plan), heel=0.7)
    return Figure(body=body, trunk=trunk, feet=feet)


def _plants(side: str, body: Body, plan: _Plan) -> list[Plant]:
    """Plan a foot of A: it lands where the pelvis will be; the foot on the inside of the turn leads."""
    sign = SIDES[side]
    wait_s = 0.0 if sign * plan.turn_rad > 0.0 or (plan.turn_rad == 0.0 and sign > 0.0) else 0.55
    lifts = [start + wait_s for start, _ in _STEPS]
    where, yaw = plan.place(np.array([0.0, *(stop for _, stop in _STEPS)]))
    where = where + facing(yaw, sign * _TRACK * body.height_m, 0.0, -0.02 * body.height_m)
    lands = [-1.0, *(lift + 0.55 for lift in lifts)]
    return plan_foot(where, yaw + sign * 0.2, lands, [*lifts, 1e6])


def _lifted(body: Body, plan: _Plan, time_s: Array) -> Figure:
    """Place trunk and feet of B, who stands before A, hangs in A's hands with loose legs, and stands again."""
    where, yaw = plan.place(time_s)
    where = where + facing(yaw, 0.0, 0.0, plan.apart_m)
    up = plan.up(time_s)
    stoop = plan.stoop_rad * window(time_s, 0.9, _RISE_S - 0.1, _DOWN_S, 9.2)
    trunk = Trunk.at(
        where,
        body.standing_m("pelvis") - 0.010 * body.height_m + plan.lift_m * up,
        turn(yaw + np.pi, 0.3 * stoop),
        (stoop, 0.0, 0.0),
        (0.10 * up - 0.5 * stoop, 0.0, 0.0),
    )
    left, right = (_hanging(side, body, plan, where, yaw + np.pi, up, time_s) for side in SIDES)
    return Figure(body=body, trunk=trunk, feet=(left, right))


def _hanging(side: str, body: Body, plan: _Plan, where: Array, yaw: Array, up: Array, time_s: Array) -> FootPath:
    """Return a foot of B: it stands, hangs below the hips with the toes down, and stands where A came to."""
    sign = SIDES[side]
    aside, ahead = sign * 0.055 * body.height_m, -0.02 * body.height_m
    stands = np.array([0.0, _DOWN_S])
    places, yaws = plan.place(stands)
    places = places + facing(yaws, 0.0, 0.0, plan.apart_m) + facing(yaws + np.pi, aside, 0.0, ahead)
    turned = sign * 0.12
    plants = plan_foot(places, yaws + np.pi + turned, (-1.0, _DOWN_S), (_RISE_S, 1e6))
    standing = walk_foot(time_s, body, plants[:1])
    drawn = (0.010 + 0.014 * (sign > 0)) * body.height_m * up
    ankle = where + facing(yaw, aside, plan.lift_m * up + drawn, ahead - 0.045 * body.height_m * up)
    ankle[:, 1] += standing.ankle_m[:, 1]
    unitquat = turn(yaw + turned, 0.55 * up)
    return FootPath(ankle_m=ankle, unitquat=unitquat, yaw_rad=yaw + turned, plants=tuple(plants))


def _hold(figures: tuple[Figure, Figure], plan: _Plan, time_s: Array) -> list[Contact]:
    """Raise the arms, lay A's hands on B's waist and B's on A's upper arms, and let go; gives the contacts."""
    contacts = []
    for person, figure in enumerate(figures):
        other, height = figures[1 - person], figure.body.height_m
        # B's arms lie on A's: they come first and leave last.
        early_s = 0.3 * person
        closed = window(time_s, 0.6 - early_s, _HOLD_S - early_s, _OPEN_S + early_s, 9.3 + early_s)
        for side, sign in SIDES.items():
            # The partner faces us: our left is the right side of the partner.
            bone = plan.waist[0] if person == 0 else f"{'right' if side == 'left' else 'left'}_elbow"
            share = plan.waist[1] if person == 0 else plan.sleeve
            rest_m = rest_distance_m(figure.body, other.body, bone)
            if person == 0:
                resting = other.round_bone(bone, share, rest_m, -sign * np.radians(95.0))
                pole = figure.chest_vector(sign * 0.9, -1.0, -0.2)
                where = "waist"
            else:
                arm = other.on_bone(bone, 1.0) - other.on_bone(bone, 0.0)
                above = other.chest_vector(sign * -0.35, 1.0, 0.6)
                along = normalise(arm)
                above = square_to(above, along)
                resting = other.on_bone(bone, share) + rest_m * above
                pole = figure.chest_vector(sign * 1.0, -0.5, -0.3)
                where = f"{'right' if side == 'left' else 'left'} upper arm"
            shoulder = figure.on_bone(f"{side}_shoulder", 1.0)
            hang = shoulder + figure.chest_vector(sign * 0.03 * height, -0.305 * height, 0.03 * height)
            out = (closed * (1.0 - closed) * 4.0)[:, None] * figure.chest_vector(
                sign * (0.06 if person == 0 else 0.10) * height, 0.02 * height, 0.05 * height
            )
            hanging = figure.chest_vector(sign * 0.35, -0.3, -1.0)
            figure.reach_hand(
                side,
                mix(hang, resting, closed) + out,
                mix(hanging, pole, closed),
                palm=other.joint("spine2") - resting if person == 0 else -above,
            )
            name = f"{'AB'[person]}'s {side} hand on {'AB'[1 - person]}'s {where}"
            contacts.append(wrist_contact(name, person, side, bone, share, rest_m, (_HOLD_S, _OPEN_S)))
    return contacts
