"""The map of pairs, and coverage by draws and by real frames."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.interaction.coverage import coverage_curve
from pasdedeux.interaction.nearest import pair_table
from pasdedeux.interaction.pair_map import PairMap
from tasks.evaluation.coverage import coverage_figure, map_figure, real_frame_levels, realism_scores

PAIRS = random_pairs(np.random.default_rng(0), 24, spread_rad=0.3)


def test_a_real_pair_is_placed_where_it_already_lies() -> None:
    plane = PairMap.of(PAIRS)
    np.testing.assert_allclose(plane.place(PAIRS[4:7]), plane.places[4:7], atol=1e-6)
    np.testing.assert_array_equal(plane.place(pair_table(PAIRS[4:7])), plane.place(PAIRS[4:7]))
    assert 0.0 < plane.share <= 1.0


def test_a_map_of_equal_pairs_is_refused() -> None:
    with pytest.raises(InputError, match="differ"):
        PairMap.of(np.repeat(PAIRS[:1], 5, axis=0))


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
