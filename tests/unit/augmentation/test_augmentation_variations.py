"""Variations: names, scales of bones, and refused values."""

import numpy as np
import pytest

from pasdedeux.augmentation import LIMB_GROUPS, VariationSettings, uniform_variations
from pasdedeux.augmentation.variations import (
    PAPER_SCALES,
    Variation,
    bone_variations,
    group_variations,
    make_variations,
    scale_axes,
)
from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22


def test_a_uniform_variation_is_named_after_person_kind_and_scale() -> None:
    (variation,) = uniform_variations([0.8], ["A"])
    assert variation.variant_id == "A-uniform-0.80"
    assert variation.uniform_scale(0) == pytest.approx(0.8)
    assert variation.uniform_scale(1) == 1.0


def test_letters_name_people_who_are_there_and_each_variation_is_made_once() -> None:
    settings = VariationSettings(kinds=("uniform", "bones"), scales=(0.9,), persons=("A", "CA", "B", "all"))
    for count, persons in ((1, ["A"]), (2, ["A", "B", "AB"]), (3, ["A", "AC", "B", "ABC"])):
        variations = make_variations(settings, count)
        assert [v.variant_id.split("-")[0] for v in variations if "uniform" in v.variant_id] == persons
        assert all(v.bone_scale.shape == (count, 22) for v in variations)
    (both,) = (v for v in variations if v.variant_id == "AC-uniform-0.90")
    assert [both.uniform_scale(person) for person in range(3)] == [0.9, 1.0, 0.9]


def test_limb_groups_cover_every_bone_once_and_left_like_right() -> None:
    bones = [bone for group in LIMB_GROUPS.values() for bone in group]
    assert sorted(bones) == sorted(set(BODY22.joint_names) - {"pelvis"})
    for variation in group_variations([0.9]) + bone_variations([0.9]):
        assert np.all(variation.bone_scale[:, list(BODY22.mirror)] == variation.bone_scale)


def test_variant_names_are_unique() -> None:
    variations = uniform_variations(PAPER_SCALES, ["A", "B", "AB"])
    variations += group_variations(PAPER_SCALES, ["A", "B"]) + bone_variations(PAPER_SCALES, ["A", "B"])
    names = [variation.variant_id for variation in variations]
    assert len(set(names)) == len(names)


def test_longer_legs_raise_the_root() -> None:
    (legs,) = group_variations([1.2], ["A"], ["legs"])
    (arms,) = group_variations([1.2], ["A"], ["arms"])
    assert legs.bone_scale[0, BODY22.root] == pytest.approx(1.2)
    assert arms.bone_scale[0, BODY22.root] == 1.0


def test_scale_axes_finds_what_was_varied_by_itself() -> None:
    def axes(*parts: list[Variation]) -> dict[str, list[float]]:
        scales = np.stack([variation.bone_scale for part in parts for variation in part])
        return {label: values.tolist() for label, values in scale_axes(scales).items()}

    assert axes(uniform_variations([0.8, 1.2], ["A", "B"])) == {
        "person A": [0.8, 1.2, 1, 1],
        "person B": [1, 1, 0.8, 1.2],
    }
    groups = axes(group_variations([0.9], ["B"]), uniform_variations([1.2], ["A"]))
    assert list(groups) == ["person A", *(f"B {group}" for group in LIMB_GROUPS)]
    assert groups["B arms"] == [1, 1, 0.9, 1, 1, 1]
    bones = axes(bone_variations([0.9], ["A"]))
    assert len(bones) == len(bone_variations([0.9], ["A"])), "left and right together"
    assert all(sorted(values)[:2] == [0.9, 1.0] for values in bones.values()), "one at a time"


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf"), 1e6])
def test_a_scale_that_is_not_positive_is_refused_with_its_bone(scale: float) -> None:
    bone_scale = np.ones((2, 22))
    bone_scale[1, 3] = scale
    with pytest.raises(InputError, match=r"person B's bone 'spine3'"):
        Variation("bad", bone_scale)


def test_scales_of_the_wrong_length_are_refused() -> None:
    with pytest.raises(InputError, match=r"shape \(2, 21\), expected \(2, 22\)"):
        Variation("bad", np.ones((2, 21)))
