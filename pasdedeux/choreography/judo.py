"""Judo: sleeve and lapel grips, walking steps, a turn-in to the hip, and out again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import Numbers, facing, mix, moves, turn, window
from pasdedeux.choreography.duet import Contact, Duet, DuetStyle, finish, rest_distance_m, wrist_contact
from pasdedeux.choreography.figure import SIDES, Figure, Trunk
from pasdedeux.choreography.steps import Plant, plan_foot, walk_feet

Vector = tuple[float, float, float]

_CYCLE_S = 10.0
"""The whole form; a longer duet repeats it."""
_IN_S, _HELD_S, _OUT_S, _LEAVE_S = 3.1, 4.7, 5.7, 7.2
"""When A begins to turn in, is in, begins to turn out, is out."""
_LET_GO_S, _ON_BACK_S, _BACK_S, _REGRIP_S = 3.3, 4.6, 5.8, 7.3
"""Until when A's right hand holds the lapel; from when and until when it lies on B's back; from when it holds again."""
_WALK = ((0.25, 1.30), (1.30, 2.35), (7.5, 8.55), (8.55, 9.6))
"""Walking: in each of these the pair moves by one step of both feet; two there and two back."""
_TRACK = 0.075
"""Distance of each foot from the middle of the body, fraction of height."""
_TURNED_TRACK, _TURNED_SHIFT = 0.060, 0.045
"""The same while A is turned in, and how far both feet then stand away from the partner: the hip comes first."""
_LEAD_S = 0.3
"""How much earlier B's left hand leaves A's sleeve, and how much later it comes back."""
_LAPEL_DEG = (40.0, 30.0)
"""Where A's and B's right hands hold the other's lapel, from the front over the other's left."""
_SLEEVE_SHARE = 0.75
"""Where along the upper arm the sleeve is held."""
_SLEEVE_SIDE = (0.0, 0.6, -0.8)
"""On which side of the upper arm: outside and behind, in its rest axes (along the bone, hinge, bend)."""
_OVER_RATIO = 1.11
"""A who is so much taller than B puts the right arm over B's shoulder instead of under the arm."""


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
    form = _Form(
        apart_m=style.apart * mean_m * (1.0 - 0.25 * (max(heights_m) / min(heights_m) - 1.0)),
        stride_m=style.stride * (1.0 - 0.2 * abs(float(vary[0]))) * mean_m,
        circle_rad=style.circle_rad * (1.0 + 0.2 * float(vary[1])),
        turn_rad=style.turn_rad * (1.0 + 0.02 * float(vary[2])),
        hip_m=0.205 * mean_m,
        aside_m=-0.05 * mean_m,
        num_cycles=max(1, int(np.ceil(style.duration_s / _CYCLE_S))),
    )
    stoop_rad = 0.5 * max(0.0, heights_m[1] / heights_m[0] - 1.0)
    figures = (_tori(bodies[0], form, time_s), _uke(bodies[1], form, time_s, stoop_rad))
    return finish("judo", style, figures, _grip(figures, form, time_s, style.duration_s))


@dataclass(frozen=True)
class _Form:
    """Where both people stand.

    Args:
        apart_m: Distance of the pelvises in the grip.
        stride_m: How far the pair goes in a walking step.
        circle_rad: Turn of the pair in a walking step.
        turn_rad: How far A turns in.
        hip_m: Distance of the pelvises when A is turned in.
        aside_m: How far A is then to the left of the line between them as it was.
        num_cycles: How often the form is done.
    """

    apart_m: float
    stride_m: float
    circle_rad: float
    turn_rad: float
    hip_m: float
    aside_m: float
    num_cycles: int

    def every_cycle(self, time_s: Array, rise_s: float, full_s: float, fade_s: float, stop_s: float) -> Array:
        """Return a window (frame,) that comes once in every cycle."""
        starts = _CYCLE_S * np.arange(self.num_cycles)
        return np.asarray(sum(window(time_s - start, rise_s, full_s, fade_s, stop_s) for start in starts))

    def inside(self, time_s: Array) -> Array:
        """Return how far A is turned in (frame,), 0 to 1."""
        return self.every_cycle(time_s, _IN_S, _HELD_S, _OUT_S, _LEAVE_S)

    def loaded(self, time_s: Array) -> Array:
        """Return how far B is taken onto the hip (frame,), 0 to 1."""
        return self.every_cycle(time_s, _HELD_S - 0.7, _HELD_S + 0.2, _OUT_S - 0.2, _OUT_S + 0.7)

    def place(self, person: int, time_s: Array) -> tuple[Array, Array]:
        """Return where a person's pelvis is (frame, x and z) and its facing (frame,)."""
        walked = [
            (cycle * _CYCLE_S + start_s, cycle * _CYCLE_S + stop_s, share)
            for cycle in range(self.num_cycles)
            for (start_s, stop_s), share in zip(_WALK, (1.0, 2.0, 1.0, 0.0), strict=True)
        ]
        progress = moves(time_s, 0.0, walked)
        yaw = self.circle_rad * progress
        centre = facing(0.0, 0.0, 0.0, self.stride_m * progress)
        if person == 1:
            return (centre + facing(yaw, 0.0, 0.0, 0.5 * self.apart_m))[:, [0, 2]], yaw + np.pi
        inside = self.inside(time_s)
        ahead = -0.5 * self.apart_m + inside * (self.apart_m - self.hip_m)
        return (centre + facing(yaw, inside * self.aside_m, 0.0, ahead))[:, [0, 2]], yaw + self.turn_rad * inside


def _tori(body: Body, form: _Form, time_s: Array) -> Figure:
    """Place trunk and feet of A, who turns in, sinks and leans away with B on the hip."""
    inside, loaded = form.inside(time_s), form.loaded(time_s)
    breath = np.sin(2.0 * np.pi * time_s / 2.5)
    return _on_feet(
        0,
        body,
        form,
        time_s,
        sink=0.035 + 0.025 * inside - 0.008 * loaded,
        tilt=(0.10 - 0.02 * inside, -0.10 * inside),
        spine=(0.12 + 0.10 * inside, 0.10 * inside + 0.03 * breath, -0.26 * inside - 0.10 * loaded),
        head=(-0.12 + 0.05 * inside, 0.10 * inside, -0.10 * inside),
    )


def _uke(body: Body, form: _Form, time_s: Array, stoop_rad: float) -> Figure:
    """Place trunk and feet of B, who is drawn forward and stoops when taller."""
    inside, loaded = form.inside(time_s), form.loaded(time_s)
    breath = np.sin(2.0 * np.pi * time_s / 2.5)
    return _on_feet(
        1,
        body,
        form,
        time_s,
        sink=0.030 - 0.012 * inside,
        tilt=(0.10 + 0.04 * loaded, 0.03 * inside),
        spine=(0.10 + 0.06 * loaded + stoop_rad * inside, 0.04 * breath - 0.08 * inside, 0.05 * inside),
        head=(-0.12, -0.25 * inside, 0.0),
    )


def _on_feet(
    person: int,
    body: Body,
    form: _Form,
    time_s: Array,
    *,
    sink: Array,
    tilt: tuple[Array, Array],
    spine: tuple[Numbers, ...],
    head: tuple[Numbers, ...],
) -> Figure:
    """Return somebody who sinks by a share of the height and tilts forward and to the right, on walking feet."""
    where, yaw = form.place(person, time_s)
    height_m = body.standing_m("pelvis") - body.height_m * sink
    left, right = (_plants(person, side, body, form) for side in SIDES)
    feet = walk_feet(time_s, body, left, right, heel=0.8)
    return Figure(body, Trunk.at(where, height_m, turn(yaw, *tilt), spine, head), feet)


def _plants(person: int, side: str, body: Body, form: _Form) -> list[Plant]:
    """Plan a foot: it lands where the pelvis will be when the pair, or A alone, has moved."""
    sign = SIDES[side]
    # Right feet lead for A, left feet for B; the other foot follows half a second later.
    wait_s = 0.0 if (side == "right") == (person == 0) else 0.5
    steps = [(start_s + wait_s, start_s + wait_s + 0.5, stop_s) for start_s, stop_s in _WALK]
    if person == 0 and side == "right":
        steps += [(_IN_S, _IN_S + 0.75, _HELD_S), (_OUT_S + 0.75, _LEAVE_S, _LEAVE_S)]
    elif person == 0:
        steps += [(_IN_S + 0.8, _HELD_S, _HELD_S), (_OUT_S, _OUT_S + 0.7, _LEAVE_S)]
    steps.sort()
    at_s = np.arange(form.num_cycles)[:, None] * _CYCLE_S
    lifts, lands, ends = ((at_s + np.array(column)).ravel() for column in zip(*steps, strict=True))
    is_turned = np.concatenate(
        [[False], np.tile([person == 0 and step[2] == _HELD_S for step in steps], form.num_cycles)]
    )
    lateral = np.where(is_turned, sign * _TURNED_TRACK + _TURNED_SHIFT, sign * _TRACK)
    where, yaw = form.place(person, np.concatenate([[0.0], ends]))
    where = where + facing(yaw, lateral * body.height_m, 0.0, -0.02 * body.height_m)[:, [0, 2]]
    lands, lifts = np.concatenate([[-1.0], lands]), np.concatenate([lifts, [1e6]])
    return plan_foot(where, yaw + sign * 0.22, lands, lifts)


@dataclass(frozen=True)
class _Hold:
    """A hand on the partner's back: where, how its elbow points, and by which detour it goes there.

    `bone`, `share` and `angle_deg` (from the front over the left) are the place; `pole` and `detour` are left, up and
    forward of B's chest, the detour as a share of B's height.  `haste_s` is how much sooner it is there, and how much
    later it leaves, than the contact's times.
    """

    bone: str
    share: float
    angle_deg: float
    pole: Vector
    detour: Vector
    haste_s: float = 0.0


_UNDER = (
    _Hold("spine2", 0.6, 120.0, (1.0, -0.75, 0.3), (0.14, -0.09, 0.08)),
    _Hold("spine3", 0.5, -160.0, (1.0, 0.0, 0.3), (0.08, 0.10, 0.0)),
)
_OVER = (
    _Hold("neck", 0.5, 150.0, (1.0, 0.6, 0.3), (0.10, 0.25, 0.07)),
    _Hold("spine2", 0.5, -150.0, (1.0, -0.6, 0.0), (0.14, -0.18, -0.08), haste_s=0.3),
)
"""A's right hand on B's back and B's left hand on A's back."""


def _grip(figures: tuple[Figure, Figure], form: _Form, time_s: Array, duration_s: float) -> list[Contact]:
    """Bring all hands where they belong; gives the contacts.

    Right hands first: lapels and backs depend on the trunks alone.  Then left hands: sleeves depend on the right arms.
    """
    tori, uke = figures
    holds = _OVER if tori.body.height_m > _OVER_RATIO * uke.body.height_m else _UNDER
    contacts = []
    for person, figure in enumerate(figures):
        other = figures[1 - person]
        target, held = _on_trunk(
            person, "right", figures, *_lapel(figure.body, other.body), _LAPEL_DEG[person], "left lapel"
        )
        pole, palm = figure.chest_vector(-0.7, -1.0, 0.0), other.joint("spine3") - target
        if person == 0:
            target, pole, changed = _to_back(0, "right", figures, form, time_s, (target, pole), held, holds[0])
            contacts += changed
        else:
            contacts.append(replace(held, stop_s=duration_s))
        figure.reach_hand("right", target, pole, palm=palm)
    for person, figure in enumerate(figures):
        target, palm, held = _sleeve(person, figures)
        pole = figure.chest_vector(0.8, -1.0, -0.2)
        if person == 0:
            # Turned in, the hand comes to the sleeve from B's right.
            turned = form.every_cycle(time_s, _LET_GO_S, _ON_BACK_S, _BACK_S, _REGRIP_S)
            pole = mix(pole, uke.chest_vector(-1.0, 0.2, 0.0), turned)
            contacts.append(replace(held, stop_s=duration_s))
        else:
            target, pole, changed = _to_back(1, "left", figures, form, time_s, (target, pole), held, holds[1])
            contacts += changed
        figure.reach_hand("left", target, pole, palm=palm)
    return contacts


def _to_back(
    person: int,
    side: str,
    figures: tuple[Figure, Figure],
    form: _Form,
    time_s: Array,
    gripping: tuple[Array, Array],
    held: Contact,
    hold: _Hold,
) -> tuple[Array, Array, list[Contact]]:
    """Return target and elbow pole (frame, 3) of a hand that goes to the other's back and returns, and its contacts."""
    uke = figures[1]
    lead_s = 0.0 if person == 0 else _LEAD_S
    away_s = (_ON_BACK_S - hold.haste_s, _BACK_S + hold.haste_s)
    share = form.every_cycle(time_s, _LET_GO_S - lead_s, *away_s, _REGRIP_S + lead_s)
    back, on_back = _on_trunk(person, side, figures, hold.bone, hold.share, hold.angle_deg, "back")
    detour = (4.0 * share * (1.0 - share))[:, None] * uke.chest_vector(*hold.detour) * uke.body.height_m
    contacts = [replace(held, stop_s=_LET_GO_S - lead_s)]
    for at in _CYCLE_S * np.arange(form.num_cycles):
        contacts.append(replace(on_back, start_s=float(at + _ON_BACK_S), stop_s=float(at + _BACK_S)))
        again_s, next_s = at + _REGRIP_S + lead_s, at + _CYCLE_S + _LET_GO_S - lead_s
        contacts.append(replace(held, start_s=float(again_s), stop_s=float(next_s)))
    return mix(gripping[0], back, share) + detour, mix(gripping[1], uke.chest_vector(*hold.pole), share), contacts


def _lapel(body: Body, other: Body) -> tuple[str, float]:
    """Return partner's bone and the share of it where the lapel is held: level with the own shoulder if possible."""
    wanted = body.standing_m("left_shoulder") - 0.03 * body.height_m
    return other.trunk_at(float(np.clip(wanted, 0.70 * other.height_m, 0.785 * other.height_m)))


def _on_trunk(
    person: int, side: str, figures: tuple[Figure, Figure], bone: str, share: float, angle_deg: float, name: str
) -> tuple[Array, Contact]:
    """Return where a wrist rests on the partner's trunk (frame, 3), and the contact without its times."""
    figure, other = figures[person], figures[1 - person]
    rest_m = rest_distance_m(figure.body, other.body, bone, "spine3")
    point = other.round_bone(bone, share, rest_m, np.radians(angle_deg))
    text = f"{'AB'[person]}'s {side} hand on {'AB'[1 - person]}'s {name}"
    return point, wrist_contact(text, person, side, bone, share, rest_m)


def _sleeve(person: int, figures: tuple[Figure, Figure]) -> tuple[Array, Array, Contact]:
    """Return where a left wrist holds the partner's right sleeve, where its palm looks (frame, 3), and the contact."""
    figure, other = figures[person], figures[1 - person]
    distance_m = rest_distance_m(figure.body, other.body, "left_elbow")
    share = _SLEEVE_SHARE + 0.5 * max(0.0, other.body.height_m / figure.body.height_m - 1.0)
    text = f"{'AB'[person]}'s left hand on {'AB'[1 - person]}'s right sleeve"
    point = other.on_bone("right_elbow", share, np.array(_SLEEVE_SIDE) * distance_m)
    palm = other.on_bone("right_elbow", share) - point
    return point, palm, wrist_contact(text, person, "left", "right_elbow", share, distance_m)
