"""Sides of a split: training, validation or test. Takes are split, never their clips."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

SplitName = Literal["train", "validation", "test"]
SPLITS: tuple[SplitName, ...] = ("train", "validation", "test")


@dataclass(frozen=True)
class Side:
    """The side of a take, and the reason."""

    split: SplitName
    reason: str


def take_sides(
    is_held_out: Mapping[str, bool], seed: int = 0, *, known: Mapping[str, Side] | None = None
) -> dict[str, Side]:
    """Return the side of each take: those held out test, a tenth of the others validates, the rest trains.

    Where none is held out, a fifth of three takes or more tests.  At least one of two validates.  Which is decided by
    the seed and the names alone.

    Args:
        is_held_out: Whether each take is held out, by its name.
        seed: Decides.
        known: Takes that already have a side and keep it, so that training data are never tested on later.
    """
    sides = {name: side for name, side in (known or {}).items() if name in is_held_out}
    held = {name for name, is_held in is_held_out.items() if is_held}
    sides |= {name: Side("test", "held out by the study: nothing was learned from it") for name in held}
    free = [name for name in is_held_out if name not in held]
    ranked = sorted(free, key=lambda name: hashlib.sha256(f"{seed} {name}".encode()).hexdigest())
    num_test = 0 if held or len(ranked) < 3 else max(1, round(0.2 * len(ranked)))
    num_validation = 0 if len(ranked) - num_test < 2 else max(1, round(0.1 * len(ranked)))
    shares: tuple[tuple[SplitName, int, str], ...] = (
        (
            "test",
            num_test,
            f"no take is held out: one of the {num_test} of {len(ranked)} that seed {seed} drew to test",
        ),
        (
            "validation",
            num_validation,
            f"one of the {num_validation} of {len(ranked)} that seed {seed} drew to validate",
        ),
        ("train", len(ranked), "neither held out nor drawn"),
    )
    rest = [name for name in ranked if name not in sides]
    for split, share, reason in shares:
        num_new = max(0, share - sum(sides[name].split == split for name in ranked if name in sides))
        sides |= dict.fromkeys(rest[:num_new], Side(split, reason))
        rest = rest[num_new:]
    return {name: sides[name] for name in is_held_out}
