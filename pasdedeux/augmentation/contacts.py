"""Contacts in the energy: two points keep the distance of their surfaces, and a little of their direction.

When bodies of other sizes touch, points can keep their distance although their vectors must turn: a hug of a smaller
body has the same distances in other directions.  With z the vector of a contact, v the source's, stretched to the
wanted length D, and k the share of the direction,

    k |z - v|^2 + (1 - k) (|z| - D)^2 = min over unit vectors u of |z - (k v + (1 - k) D u)|^2 + const,

so the bulk solver takes u from where the contact points now; z is linear in the positions, and the matrix is fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.fitting.terms import Normal, Term
from pasdedeux.interaction.contacts import Contacts

_SHORTEST_M = 1e-6


@dataclass(frozen=True)
class ContactTerm(Term):
    """sum w (|z| - D)^2 over the contacts of each frame.

    Args:
        contacts: The points.
        weights: w (T, M).
        lengths_m: D (T, M).
    """

    contacts: Contacts
    weights: Array
    lengths_m: Array

    is_quadratic = False

    def _units(self, positions_m: Array) -> tuple[Array, Array]:
        vectors = self.contacts.vectors(positions_m)
        lengths = np.linalg.norm(vectors, axis=-1)
        return vectors / np.maximum(lengths, _SHORTEST_M)[..., None], lengths

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        _, lengths = self._units(positions_m)
        return float((self.weights * (lengths - self.lengths_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        units, lengths = self._units(positions_m)
        normal.gradient += self.contacts.spread(
            (self.weights * (lengths - self.lengths_m))[..., None] * units, positions_m.shape[1]
        )

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the Gauss-Newton curvature, without the second derivative of the distance."""
        units, _ = self._units(positions_m)
        normal.stencils.append((self.contacts.points, self.contacts.shares, self.weights, units))
