"""Contacts in the energy: two points keep the distance of their surfaces, and a little of their direction.

When bodies of other sizes touch, points can stay as far apart as they were though their vectors must turn: a hug of a
smaller body has the same distances in other directions.  With z the vector of a contact, v the source's, stretched to
the wanted length D, and k the share of the direction,

    k |z - v|^2 + (1 - k) (|z| - D)^2 = min over unit vectors u of |z - (k v + (1 - k) D u)|^2 + const,

so the bulk solver takes u from where the contact points now; z is linear in the positions, and the matrix is fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.fitting import Term
from pasdedeux.fitting.terms import Normal
from pasdedeux.interaction.contacts import Contacts

__all__ = ["ContactTerm", "aim_contacts"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]
Indices = npt.NDArray[np.int64]

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
        """Add half the Gauss-Newton curvature, which leaves out the distance's own bending."""
        units, _ = self._units(positions_m)
        normal.stencils.append((self.contacts.points, self.contacts.shares, self.weights, units))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def aim_contacts(
    offsets: AnyFloat,
    reference: AnyFloat,
    points: Indices,
    shares: AnyFloat,
    vectors: AnyFloat,
    weights: AnyFloat,
    direction: AnyFloat,
    aim: AnyFloat,
) -> None:
    """Leave k v + (1 - k) D u less r's vector in `aim` (3, T, M, variant), u where each contact points now.

    Args:
        offsets: x (3, T, n, variant).
        reference: r's vectors (3, T, M, variant).
        points: Ends of the bones (T, M, 4).
        shares: What they contribute (T, M, 4).
        vectors: v (3, T, M, variant).
        weights: 0 for places that are not used (T, M).
        direction: k (T, M).
        aim: Written here.
    """
    frames, num_contacts, count = aim.shape[1:]
    squared, wanted = np.empty(count, aim.dtype), np.empty(count, aim.dtype)
    smallest, one_whole = aim.dtype.type(_SHORTEST_M), aim.dtype.type(1.0)
    for t in range(frames):
        for e in range(num_contacts):
            if weights[t, e] <= 0:
                continue
            keep = direction[t, e]
            free = one_whole - keep
            a, b, c, d = points[t, e, 0], points[t, e, 1], points[t, e, 2], points[t, e, 3]
            sa, sb, sc, sd = shares[t, e, 0], shares[t, e, 1], shares[t, e, 2], shares[t, e, 3]
            squared[:] = 0
            wanted[:] = 0
            for axis in range(3):
                given, kept, aims = reference[axis, t, e], vectors[axis, t, e], aim[axis, t, e]
                one, two = offsets[axis, t, a], offsets[axis, t, b]
                three, four = offsets[axis, t, c], offsets[axis, t, d]
                for v in range(count):
                    aims[v] = ((sa * one[v] + sb * two[v]) + (sc * three[v] + sd * four[v])) + given[v]
                for v in range(count):
                    squared[v] += aims[v] * aims[v]
                for v in range(count):
                    wanted[v] += kept[v] * kept[v]
            for v in range(count):
                wanted[v] = free * np.sqrt(wanted[v]) / max(np.sqrt(squared[v]), smallest)
            for axis in range(3):
                given, kept, aims = reference[axis, t, e], vectors[axis, t, e], aim[axis, t, e]
                for v in range(count):
                    aims[v] = (keep * kept[v] + wanted[v] * aims[v]) - given[v]
