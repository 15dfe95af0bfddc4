"""The likelihood by the mean distance of the joints in the image (Yin et al. 2018, Fig. 9)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.compiled import compiled
from pasdedeux.interaction.dissimilarity import align_plane
from pasdedeux.sampling.densities.aligned import AlignedLikelihood, align_lanes
from pasdedeux.sampling.densities.density import Density


class CartesianLikelihood(AlignedLikelihood):
    """The mean distance of the joints of both people, metres."""

    def dissimilarity(self, image_m: Array, annotations_m: Array) -> Array:
        """Return the mean joint distance of an image (n, 2) to annotations (k, n, 2) after the best turn, (k,)."""
        moved = align_plane(np.broadcast_to(image_m, annotations_m.shape), annotations_m)
        return np.asarray(np.linalg.norm(moved - annotations_m, axis=-1).mean(axis=-1))

    def _search(self, images_m: Array, limit: float, margin: float) -> tuple[Array, npt.NDArray[np.int64]]:
        best, slot = np.full(len(images_m), np.inf), np.full(len(images_m), -1, dtype=np.int64)
        lower_cartesian(images_m, self._counts, self._slots, self._lanes, limit, margin, best, slot)
        return best, slot


CARTESIAN = Density("cartesian", "mean joint distance of the images", CartesianLikelihood, reads_annotations=True)
"""A density for comparison with the published one: joint by joint."""


@compiled()
def lower_cartesian(images, counts, slots, lanes, limit, margin, best, best_slot):  # type: ignore[no-untyped-def]
    """Write the least mean joint distance of each view that can matter, and the slot that has it.

    Args:
        images: Centred images (m, 2, n), metres.
        counts: Candidates of each view, (m,).
        slots: Annotation of each candidate, (m, most).
        lanes: Centred candidates (m, n, 2, most), metres.
        limit: Distance above which nothing matters unless a smaller one is found, metres.
        margin: How far behind the best view another still matters, metres.
        best: Least distances (m,), inf before; changed in place.
        best_slot: Annotations that have them, (m,); changed in place.
    """
    num_points = images.shape[2]
    cosine, sine, total = np.empty(slots.shape[1]), np.empty(slots.shape[1]), np.empty(slots.shape[1])
    overall = limit
    for view in range(images.shape[0]):
        x, y, count = images[view, 0], images[view, 1], counts[view]
        align_lanes(x, y, lanes[view], count, cosine, sine)
        total[:] = 0.0
        for k in range(num_points):
            px, py = lanes[view, k, 0], lanes[view, k, 1]
            for c in range(count):
                dx = cosine[c] * x[k] - sine[c] * y[k] - px[c]
                dy = sine[c] * x[k] + cosine[c] * y[k] - py[c]
                total[c] += np.sqrt(dx * dx + dy * dy)
        for c in range(count):
            mean = total[c] / num_points
            if mean <= overall + margin and mean < best[view]:
                best[view], best_slot[view] = mean, slots[view, c]
        overall = min(overall, best[view])
