"""Judo: sleeve and lapel grips, walking steps, a turn-in to the hip (uki-goshi), and out again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.choreography.anthropometry import Body, make_body
from pasdedeux.choreography.curves import mix, moves, window
from pasdedeux.choreography.duet import BonePoint, Contact, Duet, Setting, check_style, finish
from pasdedeux.choreography.figure import SIDES, Figure, Trunk, facing, turn
from pasdedeux.choreography.steps import Plant, clear_other_foot, spread_feet, walk_foot
from pasdedeux.kinematics.rotations import normalise

__all__ = ["make_judo"]

Array = npt.NDArray[np.float64]

_CYCLE_S = 10.0
"""The whole form; a longer duet repeats it."""
_IN_S, _HELD_S, _OUT_S, _APART_S = 3.1, 4.7, 5.7, 7.2
"""When A begins to turn in, is in, begins to turn out, is out."""
_LET_GO_S, _REGRIP_S = 3.3, 7.3
"""Until when A's right hand holds the lapel, and from when on again."""
_WALK = ((0.25, 1.30), (1.30, 2.35), (7.5, 8.55), (8.55, 9.6))
"""Walking: every entry moves the pair by one step of both feet."""
_TRACK = 0.075
"""Distance of each foot from the middle of the body, fraction of height."""
_SLEEVE_SHARE = 0.75
"""Where along the upper arm the sleeve is held."""
_GAP_M = 0.004
"""Cloth between hand and body."""


@dataclass(frozen=True)
class _Plan:
    """Places that both people share, metres and radians."""

    apart_m: float
    stride_m: float
    circle_rad: float
    turn_rad: float
    hip_m: float
    aside_m: float
    num_cycles: int


def make_judo(
    *,
    duration_s: float = 10.0,
    rate_hz: float = 60.0,
    heights_m: tuple[float, float] = (1.82, 1.65),
    variation: int = 0,
    apart: float = 0.40,
    stride: float = 0.13,
    circle_rad: float = 0.35,
    turn_rad: float = 1.35,
) -> Duet:
    """Make a judo form: A turns in, B is taken onto the hip and set back.

    Contacts: A's left hand on B's right sleeve, B's left hand on A's right sleeve and B's right hand on A's left lapel, all
    the time; A's right hand on B's left lapel, and while turned in on B's back.

    Args:
        duration_s: Length; the form lasts 10 s and is repeated.
        rate_hz: Frames per second.
        heights_m: Heights of A and B.
        variation: Another take of the same form.
        apart: Distance of the two pelvises in the grip, fraction of mean height; 0.38 to 0.42.
        stride: Way of a walking step, likewise; 0 to 0.16.
        circle_rad: Turn of the pair in a walking step; -0.5 to 0.5.
        turn_rad: How far A turns in; 1.1 to 1.5.

    Raises:
        InputError: A number is outside its range.
    """
    setting = Setting(duration_s=duration_s, rate_hz=rate_hz, heights_m=heights_m, variation=variation)
    parameters = check_style(
        "judo",
        {
            "apart": (apart, 0.38, 0.42),
            "stride": (stride, 0.0, 0.16),
            "circle_rad": (circle_rad, -0.5, 0.5),
            "turn_rad": (turn_rad, 1.1, 1.5),
        },
    )
    vary = setting.vary(3)
    mean_m = float(np.mean(heights_m))
    bodies = (make_body(heights_m[0]), make_body(heights_m[1]))
    plan = _Plan(
        apart_m=apart * mean_m,
        stride_m=stride * (1.0 - 0.2 * abs(float(vary[0]))) * mean_m,
        circle_rad=circle_rad * (1.0 + 0.2 * float(vary[1])),
        turn_rad=turn_rad * (1.0 + 0.03 * float(vary[2])),
        hip_m=0.205 * mean_m,
        aside_m=0.0 * mean_m,
        num_cycles=max(1, int(np.ceil(duration_s / _CYCLE_S))),
    )
    time_s = setting.time_s
    figures = (_wrestler(0, bodies[0], plan, time_s), _wrestler(1, bodies[1], plan, time_s))
    return finish("judo", setting, figures, _grip(figures, plan, time_s, duration_s), parameters)


def _repeat(plan: _Plan, time_s: Array, rise_s: float, full_s: float, fade_s: float, stop_s: float) -> Array:
    """Give a window (frame,) that comes once in every cycle."""
    starts = [cycle * _CYCLE_S for cycle in range(plan.num_cycles)]
    return np.sum([window(time_s - at, rise_s, full_s, fade_s, stop_s) for at in starts], axis=0)


def _place(person: int, plan: _Plan, time_s: Array) -> tuple[Array, Array]:
    """Give where a person's pelvis is (frame, x and z) and which way it looks (frame,)."""
    walked: list[tuple[float, float, Array | float]] = []
    turned: list[tuple[float, float, Array | float]] = []
    for cycle in range(plan.num_cycles):
        for (start_s, stop_s), amount in zip(_WALK, (1.0, 2.0, 1.0, 0.0), strict=True):
            at = cycle * _CYCLE_S
            walked.append((at + start_s, at + stop_s, plan.stride_m * amount))
            turned.append((at + start_s, at + stop_s, plan.circle_rad * amount))
    yaw = moves(time_s, 0.0, turned)
    centre = facing(0.0, 0.0, 0.0, moves(time_s, 0.0, walked))
    inside = _repeat(plan, time_s, _IN_S, _HELD_S, _OUT_S, _APART_S)
    if person == 0:
        ahead = -0.5 * plan.apart_m + inside * (plan.apart_m - plan.hip_m)
        offset = facing(yaw, inside * plan.aside_m, 0.0, ahead)
        yaw = yaw + plan.turn_rad * inside
    else:
        offset = facing(yaw, 0.0, 0.0, 0.5 * plan.apart_m)
        yaw = yaw + np.pi
    return (centre + offset)[:, [0, 2]], yaw


def _wrestler(person: int, body: Body, plan: _Plan, time_s: Array) -> Figure:
    """Place trunk and feet."""
    where, yaw = _place(person, plan, time_s)
    height = body.height_m
    left, right = (_plants(person, side, body, plan) for side in SIDES)
    left, right = spread_feet(body, left, right)
    feet = (
        walk_foot(time_s, body, clear_other_foot(body, left, right), heel=0.8),
        walk_foot(time_s, body, clear_other_foot(body, right, left), heel=0.8),
    )
    inside = _repeat(plan, time_s, _IN_S, _HELD_S, _OUT_S, _APART_S)
    loaded = _repeat(plan, time_s, _HELD_S - 0.7, _HELD_S + 0.2, _OUT_S - 0.2, _OUT_S + 0.7)
    breath = np.sin(2.0 * np.pi * time_s / 2.5)
    if person == 0:
        pitch, low = 0.10 - 0.02 * inside, 0.035 + 0.025 * inside - 0.008 * loaded
        spine = np.stack([0.12 + 0.10 * inside, 0.10 * inside + 0.03 * breath, -0.26 * inside - 0.10 * loaded], axis=-1)
        head = np.stack([-0.12 + 0.05 * inside, 0.10 * inside, -0.10 * inside], axis=-1)
        roll = -0.10 * inside
    else:
        pitch, low = 0.10 + 0.04 * loaded, 0.030 - 0.012 * inside
        spine = np.stack([0.10 + 0.06 * loaded, 0.04 * breath - 0.08 * inside, 0.05 * inside], axis=-1)
        head = np.stack([-0.12 + 0.0 * inside, -0.25 * inside, 0.0 * inside], axis=-1)
        roll = 0.03 * inside
    trunk = Trunk(
        x_m=where[:, 0],
        z_m=where[:, 1],
        height_m=body.standing_m("pelvis") - height * low,
        unitquat=turn(yaw, pitch, roll),
        spine_rotvec=spine,
        head_rotvec=head,
    )
    return Figure(body=body, trunk=trunk, feet=feet)


def _plants(person: int, side: str, body: Body, plan: _Plan) -> list[Plant]:
    """Plan a foot: it lands where the pelvis will be when the pair, or A alone, has moved."""
    sign = 1.0 if side == "left" else -1.0
    # Right feet lead for A, left feet for B; the other foot follows.
    is_first = (side == "right") == (person == 0)
    steps = [(start + (0.0 if is_first else 0.5), start + (0.5 if is_first else 1.0), stop) for start, stop in _WALK]
    if person == 0:
        entering, leaving = (
            ((_IN_S, _IN_S + 0.75), (_OUT_S + 0.75, _APART_S)),
            ((_IN_S + 0.8, _HELD_S), (_OUT_S, _OUT_S + 0.7)),
        )
        inward, outward = entering if side == "right" else leaving
        steps += [(*inward, _HELD_S), (*outward, _APART_S)]
    events = sorted(
        (a + k * _CYCLE_S, b + k * _CYCLE_S, c + k * _CYCLE_S) for a, b, c in steps for k in range(plan.num_cycles)
    )
    lands = [-1.0, *(event[1] for event in events)]
    lifts = [*(event[0] for event in events), 1e6]
    where, yaw = _place(person, plan, np.array([0.0, *(event[2] for event in events)]))
    aside = facing(yaw, sign * _TRACK * body.height_m, 0.0, -0.02 * body.height_m)[:, [0, 2]]
    return [
        Plant(float(x), float(z), float(direction + sign * 0.22), land_s, lift_s)
        for (x, z), direction, land_s, lift_s in zip(where + aside, yaw, lands, lifts, strict=True)
    ]


def _grip(figures: tuple[Figure, Figure], plan: _Plan, time_s: Array, duration_s: float) -> list[Contact]:
    """Bring right hands to lapels, left hands to sleeves; while A is turned in, two hands lie on the other's back."""
    around = _repeat(plan, time_s, _LET_GO_S, _HELD_S - 0.1, _OUT_S + 0.1, _REGRIP_S)
    tori, uke = figures
    contacts = []
    # Right hands first: they depend on the trunks alone.
    for person, figure in enumerate(figures):
        other = figures[1 - person]
        lapel, held = _surface(person, "right", figures, "neck", 0.35, 40.0, "left lapel")
        pole = figure.chest_vector(-0.7, -1.0, 0.0)
        palm = other.joint("spine3") - lapel
        if person == 0:
            back, on_back = _surface(0, "right", figures, "spine2", 0.6, 125.0, "back")
            swing = (4.0 * around * (1.0 - around))[:, None] * other.chest_vector(0.14, -0.06, 0.08) * uke.body.height_m
            pole = mix(pole, other.chest_vector(1.0, -0.6, 0.3), around)
            figure.reach_hand("right", mix(lapel, back, around) + swing, pole, palm=palm)
            contacts += _change(plan, held, on_back)
        else:
            figure.reach_hand("right", lapel, pole, palm=palm)
            contacts.append(replace(held, stop_s=duration_s))
    for person, figure in enumerate(figures):
        sleeve, outside, held = _sleeve(person, figures)
        pole = figure.chest_vector(0.8, -1.0, -0.2)
        if person == 1:
            back, on_back = _surface(1, "left", figures, "spine3", 0.5, -160.0, "back")
            swing = (4.0 * around * (1.0 - around))[:, None] * figure.chest_vector(0.05, 0.06, 0.0) * uke.body.height_m
            pole = mix(pole, figure.chest_vector(1.0, 0.0, 0.3), around)
            figure.reach_hand("left", mix(sleeve, back, around) + swing, pole, palm=tori.joint("spine3") - back)
            contacts += _change(plan, held, on_back)
        else:
            figure.reach_hand("left", sleeve, pole, palm=-outside)
            contacts.append(replace(held, stop_s=duration_s))
    return contacts


def _surface(
    person: int, side: str, figures: tuple[Figure, Figure], bone: str, share: float, angle_deg: float, name: str
) -> tuple[Array, Contact]:
    """Give where a wrist rests on the partner's trunk (frame, 3), round from the front over the left, and the contact."""
    figure, other = figures[person], figures[1 - person]
    rest_m = other.body.radius_m(bone) + figure.body.radius_m("left_wrist") + _GAP_M
    angle = np.radians(angle_deg)
    point = other.on_bone(bone, share, (rest_m * float(np.sin(angle)), 0.0, rest_m * float(np.cos(angle))))
    text = f"{'AB'[person]}'s {side} hand on {'AB'[1 - person]}'s {name}"
    ends = (BonePoint(person, f"{side}_wrist"), BonePoint(1 - person, bone, share))
    return point, Contact(text, *ends, 0.0, 0.0, rest_m)


def _sleeve(person: int, figures: tuple[Figure, Figure]) -> tuple[Array, Array, Contact]:
    """Give where a left wrist holds the partner's right sleeve, which way is out there (frame, 3), and the contact."""
    figure, other = figures[person], figures[1 - person]
    distance_m = other.body.radius_m("left_elbow") + figure.body.radius_m("left_wrist") + _GAP_M
    arm = normalise(other.joint("right_elbow") - other.joint("right_shoulder"))
    outside = other.chest_vector(-1.0, -0.4, 0.2)
    outside = normalise(outside - np.sum(outside * arm, axis=-1, keepdims=True) * arm)
    text = f"{'AB'[person]}'s left hand on {'AB'[1 - person]}'s right sleeve"
    ends = (BonePoint(person, "left_wrist"), BonePoint(1 - person, "right_elbow", _SLEEVE_SHARE))
    point = other.on_bone("right_elbow", _SLEEVE_SHARE) + distance_m * outside
    return point, outside, Contact(text, *ends, 0.0, 0.0, distance_m)


def _change(plan: _Plan, grip: Contact, turned_in: Contact) -> list[Contact]:
    """Give the contacts of a hand that leaves its grip while A is turned in."""
    contacts = [replace(grip, stop_s=_LET_GO_S)]
    for cycle in range(plan.num_cycles):
        at = cycle * _CYCLE_S
        contacts.append(replace(turned_in, start_s=at + _HELD_S - 0.1, stop_s=at + _OUT_S + 0.1))
        contacts.append(replace(grip, start_s=at + _REGRIP_S, stop_s=at + _CYCLE_S + _LET_GO_S))
    return contacts
