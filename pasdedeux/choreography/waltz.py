"""Closed-hold waltz: natural turns in 3/4 along a circle, with rise and fall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.choreography.anthropometry import Body, make_body
from pasdedeux.choreography.curves import curve_through
from pasdedeux.choreography.duet import BonePoint, Contact, Duet, Setting, check_style, finish
from pasdedeux.choreography.figure import Figure, Trunk, facing, turn
from pasdedeux.choreography.steps import Plant, clear_other_foot, spread_feet, walk_foot
from pasdedeux.skeletons import BODY22

__all__ = ["make_waltz"]

Array = npt.NDArray[np.float64]

_TRAVEL = np.array([0.50, 0.95, 1.0])
"""Share of a bar's way that the weight has gone over the 1st, 2nd and 3rd step: long, side, close."""
_TURN = np.array([0.36, 0.80, 1.0])
"""Share of a bar's turn, likewise."""
_TRACK = 0.055
"""Distance of each foot from the middle of the body, fraction of body height."""
_DOUBLE_SUPPORT = 0.16
"""Share of a beat during which both feet stand."""
_GAP_M = 0.004
"""Cloth between a resting wrist and the body under it."""
_MID_STANCE = 0.54
"""Beats from landing until the weight is over the foot."""


def make_waltz(
    *,
    duration_s: float = 10.0,
    rate_hz: float = 60.0,
    heights_m: tuple[float, float] = (1.82, 1.65),
    variation: int = 0,
    tempo_bpm: float = 88.0,
    turn_per_bar_rad: float = -1.6,
    stride: float = 0.36,
    apart: float = 0.304,
    aside: float = 0.066,
    rise: float = 0.008,
) -> Duet:
    """Make a waltz: A leads, B follows, in closed hold.

    A bar is three steps (long, side, close).  Half a turn to the right a bar, seen from the line of dance, makes it the
    natural turn: A goes forward in one bar and backward in the next.  Contacts: A's left wrist and B's right wrist
    (clasped hands), A's right wrist on B's left back, B's left wrist on A's right upper arm.

    Args:
        duration_s: Length.
        rate_hz: Frames per second.
        heights_m: Heights of leader and follower.
        variation: Another take of the same dance.
        tempo_bpm: Beats per minute, a step each; 60 to 100.
        turn_per_bar_rad: Turn of the pair in a bar, to the right, -1.65 to -1.2; the rest of the half turn is the
            bend of the line of dance, so the pair travels on a circle.
        stride: Way of the pair in a bar, fraction of their mean height; 0.25 to 0.4.
        apart: Distance of the two pelvises along the way they face, fraction of their mean height; 0.30 to 0.31.
        aside: How far B stands to the right of A's middle, likewise; 0.064 to 0.07.
        rise: Rise and fall of the pelvis in a bar, fraction of body height; 0 to 0.012.

    Raises:
        InputError: A number is outside its range.
    """
    setting = Setting(duration_s=duration_s, rate_hz=rate_hz, heights_m=heights_m, variation=variation)
    style = {
        "tempo_bpm": (tempo_bpm, 60.0, 100.0),
        "turn_per_bar_rad": (turn_per_bar_rad, -1.65, -1.2),
        "stride": (stride, 0.25, 0.4),
        "apart": (apart, 0.30, 0.31),
        "aside": (aside, 0.064, 0.07),
        "rise": (rise, 0.0, 0.012),
    }
    parameters = check_style("waltz", style)
    vary = setting.vary(5)
    leader, follower = (make_body(height) for height in heights_m)
    mean_m = float(np.mean(heights_m))
    beat_s = 60.0 / (tempo_bpm * (1.0 + 0.05 * vary[0]))
    way_m = stride * (1.0 - 0.10 * abs(vary[2])) * mean_m
    path = _PairPath(
        turn_rad=np.pi,
        way_m=way_m,
        radius_m=way_m / (np.pi + turn_per_bar_rad * (1.0 + 0.03 * vary[1])),
        phase_rad=np.pi * float(vary[3]),
        apart_m=apart * mean_m,
        aside_m=aside * mean_m,
    )
    time_s = setting.time_s
    beats = np.arange(-5, int(np.ceil(duration_s / beat_s)) + 6)
    rise_share = rise * (1.0 + 0.3 * float(vary[4]))
    lean_rad = 0.65 * max(0.0, leader.height_m / follower.height_m - 1.0)
    figures = (
        _dancer(0, leader, path, time_s, beats, beat_s, rise=rise_share, lean_rad=lean_rad),
        _dancer(1, follower, path, time_s, beats, beat_s, rise=rise_share, lean_rad=0.0),
    )
    return finish("waltz", setting, figures, _hold(figures, path, (0.0, duration_s)), parameters)


@dataclass(frozen=True)
class _PairPath:
    """Where the pair is when its weight is over the foot of a beat.

    Args:
        turn_rad: Turn to the right in a bar, seen from the line of dance.
        way_m: Way along the line of dance in a bar.
        radius_m: Radius of the line of dance, which runs counter-clockwise seen from above.
        phase_rad: Where on the circle it begins.
        apart_m: Distance of the pelvises along the way the leader faces.
        aside_m: How far the follower stands to the leader's right.
    """

    turn_rad: float
    way_m: float
    radius_m: float
    phase_rad: float
    apart_m: float
    aside_m: float

    def place(self, person: int, beat: npt.NDArray[np.int_]) -> tuple[Array, Array]:
        """Return where a person stands (beat, x and z) and which way it faces (beat,)."""
        bar, step = np.divmod(beat, 3)
        angle = self.phase_rad + (bar + _TRAVEL[step]) * self.way_m / self.radius_m
        yaw = np.pi + angle - self.turn_rad * (bar + _TURN[step] - 0.15)
        sign = -1.0 if person == 0 else 1.0
        offset = facing(yaw, -0.5 * sign * self.aside_m, 0.0, 0.5 * sign * self.apart_m)
        centre = self.radius_m * np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
        return centre + offset[:, [0, 2]], yaw + (0.0 if person == 0 else np.pi)


def _dancer(
    person: int,
    body: Body,
    path: _PairPath,
    time_s: Array,
    beats: npt.NDArray[np.int_],
    beat_s: float,
    *,
    rise: float,
    lean_rad: float,
) -> Figure:
    """Place trunk and feet of one dancer."""
    where, yaw = path.place(person, beats)
    is_left = (beats % 2 == 1) if person == 0 else (beats % 2 == 0)
    left, right = (
        _plants(body, beats[mask], beat_s, where[mask], yaw[mask], sign)
        for sign, mask in ((1.0, is_left), (-1.0, ~is_left))
    )
    left, right = spread_feet(body, left, right)
    feet = (
        walk_foot(time_s, body, clear_other_foot(body, left, right)),
        walk_foot(time_s, body, clear_other_foot(body, right, left)),
    )
    # The pelvis leans over the standing foot, and the weight is there some time after the foot has landed.
    sway = 0.018 * body.height_m * np.where(is_left, 1.0, -1.0)
    over = where + facing(yaw, sway, 0.0, 0.0)[:, [0, 2]]
    first_s = float(beats[0] + _MID_STANCE) * beat_s
    x, z = np.moveaxis(curve_through(time_s, first_s, beat_s, over), -1, 0)
    facing_yaw = curve_through(time_s, first_s, beat_s, yaw)
    bar = time_s / (3.0 * beat_s)
    phase = 2.0 * np.pi * (bar - 0.62)
    swing = np.sin(2.0 * np.pi * bar / 2.0)
    side = np.cos(phase) * np.sin(np.pi * bar) * 0.03
    up = body.standing_m("pelvis") + body.height_m * (-0.015 + rise * np.cos(phase))
    sign = 1.0 if person == 0 else -1.0
    trunk = Trunk(
        x_m=x,
        z_m=z,
        height_m=up,
        unitquat=turn(facing_yaw, 0.03, side),
        spine_rotvec=np.stack(
            [
                lean_rad - 0.02 + 0.02 * np.cos(phase),
                0.05 * swing * sign + (0.12 if person == 0 else -0.04),
                -0.05 * np.cos(phase - 0.5) * sign,
            ],
            -1,
        ),
        head_rotvec=np.stack([0.02 + 0.0 * bar, 0.38 + 0.10 * np.sin(phase + 1.0), -0.04 + 0.0 * bar], -1),
    )
    return Figure(body=body, trunk=trunk, feet=feet)


def _plants(
    body: Body, beats: npt.NDArray[np.int_], beat_s: float, where: Array, yaw: Array, sign: float
) -> list[Plant]:
    aside = facing(yaw, sign * _TRACK * body.height_m, 0.0, -0.01 * body.height_m)[:, [0, 2]]
    return [
        Plant(
            x_m=float(x),
            z_m=float(z),
            yaw_rad=float(direction + sign * 0.08),
            land_s=float(beat * beat_s),
            lift_s=float((beat + 1.0 + _DOUBLE_SUPPORT) * beat_s),
        )
        for beat, (x, z), direction in zip(beats, where + aside, yaw, strict=True)
    ]


def _hold(figures: tuple[Figure, Figure], path: _PairPath, span_s: tuple[float, float]) -> list[Contact]:
    """Bring the four hands into closed hold."""
    leader, follower = figures
    heights = (leader.body.height_m, follower.body.height_m)
    # Clasped hands: wrists either side of a point out on the leader's left, between the two chests.
    middle = 0.5 * (leader.joint("spine3") + follower.joint("spine3"))
    across = follower.joint("spine3") - leader.joint("spine3")
    across = across * [1.0, 0.0, 1.0] / np.linalg.norm(across[:, [0, 2]], axis=-1, keepdims=True)
    left = np.cross([0.0, 1.0, 0.0], across)
    shoulders = 0.5 * (leader.joint("left_shoulder") + follower.joint("right_shoulder"))[:, 1]
    point = middle + left * 0.29 * float(np.mean(heights))
    point[:, 1] = shoulders + 0.015
    clasp = 0.024 * sum(heights)
    down = np.array([0.0, -1.0, 0.0])
    leader.reach_hand("left", point - 0.5 * clasp * across, 0.5 * left + down - 0.3 * across, palm=across)
    follower.reach_hand("right", point + 0.5 * clasp * across, 0.5 * left + down + 0.3 * across, palm=-across)
    # The leader's right wrist on the follower's back, under her left arm.
    back_bone, back_share = _back_height(leader.body, follower.body)
    rest_m = (
        max(follower.body.radius_m(back_bone), follower.body.radius_m("spine3"))
        + leader.body.radius_m("left_wrist")
        + _GAP_M
    )
    angle = _round_the_back(leader.body, follower.body, path, back_bone, back_share, rest_m)
    back = (rest_m * float(np.sin(angle)), 0.0, rest_m * float(np.cos(angle)))
    target = follower.on_bone(back_bone, back_share, back)
    leader.reach_hand("right", target, -left + 0.9 * down, palm=-across)
    # The follower's left wrist on the leader's right upper arm.
    radius = leader.body.radius_m("left_elbow") + follower.body.radius_m("left_wrist") + _GAP_M
    share = 0.35 + 0.6 * max(0.0, heights[0] / heights[1] - 1.0)
    shoulder, elbow = leader.joint("right_shoulder"), leader.joint("right_elbow")
    bone = (elbow - shoulder) / leader.body.length_m("right_elbow")
    outward = -left * 0.5 + [0.0, 1.0, 0.0] + 0.4 * across
    outward = outward - np.sum(outward * bone, axis=-1, keepdims=True) * bone
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    follower.reach_hand(
        "left",
        shoulder + share * (elbow - shoulder) + radius * outward,
        -left + 0.4 * down,
        palm=np.broadcast_to(down, left.shape),
    )
    return [
        Contact("clasped hands", BonePoint(0, "left_wrist"), BonePoint(1, "right_wrist"), *span_s, clasp),
        Contact("hand on back", BonePoint(0, "right_wrist"), BonePoint(1, back_bone, back_share), *span_s, rest_m),
        Contact("hand on upper arm", BonePoint(1, "left_wrist"), BonePoint(0, "right_elbow", share), *span_s, radius),
    ]


def _back_height(leader: Body, follower: Body) -> tuple[str, float]:
    """Return follower's bone and the share of it where the leader's wrist rests: under her arm, not far below his."""
    wanted = leader.standing_m("left_shoulder") - 0.21 * leader.height_m
    wanted = min(wanted, follower.standing_m("left_shoulder") - 0.045 * follower.height_m)
    low, chest, neck = (follower.standing_m(joint) for joint in ("spine2", "spine3", "neck"))
    lowest = low + 0.75 * (chest - low)
    if wanted > chest:
        return "neck", (wanted - chest) / (neck - chest)
    return "spine3", (max(wanted, lowest) - low) / (chest - low)


def _round_the_back(leader: Body, follower: Body, path: _PairPath, bone: str, share: float, rest_m: float) -> float:
    """Return how far round the follower's back the leader's wrist goes, radians from her front over her left side.

    As far as 92 % of the leader's arm reaches when both stand upright, at most to the shoulder blade.
    """
    angles = np.linspace(0.25, 0.64, 79) * np.pi
    shoulder_x = -leader.rest_offsets_m[BODY22.indices(["left_collar", "left_shoulder"]), 0].sum()
    x = -path.aside_m - rest_m * np.sin(angles) - shoulder_x  # the leader's left is +X, his shoulder lies at -X
    z = path.apart_m - rest_m * np.cos(angles)
    start = follower.standing_m("spine2" if bone == "spine3" else "spine3")
    y = start + share * follower.length_m(bone) - leader.standing_m("left_shoulder")
    arm = leader.length_m("left_elbow") + leader.length_m("left_wrist")
    num_reached = int(np.sum(np.sqrt(x**2 + y**2 + z**2) <= 0.92 * arm))
    return float(angles[max(num_reached - 1, 0)])
