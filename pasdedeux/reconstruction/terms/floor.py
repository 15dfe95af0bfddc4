"""The floor on which everybody stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.reconstruction.terms.placed import (
    ANKLES,
    By,
    PlacedPeople,
    SeenPerson,
    Unknown,
    beside,
    up_axis,
    up_axis_slope,
)
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm

_ANKLE_HEIGHT = 0.04
"""Height of the ankle over the floor, standing, as a part of the stature (Winter 2009, fig. 4.1: 0.039)."""


def heights_m(scene: PlacedPeople, number: int) -> Array:
    """Return the height of the body's surface at each joint of a person over the floor (frame, 14), metres."""
    seen, x = scene.seen, scene.x
    bearing = _bearing_m(seen.people[number]) * scene.sizes[number] + x[seen.ankles[number]]
    height = scene.height_m + x[Unknown.TILT] * seen.mean_distance_m
    return np.asarray(scene.joints[number][0, :, :-1] @ _up_tilted(scene) + height - bearing)


@dataclass(frozen=True)
class FloorTerm(SceneTerm):
    """(lowest joint . up + height - its radius) / (size * deviation): the lowest part of a person is on the floor.

    Errors of poses in depth tilt the floor without changing the pitch, so the tilt is added to the upright axis along
    the camera's axis.  People above the floor leap or stand on something, and have little weight (robust); nobody is
    below it.

    Args:
        person: Number of the person.
        is_carried: Whether the person may be above the floor; nobody is below it.
        deviation_m: Standard deviation of the lowest part from the floor, at the initial size.  It grows with the size,
            as errors of poses do, so that small sizes do not lower the cost.
    """

    person: int
    is_carried: bool = False
    deviation_m: float = 0.045
    alike_s = 0.7

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (shown frame,)."""
        lowest_m = heights_m(scene, self.person).min(axis=1)[scene.seen.people[self.person].shown]
        residual = lowest_m / (scene.sizes[self.person] * self.deviation_m)
        return np.minimum(residual, 0.0) if self.is_carried else residual

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        seen, number = scene.seen, self.person
        person, residual, unit = seen.people[number], self.residual(scene), scene.sizes[number] * self.deviation_m
        lowest = np.argmin(heights_m(scene, number)[person.shown], axis=1)
        joints = scene.joints[number][:, person.shown, lowest]
        moved = joints @ _up_tilted(scene) / unit
        slopes = beside(
            moved[By.DISTANCE],
            moved[By.SIZE] - _bearing_m(person)[lowest] / self.deviation_m - residual,
            moved[By.LENS],
            joints[0] @ up_axis_slope(scene.x[Unknown.PITCH]) / unit,
            scene.height_m / unit,
            (joints[0, :, 2] + seen.mean_distance_m) / unit,
            -1.0 / unit,
        )
        columns = beside(
            seen.distances(number)[person.shown],
            seen.sizes[number],
            Unknown.LENS,
            Unknown.PITCH,
            Unknown.HEIGHT,
            Unknown.TILT,
            seen.ankles[number],
        )
        return Jacobian(columns, slopes * (residual < 0.0)[:, None] if self.is_carried else slopes)

    def robust(self, residual: Array) -> Flags:
        """Tell which residuals are robust: those of people above the floor."""
        return residual > 0


def _up_tilted(scene: PlacedPeople) -> Array:
    return up_axis(scene.x[Unknown.PITCH]) + np.array([0.0, 0.0, scene.x[Unknown.TILT]])


def _bearing_m(person: SeenPerson) -> Array:
    """Return the height of each joint (14,) over the floor when it bears the person."""
    bearing = np.array(person.radii_m)
    bearing[ANKLES] = _ANKLE_HEIGHT * person.stature_m
    return bearing
