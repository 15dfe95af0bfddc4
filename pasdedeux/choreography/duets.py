"""The built-in duets by name."""

from __future__ import annotations

from difflib import get_close_matches
from inspect import signature
from typing import Protocol

from pasdedeux.choreography.duet import Duet
from pasdedeux.choreography.hug import make_hug
from pasdedeux.choreography.judo import make_judo
from pasdedeux.choreography.push_hands import make_push_hands
from pasdedeux.choreography.waltz import make_waltz
from pasdedeux.errors import InputError

__all__ = ["DUETS", "DuetMaker", "make_duet"]


class DuetMaker(Protocol):
    """Makes one of the built-in duets; style parameters of its own come as further keywords."""

    def __call__(
        self,
        *,
        duration_s: float = 10.0,
        rate_hz: float = 60.0,
        heights_m: tuple[float, float] = (1.82, 1.65),
        variation: int = 0,
    ) -> Duet:
        """Make the duet."""
        ...


DUETS: dict[str, DuetMaker] = {"waltz": make_waltz, "hug": make_hug, "judo": make_judo, "push_hands": make_push_hands}
"""The built-in duets by name."""


def make_duet(
    name: str,
    *,
    duration_s: float = 10.0,
    rate_hz: float = 60.0,
    heights_m: tuple[float, float] = (1.82, 1.65),
    variation: int = 0,
    **style: float,
) -> Duet:
    """Make a built-in duet by name.

    Args:
        name: One of `DUETS`.
        duration_s: Length in seconds.
        rate_hz: Frames per second; any rate samples the same motion.
        heights_m: Standing heights of person A and person B.
        variation: 0 for the dance as written, another number for another take of it.
        **style: Style parameters of that duet, see its maker.

    Raises:
        InputError: The name or a style parameter is unknown (the nearest is named), or a value is not allowed.

    >>> make_duet("waltz", duration_s=1.0).num_frames
    60
    """
    if name not in DUETS:
        raise InputError(f"duet '{name}' is not known{_nearest(name, list(DUETS))}; known duets: {', '.join(DUETS)}")
    known = list(signature(DUETS[name]).parameters)
    for key in style:
        if key not in known:
            raise InputError(
                f"duet '{name}': parameter '{key}' is not known{_nearest(key, known)}; known: {', '.join(known)}"
            )
    return DUETS[name](duration_s=duration_s, rate_hz=rate_hz, heights_m=heights_m, variation=variation, **style)


def _nearest(name: str, known: list[str]) -> str:
    nearest = get_close_matches(name, known, n=1)
    return f", did you mean '{nearest[0]}'?" if nearest else ""
