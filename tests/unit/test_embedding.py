"""The map of pairs, and coverage by sets of draws, of selected pairs and of real frames."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.interaction.coverage import coverage_curve
from pasdedeux.interaction.nearest import pair_table
from pasdedeux.interaction.pair_map import PairMap
from tasks.evaluation.coverage import (
    coverage_figure,
    coverage_scores,
    map_figure,
    nearest_by_method,
    real_frame_levels,
    realism_scores,
    set_scores,
    set_table,
)
from tasks.selection import SelectedPairs

PAIRS = random_pairs(np.random.default_rng(0), 24, spread_rad=0.3)


def test_a_real_pair_is_placed_where_it_already_lies() -> None:
    plane = PairMap.of(PAIRS)
    np.testing.assert_allclose(plane.place(PAIRS[4:7]), plane.places[4:7], atol=1e-6)
    np.testing.assert_array_equal(plane.place(pair_table(PAIRS[4:7])), plane.place(PAIRS[4:7]))
    assert 0.0 < plane.share <= 1.0


def test_a_map_of_equal_pairs_is_refused() -> None:
    with pytest.raises(InputError, match="differ"):
        PairMap.of(np.repeat(PAIRS[:1], 5, axis=0))


def test_draws_and_grown_seeds_together_cover_as_one_set() -> None:
    curves = {"ic": coverage_curve(PAIRS[:5], PAIRS[5:12], [7]), "grown": coverage_curve(PAIRS[:5], PAIRS[12:20], [8])}
    levels = real_frame_levels(PAIRS[:5], PAIRS[5:], np.random.default_rng(0))
    together = coverage_curve(PAIRS[:5], PAIRS[5:20], [15]).cartesian_m[-1]
    scores = coverage_scores(curves, levels, nearest_by_method(curves, "grown"), split="annotated")
    (both,) = [one for one in scores if (one.method, one.metric) == ("ic_and_grown", "coverage_D_C")]
    assert (both.value, both.count) == (pytest.approx(together), 5)
    assert list(nearest_by_method({"ic": curves["ic"]}, "grown")) == ["ic"]


def test_selected_pairs_random_ones_and_real_frames_are_compared_in_sets_of_one_size() -> None:
    selected = SelectedPairs({"rank": range(12), "pair17_m": list(PAIRS[12:])}, (), 0, 0, 0, 0.0, 0.02)
    levels = real_frame_levels(PAIRS[:5], PAIRS[5:], np.random.default_rng(0))
    pool = [PAIRS[5:10], PAIRS[10:]]
    scores = set_scores(PAIRS[:5], selected, pool, levels, np.random.default_rng(0), split="held_out")
    found = {(score.method, score.at): score.value for score in scores}
    assert found["selected_pairs", 10.0] == coverage_curve(PAIRS[:5], PAIRS[12:22], [10]).cartesian_m[0]
    assert found["real_frames", 10.0] == levels.cartesian_m[2]
    assert found["random_pairs", 10.0] >= coverage_curve(PAIRS[:5], PAIRS[5:], [19]).cartesian_m[0]
    (table,) = set_table(scores)
    assert table.headings[2:] == ("selected pairs", "random pairs", "real frames")
    assert [row[:2] for row in table.rows] == [("held-out takes", size) for size in ("1", "3", "10")]


def test_real_pairs_are_at_no_distance_from_themselves() -> None:
    scores = realism_scores({"ic": PAIRS[:6]}, PAIRS, np.random.default_rng(0), split="annotated")
    assert {score.metric for score in scores} == {f"draw_to_nearest_real_D_C_{k}" for k in ("mean", "median", "p90")}
    assert max(score.value for score in scores) < 1e-6


def test_the_pictures_of_coverage_are_drawn() -> None:
    curve = coverage_curve(PAIRS[:5], PAIRS[5:], [1, 4])
    levels = real_frame_levels(PAIRS[:5], PAIRS[5:], np.random.default_rng(0))
    plane = PairMap.of(PAIRS[:10])
    panels = {"8 draws": {"ic": plane.place(PAIRS[:8]), "prior_only": plane.place(PAIRS[8:12])}}
    for picture in (
        coverage_figure({"ic": curve}, levels, "annotated"),
        map_figure(plane.places, panels, seed=plane.places[0], title="map"),
    ):
        assert b"<image" in picture or picture.count(b"<use") > 5, "an empty picture"
        assert len(picture) < 60_000
