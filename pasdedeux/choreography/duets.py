"""The built-in duets by name, and what they teach of torsos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
from typing import Any, Generic, TypeVar

import numpy as np
from pydantic import ValidationError

from pasdedeux.cameras.torso import TorsoBasis, learn_torso_basis
from pasdedeux.choreography.duet import Duet, DuetStyle
from pasdedeux.choreography.hug import HugStyle, make_hug
from pasdedeux.choreography.judo import JudoStyle, make_judo
from pasdedeux.choreography.lift import LiftStyle, make_lift
from pasdedeux.choreography.push_hands import PushHandsStyle, make_push_hands
from pasdedeux.choreography.trio import TrioStyle, make_trio
from pasdedeux.choreography.waltz import WaltzStyle, make_waltz
from pasdedeux.errors import InputError
from pasdedeux.formats.working_poses import derive_working_poses
from pasdedeux.skeletons.layouts import LAYOUTS

S = TypeVar("S", bound=DuetStyle)

_TORSO_DURATION_S, _TORSO_RATE_HZ = 10.0, 6.0


@dataclass(frozen=True)
class Dance(Generic[S]):
    """A built-in duet: the model of its style, and what makes it."""

    style: type[S]
    make: Callable[[S], Duet]


DUETS: dict[str, Dance[Any]] = {
    "waltz": Dance(WaltzStyle, make_waltz),
    "hug": Dance(HugStyle, make_hug),
    "judo": Dance(JudoStyle, make_judo),
    "push_hands": Dance(PushHandsStyle, make_push_hands),
    "lift": Dance(LiftStyle, make_lift),
    "trio": Dance(TrioStyle, make_trio),
}
"""The built-in duets by name."""

DRAWN_HEIGHTS_M = (1.5, 1.95)
"""Heights of drawn bodies, metres."""
DRAWN_SPEEDS = (0.85, 1.15)
"""Speeds of drawn duets."""

DEFAULT_DUETS = ("waltz", "hug", "judo", "push_hands")
"""What a study that names no motion gets, and what the torso basis is learned from."""


def make_duet(name: str, **style: object) -> Duet:
    """Make a built-in duet by name.

    Args:
        name: One of `DUETS`.
        **style: Values of that duet's style, such as `duration_s`, `rate_hz`, `heights_m`, `variation` and its own.

    Raises:
        InputError: The name or a style parameter is unknown (the nearest is named), or a value is not allowed.

    >>> make_duet("waltz", duration_s=1.0).num_frames
    60
    """
    chosen = style_of(name, **style)
    if chosen.speed == 1.0:
        return DUETS[name].make(chosen)
    # Sampled coarsely over a longer time, and played faster: the same number of frames.
    slow = {"duration_s": chosen.duration_s * chosen.speed, "rate_hz": chosen.rate_hz / chosen.speed}
    made = DUETS[name].make(chosen.model_copy(update=slow)).at_speed(chosen.speed)
    return replace(made, parameters=chosen.model_dump())


def draw_styles(num_people: int, count: int, generator: np.random.Generator) -> list[dict[str, Any]]:
    """Draw variation, speed and heights of everybody for so many takes of a duet.

    Nobody is as tall as anybody else: each height is from a part of `DRAWN_HEIGHTS_M` of its own.
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


def style_of(name: str, **style: object) -> DuetStyle:
    """Return the style of a built-in duet, with defaults for what is not given.

    Raises:
        InputError: As `make_duet` does.
    """
    if name not in DUETS:
        raise InputError(f"duet '{name}' is not known{_nearest(name, list(DUETS))}; known duets: {', '.join(DUETS)}")
    dance = DUETS[name]
    known = list(dance.style.model_fields)
    for key in style:
        if key not in known:
            raise InputError(
                f"duet '{name}': parameter '{key}' is not known{_nearest(key, known)}; known: {', '.join(known)}"
            )
    try:
        return dance.style.model_validate(style)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        message = (
            f"{place} is {first['input']}: {first['msg']}" if place else first["msg"].removeprefix("Value error, ")
        )
        raise InputError(f"duet '{name}': {message}") from None


@lru_cache
def duet_torso_basis() -> TorsoBasis:
    """Return the torso basis learned from both people of every default duet, 10 s each at 6 Hz.

    For studies that name no prior takes.  It has seen those duets: what is evaluated on them takes
    `proportions_torso_basis` instead.
    """
    style = {"duration_s": _TORSO_DURATION_S, "rate_hz": _TORSO_RATE_HZ}
    motions = [motion for name in DEFAULT_DUETS for motion in make_duet(name, **style).motions]
    poses = [derive_working_poses(motion, LAYOUTS["body22"]).pair17_m for motion in motions]
    return learn_torso_basis(np.concatenate(poses))


def _nearest(name: str, known: list[str]) -> str:
    nearest = get_close_matches(name, known, n=1)
    return f", did you mean '{nearest[0]}'?" if nearest else ""
