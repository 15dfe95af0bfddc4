"""Cost of retrieval compared with brute force, and agreement of the results: `pasdedeux bench lifting`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.benchmark import BenchmarkResult, in_turn, measure_rate
from benchmarks.synthetic import random_pairs
from pasdedeux.cameras.frames import project_pair
from pasdedeux.completion.draw_index import DrawIndex, NearestDraws
from pasdedeux.interaction.dissimilarity import plane_residual
from pasdedeux.kinematics.rotations import normalise

NUM_DRAWS, NUM_PLACES = 100_000, 4_000


def retrieval_problem() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return draws (n, 2, 17, 3) as chains leave them, close together round many places, images of others, and views.

    The images (64, 2, 17, 2) are of pairs that are no draws, with 2 cm of noise.
    """
    rng = np.random.default_rng(1)
    places = random_pairs(rng, NUM_PLACES, spread_rad=0.3)
    first, other, start = (places[rng.integers(NUM_PLACES, size=NUM_DRAWS)] for _ in range(3))
    draws = start + 0.1 * (first - other)
    views = normalise(rng.normal(size=(64, 3)) * [1.0, 0.2, 1.0])
    images = project_pair(random_pairs(rng, 64, spread_rad=0.3), views) + rng.normal(scale=0.02, size=(64, 2, 17, 2))
    return draws, images, views


def plain_nearest(pairs_m: np.ndarray, image_m: np.ndarray, directions: np.ndarray, *, count: int = 1) -> NearestDraws:
    """Return the nearest draws by brute force over draws and views: the oracle of `DrawIndex.nearest`."""
    is_seen = np.isfinite(image_m).all(axis=-1).ravel()
    image = image_m.reshape(-1, 2)[is_seen]
    squared = np.stack(
        [
            plane_residual(project_pair(pairs_m, view).reshape(len(pairs_m), -1, 2)[:, is_seen], image)
            for view in directions
        ],
        axis=1,
    )
    best = squared.min(axis=1)
    order = np.lexsort((np.arange(len(best)), best))[:count]
    return NearestDraws(
        draw=order.astype(np.int64),
        view=np.argmin(squared[order], axis=1).astype(np.int64),
        distance_m=np.sqrt(best[order] / is_seen.sum()),
    )


def _retrieval(count: int) -> BenchmarkResult:
    draws, images, views = retrieval_problem()
    index = DrawIndex(draws)

    def fast(at: int) -> NearestDraws:
        return index.nearest(images[at], views[at : at + 1], count=count)

    def plain(at: int) -> NearestDraws:
        return plain_nearest(draws, images[at], views[at : at + 1], count=count)

    num_same = sum(np.array_equal(fast(at).draw, plain(at).draw) for at in range(8))
    rate = measure_rate("index", in_turn(fast, range(len(images))))
    return BenchmarkResult(
        f"retrieval of {count}",
        "annotations",
        *rate,
        *measure_rate("numpy over all draws", in_turn(plain, range(len(images)))),
        f"{NUM_DRAWS:,} draws, one view, {1e3 / rate.per_s:.1f} ms each; same answers: {num_same} of 8",
    )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    f"retrieval of {count}": partial(_retrieval, count) for count in (1, 8)
}
