"""Thicker and thinner bodies: contacts keep the distance of surfaces."""

import numpy as np
import pytest

from pasdedeux.augmentation import AugmentationSettings, Augmenter, Source, uniform_variations
from pasdedeux.augmentation.contacts import joint_radii_m
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.choreography import make_duet
from pasdedeux.fitting import FitSettings
from pasdedeux.interaction.contacts import joint_pair_distances
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair
from tests.builders.oracles_augmentation import plain_residuals

SCALE_ONE = uniform_variations([1.0], ["A"])


def test_joints_are_as_thick_as_the_thickest_bone_that_ends_there() -> None:
    radii = joint_radii_m(Source(swaying_pair(3), 30.0))
    pelvis, elbow, wrist = (BODY22.index(name) for name in ("pelvis", "left_elbow", "left_wrist"))
    assert (radii > 0).all()
    assert (radii[:, pelvis] > radii[:, elbow]).all()
    assert (radii[:, elbow] > radii[:, wrist]).all()


def test_hands_that_hold_each_other_part_by_what_a_thicker_body_adds() -> None:
    source = Source(swaying_pair(10), 30.0)
    (variant,) = Augmenter(source, AugmentationSettings(girth=(1.5, 1.0))).solve(SCALE_ONE)
    hand, other = BODY22.index("left_wrist"), BODY22.index("right_wrist")
    before, after = (joint_pair_distances(pair)[:, hand, other] for pair in (source.positions_m, variant.positions_m))
    added = 0.5 * joint_radii_m(source)[0, hand]
    assert added > 0.01
    np.testing.assert_allclose(after - before, added, atol=0.4 * added)
    assert variant.quality.contact_drift_m < 0.005


def test_thicker_bodies_in_a_hug_move_apart_rather_than_into_each_other() -> None:
    source = Source(make_duet("hug", rate_hz=10.0).positions_m(), 10.0)
    (variant,) = Augmenter(source, AugmentationSettings(girth=(1.3, 1.3))).solve(SCALE_ONE)
    spine = BODY22.index("spine3")
    before, after = (joint_pair_distances(pair)[:, spine, spine] for pair in (source.positions_m, variant.positions_m))
    touching = before < np.percentile(before, 20)
    assert (after - before)[touching].mean() > 0.01
    assert variant.quality.penetration_m < 0.02


def test_energy_falls_with_girth_and_is_what_the_formulas_say() -> None:
    problem = build_problem(Source(swaying_pair(6), 30.0), AugmentationSettings(girth=(1.4, 0.7)))
    targets = build_targets(problem, np.stack([variation.bone_scale for variation in uniform_variations([0.8])]))
    result = descend(targets, 0, fit_terms(problem, targets, 0), settings=FitSettings(max_iterations=20))
    assert np.all(np.diff(result.energies) <= 0)
    written = (plain_residuals(problem, targets, result.positions_m - targets.reference[0]) ** 2).sum()
    assert result.energies[-1] == pytest.approx(written, rel=1e-9)
