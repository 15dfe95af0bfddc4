"""The depth between the two people of a couple, by pairs of a database that look like both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.reconstruction.couples import PairDepth
from pasdedeux.reconstruction.terms.placed import By, PlacedPeople, SeenPeople, Unknown, beside
from pasdedeux.reconstruction.terms.term import Jacobian, SceneTerm

_SIGNS = np.array([-1.0, 1.0])[:, None, None]


@dataclass(frozen=True)
class PairTerm(SceneTerm):
    """(nearer / size - depth) / deviation: how much nearer the second is along the ray to the middle of both.

    The size is the geometric mean of both, because pairs were searched at the initial size.  The database holds certain
    couples: where its pairs are wrong, they are wrong all the time.

    Args:
        pair: The depth by pairs of a database.
    """

    pair: PairDepth
    is_robust = True
    is_certain = False
    alike_s = 0.5

    def residual(self, scene: PlacedPeople) -> Array:
        """Return the residuals (frame with pairs,)."""
        roots, towards = self._roots(scene)
        nearer = (_SIGNS * roots[:, 0] * towards).sum(axis=(0, 2))
        wanted = (self.pair.depth_m / self.pair.deviation_m)[self._known]
        return np.asarray(nearer / self._unit(scene) - wanted)

    def jacobian(self, scene: PlacedPeople) -> Jacobian:
        """Return their derivatives."""
        unit, (roots, towards) = self._unit(scene), self._roots(scene)
        middle, across = roots[:, 0].sum(axis=0), roots[1, 0] - roots[0, 0]
        nearer = (across * towards).sum(axis=-1)
        turned = (across - nearer[:, None] * towards) / np.linalg.norm(middle, axis=-1, keepdims=True)
        moved = (roots * (_SIGNS * towards - turned)[:, None]).sum(axis=-1) / unit
        grown = -0.5 * nearer / unit
        slopes = beside(*moved[:, By.DISTANCE], grown, grown, moved[:, By.LENS].sum(axis=0))
        seen, people = scene.seen, list(self.pair.people)
        distances = seen.starts[people][:, None] + self._at(seen)
        return Jacobian(beside(*distances, *seen.sizes[people], Unknown.LENS), slopes)

    @property
    def _known(self) -> Integers:
        return np.flatnonzero(np.isfinite(self.pair.deviation_m))

    def _at(self, seen: SeenPeople) -> Integers:
        """Return the frames with pairs, counted from the first of each person (person=2, frame with pairs)."""
        frames = self.pair.frames[self._known]
        return np.stack([frames - seen.people[number].track.track.first_frame for number in self.pair.people])

    def _roots(self, scene: PlacedPeople) -> tuple[Array, Array]:
        """Return mid-hips and derivatives (person=2, 4, frame with pairs, 3), and the direction from their middle."""
        sides = zip(self.pair.people, self._at(scene.seen), strict=True)
        roots = np.stack([scene.joints[number][:, rows, -1] for number, rows in sides])
        middle = roots[:, 0].sum(axis=0)
        return roots, -middle / np.linalg.norm(middle, axis=-1, keepdims=True)

    def _unit(self, scene: PlacedPeople) -> Array:
        size = np.sqrt(scene.sizes[list(self.pair.people)].prod())
        return np.asarray(size * self.pair.deviation_m[self._known])
