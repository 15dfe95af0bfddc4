"""Variations of body proportions: scales of some bones of some people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.people.names import person_name, person_names
from pasdedeux.plain_text import together
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22, Skeleton

EVERYBODY = "all"


def _check_persons(who: str) -> str:
    if who != EVERYBODY and not (who.isascii() and who.isalpha() and who.isupper()):
        raise ValueError(f"'{who}' names nobody; people are letters such as A, B or AC, everybody is {EVERYBODY}")
    return who


Persons = Annotated[str, AfterValidator(_check_persons)]

Group = Literal["torso", "shoulders", "arms", "hips", "legs"]

LIMB_GROUPS: Mapping[Group, tuple[str, ...]] = {
    "torso": ("spine1", "spine2", "spine3", "neck", "head"),
    "shoulders": ("left_collar", "right_collar", "left_shoulder", "right_shoulder"),
    "arms": ("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    "hips": ("left_hip", "right_hip"),
    "legs": ("left_knee", "right_knee", "left_ankle", "right_ankle", "left_toe", "right_toe"),
}
"""Bones (named by their child joint) that scale together; left and right always do, so a body stays symmetric."""

_LEG_BONES = ("left_knee", "left_ankle", "right_knee", "right_ankle")
_SMALLEST_SCALE, _LARGEST_SCALE = 0.05, 20.0

Scale = Annotated[float, Field(ge=_SMALLEST_SCALE, le=_LARGEST_SCALE)]


PAPER_SCALES = (0.75, 0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.25)
"""Without 1, the template itself (Li et al. 2024, section 4)."""


class VariationSettings(Settings):
    """Which variations are made."""

    kinds: tuple[Literal["uniform", "groups", "bones"], ...] = Field(
        ("uniform",), min_length=1, description="uniform, groups, bones"
    )
    persons: tuple[Persons, ...] = Field(
        ("A",),
        min_length=1,
        description="Who is scaled: A, B, C, ...; AB, BC, ... (alike); all (everybody alike, also after the 26th, Z).  "
        "Who a take does not have is skipped",
    )
    groups: tuple[Group, ...] = Field(tuple(LIMB_GROUPS), description="Limb groups of kind groups")
    scales: tuple[Scale, ...] = Field(PAPER_SCALES, min_length=1, description="Scales of the variants")


@dataclass(frozen=True)
class Variation:
    """New proportions of everybody: a name and a scale for every bone.

    Args:
        variant_id: Name, unique in a take, e.g. `A-uniform-0.80`.
        bone_scale: Scale of each bone (P, 22), a bone named by its child joint; the root's entry is the root height's.
    """

    variant_id: str
    bone_scale: Array

    def __post_init__(self) -> None:
        """Check the scales."""
        check_bone_scales(self.bone_scale, what=f"variant '{self.variant_id}'")

    def uniform_scale(self, person: int) -> float:
        """Return the one scale of all of a person's bones, or NaN where they differ."""
        scales = self.bone_scale[person]
        return float(scales[0]) if np.ptp(scales) < 1e-9 else float("nan")


def persons_of(who: str, num_people: int) -> list[int]:
    """Return the numbers of the people that letters (or "all") name, without absent ones.

    Letters name the first 26 people; all others are among "all" only.

    >>> persons_of("CA", 3), persons_of("AB", 1), persons_of("all", 2)
    ([0, 2], [0], [0, 1])
    """
    return [person for person, name in enumerate(person_names(num_people)) if who == EVERYBODY or name in set(who)]


def check_bone_scales(
    bone_scale: Array, num_people: int | None = None, *, what: str = "bone_scale", skeleton: Skeleton = BODY22
) -> None:
    """Refuse scales of the wrong shape, or outside 0.05 to 20 (zero, negative and non-finite ones included).

    With `num_people`, they must be for that number of people.

    Raises:
        InputError: With the person and bone at fault.
    """
    people = num_people or (bone_scale.shape[-2] if bone_scale.ndim > 1 else 2)
    expected = (people, skeleton.num_joints)
    if bone_scale.shape[-2:] != expected:
        raise InputError(
            f"{what}: bone scales have shape {bone_scale.shape}, expected {expected} (person, {skeleton.name} bone)"
        )
    is_bad = ~(np.isfinite(bone_scale) & (bone_scale >= _SMALLEST_SCALE) & (bone_scale <= _LARGEST_SCALE))
    if is_bad.any():
        at = tuple(int(i) for i in np.argwhere(is_bad)[0])
        raise InputError(
            f"{what}: the scale of person {person_name(at[-2])}'s bone '{skeleton.joint_names[at[-1]]}' is "
            f"{bone_scale[at]:g}; allowed are {_SMALLEST_SCALE:g} to {_LARGEST_SCALE:g}"
        )


def make_variations(settings: VariationSettings, num_people: int = 2) -> list[Variation]:
    """Return the requested variations, each once.

    A take without the persons named has none.
    """
    letters = ("".join(map(person_name, persons_of(who, num_people))) for who in settings.persons)
    persons, scales = list(dict.fromkeys(filter(None, letters))), settings.scales
    make = {
        "uniform": lambda: uniform_variations(scales, persons, num_people),
        "groups": lambda: group_variations(scales, persons, settings.groups, num_people),
        "bones": lambda: bone_variations(scales, persons, num_people),
    }
    variations = [variation for kind in settings.kinds for variation in make[kind]()]
    return list({variation.variant_id: variation for variation in variations}.values())


def variant_in_words(variant_id: str) -> str:
    """Describe the bones, people and scale of a variant; a name of another form stays as it is.

    >>> variant_in_words("A-uniform-0.75"), variant_in_words("AB-upper_arm-1.25"), variant_in_words("mine")
    ('all bones of A times 0.75', 'upper arm of A and B times 1.25', 'mine')
    """
    match variant_id.split("-"):
        case [who, kind, scale]:
            bones = "all bones" if kind == "uniform" else kind.replace("_", " ")
            return f"{bones} of {together(who)} times {scale}"
        case _:
            return variant_id


def leg_ratio(bone_scale: Array, lengths_m: Array, skeleton: Skeleton = BODY22) -> Array:
    """Return new over old leg length (thigh and shin, both sides) of scales (*batch, 22) and lengths (22,)."""
    bones = skeleton.indices(_LEG_BONES)
    old = lengths_m[..., bones].sum(axis=-1)
    new = (lengths_m[..., bones] * bone_scale[..., bones]).sum(axis=-1)
    return np.asarray(np.where(old > 0, new / np.where(old > 0, old, 1.0), 1.0))


def uniform_variations(
    scales: Sequence[float], persons: Sequence[str] = ("A",), num_people: int = 2
) -> list[Variation]:
    """Scale all bones of one person alike, or of several (`AB`), each by every scale."""
    return _scaled({"uniform": BODY22.joint_names}, scales, persons, num_people)


def group_variations(
    scales: Sequence[float],
    persons: Sequence[str] = ("A",),
    groups: Sequence[Group] = tuple(LIMB_GROUPS),
    num_people: int = 2,
) -> list[Variation]:
    """Scale one group of limbs (`LIMB_GROUPS`) at a time; the root height follows the legs."""
    return _scaled({group: LIMB_GROUPS[group] for group in groups}, scales, persons, num_people)


def bone_variations(scales: Sequence[float], persons: Sequence[str] = ("A",), num_people: int = 2) -> list[Variation]:
    """Scale one bone at a time, left and right together; the root height follows the legs."""
    bones: dict[str, tuple[str, ...]] = {}
    for index, name in enumerate(BODY22.joint_names):
        if index != BODY22.root and not name.startswith("right_"):
            mirrored = BODY22.joint_names[BODY22.mirror[index]]
            bones[name.removeprefix("left_")] = (name,) if name == mirrored else (name, mirrored)
    return _scaled(bones, scales, persons, num_people)


def scale_axes(bone_scale: Array) -> dict[str, Array]:
    """Return independent variations in scales (variant, person, 22): a person, a group of limbs, a bone and its mirror.

    The result has, by name, the scales of the variants (variant,), without what all have in common.

    >>> scale_axes(np.stack([one.bone_scale for one in group_variations([0.8, 1.2], ["B"], ["arms"])]))
    {'B arms': array([0.8, 1.2])}
    """
    axes: dict[str, Array] = {}
    for letter, person_scale in zip(person_names(bone_scale.shape[1]), np.moveaxis(bone_scale, 1, 0), strict=True):
        parts = {f"person {letter}": list(BODY22.joint_names[1:])}
        if _differ(person_scale[:, 1:]):
            parts = {}
            for group, names in LIMB_GROUPS.items():
                alone = {f"{letter} {name.removeprefix('left_')}": [name] for name in names if name[:6] != "right_"}
                parts |= (
                    alone if _differ(person_scale[:, BODY22.indices(names)]) else {f"{letter} {group}": list(names)}
                )
        axes |= {label: person_scale[:, BODY22.indices(names)[0]] for label, names in parts.items()}
    return {label: scales for label, scales in axes.items() if np.ptp(scales) > 1e-9}


def _differ(scales: Array) -> bool:
    """Tell whether bones of a variant differ in scales (variant, bone)."""
    return bool(np.ptp(scales, axis=1).max() > 1e-9)


def _scaled(
    bones: Mapping[str, Sequence[str]], scales: Sequence[float], persons: Sequence[str], num_people: int
) -> list[Variation]:
    """Scale each set of bones by every scale, for each of the persons."""
    variations = []
    for who in persons:
        for kind, names in bones.items():
            for scale in scales:
                bone_scale = np.ones((num_people, BODY22.num_joints))
                for person in persons_of(who, num_people):
                    bone_scale[person, BODY22.indices(names)] = scale
                if kind != "uniform":
                    # Before the source's lengths are known, the root's height follows thigh and shin in equal parts.
                    bone_scale[:, BODY22.root] = bone_scale[:, BODY22.indices(_LEG_BONES)].mean(axis=-1)
                shown = f"{scale:.2f}" if round(scale, 2) == scale else f"{scale:g}"
                variations.append(Variation(f"{who}-{kind}-{shown}", bone_scale))
    return variations
