"""Variations of body proportions: which bones of whom are scaled by how much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22

__all__ = [
    "LIMB_GROUPS",
    "PAPER_SCALES",
    "Variation",
    "bone_variations",
    "check_bone_scales",
    "drawn_variations",
    "group_variations",
    "leg_ratio",
    "population_variations",
    "scale_grid",
    "uniform_variations",
]

Array = npt.NDArray[np.float64]

PERSON_NAMES = ("A", "B")
"""Persons 0 and 1."""

LIMB_GROUPS: Mapping[str, tuple[str, ...]] = {
    "torso": ("spine1", "spine2", "spine3", "neck", "head"),
    "shoulders": ("left_collar", "right_collar", "left_shoulder", "right_shoulder"),
    "arms": ("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    "hips": ("left_hip", "right_hip"),
    "legs": ("left_knee", "right_knee", "left_ankle", "right_ankle", "left_toe", "right_toe"),
}
"""Bones (named by their child joint) that scale together; left and right always do, so a body stays symmetric."""

PAPER_SCALES: tuple[float, ...] = (0.75, 0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.25)
"""0.75 to 1.25 by 0.05 without the template's own 1 (Li et al. 2024, section 4)."""

DEVIATIONS: Mapping[str, float] = {
    **dict.fromkeys(("spine1", "spine2", "spine3", "neck", "head"), 35.69 / 918.29),
    **dict.fromkeys(("left_collar", "left_shoulder"), 19.16 / 415.68),
    "left_elbow": 17.48 / 335.24,
    "left_wrist": 15.42 / 267.88,
    "left_hip": 24.16 / 345.73,
    "left_knee": 30.58 / 617.95,
    "left_ankle": 28.12 / 488.39,
    "left_toe": 13.10 / 271.18,
}
"""Standard deviation of a bone's length over its mean among adults: 4,082 men of the US Army (Gordon et al. 2014,
"2012 Anthropometric Survey of U.S. Army Personnel", NATICK/TR-15/007).  Measures that stand for bones: sitting height
(spine), biacromial breadth (collar, shoulder), acromion-radiale and radiale-stylion length (arm), hip breadth,
buttock-knee length (thigh), mid-patella height (shank), foot length."""

_LEG_BONES = ("left_knee", "left_ankle", "right_knee", "right_ankle")
_LARGEST_SPREAD = 3.0
_SMALLEST_SCALE = 0.05
_LARGEST_SCALE = 20.0


@dataclass(frozen=True)
class Variation:
    """New proportions of both people: a name and a scale for every bone.

    Args:
        variant_id: Name, unique in a take, e.g. `A-uniform-0.80`.
        bone_scale: Scale of each bone (2, 22), a bone named by its child joint; the root's entry is the root height's.

    Raises:
        InputError: Wrong shape, or a scale that is not a positive number.
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


def check_bone_scales(bone_scale: Array, *, what: str = "bone_scale") -> None:
    """Refuse scales of the wrong shape, or outside 0.05 to 20 (zero, negative and non-finite ones included).

    Raises:
        InputError: With the person and bone at fault.
    """
    expected = (2, BODY22.num_joints)
    if bone_scale.shape[-2:] != expected:
        raise InputError(
            f"{what}: bone scales have shape {bone_scale.shape}, expected {expected} (person, body22 bone)"
        )
    is_bad = ~(np.isfinite(bone_scale) & (bone_scale >= _SMALLEST_SCALE) & (bone_scale <= _LARGEST_SCALE))
    if is_bad.any():
        at = tuple(int(i) for i in np.argwhere(is_bad)[0])
        raise InputError(
            f"{what}: the scale of person {PERSON_NAMES[at[-2]]}'s bone '{BODY22.joint_names[at[-1]]}' is "
            f"{bone_scale[at]:g}; allowed are {_SMALLEST_SCALE:g} to {_LARGEST_SCALE:g}"
        )


def scale_grid(start: float, stop: float, step: float) -> tuple[float, ...]:
    """Return the scales from `start` to `stop` (inclusive) by `step`, without 1, which is the template itself.

    >>> scale_grid(0.9, 1.1, 0.05)
    (0.9, 0.95, 1.05, 1.1)
    """
    if not (np.isfinite([start, stop, step]).all() and 0 < start <= stop and step > 0):
        raise InputError(
            f"a grid of scales from {start:g} to {stop:g} by {step:g}: allowed is 0 < start <= stop, step > 0"
        )
    count = int(np.floor((stop - start) / step + 1e-9)) + 1
    scales = (round(start + step * index, 6) for index in range(count))
    return tuple(scale for scale in scales if abs(scale - 1.0) > 1e-9)


def leg_ratio(bone_scale: Array, lengths_m: Array) -> Array:
    """Return new over old leg length (thigh and shin, both sides) of scales (*batch, 22) and lengths (22,)."""
    bones = BODY22.indices(_LEG_BONES)
    old = lengths_m[..., bones].sum(axis=-1)
    new = (lengths_m[..., bones] * bone_scale[..., bones]).sum(axis=-1)
    return np.asarray(np.where(old > 0, new / np.where(old > 0, old, 1.0), 1.0))


def uniform_variations(scales: Sequence[float], persons: Sequence[str] = ("A",)) -> list[Variation]:
    """Scale all bones of one person alike, or of both (`AB`), each by every scale.

    Args:
        scales: Scales, each positive.
        persons: Any of `A`, `B` and `AB` (both alike).

    Raises:
        InputError: Unknown person, or a scale that is not positive.
    """
    return [
        _variation(persons=person, kind="uniform", bones=BODY22.joint_names, scale=scale)
        for person in persons
        for scale in scales
    ]


def group_variations(
    scales: Sequence[float], persons: Sequence[str] = ("A",), groups: Sequence[str] = tuple(LIMB_GROUPS)
) -> list[Variation]:
    """Scale one group of limbs (`LIMB_GROUPS`) at a time; the root height follows the legs.

    Raises:
        InputError: Unknown group or person, or a scale that is not positive.
    """
    for group in groups:
        if group not in LIMB_GROUPS:
            raise InputError(f"limb group '{group}' is not known; known groups: {', '.join(LIMB_GROUPS)}")
    return [
        _variation(persons=person, kind=group, bones=LIMB_GROUPS[group], scale=scale)
        for person in persons
        for group in groups
        for scale in scales
    ]


def bone_variations(scales: Sequence[float], persons: Sequence[str] = ("A",)) -> list[Variation]:
    """Scale one bone at a time, left and right together; the root height follows the legs."""
    bones = []
    for index, name in enumerate(BODY22.joint_names):
        if index == BODY22.root or name.startswith("right_"):
            continue
        bones.append(tuple(dict.fromkeys((name, BODY22.joint_names[BODY22.mirror[index]]))))
    return [
        _variation(persons=person, kind=pair[0].removeprefix("left_"), bones=pair, scale=scale)
        for person in persons
        for pair in bones
        for scale in scales
    ]


def drawn_variations(
    generator: np.random.Generator,
    count: int,
    *,
    low: float,
    high: float,
    persons: str = "AB",
    is_symmetric: bool = True,
) -> list[Variation]:
    """Draw variations with every bone's scale uniform in [low, high], left and right alike unless told otherwise.

    Raises:
        InputError: A range that is not positive, or a negative count.
    """
    if not (0 < low <= high) or count < 0:
        raise InputError(
            f"{count} scales drawn from {low:g} to {high:g}: allowed is 0 < low <= high and a count from 0"
        )
    variations = []
    for index in range(count):
        bone_scale = np.ones((2, BODY22.num_joints))
        for person in _person_indices(persons):
            drawn = generator.uniform(low, high, BODY22.num_joints)
            if is_symmetric:
                drawn = drawn[np.minimum(np.arange(BODY22.num_joints), BODY22.mirror)]
            bone_scale[person] = drawn
        bone_scale[:, BODY22.root] = _root_scale(bone_scale)
        variations.append(Variation(f"{persons}-drawn-{index:04d}", bone_scale))
    return variations


def population_variations(
    generator: np.random.Generator, count: int, *, correlation: float = 0.8, spread: float = 1.0, persons: str = "AB"
) -> list[Variation]:
    """Draw bodies as they differ among adults: overall size and proportions, left and right alike.

    With z and z_b standard normal, cut at 3, the scale of bone b is 1 + spread c_b (r z + sqrt(1 - r^2) z_b): c_b from
    `DEVIATIONS`, r the correlation of a length with overall size.  So two lengths correlate by r^2.  The survey's own
    correlations are not used; 0.8 is a round middle of what long bones have with stature.

    Raises:
        InputError: A correlation outside 0 to 1, a spread outside 0 to 3, or a negative count.
    """
    if not (0 <= correlation <= 1 and 0 <= spread <= _LARGEST_SPREAD) or count < 0:
        raise InputError(
            f"{count} bodies with correlation {correlation:g} and spread {spread:g}: allowed are a count from 0, "
            f"0 to 1, and 0 to {_LARGEST_SPREAD:g}"
        )
    names = list(DEVIATIONS)
    bones = BODY22.indices(names)
    mirrored = [BODY22.mirror[bone] for bone in bones]
    deviations = np.array([DEVIATIONS[name] for name in names])
    variations = []
    for index in range(count):
        bone_scale = np.ones((2, BODY22.num_joints))
        for person in _person_indices(persons):
            size, each = np.split(np.clip(generator.standard_normal(1 + len(names)), -3.0, 3.0), [1])
            scale = 1.0 + spread * deviations * (correlation * size + np.sqrt(1.0 - correlation**2) * each)
            bone_scale[person, bones] = bone_scale[person, mirrored] = scale
        bone_scale[:, BODY22.root] = _root_scale(bone_scale)
        variations.append(Variation(f"{persons}-population-{index:04d}", bone_scale))
    return variations


def _variation(*, persons: str, kind: str, bones: Sequence[str], scale: float) -> Variation:
    bone_scale = np.ones((2, BODY22.num_joints))
    for person in _person_indices(persons):
        bone_scale[person, BODY22.indices(bones)] = scale
    if kind != "uniform":
        bone_scale[:, BODY22.root] = _root_scale(bone_scale)
    return Variation(
        f"{persons}-{kind}-{scale:.2f}" if round(scale, 2) == scale else f"{persons}-{kind}-{scale:g}", bone_scale
    )


def _root_scale(bone_scale: Array) -> Array:
    """Scale of the root height before the source's lengths are known: thigh and shin in equal parts."""
    return np.asarray(bone_scale[:, BODY22.indices(_LEG_BONES)].mean(axis=-1))


def _person_indices(persons: str) -> list[int]:
    known = {"A": [0], "B": [1], "AB": [0, 1]}
    if persons not in known:
        raise InputError(f"persons '{persons}' are not known; allowed are A, B and AB")
    return known[persons]
