"""Cartesian and shape-context likelihoods against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.benchmarks.synthetic import random_annotations
from pasdedeux.cameras import project_pair
from pasdedeux.errors import InputError
from pasdedeux.experiments.measured_likelihood import (
    ImageMeasure,
    MeasuredLikelihood,
    image_dissimilarity,
    matched_scale,
)
from pasdedeux.interaction import interaction_dissimilarity
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.sampling.annotations import AnnotatedPairs, build_bank
from tests.builders.poses import dancers

PAIRS = dancers(5, 8)
ENTRIES = random_annotations(np.random.default_rng(1), dancers(6, 120), 120)
BANK = build_bank(ENTRIES.directions[:5], ENTRIES, num_candidates=40)


@pytest.mark.parametrize("measure", list(ImageMeasure))
def test_the_kernels_agree_with_the_definition(measure: ImageMeasure) -> None:
    likelihood = MeasuredLikelihood(ENTRIES, BANK, measure, sigma_l=0.05, num_ranked=40)
    for pair in PAIRS:
        images = project_pair(pair, BANK.directions).reshape(5, 34, 2)
        best = []
        for view, image in enumerate(images):
            fixed = ENTRIES.points_m[BANK.candidates[view, : BANK.counts[view]]].reshape(-1, 34, 2)
            best.append(float(image_dissimilarity(image[None], fixed, measure).min()))
        scaled = np.array(best) * likelihood.scale
        match = likelihood.match(pair)
        mattered = np.isfinite(match.dissimilarity_m)
        assert mattered.any()
        # A joint on the edge of a bin may change sides by rounding: one of 34 x 33.
        np.testing.assert_allclose(match.dissimilarity_m[mattered], scaled[mattered], atol=2e-3 * likelihood.scale)
        # Views that are left out add less than rounding.
        assert scaled[~mattered].min(initial=np.inf) > scaled.min() + 0.1
        assert match.log_likelihood == pytest.approx(
            np.log(np.mean(np.exp(-match.dissimilarity_m / (2 * 0.05**2)))), rel=1e-9
        )
        np.testing.assert_array_equal(likelihood.nearest(pair)[mattered], match.entry[mattered])
        assert likelihood.log_likelihood(pair, at_least=match.log_likelihood + 1e-6) == -np.inf


def test_shape_contexts_that_are_left_do_not_hold_the_best() -> None:
    fast = MeasuredLikelihood(ENTRIES, BANK, ImageMeasure.SHAPE_CONTEXT)
    exact = MeasuredLikelihood(ENTRIES, BANK, ImageMeasure.SHAPE_CONTEXT, is_exact=True)
    for pair in PAIRS:
        assert fast.log_likelihood(pair) == pytest.approx(exact.log_likelihood(pair), rel=1e-12)


@pytest.mark.parametrize("measure", list(ImageMeasure))
def test_an_annotated_pair_seen_from_its_view_is_the_likeliest(measure: ImageMeasure) -> None:
    pairs = dancers(6, 40)
    directions = normalise(np.random.default_rng(1).normal(size=(40, 3)))
    entries = AnnotatedPairs(project_pair(pairs, directions), directions, np.arange(40))
    # Only the first pair is annotated from where the one view of the bank looks.
    bank = build_bank(directions[:1], entries, num_candidates=1)
    logs = [MeasuredLikelihood(entries, bank, measure).log_likelihood(pair) for pair in pairs]
    assert logs[0] == pytest.approx(0.0, abs=1e-6)
    assert max(logs[1:]) < logs[0] - 1.0


def test_the_scale_makes_neighbours_as_far_apart_as_in_interaction_coordinates() -> None:
    # Images that differ from one another by the same small shift of one person: every neighbour is as far.
    scales = {measure: matched_scale(ENTRIES, measure) for measure in ImageMeasure}
    points = ENTRIES.points_m.reshape(-1, 34, 2)
    for measure, scale in scales.items():
        own = np.array([float(image_dissimilarity(points[i], points[i + 1], measure)) for i in range(60)])
        interaction = np.array([interaction_dissimilarity(points[i], points[i + 1]) for i in range(60)])
        # Other pairs than the nearest, so only roughly.
        assert 0.5 < np.median(own * scale) / np.median(interaction) < 2.0


def test_widths_must_be_positive() -> None:
    with pytest.raises(InputError, match="positive"):
        MeasuredLikelihood(ENTRIES, BANK, ImageMeasure.CARTESIAN, sigma_l=0.0)
