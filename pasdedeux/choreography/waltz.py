"""Closed-hold waltz: natural turns in 3/4 along a circle, with rise and fall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body
from pasdedeux.choreography.curves import facing, turn
from pasdedeux.choreography.duet import BonePoint, Contact, Duet, DuetStyle, finish, rest_distance_m, wrist_contact
from pasdedeux.choreography.figure import Figure, Trunk
from pasdedeux.choreography.reach import square_to
from pasdedeux.choreography.steps import walk_on_beats
from pasdedeux.skeletons import BODY22

_TRAVEL = np.array([0.50, 0.95, 1.0])
"""Share of a bar's travel that the weight has done over the 1st, 2nd and 3rd step: long, side, close."""
_TURN = np.array([0.36, 0.80, 1.0])
"""Share of a bar's turn, likewise."""
_TRACK = 0.055
"""Distance of each foot from the middle of the body, fraction of body height."""


class WaltzStyle(DuetStyle):
    """Style of the waltz; lengths are fractions of the mean height unless stated otherwise."""

    tempo_bpm: float = Field(88.0, ge=60.0, le=100.0, description="Beats per minute, a step each")
    turn_per_bar_rad: float = Field(
        -1.6,
        ge=-1.65,
        le=-1.2,
        description="Turn of the pair in a bar, to the right; the rest of the half turn is the bend of the line of "
        "dance, so the pair travels on a circle",
    )
    stride: float = Field(0.36, ge=0.25, le=0.4, description="How far the pair travels in a bar")
    apart: float = Field(0.304, ge=0.30, le=0.31, description="Distance of the pelvises in the direction they face")
    aside: float = Field(0.066, ge=0.064, le=0.07, description="How far B stands to the right of A's middle")
    rise: float = Field(0.008, ge=0.0, le=0.012, description="Rise and fall of the pelvis in a bar, of body height")


def make_waltz(style: WaltzStyle) -> Duet:
    """Make a waltz: A leads, B follows, in closed hold.

    A bar is three steps (long, side, close).  Half a turn to the right a bar, seen from the line of dance, makes it the
    natural turn: A goes forward in one bar and backward in the next.  Contacts: A's left wrist and B's right wrist
    (clasped hands), A's right wrist on B's left back, B's left wrist on A's right upper arm.
    """
    vary, mean_m, time_s = style.vary(5), style.mean_m, style.time_s
    leader, follower = style.bodies
    beat_s = 60.0 / (style.tempo_bpm * (1.0 + 0.05 * vary[0]))
    travel_m = style.stride * (1.0 - 0.10 * abs(vary[2])) * mean_m
    path = _PairPath(
        turn_rad=np.pi,
        travel_m=travel_m,
        radius_m=travel_m / (np.pi + style.turn_per_bar_rad * (1.0 + 0.03 * vary[1])),
        phase_rad=np.pi * float(vary[3]),
        apart_m=style.apart * mean_m,
        aside_m=style.aside * mean_m,
    )
    beats = np.arange(-5, int(np.ceil(style.duration_s / beat_s)) + 6)
    rise_share = style.rise * (1.0 + 0.3 * float(vary[4]))
    lean_rad = 0.65 * max(0.0, leader.height_m / follower.height_m - 1.0)
    figures = (
        _dancer(0, leader, path, time_s, beats, beat_s, rise=rise_share, lean_rad=lean_rad),
        _dancer(1, follower, path, time_s, beats, beat_s, rise=rise_share, lean_rad=0.0),
    )
    return finish("waltz", style, figures, _hold(figures, path, (0.0, style.duration_s)))


@dataclass(frozen=True)
class _PairPath:
    """Where the pair is when its weight is over the foot of a beat.

    Args:
        turn_rad: Turn to the right in a bar, seen from the line of dance.
        travel_m: Distance along the line of dance in a bar.
        radius_m: Radius of the line of dance, which runs counter-clockwise seen from above.
        phase_rad: Where on the circle it begins.
        apart_m: Distance of the pelvises in the direction the leader faces.
        aside_m: How far the follower stands to the leader's right.
    """

    turn_rad: float
    travel_m: float
    radius_m: float
    phase_rad: float
    apart_m: float
    aside_m: float

    def place(self, person: int, beat: npt.NDArray[np.int_]) -> tuple[Array, Array]:
        """Return where a person stands (beat, x and z) and its facing (beat,)."""
        bar, step = np.divmod(beat, 3)
        angle = self.phase_rad + (bar + _TRAVEL[step]) * self.travel_m / self.radius_m
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
    is_left = beats % 2 == 1 - person
    stations = path.place(person, beats)
    walk = walk_on_beats(time_s, body, stations, beats, beat_s, is_left, track=_TRACK, out_rad=0.08, sway=0.018)
    bar = time_s / (3.0 * beat_s)
    phase = 2.0 * np.pi * (bar - 0.62)
    swing = np.sin(2.0 * np.pi * bar / 2.0)
    side = np.cos(phase) * np.sin(np.pi * bar) * 0.03
    sign = 1.0 if person == 0 else -1.0
    trunk = Trunk.at(
        walk.where_m,
        body.standing_m("pelvis") + body.height_m * (-0.015 + rise * np.cos(phase)),
        turn(walk.yaw_rad, 0.03, side),
        (
            lean_rad - 0.02 + 0.02 * np.cos(phase),
            0.05 * swing * sign + (0.12 if person == 0 else -0.04),
            -0.05 * np.cos(phase - 0.5) * sign,
        ),
        (0.02, 0.38 + 0.10 * np.sin(phase + 1.0), -0.04),
    )
    return Figure(body=body, trunk=trunk, feet=walk.feet)


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
    rest_m = rest_distance_m(leader.body, follower.body, back_bone, "spine3")
    angle = _round_the_back(leader.body, follower.body, path, back_bone, back_share, rest_m)
    target = follower.round_bone(back_bone, back_share, rest_m, angle)
    leader.reach_hand("right", target, -left + 0.9 * down, palm=-across)
    # The follower's left wrist on the leader's right upper arm.
    radius = rest_distance_m(follower.body, leader.body, "left_elbow")
    share = 0.35 + 0.6 * max(0.0, heights[0] / heights[1] - 1.0)
    shoulder, elbow = leader.joint("right_shoulder"), leader.joint("right_elbow")
    bone = (elbow - shoulder) / leader.body.length_m("right_elbow")
    outward = square_to(-left * 0.5 + [0.0, 1.0, 0.0] + 0.4 * across, bone)
    follower.reach_hand(
        "left",
        shoulder + share * (elbow - shoulder) + radius * outward,
        -left + 0.4 * down,
        palm=np.broadcast_to(down, left.shape),
    )
    return [
        Contact("clasped hands", BonePoint(0, "left_wrist"), BonePoint(1, "right_wrist"), *span_s, clasp),
        wrist_contact("hand on back", 0, "right", back_bone, back_share, rest_m, span_s),
        wrist_contact("hand on upper arm", 1, "left", "right_elbow", share, radius, span_s),
    ]


def _back_height(leader: Body, follower: Body) -> tuple[str, float]:
    """Return follower's bone and the share of it where the leader's wrist rests: under her arm, not far below his."""
    wanted = leader.standing_m("left_shoulder") - 0.21 * leader.height_m
    wanted = min(wanted, follower.standing_m("left_shoulder") - 0.045 * follower.height_m)
    low, chest = follower.standing_m("spine2"), follower.standing_m("spine3")
    return follower.trunk_at(max(wanted, low + 0.75 * (chest - low)))


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
