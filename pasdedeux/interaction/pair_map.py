"""The space of pairs as a picture: draws among real pairs, and annotations (Yin et al. 2018, Figs. 8 and 5b).

Classical scaling of the real pairs under D_I, or of images under d_I; others are placed by their dissimilarities to
these (de Silva and Tenenbaum 2004, "Sparse multidimensional scaling using landmark points"), so more of them never move
the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.interaction.nearest import PairTable, image_distances, interaction_distances, pair_table


@dataclass(frozen=True)
class PairMap:
    """A plane map of real pairs or images that best preserves the distances D_I.

    Args:
        landmarks_m: The real pairs, prepared, or images, (n, person=2, joint, 2), metres.
        places: Their places, (n, 2), metres.
        share: Share of the positive eigenvalues that the plane shows.
    """

    landmarks_m: Array | PairTable
    places: Array
    share: float
    _mean_squares: Array
    _inverse: Array

    @classmethod
    def of(cls, pairs_m: Array) -> PairMap:
        """Lay out real pairs (n, person=2, joint, 3), or images (..., 2), metres, at least three that differ."""
        if len(pairs_m) < 3:
            raise InputError(f"a map needs at least 3 pairs, found {len(pairs_m)}")
        landmarks = pairs_m if pairs_m.shape[-1] == 2 else pair_table(pairs_m)
        squared = _distances(landmarks, landmarks) ** 2
        squared = 0.5 * (squared + squared.T)
        np.fill_diagonal(squared, 0.0)
        mean = squared.mean(axis=0)
        values, vectors = np.linalg.eigh(-0.5 * (squared - mean - mean[:, None] + squared.mean()))
        largest = values[::-1][:2]
        if largest[1] <= 1e-12:
            raise InputError("a map needs pairs that differ in more than one way")
        axes = vectors[:, ::-1][:, :2]
        # The sign of an eigenvector is arbitrary: make the largest entry positive.
        axes = axes * np.sign(axes[np.argmax(np.abs(axes), axis=0), [0, 1]])
        root = np.sqrt(largest)
        return cls(
            landmarks_m=landmarks,
            places=axes * root,
            share=float(largest.sum() / values[values > 0].sum()),
            _mean_squares=mean,
            _inverse=(axes / root).T,
        )

    def place(self, pairs_m: Array | PairTable) -> Array:
        """Return the places (m, 2), metres, of other pairs (m, person=2, joint, 3 or 2); 3D pairs may be prepared."""
        if not isinstance(pairs_m, PairTable) and not len(pairs_m):
            return np.empty((0, 2))
        squared = _distances(pairs_m, self.landmarks_m) ** 2
        return np.asarray(-0.5 * (squared - self._mean_squares) @ self._inverse.T)


def _distances(first_m: Array | PairTable, second_m: Array | PairTable) -> Array:
    if isinstance(first_m, PairTable) or isinstance(second_m, PairTable):
        return interaction_distances(first_m, second_m)
    return image_distances(first_m, second_m)
