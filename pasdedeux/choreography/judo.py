"""Judo: sleeve and lapel grips, walking steps, a turn-in to the hip, and out again."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.duet import Duet, DuetStyle, finish
from pasdedeux.choreography.figure import SIDES, Figure, Trunk, facing, turn
from pasdedeux.choreography.judo_form import CYCLE_S, HELD_S, IN_S, LEAVE_S, OUT_S, WALK, JudoForm
from pasdedeux.choreography.judo_grip import grip
from pasdedeux.choreography.steps import Plant, walk_feet

_TRACK = 0.075
"""Distance of each foot from the middle of the body, fraction of height."""
_TURNED_TRACK, _TURNED_SHIFT = 0.060, 0.045
"""The same while A is turned in, and how far both feet then stand away from the partner: the hip comes first."""


class JudoStyle(DuetStyle):
    """Style of the judo form; lengths are fractions of the mean height.  The form lasts 10 s and is repeated."""

    apart: float = Field(0.40, ge=0.38, le=0.42, description="Distance of the two pelvises in the grip")
    stride: float = Field(0.13, ge=0.0, le=0.15, description="Length of a walking step")
    circle_rad: float = Field(0.35, ge=-0.4, le=0.4, description="Turn of the pair in a walking step")
    turn_rad: float = Field(1.35, ge=1.3, le=1.36, description="How far A turns in")


def make_judo(style: JudoStyle) -> Duet:
    """Make a judo form: A turns in, B is taken onto the hip and set back.

    A's right arm goes under B's left arm round the waist (uki-goshi); when A is more than 11 % taller, over B's left
    shoulder (koshi-guruma).  Contacts: A's left hand on B's right sleeve and B's right hand on A's left lapel all the
    time; A's right hand on B's left lapel and B's left hand on A's right sleeve, but on the other's back while A is
    turned in.
    """
    vary, mean_m, time_s, bodies, heights_m = style.vary(3), style.mean_m, style.time_s, style.bodies, style.heights_m
    form = JudoForm(
        apart_m=style.apart * mean_m * (1.0 - 0.25 * (max(heights_m) / min(heights_m) - 1.0)),
        stride_m=style.stride * (1.0 - 0.2 * abs(float(vary[0]))) * mean_m,
        circle_rad=style.circle_rad * (1.0 + 0.2 * float(vary[1])),
        turn_rad=style.turn_rad * (1.0 + 0.02 * float(vary[2])),
        hip_m=0.205 * mean_m,
        aside_m=-0.05 * mean_m,
        num_cycles=max(1, int(np.ceil(style.duration_s / CYCLE_S))),
    )
    stoop_rad = 0.5 * max(0.0, heights_m[1] / heights_m[0] - 1.0)
    figures = (_tori(bodies[0], form, time_s), _uke(bodies[1], form, time_s, stoop_rad))
    return finish("judo", style, figures, grip(figures, form, time_s, style.duration_s))


def _tori(body: Body, form: JudoForm, time_s: Array) -> Figure:
    """Place trunk and feet of A, who turns in, sinks and leans away with B on the hip."""
    where, yaw = form.place(0, time_s)
    inside, loaded = form.inside(time_s), form.loaded(time_s)
    breath = np.sin(2.0 * np.pi * time_s / 2.5)
    trunk = Trunk(
        x_m=where[:, 0],
        z_m=where[:, 1],
        height_m=body.standing_m("pelvis") - body.height_m * (0.035 + 0.025 * inside - 0.008 * loaded),
        unitquat=turn(yaw, 0.10 - 0.02 * inside, -0.10 * inside),
        spine_rotvec=np.stack(
            [0.12 + 0.10 * inside, 0.10 * inside + 0.03 * breath, -0.26 * inside - 0.10 * loaded], axis=-1
        ),
        head_rotvec=np.stack([-0.12 + 0.05 * inside, 0.10 * inside, -0.10 * inside], axis=-1),
    )
    return _on_feet(0, body, form, trunk, time_s)


def _uke(body: Body, form: JudoForm, time_s: Array, stoop_rad: float) -> Figure:
    """Place trunk and feet of B, who is drawn forward and stoops when taller."""
    where, yaw = form.place(1, time_s)
    inside, loaded = form.inside(time_s), form.loaded(time_s)
    breath = np.sin(2.0 * np.pi * time_s / 2.5)
    trunk = Trunk(
        x_m=where[:, 0],
        z_m=where[:, 1],
        height_m=body.standing_m("pelvis") - body.height_m * (0.030 - 0.012 * inside),
        unitquat=turn(yaw, 0.10 + 0.04 * loaded, 0.03 * inside),
        spine_rotvec=np.stack(
            [0.10 + 0.06 * loaded + stoop_rad * inside, 0.04 * breath - 0.08 * inside, 0.05 * inside], axis=-1
        ),
        head_rotvec=np.stack([-0.12 + 0.0 * inside, -0.25 * inside, 0.0 * inside], axis=-1),
    )
    return _on_feet(1, body, form, trunk, time_s)


def _on_feet(person: int, body: Body, form: JudoForm, trunk: Trunk, time_s: Array) -> Figure:
    left, right = (_plants(person, side, body, form) for side in SIDES)
    return Figure(body=body, trunk=trunk, feet=walk_feet(time_s, body, left, right, heel=0.8))


def _plants(person: int, side: str, body: Body, form: JudoForm) -> list[Plant]:
    """Plan a foot: it lands where the pelvis will be when the pair, or A alone, has moved."""
    sign = 1.0 if side == "left" else -1.0
    # Right feet lead for A, left feet for B; the other foot follows half a second later.
    wait_s = 0.0 if (side == "right") == (person == 0) else 0.5
    steps = [(start_s + wait_s, start_s + wait_s + 0.5, stop_s) for start_s, stop_s in WALK]
    if person == 0 and side == "right":
        steps += [(IN_S, IN_S + 0.75, HELD_S), (OUT_S + 0.75, LEAVE_S, LEAVE_S)]
    elif person == 0:
        steps += [(IN_S + 0.8, HELD_S, HELD_S), (OUT_S, OUT_S + 0.7, LEAVE_S)]
    steps.sort()
    at_s = np.arange(form.num_cycles)[:, None] * CYCLE_S
    lifts, lands, ends = ((at_s + np.array(column)).ravel() for column in zip(*steps, strict=True))
    is_turned = np.concatenate(
        [[False], np.tile([person == 0 and step[2] == HELD_S for step in steps], form.num_cycles)]
    )
    lateral = np.where(is_turned, sign * _TURNED_TRACK + _TURNED_SHIFT, sign * _TRACK)
    where, yaw = form.place(person, np.concatenate([[0.0], ends]))
    where = where + facing(yaw, lateral * body.height_m, 0.0, -0.02 * body.height_m)[:, [0, 2]]
    return [
        Plant(float(x), float(z), float(direction + sign * 0.22), float(land_s), float(lift_s))
        for (x, z), direction, land_s, lift_s in zip(
            where, yaw, np.concatenate([[-1.0], lands]), np.concatenate([lifts, [1e6]]), strict=True
        )
    ]
