"""Rows of `lifted_pairs` and `in_betweens`: one annotation lifted every way, frames filled in between two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.expected_error import expected_error, expected_over_time
from pasdedeux.completion.fit import fit_pair, pooled_lengths
from pasdedeux.completion.in_betweens import fill_between, straight_between
from pasdedeux.completion.occlusion import complete_pair, in_depth_order
from pasdedeux.completion.retrieval import image_residual, retrieve
from pasdedeux.reconstruction.annotated import as_pair17
from tasks.rows.annotated_pairs import PLACE_COLUMNS, PairPlace, SeenPair
from tasks.rows.draw_sets import DrawSet

Row = dict[str, Any]
EXPECTED = ("expected_error_m", "expected_low_m", "expected_high_m")
_NUM_COMPLETING = 100
"""Number of draws nearest in D_I from which unseen joints are taken."""


def lifted_row(seen: SeenPair, method: str, pair_m: np.ndarray, **more: Any) -> Row:
    """Return the row of a pair (2, 17, 3), camera axes, metres; `more` are other columns of `lifted_pairs`."""
    return {
        **seen.place._asdict(),
        "method": method,
        "num_joints_seen": seen.num_seen,
        "residual_m": image_residual(pair_m, seen.image_m),
        "draw": None,
        "hypothesis": None,
        **dict.fromkeys(EXPECTED),
        "pair17_m": pair_m - pair_m.reshape(-1, 3).mean(axis=0),
        **more,
    }


class Together(NamedTuple):
    """Two people (2, 14, 3) lifted with others of their camera, their expected error, and whether draws were used."""

    people_m: np.ndarray
    expected_m: float
    is_of_draws: bool


def lift_annotation(
    seen: SeenPair, draws: DrawSet, index: DrawIndex, drawn: Sequence[int], over_time: Together | None = None
) -> tuple[list[Row], np.ndarray]:
    """Return the rows of one annotation, and its last pair in place; `drawn` are the draws that were lifted from it."""
    retrieved = retrieve(index, seen.image_m, seen.directions)
    known = {
        "draw": draws.reference(int(retrieved.nearest.draw[0])),
        "hypothesis": int(seen.hypotheses[retrieved.nearest.view[0]]),
    }
    lengths = pooled_lengths(retrieved.pairs_m, retrieved.weight)
    fitted = fit_pair(seen.image_m, retrieved.mean_m, lengths)
    rows = [
        lifted_row(seen, "nearest", retrieved.pairs_m[0], **known),
        lifted_row(seen, "neighbours", retrieved.mean_m, **known),
        lifted_row(seen, "fitted", fitted, **known),
    ]
    if not seen.is_seen.all():
        incomplete = np.where(seen.is_seen[..., None], fitted, np.nan)
        fitted = complete_pair(incomplete, draws.pairs_m, num_nearest=_NUM_COMPLETING).fitted_m
        if over_time is not None:  # one image hardly shows the order in depth; its video does
            fitted = in_depth_order(fitted, as_pair17(over_time.people_m, fitted))
        rows.append(lifted_row(seen, "completed", fitted, **known))
    has_own_draw = bool(np.isin(drawn, retrieved.nearest.draw).any())
    others = retrieve(index, seen.image_m, seen.directions, without=drawn) if has_own_draw else retrieved
    expected = expected_error(seen.image_m, others.mean_m, fitted, has_own_draw=has_own_draw)
    if over_time is not None:
        expected = expected_over_time(expected if over_time.is_of_draws else None, over_time.expected_m)
        fitted = as_pair17(over_time.people_m, fitted)
        off = np.nanmean(np.where(seen.is_seen[..., None], fitted[..., :2] - seen.image_m, np.nan), axis=(0, 1))
        fitted = fitted - np.array([*off, fitted[..., 2].mean()])
        rows.append(lifted_row(seen, "over_time", fitted, **known))
    rows[-1] |= dict(zip(EXPECTED, (expected.value_m, expected.low_m, expected.high_m), strict=True))
    # The mean of all draws, seen from the likeliest view: the estimate for any pair from the draws alone.
    rows.append(lifted_row(seen, "mean_pair", index.placed_mean(seen.directions[0], seen.image_m)))
    return rows, fitted


def fill_span(span: tuple[PairPlace, PairPlace], fitted: dict[PairPlace, np.ndarray], draws: DrawSet) -> list[Row]:
    """Return the rows between two lifted pairs of a sequence."""
    first, last = (end.frame for end in span)
    ends = [fitted[end] - fitted[end].reshape(-1, 3).mean(axis=0) for end in span]
    count = last - first - 1
    if count < 1:
        return []
    filled = {
        "draws": fill_between(ends[0], ends[1], count, draws.pairs_m),
        "straight": straight_between(ends[0], ends[1], count),
    }
    return [
        {
            **span[0]._replace(frame=first + 1 + at)._asdict(),
            "method": method,
            "first_frame": first,
            "last_frame": last,
            "pair17_m": pair,
        }
        for method, pairs in filled.items()
        for at, pair in enumerate(pairs)
    ]


def as_columns(rows: list[Row]) -> dict[str, list[Any]]:
    """Return rows as columns, in the order of the table."""
    order = (*PLACE_COLUMNS, "method")
    ordered = sorted(rows, key=lambda row: (*(row[name] for name in order), row.get("first_frame", 0)))
    return {name: [row[name] for row in ordered] for name in ordered[0]}
