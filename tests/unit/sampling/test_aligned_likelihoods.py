"""Cartesian and shape-context likelihoods: the compiled search finds what the definition does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synthetic import random_annotations
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity
from pasdedeux.interaction.shape_context import plane_shape_dissimilarity
from pasdedeux.sampling.annotations import GatheredPairs
from pasdedeux.sampling.densities.aligned import AlignedLikelihood, matched_scale
from pasdedeux.sampling.densities.annotated import AnnotationSettings, Pooling
from pasdedeux.sampling.densities.cartesian import CartesianLikelihood
from pasdedeux.sampling.densities.shape_context import ShapeContextLikelihood
from tests.builders.poses import dancers

PAIRS = dancers(5, 6)
KINDS = pytest.mark.parametrize("kind", [CartesianLikelihood, ShapeContextLikelihood])


def gathered(num_incomplete: int = 0) -> GatheredPairs:
    pairs = random_annotations(np.random.default_rng(1), dancers(6, 120), 120)
    points = pairs.points_m.copy()
    points[:num_incomplete, 0, 4] = np.nan
    return GatheredPairs(replace(pairs, points_m=points), np.ones(120), 0, np.full((120, 2), 0.01))


def likelihood_of(kind: type[AlignedLikelihood], annotated: GatheredPairs, **settings: object) -> AlignedLikelihood:
    quick = AnnotationSettings.model_validate({"num_views": 5, "num_candidates": 60, "sigma_l": 0.02, **settings})
    return kind(quick, np.random.default_rng(3), annotated)


@KINDS
@pytest.mark.parametrize("pooling", list(Pooling))
def test_the_search_agrees_with_the_definition(kind: type[AlignedLikelihood], pooling: Pooling) -> None:
    likelihood = likelihood_of(kind, gathered(), pooling=pooling)
    for pair in PAIRS:
        assert likelihood.log_likelihood(pair) == pytest.approx(likelihood.plain(pair), rel=1e-9)


@KINDS
def test_annotations_that_lack_a_joint_are_never_the_nearest(kind: type[AlignedLikelihood]) -> None:
    likelihood = likelihood_of(kind, gathered(100))
    entries = np.concatenate([likelihood.nearest(pair).entry for pair in PAIRS])
    assert entries.min() >= 100
    with pytest.raises(InputError, match="shows all joints"):
        likelihood_of(kind, gathered(120))


@KINDS
def test_the_scale_makes_neighbours_as_far_apart_as_in_interaction_coordinates(kind: type[AlignedLikelihood]) -> None:
    annotated = gathered()
    likelihood = likelihood_of(kind, annotated)
    points = annotated.pairs.points_m.reshape(-1, 34, 2)
    scale = matched_scale(likelihood, annotated.pairs)
    dissimilarity = [float(likelihood.dissimilarity(points[at], points[at + 1][None])[0]) for at in range(60)]
    interaction = [interaction_dissimilarity(points[at], points[at + 1]) for at in range(60)]
    # The pairs are not the nearest ones, so the scale is only approximate.
    assert 0.5 < scale * np.median(dissimilarity) / np.median(interaction) < 2.0


def test_shape_contexts_of_an_image_do_not_change_when_it_is_turned_and_differ_from_another() -> None:
    first, second = gathered().pairs.points_m.reshape(-1, 34, 2)[:2]
    turned = first @ np.array([[0.6, -0.8], [0.8, 0.6]]) + [1.0, 2.0]
    assert plane_shape_dissimilarity(turned, first) == pytest.approx(0.0, abs=0.01)
    assert plane_shape_dissimilarity(second, first) > 0.1
