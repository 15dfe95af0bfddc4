"""The likelihood of a 3D pair given 2D annotations: interaction coordinates under a fixed bank of views.

Yin et al. 2018, eqs. 6 and 9: the mean over m views of the greatest, over annotations with a similar view, of
exp(-d_I / (2 sigma_l^2)).  The views are drawn once per seed from the view density and then stay: the target is one
fixed function.  `plain_log_likelihood` is the definition; `InteractionLikelihood` gives the same value fast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import angle_between_directions, project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import BETA_M, align_plane, edge_weights
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.kernels import EdgeTable, edge_table
from pasdedeux.interaction.triangulation import jitter
from pasdedeux.sampling.kernels import best_per_view

__all__ = [
    "AnnotatedPairs",
    "InteractionLikelihood",
    "Match",
    "ViewBank",
    "build_bank",
    "plain_log_likelihood",
]

Array = npt.NDArray[np.float64]

LEAST_CANDIDATES = 20
"""Annotations a view is compared with even when none is within the view bandwidth."""

LEAST_RATIO = 0.55
"""d_I is taken to be at least so many times what the best rotation in the plane leaves: a view that cannot matter by
that is left.  Over 4,000 views of random pairs and of salsa frames the ratio was 0.6 to 2.6, 1.7 in the median."""

OWN_SHARE = 0.75
"""Share of the best d_I that the pair's own edges are taken to account for at most: candidates beyond that are left.
Over the same views it was 0.51 in the median and 0.71 at most."""

NUM_RANKED = 192
"""Candidates of a view that are compared in full.  With 32 the best was missed in 6 % of random pairs among 8,000
annotations and in 1 % of salsa frames among 600; with 192 in none of 1,200 evaluations."""


@dataclass(frozen=True)
class AnnotatedPairs:
    """Annotated pairs in metres with the views they are seen under; an annotation may come with several views.

    Args:
        points_m: Image points (entry, person=2, joint=17, 2), metres, x right, y up; all finite.
        directions: View of each entry in the pair's local frame, unit (a, b, c), (entry, 3).
        annotation_index: Which annotation an entry is a view hypothesis of, (entry,).

    Raises:
        InputError: No entry, shapes that do not fit, or a value that is not finite.
    """

    points_m: Array
    directions: Array
    annotation_index: npt.NDArray[np.int64]

    def __post_init__(self) -> None:
        """Check shapes and finiteness."""
        count = len(self.points_m)
        if count == 0:
            raise InputError("no annotated pair is left: the likelihood needs at least one with all joints and a view")
        if self.points_m.shape != (count, 2, 17, 2) or self.directions.shape != (count, 3):
            raise InputError(
                f"annotations {self.points_m.shape} and views {self.directions.shape} do not fit: "
                "expected (entry, 2, 17, 2) and (entry, 3)"
            )
        if len(self.annotation_index) != count:
            raise InputError(f"{count} annotated pairs but {len(self.annotation_index)} annotation indices")
        if not (np.isfinite(self.points_m).all() and np.isfinite(self.directions).all()):
            raise InputError("an annotated pair or its view has a value that is not finite")


@dataclass(frozen=True)
class ViewBank:
    """The fixed views of one seed and the entries each is compared with.

    Args:
        directions: Views (m, 3) in the pair's local frame.
        candidates: Entries compared with each view, nearest view first, (m, most); -1 beyond the valid ones.
        counts: Number of valid candidates of each view, (m,).
    """

    directions: Array
    candidates: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Match:
    """How well a pair agrees with the annotations.

    Args:
        log_likelihood: Log of eq. 6, -inf when it was found to lie below the floor asked for.
        dissimilarity_m: Least d_I of each view, (m,), metres; inf where it cannot matter to the result.
        entry: Entry that reached it, (m,); -1 where none did.
    """

    log_likelihood: float
    dissimilarity_m: Array
    entry: npt.NDArray[np.int64]


def build_bank(
    directions: Array, pairs: AnnotatedPairs, *, num_candidates: int = 500, view_bandwidth_rad: float = 0.5
) -> ViewBank:
    """Give the bank of views (m, 3): each with the nearest `num_candidates` annotations by view.

    An annotation enters a view once, by its nearest hypothesis.  Annotations farther than the bandwidth are dropped as
    long as 20 stay.

    Raises:
        InputError: There is no view or `num_candidates` is not positive.
    """
    if len(directions) == 0 or num_candidates < 1:
        raise InputError(f"a bank needs views and candidates, found {len(directions)} and {num_candidates}")
    chosen: list[npt.NDArray[np.int64]] = []
    for direction in directions:
        angle = angle_between_directions(direction, pairs.directions)
        order = np.argsort(angle, kind="stable")
        _, first = np.unique(pairs.annotation_index[order], return_index=True)
        order = order[np.sort(first)][:num_candidates]
        num_similar = int(np.searchsorted(angle[order], view_bandwidth_rad, side="right"))
        chosen.append(order[: max(num_similar, LEAST_CANDIDATES)])
    most = max(len(own) for own in chosen)
    candidates = np.full((len(directions), most), -1, dtype=np.int64)
    for row, own in enumerate(chosen):
        candidates[row, : len(own)] = own
    return ViewBank(
        directions=np.asarray(directions, dtype=np.float64),
        candidates=candidates,
        counts=np.array([len(own) for own in chosen], dtype=np.int64),
    )


def plain_log_likelihood(
    pair_m: Array,
    pairs: AnnotatedPairs,
    bank: ViewBank,
    *,
    table: EdgeTable | None = None,
    sigma_l: float = 0.01,
    beta_m: float = BETA_M,
) -> Match:
    """Give the log likelihood of a pair (2, 17, 3) by the definition, vectorised over the candidates of a view.

    `table` are the edges of all of `pairs` (`edge_table`), made here when not given.  `InteractionLikelihood` with
    `is_exact` gives the same.
    """
    if table is None:
        table = edge_table(pairs.points_m.reshape(len(pairs.points_m), -1, 2), beta_m=beta_m)
    images = project_pair(pair_m, bank.directions).reshape(len(bank.directions), -1, 2)
    best = np.full(len(images), np.inf)
    entry = np.full(len(images), -1, dtype=np.int64)
    for view, image in enumerate(images):
        own = bank.candidates[view, : bank.counts[view]]
        if not len(own):
            continue
        fixed = pairs.points_m[own].reshape(len(own), -1, 2)
        difference = align_plane(image, fixed) - fixed
        edges = delaunay_edges(image)
        along = difference[:, edges[:, 1]] - difference[:, edges[:, 0]]
        total = np.linalg.norm(along, axis=-1) @ edge_weights(image, edges, beta_m=beta_m)
        start, end = np.moveaxis(table.edges[own], -1, 0)[..., None]
        along = np.take_along_axis(difference, end, axis=1) - np.take_along_axis(difference, start, axis=1)
        total += np.sum(table.weights[own] * np.linalg.norm(along, axis=-1), axis=-1)
        best[view], entry[view] = total.min(), own[int(total.argmin())]
    return Match(log_likelihood=_log_mean(best, sigma_l), dissimilarity_m=best, entry=entry)


def _log_mean(best: Array, sigma_l: float) -> float:
    """Give the log of eq. 6 of the least d_I of each view."""
    least = float(best.min())
    if not np.isfinite(least):
        return -np.inf
    scale = 2.0 * sigma_l**2
    return float(np.log(np.mean(np.exp(-(best - least) / scale))) - least / scale)


class InteractionLikelihood:
    """The likelihood of eqs. 6 and 9 over a fixed bank, as a compiled kernel.

    For each view the candidates are ranked by what the best rotation in the plane leaves; the best `num_ranked` are
    compared over the pair's own edges, and over an annotation's only while that can still matter.  Views far behind the
    best one contribute less than rounding and are left out, mostly before anything is triangulated.

    Args:
        pairs: Annotated pairs.
        bank: Views and their candidates.
        sigma_l: Bandwidth; 2 sigma_l^2 is in metres (the paper divides d_I, not its square).
        beta_m: Edge length below which weights stop growing, metres.
        num_ranked: Candidates compared in full per view.
        is_exact: Compare all candidates, ranked or not: the oracle.

    Raises:
        InputError: `sigma_l` or `num_ranked` is not positive.
    """

    def __init__(
        self,
        pairs: AnnotatedPairs,
        bank: ViewBank,
        *,
        sigma_l: float = 0.01,
        beta_m: float = BETA_M,
        num_ranked: int = NUM_RANKED,
        is_exact: bool = False,
    ) -> None:
        if not sigma_l > 0.0 or num_ranked < 1:
            raise InputError(f"sigma_l and num_ranked must be positive, found {sigma_l} and {num_ranked}")
        self.sigma_l = sigma_l
        self._beta_m = beta_m
        self._num_ranked = int(bank.candidates.shape[1]) if is_exact else num_ranked
        self._least_ratio, self._own_share = (0.0, 1.0) if is_exact else (LEAST_RATIO, OWN_SHARE)
        self._directions = np.ascontiguousarray(bank.directions)
        self._counts = bank.counts
        # Only the entries that some view may meet are kept.
        used = np.unique(bank.candidates[bank.candidates >= 0])
        self._used = used
        points = pairs.points_m[used].reshape(len(used), -1, 2)
        self._points = np.ascontiguousarray(points - points.mean(axis=1, keepdims=True))
        self._table: EdgeTable = edge_table(points, beta_m=beta_m)
        slots = np.searchsorted(used, np.maximum(bank.candidates, used[0])).astype(np.int32)
        self._slots = slots
        # Ranking tables, float32, a candidate per lane: (view, joint, candidate).
        table = self._points[slots].astype(np.float32)
        self._rank_x = np.ascontiguousarray(np.moveaxis(table[..., 0], 2, 1))
        self._rank_y = np.ascontiguousarray(np.moveaxis(table[..., 1], 2, 1))
        self._rank_squares = np.sum(table**2, axis=(-1, -2))
        self._rough = (
            np.ascontiguousarray(self._table.edges[..., 0], dtype=np.uint8),
            np.ascontiguousarray(self._table.edges[..., 1], dtype=np.uint8),
            self._table.weights.astype(np.float32),
        )
        self._jitter = jitter(points.shape[1])
        # A view this far behind the best adds less than 1e-17 of the sum even if all views were like it.
        self._margin = 2.0 * sigma_l**2 * float(np.log(len(self._directions) * 1e17))
        self._best = np.empty(len(self._directions))
        self._slot = np.empty(len(self._directions), dtype=np.int64)

    def match(self, pair_m: Array, *, at_least: float = -np.inf) -> Match:
        """Give the log likelihood of a pair (2, 17, 3), metres; -inf as soon as it is known to lie below `at_least`."""
        scale = 2.0 * self.sigma_l**2
        # The mean over views is at most the best view: it alone must reach the floor.
        limit = np.inf if at_least == -np.inf else -at_least * scale
        entry = self._search(pair_m, limit, self._margin)
        best = self._best.copy()
        log_likelihood = _log_mean(best, self.sigma_l)
        if log_likelihood < at_least:
            log_likelihood = -np.inf
        return Match(log_likelihood=log_likelihood, dissimilarity_m=best, entry=entry)

    def nearest(self, pair_m: Array) -> npt.NDArray[np.int64]:
        """Give the entry nearest in d_I to the pair (2, 17, 3) under every view, (m,), also where it cannot matter.

        This is D* of eq. 12 among the ranked candidates; -1 for a view without any.
        """
        return self._search(pair_m, np.inf, np.inf)

    def _search(self, pair_m: Array, limit: float, margin: float) -> npt.NDArray[np.int64]:
        """Fill the least d_I of each view as far as it matters, and give its entry."""
        best_per_view(
            np.ascontiguousarray(pair_m).reshape(-1, 3),
            self._directions,
            self._counts,
            self._slots,
            self._rank_x,
            self._rank_y,
            self._rank_squares,
            self._points,
            self._table.edges,
            self._table.weights,
            self._table.counts,
            *self._rough,
            self._jitter,
            self._beta_m,
            self._num_ranked,
            self._least_ratio,
            self._own_share,
            limit,
            margin,
            self._best,
            self._slot,
        )
        return np.where(self._slot >= 0, self._used[np.maximum(self._slot, 0)], -1)

    def log_likelihood(self, pair_m: Array, *, at_least: float = -np.inf) -> float:
        """Give the log likelihood alone."""
        return self.match(pair_m, at_least=at_least).log_likelihood
