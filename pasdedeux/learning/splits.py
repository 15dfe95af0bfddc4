"""Splits of variants into training, validation and test set (Li et al. 2024, section 5.1; validation is ours).

Validation serves to choose or stop a model: it is never learned from, never tested on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22

SplitName = Literal[
    "random",
    "cross_scale",
    "extrapolation",
    "cross_interaction",
    "cross_interaction_swapped",
    "cross_scale_interaction",
    "cross_scale_interaction_swapped",
]
SPLIT_NAMES = get_args(SplitName)
"""random: a fifth of the variants; cross_scale: near scales train, far ones test, of the same takes; extrapolation:
near scales train, those beyond all others test (0.65 and 1.3 in the paper), of the same takes; cross_interaction: some
interactions train, others test; cross_scale_interaction: both.  In the swapped ones the halves change places.  Variants
beyond the far scales are in no split but extrapolation.  Validation is of the takes and scales that do not test: scales
between near and far where these are split, a take where takes are and there are enough, otherwise a tenth of the
variants."""

_SWAPPED = "_swapped"

TRAIN_REACH = 0.05
"""Training scales lie in [0.95, 1.05]."""
TEST_REACH = (0.15, 0.25)
"""Test scales lie in [0.75, 0.85] or [1.15, 1.25]."""

_TEST_SHARE = 0.2
_VALIDATION_SHARE = 0.1
_FEWEST_TAKES = 4
"""Takes beside those tested on, of which one is left to validation."""
_ROUNDING = 1e-6


@dataclass(frozen=True)
class VariantKey:
    """A variant for splits: its take, its name, its scales (2, 22), and the interaction of the take.

    Takes of one interaction, such as two waltzes, are never on both sides of a split across interactions, whichever of
    them are named as test takes or held out; a take without one counts as its own interaction.
    """

    take_id: str
    variant_id: str
    bone_scale: Array
    interaction: str = ""

    @property
    def furthest_scale(self) -> float:
        """The scale furthest from 1 over all bones of both persons; the root height is no bone."""
        scales = np.delete(self.bone_scale, BODY22.root, axis=1)
        return float(scales.flat[np.argmax(np.abs(scales - 1.0))])

    @property
    def reach(self) -> float:
        """Largest distance of a bone's scale from 1."""
        return abs(self.furthest_scale - 1.0)


@dataclass(frozen=True)
class Split:
    """Training, validation and test variants; no two share a variant.

    Args:
        name: Name of the split.
        train: Variants trained on.
        validation: Variants that models are chosen by; none where there are too few.
        test: Variants tested on.
        shares_takes: Takes in the test set are also in the training set, by design of the split.
    """

    name: str
    train: tuple[VariantKey, ...]
    validation: tuple[VariantKey, ...]
    test: tuple[VariantKey, ...]
    shares_takes: bool


def make_split(
    name: str,
    keys: Sequence[VariantKey],
    generator: np.random.Generator,
    *,
    test_takes: Sequence[str] = (),
    held_out: Sequence[str] = (),
) -> Split:
    """Split variants.

    Args:
        name: One of `SPLIT_NAMES`.
        keys: All variants.
        generator: Decides the random split.
        test_takes: Takes that splits across interactions test on, and swapped ones learn from; the other splits leave
            them out.  Splits across interactions need some: where none are given (nor held out), they are those of the
            later half of the interactions by name.  A take stands for all of its interaction there.
        held_out: Takes that nothing is learned from: tested on across interactions, swapped or not, with all takes of
            their interactions; else skipped.

    Raises:
        InputError: Unknown split, or its training or test set is empty.
    """
    if name not in SPLIT_NAMES:
        raise InputError(f"split '{name}' is not known; known splits: {', '.join(SPLIT_NAMES)}")
    kind = name.removesuffix(_SWAPPED)
    ordered = sorted(keys, key=lambda key: (key.take_id, key.variant_id))
    takes = {key.take_id for key in ordered}
    is_across = kind in ("cross_interaction", "cross_scale_interaction")
    tested = takes & {*test_takes, *held_out}
    if is_across:
        tested = _tested_takes(name, ordered, takes & set(test_takes), takes & set(held_out))
    within = ordered if kind == "extrapolation" else [key for key in ordered if key.reach <= TEST_REACH[1] + _ROUNDING]
    known, test = _part(within, lambda key: key.take_id not in tested)
    left: list[VariantKey] = []
    if is_across and len({key.take_id for key in known}) >= _FEWEST_TAKES:
        last = max(key.take_id for key in known)
        known, left = _part(known, lambda key: key.take_id != last)
    if kind == "random":
        test, known = _draw(known, _TEST_SHARE, generator, fewest=1)
    elif not is_across:
        test = known
    train = known
    if kind in ("cross_scale", "cross_scale_interaction"):
        test, (train, others) = [key for key in test if _is_far(key)], _part(known, _is_near)
        left = [key for key in left if _is_far(key)] or [key for key in others if key.reach < TEST_REACH[0] - _ROUNDING]
    elif kind == "extrapolation":
        test, (train, others) = [key for key in test if _is_beyond(key)], _part(known, _is_near)
        left = [key for key in others if not _is_beyond(key)]
    if not left:
        left, train = _draw(train, _VALIDATION_SHARE, generator, fewest=0)
    for what, keys_of_part in (("training", train), ("test", test)):
        if not keys_of_part:
            raise InputError(
                f"split '{name}' has no {what} variant among {len(keys)} variants of "
                f"{counted(len(takes), 'take')}; it needs {_NEEDS[kind]}"
            )
    return Split(name, tuple(train), tuple(left), tuple(test), shares_takes=not is_across)


def _tested_takes(name: str, keys: Sequence[VariantKey], stated: set[str], held_out: set[str]) -> set[str]:
    """Return the takes that a split across interactions tests on; nothing is ever learned from those held out."""
    interactions = {key.take_id: key.interaction or key.take_id for key in keys}
    stated, held_out = (
        {take for take, what in interactions.items() if what in {interactions[take_id] for take_id in named}}
        for named in (stated, held_out)
    )
    free = {take: what for take, what in interactions.items() if take not in held_out}
    is_swapped = name.endswith(_SWAPPED)
    if not stated and (is_swapped or not held_out):
        kinds = sorted(set(free.values()))
        stated = {take for take, what in free.items() if what in kinds[(len(kinds) + 1) // 2 :]}
    return (set(free) - stated if is_swapped else stated) | held_out


_NEEDS = {
    "random": "at least two variants with scales within 0.75 to 1.25",
    "cross_scale": "scales within 0.95 to 1.05, and within 0.75 to 0.85 or 1.15 to 1.25",
    "extrapolation": "scales within 0.95 to 1.05, and below 0.75 or above 1.25, such as 0.65 and 1.3",
    "cross_interaction": "variants of at least two takes that are not of one interaction, or training.test_takes",
    "cross_scale_interaction": "at least two takes that are not of one interaction, scales within 0.95 to 1.05 of the "
    "one and 0.75 to 0.85 or 1.15 to 1.25 of the other",
}


def _is_near(key: VariantKey) -> bool:
    return key.reach <= TRAIN_REACH + _ROUNDING


def _is_far(key: VariantKey) -> bool:
    return TEST_REACH[0] - _ROUNDING <= key.reach <= TEST_REACH[1] + _ROUNDING


def _is_beyond(key: VariantKey) -> bool:
    return key.reach > TEST_REACH[1] + _ROUNDING


def _part(keys: Sequence[VariantKey], is_in: Callable[[VariantKey], bool]) -> tuple[list[VariantKey], list[VariantKey]]:
    """Return the variants with a property, and the others."""
    return [key for key in keys if is_in(key)], [key for key in keys if not is_in(key)]


def _draw(
    keys: list[VariantKey], share: float, generator: np.random.Generator, *, fewest: int
) -> tuple[list[VariantKey], list[VariantKey]]:
    """Return a share of the variants, drawn, and the others."""
    count = max(round(share * len(keys)), fewest)
    chosen = set(generator.permutation(len(keys))[:count].tolist())
    drawn = [keys[index] for index in sorted(chosen)]
    return drawn, [key for index, key in enumerate(keys) if index not in chosen]
