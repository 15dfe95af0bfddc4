"""Thicker and thinner bodies: contacts keep the distance of surfaces."""

import numpy as np
import pytest

from pasdedeux.augmentation import AugmentationSettings, Augmenter, Source, uniform_variations
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.choreography import make_duet
from pasdedeux.fitting import FitSettings
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair
from tests.builders.oracles_augmentation import plain_residuals

SCALE_ONE = uniform_variations([1.0], ["A"])


def _gaps(pair: np.ndarray, source: Source, girth: np.ndarray) -> np.ndarray:
    """Gaps of all bones of A and B (frame, 21, 21) of bodies of this girth (2, 22)."""
    return surface_gaps(pair, source.radii_m * girth, BODY22).gap_m


def test_surfaces_of_thicker_bodies_that_touched_still_touch() -> None:
    source = Source(swaying_pair(10), 30.0)
    (variant,) = Augmenter(source, AugmentationSettings(girth=(1.5, 1.0))).solve(SCALE_ONE)
    girth = np.repeat([[1.5], [1.0]], 22, axis=1)
    before, after = _gaps(source.positions_m, source, np.ones((2, 22))), _gaps(variant.positions_m, source, girth)
    touching = before < 0.06
    assert touching.any()
    np.testing.assert_allclose(after[touching], before[touching], atol=0.006)
    assert variant.quality.contact_drift_m < 0.005


def test_thicker_bodies_in_a_hug_do_not_move_into_each_other() -> None:
    source = Source(make_duet("hug", rate_hz=10.0).positions_m(), 10.0)
    (variant,) = Augmenter(source, AugmentationSettings(girth=(1.3, 1.3))).solve(SCALE_ONE)
    assert variant.quality.penetration_m < 0.02


@pytest.mark.parametrize("scale", [0.5, 1.4])
def test_two_people_of_another_size_whose_girth_follows_are_similar_to_the_source(scale: float) -> None:
    source = Source(make_duet("hug", rate_hz=10.0).positions_m()[40:65], 10.0)
    settings = AugmentationSettings(girth="follow", solver="polished")
    (variant,) = Augmenter(source, settings).solve(uniform_variations([scale], ["AB"]))
    distances = [
        np.linalg.norm(pair[:, 0, :, None] - pair[:, 1, None], axis=-1)
        for pair in (source.positions_m, variant.positions_m)
    ]
    # The pull towards plain forward kinematics, in which people stand where they stood, is what keeps them from it.
    np.testing.assert_allclose(distances[1], scale * distances[0], atol=0.055 * scale)
    assert variant.quality.contact_drift_m < 0.002


def test_energy_falls_with_girth_and_is_what_the_formulas_say() -> None:
    problem = build_problem(Source(swaying_pair(6), 30.0), AugmentationSettings(girth=(1.4, 0.7)))
    targets = build_targets(problem, np.stack([variation.bone_scale for variation in uniform_variations([0.8])]))
    result = descend(targets, 0, fit_terms(problem, targets, 0), settings=FitSettings(max_iterations=20))
    assert np.all(np.diff(result.energies) <= 0)
    written = (plain_residuals(problem, targets, result.positions_m - targets.reference[0]) ** 2).sum()
    assert result.energies[-1] == pytest.approx(written, rel=1e-9)
