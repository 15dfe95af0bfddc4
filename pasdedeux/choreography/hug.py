"""Hug with sway: two people walk up to each other, embrace, sway from foot to foot, let go and step back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import facing, mix, moves, turn, window
from pasdedeux.choreography.duet import Contact, Duet, DuetStyle, finish, rest_distance_m, wrist_contact
from pasdedeux.choreography.figure import SIDES, Figure, Trunk
from pasdedeux.choreography.steps import FootPath, plan_foot, walk_foot

_ARRIVE_S, _HOLD_S, _LEAVE_S = 2.5, 3.3, 3.0
"""When both have arrived; when the arms are closed; how long before the end the arms begin to open."""
_MIN_HOLD_S = 1.0
_ALIKE_LIFT = 1.05
"""How much higher the elbows of the one on top point when both are equally tall."""
_TRACK = 0.062
"""Distance of each foot from the middle of the body, fraction of height."""


@dataclass(frozen=True)
class _Plan:
    """Times and places that both people share, seconds and metres."""

    start_m: float
    embrace_m: float
    aside_m: float
    hold_s: float
    open_s: float
    sway_m: float
    sway_s: float
    phase_rad: float
    over: int


class HugStyle(DuetStyle):
    """Style of the hug; lengths are fractions of the mean height."""

    sway: float = Field(0.022, ge=0.0, le=0.03, description="How far the pelvises go to either side")
    sway_s: float = Field(2.4, ge=1.6, le=5.0, description="Time of one sway to and fro, seconds")
    approach: float = Field(0.95, ge=0.7, le=1.0, description="Distance of the two at the beginning")


def make_hug(style: HugStyle) -> Duet:
    """Make a hug: the taller one's arms go over the shoulders, the other's round the waist.

    Contacts while the arms are closed: the four wrists on the partner's back.  The arms open 3 s before the end; a hug
    of less than 7 s is the beginning of one that lasts longer.
    """
    vary, mean_m, time_s, bodies = style.vary(4), style.mean_m, style.time_s, style.bodies
    plan = _Plan(
        start_m=style.approach * (1.0 + 0.08 * float(vary[0])) * mean_m,
        embrace_m=0.194 * mean_m,
        aside_m=0.070 * mean_m,
        hold_s=_HOLD_S,
        open_s=max(style.duration_s - _LEAVE_S, _HOLD_S + _MIN_HOLD_S),
        sway_m=style.sway * (1.0 - 0.2 * abs(float(vary[1]))) * mean_m,
        sway_s=style.sway_s * (1.0 + 0.1 * float(vary[2])),
        phase_rad=np.pi * float(vary[3]),
        over=0 if style.heights_m[0] >= style.heights_m[1] else 1,
    )
    figures = (_walk(0, bodies, plan, time_s), _walk(1, bodies, plan, time_s))
    return finish("hug", style, figures, _embrace(figures, plan, time_s))


def _walk(person: int, bodies: tuple[Body, ...], plan: _Plan, time_s: Array) -> Figure:
    """Place trunk and feet: A comes along +Z, B along -Z; each keeps to its own left."""
    body = bodies[person]
    height = body.height_m
    yaw = 0.0 if person == 0 else np.pi
    far, near = 0.5 * plan.start_m, 0.5 * plan.embrace_m
    left = 0.5 * plan.aside_m
    leave = plan.open_s + 0.9
    ahead = moves(time_s, -far, [(0.15, _ARRIVE_S + 0.1, -near), (leave, leave + 1.9, -(near + 0.5 * (far - near)))])
    closed = window(time_s, 1.6, plan.hold_s, plan.open_s - 0.2, plan.open_s + 1.0)
    sway = plan.sway_m * np.sin(2.0 * np.pi * (time_s - plan.hold_s) / plan.sway_s + plan.phase_rad)
    sway = sway * window(time_s, plan.hold_s - 0.6, plan.hold_s + 0.8, plan.open_s - 1.2, plan.open_s + 0.2)
    sign = 1.0 if person == 0 else -1.0
    # Weight over the standing foot while walking: a sideways curve through the steps.
    step = window(time_s, 0.4, 1.0, 1.6, 2.3) + window(time_s, leave + 0.1, leave + 0.6, leave + 1.2, leave + 1.8)
    weight = 0.016 * height * step * np.sin(2.0 * np.pi * (time_s - 0.35) / 1.3)
    where = facing(yaw, left + sign * sway + weight, 0.0, ahead)
    other = bodies[1 - person]
    bow = 0.45 * max(0.0, height / other.height_m - 1.0)
    lean = 0.10 + bow
    walking = 0.05 * (1.0 - closed)
    nod = 0.05 * np.sin(2.0 * np.pi * time_s / plan.sway_s) * closed
    trunk = Trunk.at(
        where,
        body.standing_m("pelvis") - 0.009 * height,
        turn(yaw + 0.06 * step * np.sin(2.0 * np.pi * (time_s - 0.2) / 1.3), walking + lean * closed),
        (walking * 0.4 + 0.6 * lean * closed, -0.02 * closed, 1.1 * sign * sway / height),
        (-0.05 - (0.9 * lean + 0.1) * closed + nod, 0.30 * closed, -0.20 * closed),
    )
    left_foot, right_foot = (_foot(side, body, plan, yaw, left, time_s) for side in SIDES)
    return Figure(body=body, trunk=trunk, feet=(left_foot, right_foot))


def _foot(side: str, body: Body, plan: _Plan, yaw: float, left_m: float, time_s: Array) -> FootPath:
    """Walk up in three steps (right, left, right), stand through the embrace, and step back (left, right)."""
    sign = SIDES[side]
    far, near = -0.5 * plan.start_m, -0.5 * plan.embrace_m
    back = near + 0.5 * (far - near)
    leave = plan.open_s + 1.0
    if side == "left":
        stops = [(-1.0, 0.84, far), (1.42, leave, near), (leave + 0.60, 1e3, back)]
    else:
        stops = [
            (-1.0, 0.22, far),
            (0.78, 1.5, far + 0.6 * (near - far)),
            (2.1, leave + 0.66, near),
            (leave + 1.26, 1e3, back),
        ]
    lands, lifts, aheads = np.array(stops).T
    at = facing(yaw, left_m + sign * _TRACK * body.height_m, 0.0, aheads - 0.02 * body.height_m)
    plants = plan_foot(at, np.full(len(stops), yaw + sign * 0.14), lands, lifts)
    return walk_foot(time_s, body, plants, heel=1.15)


def _embrace(figures: tuple[Figure, Figure], plan: _Plan, time_s: Array) -> list[Contact]:
    """Swing the arms, open them, close them round the partner, and let go again."""
    contacts = []
    for person, figure in enumerate(figures):
        other = figures[1 - person]
        is_over = plan.over == person
        bone, share, angle = _resting_place(figure.body, other.body, is_over)
        rest_m = rest_distance_m(figure.body, other.body, bone)
        height = figure.body.height_m
        # Arms of equal people go over the shoulders; a taller one's may stay lower.
        alike = float(np.clip(1.0 - (height / other.body.height_m - 1.0) / 0.10, 0.0, 1.0))
        up = 0.02 + 0.07 * alike if is_over else -0.11
        for side, sign in SIDES.items():
            shoulder = figure.on_bone(f"{side}_shoulder", 1.0)
            swing = 0.05 * height * np.sin(2.0 * np.pi * (time_s - 0.25) / 1.3) * window(time_s, 0.2, 0.8, 1.4, 2.0)
            hang = shoulder + figure.chest_vector(sign * 0.030 * height, -0.305 * height, 0.03 * height - sign * swing)
            # The partner faces us: our left is the right side of the partner.
            resting = other.round_bone(bone, share, rest_m, -sign * angle)
            wide = shoulder + figure.chest_vector(
                sign * 0.15 * height, up * height, (0.19 if is_over else 0.20) * height
            )
            sink_s = plan.open_s + (1.5 if is_over else 0.8)
            opened = window(time_s, 0.7 if is_over else 1.1, 2.0 if is_over else 2.4, sink_s, sink_s + 1.2)
            closed = window(time_s, 2.0, plan.hold_s, plan.open_s, plan.open_s + 1.1)
            round_about = (closed * (1.0 - closed) * 4.0)[:, None] * figure.chest_vector(
                sign * 0.10 * height, (0.06 if is_over else -0.03) * height, 0.02 * height
            )
            target = mix(mix(hang, wide, opened), resting, closed) + round_about
            pole_high = figure.chest_vector(sign * 1.0, 0.3 + _ALIKE_LIFT * alike if is_over else -0.3, -0.1)
            pole = mix(figure.chest_vector(sign * 0.35, -0.3, -1.0), pole_high, np.maximum(opened, closed))
            figure.reach_hand(side, target, pole, palm=other.joint("spine3") - target)
            name = f"{'AB'[person]}'s {side} hand on {'AB'[1 - person]}'s back"
            span_s = (plan.hold_s, plan.open_s)
            contacts.append(wrist_contact(name, person, side, bone, share, rest_m, span_s))
    return contacts


def _resting_place(body: Body, other: Body, is_over: bool) -> tuple[str, float, float]:
    """Return the partner's bone, the share of it, and how far round the back (radians from the front) a wrist rests."""
    if is_over:
        chest, neck = other.standing_m("spine3"), other.standing_m("neck")
        return "neck", (0.79 * other.height_m - chest) / (neck - chest), np.radians(150.0)
    low, high = other.standing_m("spine1"), other.standing_m("spine2")
    wanted = body.standing_m("left_shoulder") - 0.12 * body.height_m
    return "spine2", float(np.clip((wanted - low) / (high - low), 0.0, 1.0)), np.radians(145.0)
