"""Paths are smooth in depth, and a foot that stands does not move in depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.reconstruction.terms.floor import heights_m
from pasdedeux.reconstruction.terms.placed import ANKLES, By, PlacedPeople, Unknown, beside
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm


@dataclass(frozen=True)
class PathTerm(SceneTerm):
    """(d(t) - 2 d(t+1) + d(t+2)) rate^2 / deviation of the distance d over the size.

    Args:
        person: Number of the person, in three frames at least.
        deviation_m_s2: Standard deviation of the acceleration along the ray.
    """

    person: int
    deviation_m_s2: float = 8.0

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (frame - 2,)."""
        return np.diff(self._distance(scene), n=2)

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        at, distance = scene.seen.distances(self.person), self._distance(scene)
        slopes = beside(distance[:-2], -2.0 * distance[1:-1], distance[2:], -np.diff(distance, n=2))
        return Jacobian(beside(at[:-2], at[1:-1], at[2:], scene.seen.sizes[self.person]), slopes)

    def _distance(self, scene: PlacedPeople) -> Array:
        """Return the distance over the size (frame,), in deviations."""
        seen, x = scene.seen, scene.x
        factor = np.exp(x[seen.distances(self.person)] - x[seen.sizes[self.person]])
        return np.asarray(seen.people[self.person].distance_m * factor * seen.rate_hz**2 / self.deviation_m_s2)


@dataclass(frozen=True)
class StanceTerm(SceneTerm):
    """still * (z(t+1) - z(t)) rate / (size * deviation) of the lower ankle, whose depth is z.

    Args:
        person: Number of the person, in three frames at least.
        deviation_m_s: Standard deviation of the speed in depth of a foot that stands.
        still_m_s: Speed across the image below which feet stand.
    """

    person: int
    deviation_m_s: float = 0.3
    still_m_s: float = 0.3
    is_robust = True
    alike_s = 0.7

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (frame - 1,)."""
        before, after = self._depths(scene)
        return np.asarray(after[0] - before[0])

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        at, (before, after) = scene.seen.distances(self.person), self._depths(scene)
        step = after - before
        slopes = beside(-before[By.DISTANCE], after[By.DISTANCE], step[By.SIZE] - step[0], step[By.LENS])
        return Jacobian(beside(at[:-1], at[1:], scene.seen.sizes[self.person], Unknown.LENS), slopes)

    def _depths(self, scene: PlacedPeople) -> tuple[Array, Array]:
        """Return the depth of the lower ankle before and after each step, and its derivatives (4, frame - 1)."""
        joints, still = scene.joints[self.person], self._stillness(scene)
        still = np.sqrt(np.minimum(still[1:], still[:-1]))
        lower = np.argmin(heights_m(scene, self.person)[1:, ANKLES], axis=1)
        steps = np.arange(len(lower))
        unit = still[steps, lower] * scene.seen.rate_hz / (scene.sizes[self.person] * self.deviation_m_s)
        before, after = (joints[:, steps + late, ANKLES[lower], 2] * unit for late in (0, 1))
        return before, after

    def _stillness(self, scene: PlacedPeople) -> Array:
        """Return how surely each foot stands (frame, foot), 0 to 1, by its speed across the image."""
        track = scene.seen.people[self.person].track
        speed = np.linalg.norm(np.gradient(track.positions_m[:, ANKLES, :2], axis=0), axis=-1) * scene.seen.rate_hz
        return np.where(track.is_bridged[:, None], 0.0, 1.0 / (1.0 + (speed / self.still_m_s) ** 4))
