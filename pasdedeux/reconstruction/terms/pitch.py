"""The pitch of the camera, by the image of people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.terms.placed import PlacedPeople, Unknown, by_lens, rays_through, up_axis, up_axis_slope
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm

_GIVEN_RAD = 1e-3
"""Standard deviation of a pitch that was stated."""


@dataclass(frozen=True)
class PitchTerm(SceneTerm):
    """(mean over frames of arcsin(-ray . up) - pitch) / deviation: the downward angle of rays to people.

    For a stated pitch, it is (x - pitch) / deviation.

    Args:
        pitch: Estimate of the pitch from the image.
    """

    pitch: PitchEstimate

    def off_rad(self, scene: PlacedPeople) -> float:
        """Return how much farther down rays to people (for a stated pitch, the camera) look than the estimate."""
        if self.pitch.is_given:
            return float(scene.x[Unknown.PITCH] - self.pitch.pitch_rad)
        return float(np.arcsin(self._down(scene, self._rays(scene))).mean() - self.pitch.pitch_rad)

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residual (1,)."""
        return np.array([self.off_rad(scene) / self._deviation_rad])

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return its derivatives."""
        columns = np.array([[Unknown.PITCH, Unknown.LENS]])
        if self.pitch.is_given:
            return Jacobian(columns, np.array([[1.0, 0.0]]) / self._deviation_rad)
        rays = self._rays(scene)
        per_down = 1.0 / np.sqrt(np.maximum(1.0 - self._down(scene, rays) ** 2, 1e-12))
        slopes = -rays @ up_axis_slope(scene.x[Unknown.PITCH]), -by_lens(rays) @ up_axis(scene.x[Unknown.PITCH])
        return Jacobian(columns, np.array([[(per_down * slope).mean() for slope in slopes]]) / self._deviation_rad)

    @property
    def _deviation_rad(self) -> float:
        return self.pitch.deviation_rad or _GIVEN_RAD

    def _rays(self, scene: PlacedPeople) -> Array:
        plane = np.concatenate([person.plane[person.shown] for person in scene.seen.people])
        return rays_through(plane, float(np.exp(scene.x[Unknown.LENS])))

    def _down(self, scene: PlacedPeople, rays: Array) -> Array:
        return np.clip(-rays @ up_axis(scene.x[Unknown.PITCH]), -1.0, 1.0)
