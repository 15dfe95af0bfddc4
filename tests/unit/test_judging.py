"""Corruptions keep what they promise to keep, and the AUC is the AUC."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.benchmarks.synthetic import random_annotations
from pasdedeux.cameras import project_pair
from pasdedeux.errors import InputError
from pasdedeux.experiments.judging import (
    Corruption,
    TermComparer,
    area_under_curve,
    camera_axes,
    corrupt,
    paired_accuracy,
)
from pasdedeux.interaction import cartesian_dissimilarity, plane_residual
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility import JointLimits, Occupancy, capsule_model
from pasdedeux.sampling.annotations import build_bank
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import dancers

PAIRS = dancers(5, 30)
VIEWS = normalise(np.random.default_rng(0).normal(size=(30, 3)) * [1.0, 0.2, 1.0])


@pytest.mark.parametrize("kind", list(Corruption))
def test_no_corruption_shows_in_its_image(kind: Corruption) -> None:
    corrupted = corrupt(np.random.default_rng(1), PAIRS, VIEWS, kind)
    assert len(corrupted.rows) == len(corrupted.pairs_m) > 0
    # Lifting badly trades a millimetre in the image for exact bone lengths.
    tolerance = 2e-3 if kind is Corruption.BADLY_LIFTED else 1e-9
    np.testing.assert_allclose(corrupted.pairs_m[..., :2], corrupted.seen_m[..., :2], atol=tolerance)
    real = PAIRS[corrupted.rows].reshape(-1, 34, 3)
    assert np.abs(cartesian_dissimilarity(corrupted.seen_m.reshape(-1, 34, 3), real)).max() < 1e-9
    assert (corrupted.moved_m > 0.0).all()
    if kind not in (Corruption.INSIDE_5, Corruption.INSIDE_10):
        before = project_pair(PAIRS[corrupted.rows], VIEWS[corrupted.rows]).reshape(-1, 34, 2)
        image = corrupted.pairs_m[..., :2].reshape(-1, 34, 2)
        np.testing.assert_allclose(plane_residual(image, before), 0.0, atol=34 * tolerance**2 + 1e-9)


def test_a_slide_moves_one_person_by_what_it_says() -> None:
    for kind, far in ((Corruption.SLID_10, 0.1), (Corruption.SLID_20, 0.2), (Corruption.SLID_40, 0.4)):
        corrupted = corrupt(np.random.default_rng(1), PAIRS, VIEWS, kind)
        np.testing.assert_allclose(corrupted.moved_m, far, atol=1e-9)
        np.testing.assert_allclose(corrupted.pairs_m[:, 0], corrupted.seen_m[:, 0])


@pytest.mark.parametrize("kind", list(Corruption))
def test_bones_keep_their_lengths_under_every_corruption(kind: Corruption) -> None:
    corrupted = corrupt(np.random.default_rng(2), PAIRS, VIEWS, kind)
    before = bone_lengths(PAIR17, PAIRS[corrupted.rows])
    np.testing.assert_allclose(bone_lengths(PAIR17, corrupted.pairs_m), before, atol=1e-9)


def test_pushed_bodies_penetrate_by_what_was_asked_for() -> None:
    model = capsule_model(PAIR17)
    corrupted = corrupt(np.random.default_rng(3), PAIRS, VIEWS, Corruption.INSIDE_10)
    for real, false in zip(corrupted.seen_m, corrupted.pairs_m, strict=True):
        radii = model.radii_of(real[None])
        added = [model.penetration(one, radii)[2] for one in (false, real)]
        assert added[0] - added[1] >= 0.1


def test_area_under_curve_is_the_chance_of_the_right_order() -> None:
    assert area_under_curve(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1.0
    assert area_under_curve(np.zeros(4), np.zeros(3)) == 0.5
    assert area_under_curve(np.array([1.0, 3.0]), np.array([2.0])) == 0.5
    with pytest.raises(InputError, match="real and corrupted"):
        area_under_curve(np.zeros(0), np.zeros(1))


def test_paired_accuracy_compares_each_with_its_own() -> None:
    assert paired_accuracy(np.array([1.0, 3.0]), np.array([0.0, 2.0])) == 1.0
    assert area_under_curve(np.array([1.0, 3.0]), np.array([0.0, 2.0])) == 0.75
    with pytest.raises(InputError, match="one by one"):
        paired_accuracy(np.zeros(2), np.zeros(1))


def test_terms_prefer_real_pairs_to_mirrored_ones_and_the_best_view_cannot() -> None:
    rng = np.random.default_rng(4)
    entries = random_annotations(rng, dancers(6, 150), 150)
    bank = build_bank(entries.directions[:4], entries, num_candidates=60)
    grown = PAIRS + rng.normal(scale=0.01, size=PAIRS.shape)
    occupancy = Occupancy.empty().extended(dancers(7, 200))
    comparer = TermComparer(JointLimits.published(), occupancy, entries, bank, grown)
    alone = TermComparer(JointLimits.published(), Occupancy.empty(), entries, bank, PAIRS[:0]).values(PAIRS[:2])
    assert "agreement" not in alone
    assert (alone["pose_prior"] == 0.0).all()
    real = comparer.values(PAIRS)
    values = comparer.values(corrupt(rng, PAIRS, VIEWS, Corruption.DEPTH_MIRRORED).pairs_m)
    assert set(values) == set(real)
    assert all(np.isfinite(one).all() for one in values.values())
    for term in ("joint_limits", "pose_prior", "grown_D_I", "limbs", "agreement"):
        assert area_under_curve(real[term], values[term]) > 0.9
    assert area_under_curve(real["likelihood"], values["likelihood"]) == pytest.approx(0.5, abs=0.15)
    pushed = comparer.values(corrupt(rng, PAIRS, VIEWS, Corruption.INSIDE_10).pairs_m)
    assert (pushed["contact"] < real["contact"].min()).mean() > 0.9


def test_comparisons_hold_each_pair_beside_its_own_corruption_and_the_odds_of_both() -> None:
    rng = np.random.default_rng(5)
    entries = random_annotations(rng, dancers(6, 60), 60)
    bank = build_bank(entries.directions[:2], entries, num_candidates=20)
    grown = PAIRS + rng.normal(scale=0.01, size=PAIRS.shape)
    comparer = TermComparer(JointLimits.published(), Occupancy.empty(), entries, bank, grown)
    few, views = PAIRS[:3], VIEWS[:3]
    comparisons = comparer.comparisons(np.random.default_rng(1), few, views)
    mirrored = comparisons[Corruption.DEPTH_MIRRORED]
    again = corrupt(np.random.default_rng(1), few, views, Corruption.DEPTH_MIRRORED)
    np.testing.assert_array_equal(mirrored.moved_m, again.moved_m)
    np.testing.assert_allclose(mirrored.real["agreement"], comparer.values(few)["agreement"])
    np.testing.assert_allclose(mirrored.corrupted["agreement"], comparer.values(again.pairs_m)["agreement"])
    np.testing.assert_allclose(mirrored.real["image_odds"], comparer.odds(camera_axes(few, views, Corruption.SLID_10)))
    assert (mirrored.real["image_odds"] > mirrored.corrupted["image_odds"]).all()
    far = mirrored.from_m(float(np.sort(mirrored.moved_m)[1]))
    assert len(far.moved_m) == len(far.real["limbs"]) == len(far.corrupted["image_odds"]) == 2
