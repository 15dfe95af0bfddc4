from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.augmentation import LIMB_GROUPS, VariationSettings, uniform_variations
from pasdedeux.augmentation.variations import (
    PAPER_SCALES,
    DrawnBodies,
    DrawnScales,
    Variation,
    bone_variations,
    drawn_variations,
    group_variations,
    make_variations,
    population_variations,
)
from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22


def test_a_uniform_variation_is_named_after_person_kind_and_scale() -> None:
    (variation,) = uniform_variations([0.8], ["A"])
    assert variation.variant_id == "A-uniform-0.80"
    assert variation.uniform_scale(0) == pytest.approx(0.8)
    assert variation.uniform_scale(1) == 1.0


def test_both_people_scale_alike_under_ab() -> None:
    (variation,) = uniform_variations([1.2], ["AB"])
    assert np.all(variation.bone_scale == 1.2)


def test_letters_name_those_who_are_there_and_each_variation_is_made_once() -> None:
    settings = VariationSettings(
        kinds=("uniform", "drawn"), scales=(0.9,), persons=("A", "CA", "B", "all"), drawn=DrawnScales(count=1)
    )
    made = {
        count: make_variations(settings, lambda *labels: np.random.default_rng(len(str(labels))), count)
        for count in (1, 2, 3)
    }
    names = {
        count: [v.variant_id.split("-")[0] for v in found if "uniform" in v.variant_id] for count, found in made.items()
    }
    assert names == {1: ["A"], 2: ["A", "B", "AB"], 3: ["A", "AC", "B", "ABC"]}
    assert all(v.bone_scale.shape == (count, 22) for count, found in made.items() for v in found)
    (both,) = (v for v in made[3] if v.variant_id == "AC-uniform-0.90")
    assert [both.uniform_scale(person) for person in range(3)] == [0.9, 1.0, 0.9]


def test_limb_groups_cover_every_bone_once_and_left_like_right() -> None:
    bones = [bone for group in LIMB_GROUPS.values() for bone in group]
    assert sorted(bones) == sorted(set(BODY22.joint_names) - {"pelvis"})
    for variation in group_variations([0.9]) + bone_variations([0.9]):
        assert np.all(variation.bone_scale[:, list(BODY22.mirror)] == variation.bone_scale)


def test_variant_names_are_unique() -> None:
    variations = uniform_variations(PAPER_SCALES, ["A", "B", "AB"])
    variations += group_variations(PAPER_SCALES, ["A", "B"]) + bone_variations(PAPER_SCALES, ["A", "B"])
    variations += drawn_variations(np.random.default_rng(1), DrawnScales(low=0.5, high=1.5))
    names = [variation.variant_id for variation in variations]
    assert len(set(names)) == len(names)


def test_longer_legs_raise_the_root() -> None:
    (legs,) = group_variations([1.2], ["A"], ["legs"])
    (arms,) = group_variations([1.2], ["A"], ["arms"])
    assert legs.bone_scale[0, BODY22.root] == pytest.approx(1.2)
    assert arms.bone_scale[0, BODY22.root] == 1.0


def test_the_same_generator_draws_the_same_variations() -> None:
    first, second = (drawn_variations(np.random.default_rng(3), DrawnScales(count=4)) for _ in range(2))
    assert all(np.array_equal(a.bone_scale, b.bone_scale) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf"), 1e6])
def test_a_scale_that_is_not_positive_is_refused_with_its_bone(scale: float) -> None:
    bone_scale = np.ones((2, 22))
    bone_scale[1, 3] = scale
    with pytest.raises(InputError, match=r"person B's bone 'spine3'"):
        Variation("bad", bone_scale)


def test_scales_of_the_wrong_length_are_refused() -> None:
    with pytest.raises(InputError, match=r"shape \(2, 21\), expected \(2, 22\)"):
        Variation("bad", np.ones((2, 21)))


@pytest.mark.parametrize(
    "settings",
    [
        {"persons": ("cat",)},
        {"groups": ("wings",)},
        {"kinds": ("spiral",)},
        {"drawn": {"low": 1.2, "high": 0.8}},
        {"population": {"correlation": 1.5}},
    ],
)
def test_variations_that_cannot_be_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        VariationSettings.model_validate(settings)


def test_bodies_differ_as_the_survey_says_and_long_bones_belong_to_tall_people() -> None:
    drawn = population_variations(np.random.default_rng(0), DrawnBodies(count=4000), "A")
    scales = np.stack([variation.bone_scale[0] for variation in drawn])
    thigh, arm = BODY22.index("left_knee"), BODY22.index("left_elbow")
    # Standard errors of a deviation and a correlation of 4,000 draws are about 1 %.
    assert scales[:, thigh].std() == pytest.approx(30.58 / 617.95, rel=0.05)
    assert scales[:, thigh].mean() == pytest.approx(1.0, abs=0.005)
    assert np.corrcoef(scales[:, thigh], scales[:, arm])[0, 1] == pytest.approx(0.64, abs=0.05)
    np.testing.assert_array_equal(scales, scales[:, BODY22.mirror])
    assert all((variation.bone_scale[1] == 1.0).all() for variation in drawn)


def test_a_population_without_spread_is_the_template() -> None:
    (one,) = population_variations(np.random.default_rng(0), DrawnBodies(count=1, spread=0.0))
    np.testing.assert_array_equal(one.bone_scale, 1.0)
    assert one.variant_id == "AB-population-0000"
