"""Closed-hold waltz: natural turns in 3/4 along a circle, with rise and fall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Physique
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.duet import BonePoint, Contact, Dance, hand_contact
from pasdedeux.choreography.geometry import on_circle, on_floor, square_to
from pasdedeux.choreography.steps import Rhythm
from pasdedeux.skeletons import BODY22

_TRAVEL = np.array([0.50, 0.95, 1.0])
"""Share of a bar's travel completed by the weight over the 1st, 2nd and 3rd step: long, side, close."""
_TURN = np.array([0.36, 0.80, 1.0])
"""Share of a bar's half turn, likewise."""
_TEMPO_BPM = 88.0
"""Beats per minute, a step each."""
_TURN_PER_BAR_RAD = -1.6
"""Turn of the pair in a bar, to the right; the rest of the half turn is the bend of the line of dance, so the pair
travels on a circle."""
_STRIDE, _APART, _ASIDE = 0.36, 0.304, 0.066
"""Travel of the pair in a bar, distance of the pelvises in the direction they face, place of B to the right of A's
middle; fractions of the mean height."""
_RISE = 0.008
"""Rise and fall of the pelvis in a bar, fraction of body height."""


class Waltz(Dance):
    """Waltz: A leads, B follows, in closed hold.

    A bar is three steps (long, side, close).  Half a turn to the right a bar, seen from the line of dance, makes it the
    natural turn: A goes forward in one bar and backward in the next.  The line of dance is a circle, counter-clockwise
    seen from above.  Contacts: A's left wrist and B's right wrist (clasped hands), A's right wrist on B's left back,
    B's left wrist on A's right upper arm.
    """

    def place(self, person: int) -> DancerFrames:
        """Place trunk and feet of one dancer."""
        body = self.bodies[person]
        rhythm = Rhythm.of(self.time_s, self.duration_s, _TEMPO_BPM * (1.0 + 0.05 * self.vary[0]))
        floor, yaw = self._station(person, rhythm.beats)
        is_left = rhythm.beats % 2 == 1 - person
        # The pelvis leans over the standing foot, and the weight is there some time after the foot has landed.
        sway = 0.018 * body.height_m * np.where(is_left, 1.0, -1.0)
        bar = self.time_s / (3.0 * rhythm.beat_s)
        phase = 2.0 * np.pi * (bar - 0.62)
        swing = np.sin(2.0 * np.pi * bar / 2.0)
        rise = _RISE * (1.0 + 0.3 * self.vary[4])
        sign = 1.0 if person == 0 else -1.0
        heights = self.heights_m
        lean = 0.65 * max(0.0, heights[0] / heights[1] - 1.0) if person == 0 else 0.0
        return DancerFrames(
            body,
            rhythm.walk_feet(body, floor, yaw, is_left, track=0.055, out_rad=0.08),
            floor_m=rhythm.curve(floor + on_floor(yaw, sway, 0.0)),
            height_m=body.standing_m("pelvis") + body.height_m * (-0.015 + rise * np.cos(phase)),
            pelvis=(rhythm.curve(yaw), 0.03, np.cos(phase) * np.sin(np.pi * bar) * 0.03),
            spine=(
                lean - 0.02 + 0.02 * np.cos(phase),
                0.05 * swing * sign + (0.12 if person == 0 else -0.04),
                -0.05 * np.cos(phase - 0.5) * sign,
            ),
            head=(0.02, 0.38 + 0.10 * np.sin(phase + 1.0), -0.04),
        )

    def _station(self, person: int, beat: npt.NDArray[np.int_]) -> tuple[Array, Array]:
        """Return X and Z (beat, 2) and facing (beat,) of a person when the weight is over the foot of a beat."""
        vary = self.vary
        travel_m = _STRIDE * (1.0 - 0.10 * abs(vary[2])) * self.mean_m
        radius_m = travel_m / (np.pi + _TURN_PER_BAR_RAD * (1.0 + 0.03 * vary[1]))
        bar, step = np.divmod(beat, 3)
        angle = np.pi * vary[3] + (bar + _TRAVEL[step]) * travel_m / radius_m
        yaw = np.pi + angle - np.pi * (bar + _TURN[step] - 0.15)
        sign = -1.0 if person == 0 else 1.0
        offset = on_floor(yaw, -0.5 * sign * _ASIDE * self.mean_m, 0.5 * sign * _APART * self.mean_m)
        return on_circle(radius_m, angle) + offset, yaw + np.pi * person

    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Move the four hands into closed hold."""
        leader, follower = figures
        # Clasped hands: wrists either side of a point out on the leader's left, between the two chests.
        middle = 0.5 * (leader.joint("spine3") + follower.joint("spine3"))
        across = follower.joint("spine3") - leader.joint("spine3")
        across = across * [1.0, 0.0, 1.0] / np.linalg.norm(across[:, [0, 2]], axis=-1, keepdims=True)
        left = np.cross([0.0, 1.0, 0.0], across)
        point = middle + left * 0.29 * self.mean_m
        point[:, 1] = 0.5 * (leader.joint("left_shoulder") + follower.joint("right_shoulder"))[:, 1] + 0.015
        clasp_m = 0.024 * sum(self.heights_m)
        down = np.array([0.0, -1.0, 0.0])
        leader.reach_hand("left", point - 0.5 * clasp_m * across, 0.5 * left + down - 0.3 * across, palm=across)
        follower.reach_hand("right", point + 0.5 * clasp_m * across, 0.5 * left + down + 0.3 * across, palm=-across)
        # The leader's right wrist on the follower's back, under her left arm.
        bone, back_share = _back_height(leader.body, follower.body)
        rest_m = leader.body.rest_distance_m(follower.body, bone, "spine3")
        angle = self._round_the_back(leader.body, follower.body, bone, back_share, rest_m)
        target = follower.round_bone(bone, back_share, rest_m, angle)
        leader.reach_hand("right", target, -left + 0.9 * down, palm=-across)
        # The follower's left wrist on the leader's right upper arm.
        radius_m = follower.body.rest_distance_m(leader.body, "left_elbow")
        share = 0.35 + 0.6 * max(0.0, self.heights_m[0] / self.heights_m[1] - 1.0)
        shoulder, elbow = leader.joint("right_shoulder"), leader.joint("right_elbow")
        upper_arm = (elbow - shoulder) / leader.body.length_m("right_elbow")
        outward = square_to(upper_arm, -left * 0.5 + [0.0, 1.0, 0.0] + 0.4 * across)
        target = shoulder + share * (elbow - shoulder) + radius_m * outward
        follower.reach_hand("left", target, -left + 0.4 * down, palm=down)
        return [
            Contact(BonePoint(0, "left_wrist"), BonePoint(1, "right_wrist"), clasp_m),
            hand_contact(0, "right", bone, back_share, rest_m),
            hand_contact(1, "left", "right_elbow", share, radius_m),
        ]

    def _round_the_back(self, leader: Physique, follower: Physique, bone: str, share: float, rest_m: float) -> float:
        """Return how far round the follower's back the leader's wrist goes, radians from her front over her left side.

        It is within 92 % of the reach of the leader's arm when both stand upright, at most at the shoulder blade.
        """
        angles = np.linspace(0.25, 0.64, 79) * np.pi
        shoulder_x = -leader.rest_offsets_m[BODY22.indices(["left_collar", "left_shoulder"]), 0].sum()
        # The leader's left is +X, his right shoulder lies at -X.
        x = -_ASIDE * self.mean_m - rest_m * np.sin(angles) - shoulder_x
        z = _APART * self.mean_m - rest_m * np.cos(angles)
        start = follower.standing_m("spine2" if bone == "spine3" else "spine3")
        y = start + share * follower.length_m(bone) - leader.standing_m("left_shoulder")
        arm = leader.length_m("left_elbow") + leader.length_m("left_wrist")
        num_reached = int(np.sum(np.sqrt(x**2 + y**2 + z**2) <= 0.92 * arm))
        return float(angles[max(num_reached - 1, 0)])


def _back_height(leader: Physique, follower: Physique) -> tuple[str, float]:
    """Return follower's bone and the share of it where the leader's wrist rests: under her arm, not far below his."""
    wanted = leader.standing_m("left_shoulder") - 0.21 * leader.height_m
    wanted = min(wanted, follower.standing_m("left_shoulder") - 0.045 * follower.height_m)
    low, chest = follower.standing_m("spine2"), follower.standing_m("spine3")
    return follower.trunk_at(max(wanted, low + 0.75 * (chest - low)))
