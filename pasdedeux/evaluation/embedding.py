"""The space of pairs as a picture: draws among real pairs, and annotations (Yin et al. 2018, Figs. 8 and 5b).

Classical scaling of the real pairs under D_I, or of images under d_I; others are placed among them by their
dissimilarities to those (de Silva and Tenenbaum 2004, "Sparse multidimensional scaling using landmark points"), so more
of them never move the map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.evaluation.figures import figure_svg, new_figure
from pasdedeux.evaluation.names import in_words
from pasdedeux.interaction.nearest import image_distances, interaction_distances
from pasdedeux.sampling.densities.density import PRIOR_ONLY

_MARKERS = ("^", "s", "X", "D", "v")


@dataclass(frozen=True)
class PairMap:
    """A plane on which real pairs, or images, lie as far apart as D_I says, as far as a plane can.

    Args:
        landmarks_m: The real pairs, (n, person=2, joint, 3), or images, (n, person=2, joint, 2), metres.
        places: Where they lie, (n, 2), metres.
        share: Share of the positive eigenvalues that the plane shows.
    """

    landmarks_m: Array
    places: Array
    share: float
    _mean_squares: Array
    _inverse: Array

    @classmethod
    def of(cls, pairs_m: Array) -> PairMap:
        """Lay out real pairs (n, person=2, joint, 3), or images (..., 2), metres, at least three that differ.

        Raises:
            InputError: There are fewer than three, or all are the same.
        """
        if len(pairs_m) < 3:
            raise InputError(f"a map needs at least 3 pairs, found {len(pairs_m)}")
        squared = _distances(pairs_m, pairs_m) ** 2
        squared = 0.5 * (squared + squared.T)
        np.fill_diagonal(squared, 0.0)
        mean = squared.mean(axis=0)
        values, vectors = np.linalg.eigh(-0.5 * (squared - mean - mean[:, None] + squared.mean()))
        largest = values[::-1][:2]
        if largest[1] <= 1e-12:
            raise InputError("a map needs pairs that differ in more than one way")
        axes = vectors[:, ::-1][:, :2]
        # The sign of an eigenvector is anyone's: the largest entry is made positive.
        axes = axes * np.sign(axes[np.argmax(np.abs(axes), axis=0), [0, 1]])
        root = np.sqrt(largest)
        return cls(
            landmarks_m=pairs_m,
            places=axes * root,
            share=float(largest.sum() / values[values > 0].sum()),
            _mean_squares=mean,
            _inverse=(axes / root).T,
        )

    def place(self, pairs_m: Array) -> Array:
        """Return where other pairs (m, person=2, joint, 3 or 2) lie, (m, 2), metres."""
        if not len(pairs_m):
            return np.empty((0, 2))
        squared = _distances(pairs_m, self.landmarks_m) ** 2
        return np.asarray(-0.5 * (squared - self._mean_squares) @ self._inverse.T)


def _distances(first_m: Array, second_m: Array) -> Array:
    return (image_distances if first_m.shape[-1] == 2 else interaction_distances)(first_m, second_m)


def map_figure(real: Array, panels: Mapping[str, Mapping[str, Array]], *, seed: Array | None, title: str) -> bytes:
    """Draw sets of draws over the real pairs, a panel for each; give SVG bytes.

    Args:
        real: Places of the real pairs (n, 2).
        panels: For each panel, by its title, the places of sets of draws by their name.
        seed: Place of the seed (2,), drawn as a cross; none where it is not known.
        title: Title of the picture.
    """
    colours = {"ic": "#c2188f", PRIOR_ONLY: "#2a9d3a", "grown_seeds": "#e0861a"}
    points: dict[str, Any] = {"linewidths": 0, "rasterized": True}
    columns = max(len(panels), 1)
    figure, ((*axes,),) = new_figure(2.9 * columns, 2.9, columns=columns, has_common_axes=True)
    for axis, (name, sets) in zip(axes, panels.items(), strict=False):
        axis.scatter(100 * real[:, 0], 100 * real[:, 1], s=5, color="#3a6fd8", label="real", zorder=3, **points)
        for number, (method, places) in enumerate(sets.items()):
            colour = colours.get(method, f"C{number + 4}")
            marker = _MARKERS[number % len(_MARKERS)]  # who does not see colours sees these
            axis.scatter(*(100 * places.T), s=7, color=colour, marker=marker, label=in_words(method), **points)
        if seed is not None:
            axis.plot(100 * seed[0], 100 * seed[1], "kx", markersize=7, zorder=4)
        axis.set_title(name, fontsize=8)
        axis.tick_params(labelsize=6)
        axis.set_aspect("equal")
    width, height = (float(np.ptp(limits)) for limits in (axes[0].get_xlim(), axes[0].get_ylim()))
    figure.set_figheight(float(np.clip(0.9 + 2.4 * height / width, 1.8, 4.5)))  # equal axes leave the rest white
    axes[0].legend(fontsize=6)
    return figure_svg(figure, title=title)
