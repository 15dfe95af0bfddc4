"""Corruptions keep what they promise to keep, and the AUC is the AUC."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.cameras import project_pair
from pasdedeux.errors import InputError
from pasdedeux.interaction import plane_residual
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility import JointLimits, capsule_model, penetration
from pasdedeux.sampling import build_bank
from pasdedeux.sampling.judging import Corruption, corrupt, separation, term_values
from pasdedeux.sampling.synthetic import random_annotations
from pasdedeux.skeletons import PAIR17
from tests.unit.test_views import dancers

PAIRS = dancers(5, 30)
VIEWS = normalise(np.random.default_rng(0).normal(size=(30, 3)) * [1.0, 0.2, 1.0])
SAME_IMAGE = (
    Corruption.DEPTH_MIRRORED,
    Corruption.LIMB_FLIPPED,
    Corruption.SLID_10,
    Corruption.SLID_20,
    Corruption.SLID_40,
)


@pytest.mark.parametrize("kind", SAME_IMAGE)
def test_a_corruption_in_depth_does_not_show_in_its_image(kind: Corruption) -> None:
    rows, corrupted = corrupt(np.random.default_rng(1), PAIRS, VIEWS, kind)
    assert len(rows) == len(corrupted) > 0
    before = project_pair(PAIRS[rows], VIEWS[rows]).reshape(-1, 34, 2)
    np.testing.assert_allclose(plane_residual(corrupted[..., :2].reshape(-1, 34, 2), before), 0.0, atol=1e-9)
    assert (np.abs(np.linalg.norm(corrupted - corrupted[:, :1, :1], axis=-1)
            - np.linalg.norm(PAIRS[rows] - PAIRS[rows][:, :1, :1], axis=-1)).max(axis=(1, 2)) < 1e-9).all() == (
        kind is Corruption.DEPTH_MIRRORED
    )  # fmt: skip


@pytest.mark.parametrize("kind", list(Corruption))
def test_bones_keep_their_lengths_under_every_corruption(kind: Corruption) -> None:
    rows, corrupted = corrupt(np.random.default_rng(2), PAIRS, VIEWS, kind)
    np.testing.assert_allclose(bone_lengths(PAIR17, corrupted), bone_lengths(PAIR17, PAIRS[rows]), atol=1e-9)


def test_pushed_bodies_penetrate_by_what_was_asked_for() -> None:
    model = capsule_model(PAIR17)
    rows, corrupted = corrupt(np.random.default_rng(3), PAIRS, VIEWS, Corruption.INSIDE_10)
    for row, pair in zip(rows, corrupted, strict=True):
        radii = model.radii_of(PAIRS[row][None])
        added = [penetration(one[None], radii, model).between_m[0] for one in (pair, PAIRS[row])]
        assert added[0] - added[1] >= 0.1


def test_separation_is_the_chance_of_the_right_order() -> None:
    assert separation(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1.0
    assert separation(np.zeros(4), np.zeros(3)) == 0.5
    assert separation(np.array([1.0, 3.0]), np.array([2.0])) == 0.5
    with pytest.raises(InputError, match="real and corrupted"):
        separation(np.zeros(0), np.zeros(1))


def test_terms_prefer_real_pairs_to_mirrored_ones() -> None:
    rng = np.random.default_rng(4)
    entries = random_annotations(rng, dancers(6, 150), 150)
    bank = build_bank(entries.directions[:4], entries, num_candidates=60)
    limits = JointLimits.published()
    grown = PAIRS + rng.normal(scale=0.01, size=PAIRS.shape)
    real = term_values(PAIRS, limits, entries, bank, grown)
    assert "grown_D_I" not in term_values(PAIRS[:2], limits, entries, bank, PAIRS[:0])
    _, mirrored = corrupt(rng, PAIRS, VIEWS, Corruption.DEPTH_MIRRORED)
    values = term_values(mirrored, limits, entries, bank, grown)
    assert set(values) == set(real)
    assert all(np.isfinite(one).all() for one in values.values())
    assert separation(real["joint_limits"], values["joint_limits"]) > 0.9
    assert separation(real["grown_D_I"], values["grown_D_I"]) > 0.9
