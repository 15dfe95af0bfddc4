"""Dissimilarities between pairs, plain: the oracles of the streaming forms."""

from __future__ import annotations

import numpy as np

from pasdedeux.interaction.shape_context import NUM_BANDS, NUM_SECTORS, NUM_SHELLS, shape_bins


def pair_shape_dissimilarity(first_m: np.ndarray, second_m: np.ndarray) -> np.ndarray:
    """Return D_S (*batch,) between pairs (*batch, 2, 17, 3): the mean chi-squared cost of all joints' histograms."""
    ids = np.arange(NUM_SHELLS * NUM_SECTORS * NUM_BANDS)
    one, two = ((shape_bins(pairs)[..., None] == ids).mean(axis=-2) for pairs in (first_m, second_m))
    total = one + two
    return (0.5 * np.sum((one - two) ** 2 / np.where(total > 0.0, total, 1.0), axis=-1)).mean(axis=-1)
