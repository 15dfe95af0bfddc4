"""The likelihood of a 3D pair given 2D annotations: interaction coordinates under a fixed bank of views.

Yin et al. 2018, eqs. 6 and 9: the mean over m views of the greatest, over annotations with a similar view, of
exp(-d_I / (2 sigma_l^2)).  With a bandwidth this sharp that is the best view alone, and from one view a pair may have
any depth; so by default the logarithms are averaged, not the likelihoods: a pair must look like annotations from every
view (`Pooling`).  The views are drawn once per seed from the view density and then stay: the target is one
fixed function.  An annotation that lacks joints is compared over those that it shows (`interaction_dissimilarity`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.cameras.frames import project_pair
from pasdedeux.interaction.dissimilarity import align_plane, plane_residual
from pasdedeux.interaction.kernels import EdgeTable, edge_table
from pasdedeux.interaction.nearest import image_distances
from pasdedeux.interaction.triangulation import jitter
from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs, ViewBank
from pasdedeux.sampling.bandwidth import PUBLISHED_SIGMA_L
from pasdedeux.sampling.densities.annotated import AnnotationSettings, Pooling
from pasdedeux.sampling.densities.density import Density, Likelihood, Nearest
from pasdedeux.sampling.densities.interaction_kernels import BankTables, best_per_view

_NUM_SPRUNG = 160
"""Annotations, evenly spread, whose nearest neighbours give the typical change of each edge."""


class InteractionLikelihood(Likelihood):
    """The likelihood of eqs. 6 and 9 over a fixed bank, as a compiled kernel.

    For each view every candidate's d_I is estimated from springs (`_springs`); only candidates that may be the best by
    this estimate are compared over the annotation's edges, then over the pair's own, while it matters.  Views far
    behind the best one contribute less than rounding errors and are skipped, mostly before any triangulation.

    Args:
        pairs: Annotated pairs.
        bank: Views and their candidates.
        sigma_l: Bandwidth; 2 sigma_l^2 is in metres (the paper divides d_I, not its square).
        pooling: How the views are pooled.
    """

    sigma_l: float

    def __init__(
        self,
        pairs: AnnotatedPairs,
        bank: ViewBank,
        *,
        sigma_l: float = PUBLISHED_SIGMA_L,
        pooling: Pooling = Pooling.MEAN,
    ) -> None:
        self._pairs, self._bank, self.sigma_l = pairs, bank, sigma_l
        self.directions, self._pooling = bank.directions, pooling
        # Only the entries that some view may meet are kept.
        used = np.unique(bank.candidates[bank.candidates >= 0])
        self._used = used
        is_seen = merge_axes(pairs.is_seen[used], 1)
        points = np.ascontiguousarray(pairs.centred_m[used])
        table: EdgeTable = edge_table(merge_axes(pairs.points_m[used], 1, -1))
        slots = np.searchsorted(used, np.maximum(bank.candidates, used[0])).astype(np.int32)
        springs, factors = _springs(points, is_seen, table, slots, bank.counts)
        # Tables of the estimate, a candidate per lane: (view, joint, candidate).
        met = points[slots]
        squares = [
            [((form @ candidates) * candidates).sum(axis=(1, 2)) for form in forms]
            for forms, candidates in zip(springs, met, strict=True)
        ]
        unit = np.float32(max(float(np.abs(points).max()), 1e-6) / np.iinfo(np.int16).max)
        lanes = np.rint(np.moveaxis(met, (1, 2), (2, 1)) / unit).astype(np.int16)
        self._tables = BankTables(
            directions=np.ascontiguousarray(bank.directions),
            counts=bank.counts,
            slots=slots,
            springs=springs.astype(np.float32),
            unit=unit,
            rank_x=np.ascontiguousarray(lanes[..., 0]),
            rank_y=np.ascontiguousarray(lanes[..., 1]),
            rank_squares=np.array(squares, dtype=np.float32),
            factors=factors,
            points=points,
            edges=table.edges,
            weights=table.weights,
            num_edges=table.counts,
            rough_points=np.ascontiguousarray(np.moveaxis(points, 2, 1), dtype=np.float32),
            rough_starts=np.ascontiguousarray(table.edges[..., 0], dtype=np.uint8),
            rough_ends=np.ascontiguousarray(table.edges[..., 1], dtype=np.uint8),
            rough_weights=table.weights.astype(np.float32),
            is_seen=is_seen,
            is_whole=np.asarray(is_seen.all(axis=1)),
            has_partial=not bool(is_seen.all()),
            offsets=jitter(points.shape[1]),
            scale=2.0 * sigma_l**2,
            is_every=pooling is Pooling.EVERY_VIEW,
        )
        # Views this far behind the best add less than 1e-14 of the sum together.
        self._margin = self._tables.scale * float(np.log(len(bank.directions) * 1e14))
        self._searched_m: Array | None = None
        self._best = np.empty(len(bank.directions))
        self._slot = np.empty(len(bank.directions), dtype=np.int64)

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Return the log of eq. 6 for a pair (2, 17, 3), metres; -inf once it is known to be below `at_least`."""
        # The mean over views is at most the best view: it alone must reach the floor.
        limit = np.inf if at_least == -np.inf else -at_least * self._tables.scale
        if self._pooling is Pooling.EVERY_VIEW:
            limit *= len(self.directions)
        value = self._search(pair_m, limit, self._margin)
        # If every view counts, a finished search has covered all: `nearest` need not repeat it.
        self._searched_m = pair_m.copy() if self._pooling is Pooling.EVERY_VIEW and value > -np.inf else None
        return value if value >= at_least else -np.inf

    def plain(self, pair_m: Array) -> float:
        """Return the same from d_I of all candidates of every view."""
        return self._pooling.log_of(self.plain_nearest(pair_m).dissimilarity_m, self.sigma_l)

    def plain_nearest(self, pair_m: Array) -> Nearest:
        """Return what `nearest` does from d_I of all candidates."""
        images, bank = project_pair(pair_m, self.directions), self._bank
        entry, least = np.full(len(images), -1, dtype=np.int64), np.full(len(images), np.inf)
        for view in np.flatnonzero(bank.counts):
            candidates = bank.candidates[view, : bank.counts[view]]
            distances = image_distances(images[view, None], self._pairs.points_m[candidates])[0]
            entry[view], least[view] = candidates[distances.argmin()], distances.min()
        return Nearest(entry, least)

    def nearest(self, pair_m: Array) -> Nearest:
        """Return the entry nearest in d_I to the pair (2, 17, 3) under every view: D* of eq. 12."""
        if self._searched_m is None or not np.array_equal(self._searched_m, pair_m):
            self._search(pair_m, np.inf, np.inf)
            self._searched_m = pair_m.copy()
        return Nearest(np.where(self._slot >= 0, self._used[np.maximum(self._slot, 0)], -1), self._best.copy())

    def _search(self, pair_m: Array, limit: float, margin: float) -> float:
        """Write the least d_I of each view that can matter, and its entry; return the log likelihood."""
        points = np.ascontiguousarray(pair_m).reshape(-1, 3)
        value, _ = best_per_view(points, self._tables, limit, margin, self._best, self._slot)
        return float(value)


def _init(settings: AnnotationSettings, rng: np.random.Generator, annotated: GatheredPairs) -> InteractionLikelihood:
    bank, sigma_l = settings.bank(rng, annotated), settings.bandwidth(annotated)
    return InteractionLikelihood(annotated.pairs, bank, sigma_l=sigma_l, pooling=settings.pooling)


INTERACTION = Density("ic", "interaction coordinates", _init, reads_annotations=True)
"""The published density: interaction coordinates of the images (eqs. 6, 8 and 9)."""


def _springs(
    points: Array,
    is_seen: npt.NDArray[np.bool_],
    table: EdgeTable,
    slots: npt.NDArray[np.int32],
    counts: npt.NDArray[np.int64],
) -> tuple[Array, npt.NDArray[np.float32]]:
    """Return the springs of each view, whose roots at a difference of images estimate d_I, and the factor of each root.

    Each side of eq. 8 is a weighted mean of lengths l_e over edges that are unknown beforehand.  With w_e the mean
    weight of an edge over the candidates of a view (0 where none has it) and s_e a typical length of its difference,
    (sum w l)^2 <= (sum w s) (sum w l^2 / s) by Cauchy and Schwarz, close where lengths are as typical.  The right side
    is a quadratic form of the difference.  Edges within each person and between them have forms of their own: two
    people too far apart stretch only the latter.  A candidate's root of each kind is scaled to the weight that its own
    edges of that kind have.  The estimate is no bound, as the pair's own edges are others.  For a candidate that lacks
    joints the sums go over the edges between joints that it shows; the kernel takes the other springs out.

    Args:
        points: Centred annotations (annotation, n, 2), metres.
        is_seen: Which joints they show, (annotation, n).
        table: Their edges.
        slots: Annotation of each candidate, (m, most).
        counts: Valid candidates of each view, (m,).

    Returns:
        Forms (m, kind=3, n, n): within person A, within B, between; and factors (m, kind=3, most), float32.
    """
    num_points = points.shape[1]
    person = np.arange(num_points) >= num_points // 2
    kind_of = np.where(person[:, None] != person[None], 2, person[:, None].astype(int))
    typical, times = np.full((num_points, num_points), 1e-9), np.zeros((num_points, num_points))
    missing = np.where(is_seen[..., None], points, np.nan)
    for view, count in enumerate(counts):
        view_missing = missing[slots[view, :count]]
        spread = np.unique(np.linspace(0, max(count - 1, 0), max(_NUM_SPRUNG // len(counts), 1)).astype(int))
        for row in spread[: count if count > 1 else 0]:
            residual = plane_residual(view_missing[row], view_missing)
            residual[row] = np.inf
            nearest = view_missing[int(residual.argmin())]
            difference = align_plane(view_missing[row], nearest) - nearest
            apart = np.linalg.norm(difference[:, None] - difference[None], axis=-1)
            typical += np.nan_to_num(apart, nan=0.0)
            times += np.isfinite(apart)
    # As if all had always been seen; those never seen together get the mean of the others.
    rest = typical[times > 0].mean() if times.any() else 1.0
    typical = np.where(times > 0, typical * (times.max() / np.maximum(times, 1.0)), rest)
    forms = np.zeros((len(counts), 3, num_points, num_points))
    factors = np.zeros((len(counts), 3, slots.shape[1]), dtype=np.float32)
    for view, count in enumerate(counts):
        chosen = slots[view, :count]
        edges, own_weights = table.edges[chosen], table.weights[chosen]
        every = np.zeros((num_points, num_points))
        np.add.at(every, (edges[..., 0], edges[..., 1]), own_weights)
        seen = is_seen[chosen].astype(np.float64)
        for kind in range(3):
            weight = np.where(kind_of == kind, (every + every.T) / max(count, 1), 0.0)
            total = 0.5 * weight.sum()
            if total > 0.0:
                stiffness = weight / typical * (0.5 * (weight * typical).sum()) / total**2
                forms[view, kind] = np.diag(stiffness.sum(axis=1)) - stiffness
            of_kind = kind_of[edges[..., 0], edges[..., 1]] == kind
            factors[view, kind, :count] = 2.0 * (own_weights * of_kind).sum(axis=1)
            if not seen.all() and total > 0.0:
                left = 0.5 * ((seen @ weight) * seen).sum(axis=1)
                stretched = 0.5 * ((seen @ (weight * typical)) * seen).sum(axis=1) / (0.5 * (weight * typical).sum())
                factors[view, kind, :count] *= np.sqrt(stretched) / np.maximum(left / total, 1e-9)
    return forms, factors
