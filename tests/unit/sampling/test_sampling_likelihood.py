"""Annotations under views, and the likelihood of a pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic import random_annotations, random_bank, random_pairs
from pasdedeux.cameras.frames import project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.sampling.annotations import AnnotatedPairs, build_bank, gather_pairs
from pasdedeux.sampling.densities.annotated import Pooling
from pasdedeux.sampling.densities.interaction import InteractionLikelihood
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import with_hidden


def test_quick_estimates_find_the_same_best_as_comparing_all() -> None:
    rng = np.random.default_rng(8)
    pairs = random_annotations(rng, random_pairs(rng, 500, spread_rad=0.2), 1500)
    bank = random_bank(rng, pairs, 6, num_candidates=400, view_bandwidth_rad=1.2)
    assert bank.counts.max() > 300
    likelihood = InteractionLikelihood(pairs, bank)
    for pair in random_pairs(rng, 150, spread_rad=0.2):
        assert likelihood.log_likelihood(pair) == pytest.approx(likelihood.plain(pair), rel=1e-10)


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_the_likelihood_over_every_view_agrees_with_its_definition(share: float) -> None:
    rng = np.random.default_rng(23)
    pairs = random_annotations(rng, random_pairs(rng, 300, spread_rad=0.2), 900)
    pairs = with_hidden(rng, pairs, share) if share else pairs
    bank = random_bank(rng, pairs, 6, num_candidates=300, view_bandwidth_rad=1.2)
    every = InteractionLikelihood(pairs, bank, sigma_l=0.03, pooling=Pooling.EVERY_VIEW)
    best_alone = InteractionLikelihood(pairs, bank, sigma_l=0.03)
    for pair in random_pairs(rng, 8, spread_rad=0.2):
        plain = every.plain_nearest(pair)
        assert every.plain(pair) == pytest.approx(-plain.dissimilarity_m.mean() / (2 * 0.03**2), rel=1e-12)
        value = every.log_likelihood(pair)
        assert value == pytest.approx(every.plain(pair), rel=1e-9)
        np.testing.assert_array_equal(every.nearest(pair).entry, plain.entry)
        # Jensen: the mean of logarithms is at most the logarithm of the mean.
        assert value <= best_alone.log_likelihood(pair)
        for level in (value - 1e-9 * abs(value), value + 1e-9 * abs(value), 0.9 * value, 1.1 * value):
            found = every.log_likelihood(pair, at_least=level)
            assert found == (value if value >= level else -np.inf)
            np.testing.assert_array_equal(every.nearest(pair).entry, plain.entry)
        # A cached result is used neither for another pair nor for another content of the same memory.
        every.nearest(1.1 * pair)
        np.testing.assert_array_equal(every.nearest(pair).entry, plain.entry)
        moving = 1.5 * pair
        every.log_likelihood(moving)
        moving[:] = pair
        np.testing.assert_array_equal(every.nearest(moving).entry, plain.entry)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.35])
def test_a_likelihood_is_the_definition_and_every_view_finds_its_nearest_whatever_is_hidden(share: float) -> None:
    rng = np.random.default_rng(17)
    pairs = random_annotations(rng, random_pairs(rng, 400, spread_rad=0.2), 1200)
    pairs = with_hidden(rng, pairs, share) if share else pairs
    bank = random_bank(rng, pairs, 6, num_candidates=300, view_bandwidth_rad=1.2)
    fast = InteractionLikelihood(pairs, bank)
    assert pairs.is_seen.all() == (share == 0.0)
    for pair in random_pairs(rng, 40, spread_rad=0.2):
        assert fast.log_likelihood(pair) == pytest.approx(fast.plain(pair), rel=1e-10)
    for pair in random_pairs(rng, 6, spread_rad=0.2):
        plain = fast.plain_nearest(pair)
        np.testing.assert_array_equal(fast.nearest(pair).entry, plain.entry)
        # The definition itself: the least d_I, one annotation at a time.
        image = project_pair(pair, bank.directions[0]).reshape(34, 2)
        candidates = pairs.points_m[bank.candidates[0, : bank.counts[0]]].reshape(-1, 34, 2)
        least = min(interaction_dissimilarity(image, points) for points in candidates)
        assert plain.dissimilarity_m[0] == pytest.approx(least, rel=1e-9)


def test_an_annotated_pair_is_certain_under_its_own_view_and_what_is_hidden_may_be_anywhere() -> None:
    rng = np.random.default_rng(18)
    pair = random_pairs(rng, 1)[0]
    view = normalise(np.array([[0.3, 0.1, 1.0]]))
    whole = AnnotatedPairs(project_pair(pair, view), view, np.zeros(1, dtype=np.int64))
    part = with_hidden(np.random.default_rng(4), whole, 0.2)

    def log_likelihood(annotated: AnnotatedPairs, pair_m: np.ndarray) -> float:
        return InteractionLikelihood(annotated, build_bank(view, annotated)).log_likelihood(pair_m)

    for annotated in (whole, part):
        assert log_likelihood(annotated, pair) == pytest.approx(0.0, abs=1e-6)
    assert log_likelihood(replace(whole, points_m=whole.points_m * [-1.0, 1.0]), pair) < -100.0
    waving = pair.copy()
    waving[~part.is_seen[0]] += 0.3
    waving[:, [0, 3]] = pair[:, [0, 3]]
    assert (waving != pair).any()
    assert log_likelihood(part, waving) > -300.0
    assert log_likelihood(whole, waving) < -300.0


def test_views_that_are_skipped_add_less_than_rounding_to_the_likelihood() -> None:
    rng = np.random.default_rng(14)
    pairs = random_annotations(rng, random_pairs(rng, 60, spread_rad=0.1), 150)
    bank = build_bank(pairs.directions[:12], pairs, num_candidates=50, view_bandwidth_rad=1.0)
    for sigma_l in (0.01, 0.05):
        likelihood = InteractionLikelihood(pairs, bank, sigma_l=sigma_l)
        for pair in random_pairs(rng, 12, spread_rad=0.1):
            # exp of the logs agrees to 1e-9 relative; d_I itself is only known to that once divided by 2 sigma_l^2.
            assert likelihood.log_likelihood(pair) == pytest.approx(likelihood.plain(pair), rel=1e-11, abs=1e-10)


def test_annotations_that_show_too_little_are_left_out_and_counted() -> None:
    rng = np.random.default_rng(14)
    pixels = rng.normal(size=(5, 2, 17, 2))
    pixels[0, :, [6, 7, 9, 10, 12, 13]] = np.nan
    pixels[1, 0, PAIR17.indices(("neck", "left_hip", "left_shoulder"))] = np.nan
    pixels[4, :, 4:13] = np.nan
    gathered = gather_pairs(pixels, np.ones((5, 2)), np.ones((5, 3)), np.ones(5), np.arange(5))
    assert gathered.num_skipped == 2
    assert list(gathered.pairs.annotation_index) == [0, 2, 3]
    np.testing.assert_array_equal(gathered.pairs.is_seen[0], np.isfinite(pixels[0, ..., 0]))
    pixels[:, 1] = np.nan
    with pytest.raises(InputError, match="none of the 5 annotated pairs"):
        gather_pairs(pixels, np.ones((5, 2)), np.ones((5, 3)), np.ones(5), np.arange(5))


def test_an_annotation_enters_a_view_once_by_its_nearest_hypothesis() -> None:
    rng = np.random.default_rng(15)
    directions = normalise(rng.normal(size=(90, 3)))
    pairs = AnnotatedPairs(rng.normal(size=(90, 2, 17, 2)), directions, np.repeat(np.arange(30), 3))
    bank = build_bank(normalise(rng.normal(size=(5, 3))), pairs, num_candidates=25)
    for view in range(5):
        entries = bank.candidates[view, : bank.counts[view]]
        assert len(entries) >= 20
        assert len(set(pairs.annotation_index[entries])) == len(entries)
        for entry in entries:
            same = np.flatnonzero(pairs.annotation_index == pairs.annotation_index[entry])
            nearest = same[np.argmax(directions[same] @ bank.directions[view])]
            assert entry == nearest


def test_fewer_annotations_than_candidates_are_all_used() -> None:
    rng = np.random.default_rng(16)
    pairs = random_annotations(rng, random_pairs(rng, 3), 3)
    bank = build_bank(normalise(rng.normal(size=(4, 3))), pairs)
    assert list(bank.counts) == [3, 3, 3, 3]
    assert np.isfinite(InteractionLikelihood(pairs, bank).log_likelihood(random_pairs(rng, 1)[0]))
