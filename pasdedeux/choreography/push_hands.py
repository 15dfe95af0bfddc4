"""Push-hands: two people in bow stance, wrists and elbows in touch, circling as the weight goes to and fro."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import facing, turn
from pasdedeux.choreography.duet import BonePoint, Contact, Duet, DuetStyle, finish, rest_distance_m, wrist_contact
from pasdedeux.choreography.figure import Figure, Trunk
from pasdedeux.choreography.reach import square_to
from pasdedeux.choreography.steps import FootPath, Plant, walk_foot
from pasdedeux.kinematics.rotations import normalise

_AHEAD, _BEHIND, _ASIDE = 0.165, -0.175, 0.062
"""Where the feet stand from the middle of the stance: front foot, back foot, each to its side; fraction of height."""
_FRONT_YAW_RAD, _BACK_YAW_RAD = -0.05, 0.75


class PushHandsStyle(DuetStyle):
    """Style of push-hands; lengths are fractions of the mean height."""

    circle_s: float = Field(2.6, ge=1.8, le=6.0, description="Time of one circle, seconds")
    width: float = Field(0.050, ge=0.0, le=0.06, description="Half width of the circle")
    depth: float = Field(0.055, ge=0.03, le=0.07, description="Half depth of the circle")
    shift: float = Field(0.050, ge=0.03, le=0.06, description="How far the pelvis goes forward and back")
    apart: float = Field(0.385, ge=0.37, le=0.40, description="Distance of the two stances")


def make_push_hands(style: PushHandsStyle) -> Duet:
    """Make push-hands: right foot in front, the feet never move, right wrists circle, left hands at the right elbows.

    The circle lies level at first, stands upright two circles later, and so on.  Contacts, all the time: right wrist on
    right wrist, A's left wrist at B's right elbow, B's left wrist at A's right elbow.
    """
    vary, mean_m, time_s, bodies = style.vary(5), style.mean_m, style.time_s, style.bodies
    phase = 2.0 * np.pi * time_s / (style.circle_s * (1.0 + 0.08 * vary[0])) + np.pi * float(vary[1])
    phase = phase + 0.15 * (1.0 + vary[2]) * np.sin(0.37 * phase)
    push = style.shift * mean_m * np.cos(phase - 0.35)
    figures = (
        _stand(0, bodies[0], style.apart * mean_m, push, phase, time_s),
        _stand(1, bodies[1], style.apart * mean_m, push, phase, time_s),
    )
    # The point of touch, nearer to the shorter arm; level circle and upright circle in turn.
    upright = (0.5 - 0.5 * np.cos(0.26 * phase)) * (0.85 + 0.15 * float(vary[3]))
    size = mean_m * (1.0 - 0.1 * abs(float(vary[4])))
    share = style.heights_m[0] / sum(style.heights_m) - 0.5
    chest_m = 0.5 * (bodies[0].standing_m("spine3") + bodies[1].standing_m("spine3"))
    point = np.stack(
        [
            style.width * size * np.sin(phase) * (1.0 - 0.6 * upright),
            chest_m - 0.005 * mean_m + style.width * size * np.sin(phase) * (0.15 + 0.85 * upright),
            share * style.apart * mean_m + style.depth * size * np.cos(phase),
        ],
        axis=-1,
    )
    return finish("push_hands", style, figures, _touch(figures, point, phase, style.duration_s))


def _stand(person: int, body: Body, apart_m: float, push: Array, phase: Array, time_s: Array) -> Figure:
    """Place trunk and feet: A stands at -Z and looks along +Z, B opposite."""
    yaw = 0.0 if person == 0 else np.pi
    sign = 1.0 if person == 0 else -1.0
    middle = np.array([0.0, 0.0, -0.5 * sign * apart_m])
    forward = sign * push
    feet = (
        _foot(time_s, body, middle, yaw, _ASIDE, _BEHIND, _BACK_YAW_RAD),
        _foot(time_s, body, middle, yaw, -_ASIDE, _AHEAD, _FRONT_YAW_RAD),
    )
    where = middle + facing(yaw, 0.004 * body.height_m * np.sin(phase), 0.0, forward - 0.01 * body.height_m)
    waist = 0.24 * np.sin(phase + 0.3) + 0.10
    trunk = Trunk.at(
        where,
        body.standing_m("pelvis") - body.height_m * (0.052 + 0.006 * np.cos(phase)),
        turn(yaw + 0.16 + 0.30 * waist, 0.04 + 0.25 * forward),
        (0.05 + 0.35 * forward, 0.55 * waist, 0.03 * np.sin(phase)),
        (0.05, -0.12 - 0.7 * waist, 0.0),
    )
    return Figure(body=body, trunk=trunk, feet=feet)


def _foot(time_s: Array, body: Body, middle: Array, yaw: float, aside: float, ahead: float, out: float) -> FootPath:
    at = middle + facing(yaw, aside * body.height_m, 0.0, ahead * body.height_m)
    # It stands long before the beginning and long after the end.
    plant = Plant(x_m=float(at[0]), z_m=float(at[2]), yaw_rad=yaw + out, land_s=-1.0, lift_s=float(time_s[-1]) + 1e3)
    return walk_foot(time_s, body, [plant])


def _touch(figures: tuple[Figure, Figure], point: Array, phase: Array, duration_s: float) -> list[Contact]:
    """Bring right wrists to the point of touch, then left wrists to the other's right elbow."""
    bodies = tuple(figure.body for figure in figures)
    wrists_m = rest_distance_m(bodies[1], bodies[0], "left_wrist")
    tilt = 0.5 * np.sin(phase)
    across = np.stack([np.cos(tilt), np.sin(tilt), 0.0 * tilt], axis=-1)
    contacts = [
        Contact("wrist on wrist", BonePoint(0, "right_wrist"), BonePoint(1, "right_wrist"), 0.0, duration_s, wrists_m)
    ]
    for figure, sign in zip(figures, (-1.0, 1.0), strict=True):
        outward = figure.chest_vector(-0.9, -1.0, 0.0)
        figure.reach_hand(
            "right", point + 0.5 * sign * wrists_m * across, outward, palm=figure.chest_vector(0.6, 0.0, -0.4)
        )
    for person, figure in enumerate(figures):
        other = figures[1 - person]
        radius_m = rest_distance_m(figure.body, other.body, "left_elbow")
        elbow = other.joint("right_elbow")
        arm = normalise(elbow - other.joint("right_shoulder"))
        # The outside of the elbow; a much taller partner's arm comes from above and lies higher on it.
        above = max(0.0, figure.body.height_m / other.body.height_m - 1.0)
        towards = other.chest_vector(-0.8, 1.5 * above - 0.3, 0.5)
        side = square_to(towards, arm)
        target = elbow + radius_m * side
        figure.reach_hand("left", target, figure.chest_vector(0.8, -1.0, -0.1), palm=elbow - target)
        name = f"{'AB'[person]}'s left hand at {'AB'[1 - person]}'s elbow"
        contacts.append(wrist_contact(name, person, "left", "right_elbow", 1.0, radius_m, (0.0, duration_s)))
    return contacts
