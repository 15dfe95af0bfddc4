"""The built-in duets by name, and the torso basis learned from them."""

from __future__ import annotations

from difflib import get_close_matches
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import ValidationError

from pasdedeux.cameras.torso import TorsoBasis, learn_torso_basis
from pasdedeux.choreography.duet import Dance, Duet
from pasdedeux.choreography.hug import Hug
from pasdedeux.choreography.judo import Judo
from pasdedeux.choreography.lift import Lift
from pasdedeux.choreography.push_hands import PushHands
from pasdedeux.choreography.trio import Trio
from pasdedeux.choreography.waltz import Waltz
from pasdedeux.errors import InputError
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.skeletons.layouts import LAYOUTS

DUETS: dict[str, type[Dance]] = {
    "waltz": Waltz,
    "hug": Hug,
    "judo": Judo,
    "push_hands": PushHands,
    "lift": Lift,
    "trio": Trio,
}
"""The built-in duets by name."""

DRAWN_HEIGHTS_M = (1.5, 1.95)
"""Heights of drawn bodies, metres."""
DRAWN_SPEEDS = (0.85, 1.15)
"""Speeds of drawn duets."""

DEFAULT_DUETS = ("waltz", "hug", "judo", "push_hands")
"""Duets of a study that names no motion, from which the torso basis is learned."""


def make_duet(name: str, **style: object) -> Duet:
    """Make a built-in duet by name.

    Raises:
        InputError: The name is unknown (the nearest is given), or a value is not allowed.

    >>> make_duet("waltz", duration_s=1.0).num_frames
    60
    """
    return duet_style(name, **style).make(name)


def draw_styles(num_people: int, count: int, generator: np.random.Generator) -> list[dict[str, Any]]:
    """Draw variations, speeds and heights of everybody for several takes of a duet.

    All heights differ: each is drawn from its own part of `DRAWN_HEIGHTS_M`.
    """
    low, high = DRAWN_HEIGHTS_M
    bodies = count * num_people
    place = (generator.permutation(bodies) + generator.uniform(0.05, 0.95, bodies)) / bodies
    heights = np.round(low + (high - low) * place, 6).reshape(count, num_people)
    speeds = np.round(generator.uniform(*DRAWN_SPEEDS, count), 6)
    variations = generator.integers(1, 2**31, size=count)
    return [
        {"variation": int(variation), "speed": float(speed), "heights_m": tuple(map(float, row))}
        for variation, speed, row in zip(variations, speeds, heights, strict=True)
    ]


def duet_style(name: str, **style: object) -> Dance:
    """Return the style of a built-in duet, with defaults for missing settings."""
    if name not in DUETS:
        near = get_close_matches(name, DUETS, n=1)
        hint = f", did you mean '{near[0]}'?" if near else ""
        raise InputError(f"duet '{name}' is not known{hint}; known duets: {', '.join(DUETS)}")
    try:
        return DUETS[name].model_validate(style)
    except ValidationError as error:
        first = error.errors()[0]
        place, message = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
        prefix = f"{place} is {first['input']}: " if place else ""
        raise InputError(f"duet '{name}': {prefix}{message}") from None


@lru_cache
def duet_torso_basis() -> TorsoBasis:
    """Return the torso basis learned from both people of every default duet, 10 s each at 6 Hz.

    It serves studies that name no prior takes. It has seen those duets, so evaluation on them uses
    `proportions_torso_basis` instead.
    """
    motions = [motion for name in DEFAULT_DUETS for motion in make_duet(name, rate_hz=6.0).motions]
    poses = [derive_working_poses(motion, LAYOUTS["body22"]).pair17_m for motion in motions]
    return learn_torso_basis(np.concatenate(poses))
