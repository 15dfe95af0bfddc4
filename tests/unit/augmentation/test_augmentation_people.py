"""Variants of one person, and of more than two, follow the laws of variants of pairs."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.augmentation import AugmentationSettings, Augmenter, Source, uniform_variations
from pasdedeux.augmentation.source import points_of
from pasdedeux.augmentation.variations import Variation
from pasdedeux.choreography.duets import make_duet
from pasdedeux.interaction.contacts import stated_contacts
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from tests.builders.moving_pairs import standing_person, swaying_people


@pytest.mark.parametrize("solver", ["bulk", "polished"])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_bones_are_exact_and_the_source_is_its_own_variant_for_any_number(count: int, solver: str) -> None:
    source = Source(swaying_people(count, 12), 30.0)
    scales = np.random.default_rng(count).uniform(0.8, 1.2, (count, 22))
    variations = [Variation("same", np.ones((count, 22))), Variation("other", scales)]
    same, scaled = Augmenter(source, AugmentationSettings(solver=solver)).solve(variations)
    np.testing.assert_allclose(same.positions_m, source.positions_m, atol=1e-5)
    wanted = source.lengths_m * scales
    wanted[:, BODY22.root] = 0.0
    lengths = bone_lengths(BODY22, scaled.positions_m)
    np.testing.assert_allclose(lengths, np.broadcast_to(wanted, lengths.shape), atol=1e-9)
    assert scaled.energy <= scaled.energy_fk


def test_variants_do_not_depend_on_the_order_of_people() -> None:
    people, order = swaying_people(3, 16), [2, 0, 1]
    (variant,) = Augmenter(Source(people, 30.0)).solve(uniform_variations([0.85], ["A"], 3))
    (reordered,) = Augmenter(Source(people[:, order], 30.0)).solve(uniform_variations([0.85], ["B"], 3))
    # Sums round differently, so iterations end a fraction of a millimetre apart.
    np.testing.assert_allclose(reordered.positions_m, variant.positions_m[:, order], atol=2e-3)
    assert reordered.quality.num_contact_pairs == variant.quality.num_contact_pairs > 0


def test_a_trio_holds_hands_at_every_size() -> None:
    trio = make_duet("trio", duration_s=4.0, rate_hz=15.0)
    source, known = Source(trio.positions_m(), 15.0), trio.known_contacts(15.0)
    contacts = stated_contacts(known, source.num_frames, BODY22)
    variations = uniform_variations([0.75, 1.25], ["A", "B", "C"], 3)
    variants = Augmenter(source, user_contacts=known).solve(variations)
    before = np.linalg.norm(contacts.vectors(points_of(source.positions_m)), axis=-1)
    for variant in variants:
        after = np.linalg.norm(contacts.vectors(points_of(variant.positions_m)), axis=-1)
        assert np.percentile(np.abs(after - before), 95) < 0.005
        assert variant.quality.contact_drift_m < 0.1 * variant.quality.contact_drift_fk_m
        assert variant.verdict.level is not Level.FAIL


def test_a_person_alone_keeps_a_hand_on_the_other_arm_and_feet_on_the_floor() -> None:
    person = standing_person()
    forearm = person[BODY22.indices(["right_elbow", "right_wrist"])].mean(axis=0)
    person[BODY22.index("left_wrist")] = forearm + np.array([0.05, 0.05, 0.0])
    source = Source(np.repeat(person[None, None], 12, axis=0), 30.0)
    contacts = source.contacts()
    assert contacts.is_held.any()
    assert set(contacts.bones()[contacts.is_held].ravel()) >= set(BODY22.indices(["left_wrist", "right_wrist"]))
    for variant in Augmenter(source).solve(uniform_variations([0.8, 1.2], ["A"], 1)):
        assert variant.quality.contact_drift_p95_m < 0.005
        assert variant.quality.stance_excursion_m < 0.005
        assert variant.verdict.level is Level.PASS
    hanging = standing_person()
    assert not Source(hanging[None, None], 30.0).contacts().is_held.any()


def test_a_take_in_which_nobody_ever_stands_is_warned_of_unless_its_floor_is_said() -> None:
    people = swaying_people(1, 12) + np.linspace(0.0, 1.0, 12)[:, None, None, None] * [1.0, 0.0, 0.0]
    for floor_m, level in ((None, Level.WARN), (0.02, Level.PASS)):
        augmenter = Augmenter(Source(people, 30.0), AugmentationSettings(floor_m=floor_m))
        (variant,) = augmenter.solve(uniform_variations([0.95], ["A"], 1))
        assert variant.verdict.level is level
        assert ("nobody ever stands" in variant.verdict.reason) == (level is Level.WARN)
