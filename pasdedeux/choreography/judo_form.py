"""The form of the judo duet: when what happens, and where both people stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.choreography.curves import moves, window
from pasdedeux.choreography.figure import facing

CYCLE_S = 10.0
"""The whole form; a longer duet repeats it."""
IN_S, HELD_S, OUT_S, LEAVE_S = 3.1, 4.7, 5.7, 7.2
"""When A begins to turn in, is in, begins to turn out, is out."""
LET_GO_S, ON_BACK_S, BACK_S, REGRIP_S = 3.3, 4.6, 5.8, 7.3
"""Until when A's right hand holds the lapel; from when and until when it lies on B's back; from when it holds again."""
WALK = ((0.25, 1.30), (1.30, 2.35), (7.5, 8.55), (8.55, 9.6))
"""Walking: in each of these the pair moves by one step of both feet; two there and two back."""


@dataclass(frozen=True)
class JudoForm:
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
        starts = CYCLE_S * np.arange(self.num_cycles)
        return np.asarray(sum(window(time_s - start, rise_s, full_s, fade_s, stop_s) for start in starts))

    def inside(self, time_s: Array) -> Array:
        """Return how far A is turned in (frame,), 0 to 1."""
        return self.every_cycle(time_s, IN_S, HELD_S, OUT_S, LEAVE_S)

    def loaded(self, time_s: Array) -> Array:
        """Return how far B is taken onto the hip (frame,), 0 to 1."""
        return self.every_cycle(time_s, HELD_S - 0.7, HELD_S + 0.2, OUT_S - 0.2, OUT_S + 0.7)

    def place(self, person: int, time_s: Array) -> tuple[Array, Array]:
        """Return where a person's pelvis is (frame, x and z) and its facing (frame,)."""
        walked = [
            (cycle * CYCLE_S + start_s, cycle * CYCLE_S + stop_s, share)
            for cycle in range(self.num_cycles)
            for (start_s, stop_s), share in zip(WALK, (1.0, 2.0, 1.0, 0.0), strict=True)
        ]
        progress = moves(time_s, 0.0, walked)
        yaw = self.circle_rad * progress
        centre = facing(0.0, 0.0, 0.0, self.stride_m * progress)
        if person == 1:
            return (centre + facing(yaw, 0.0, 0.0, 0.5 * self.apart_m))[:, [0, 2]], yaw + np.pi
        inside = self.inside(time_s)
        ahead = -0.5 * self.apart_m + inside * (self.apart_m - self.hip_m)
        return (centre + facing(yaw, inside * self.aside_m, 0.0, ahead))[:, [0, 2]], yaw + self.turn_rad * inside
