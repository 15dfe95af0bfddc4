"""The hands of the judo duet: sleeve and lapel, and the partner's back while A is turned in."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import mix
from pasdedeux.choreography.duet import CLOTH_M, Contact, wrist_contact
from pasdedeux.choreography.figure import Figure
from pasdedeux.choreography.judo_form import BACK_S, CYCLE_S, LET_GO_S, ON_BACK_S, REGRIP_S, JudoForm

Vector = tuple[float, float, float]

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


@dataclass(frozen=True)
class _Hold:
    """A hand on the partner's back: where, how its elbow points, and by which detour it goes there.

    `bone`, `share` and `angle_deg` (from the front over the left) tell the place; `pole` and `detour` are left, up and
    forward of B's chest, the detour as a share of B's height.  `haste_s` is how much sooner it is there, and how much
    later it leaves, than the contact says.
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


def grip(figures: tuple[Figure, Figure], form: JudoForm, time_s: Array, duration_s: float) -> list[Contact]:
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
            turned = form.every_cycle(time_s, LET_GO_S, ON_BACK_S, BACK_S, REGRIP_S)
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
    form: JudoForm,
    time_s: Array,
    gripping: tuple[Array, Array],
    held: Contact,
    hold: _Hold,
) -> tuple[Array, Array, list[Contact]]:
    """Return target and elbow pole (frame, 3) of a hand that goes to the other's back and returns, and its contacts."""
    uke = figures[1]
    lead_s = 0.0 if person == 0 else _LEAD_S
    away_s = (ON_BACK_S - hold.haste_s, BACK_S + hold.haste_s)
    share = form.every_cycle(time_s, LET_GO_S - lead_s, *away_s, REGRIP_S + lead_s)
    back, on_back = _on_trunk(person, side, figures, hold.bone, hold.share, hold.angle_deg, "back")
    detour = (4.0 * share * (1.0 - share))[:, None] * uke.chest_vector(*hold.detour) * uke.body.height_m
    contacts = [replace(held, stop_s=LET_GO_S - lead_s)]
    for at in CYCLE_S * np.arange(form.num_cycles):
        contacts.append(replace(on_back, start_s=float(at + ON_BACK_S), stop_s=float(at + BACK_S)))
        again_s, next_s = at + REGRIP_S + lead_s, at + CYCLE_S + LET_GO_S - lead_s
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
    rest_m = (
        max(other.body.radius_m(bone), other.body.radius_m("spine3")) + figure.body.radius_m("left_wrist") + CLOTH_M
    )
    point = other.round_bone(bone, share, rest_m, np.radians(angle_deg))
    text = f"{'AB'[person]}'s {side} hand on {'AB'[1 - person]}'s {name}"
    return point, wrist_contact(text, person, side, bone, share, rest_m)


def _sleeve(person: int, figures: tuple[Figure, Figure]) -> tuple[Array, Array, Contact]:
    """Return where a left wrist holds the partner's right sleeve, where its palm looks (frame, 3), and the contact."""
    figure, other = figures[person], figures[1 - person]
    distance_m = other.body.radius_m("left_elbow") + figure.body.radius_m("left_wrist") + CLOTH_M
    share = _SLEEVE_SHARE + 0.5 * max(0.0, other.body.height_m / figure.body.height_m - 1.0)
    text = f"{'AB'[person]}'s left hand on {'AB'[1 - person]}'s right sleeve"
    point = other.on_bone("right_elbow", share, np.array(_SLEEVE_SIDE) * distance_m)
    palm = other.on_bone("right_elbow", share) - point
    return point, palm, wrist_contact(text, person, "left", "right_elbow", share, distance_m)
