"""Figures: measured values, each declared once with its column, words, limits and complaint.

A measurement is a dataclass; each of its fields declares a figure:

    drop_m: float = figure("Greatest drop of a joint", (0.1, 0.5))

`tasks/rows/figures.py` has the tables with these columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from pasdedeux.arrays import Integers
from pasdedeux.verdict import Level

Limits = Mapping[str, tuple[float, float]]
"""Limits by figure: past the first, a value is a warning; past the second, a failure."""

LEVELS = (Level.PASS, Level.WARN, Level.FAIL)
"""Levels by the number of limits that a figure is past."""
_UNITS = {"_m_s3": "m/s^3", "_m_s": "m/s", "_m": "m", "_rad": "rad", "_s": "s"}
"""Units by the ending of a name."""
_SHOWN = {"m": (" mm", 1e3), "rad": (" rad", 1.0)}
"""Units in sentences, and the factor from the figure's unit to them."""


@dataclass(frozen=True)
class Figure:
    """Declaration of a figure.

    Args:
        name: Name of its field, its column and its limits.
        unit: Its unit, with which the name ends.
        meaning: Its meaning, for the data dictionary and the report.
        better: Whether smaller or larger values are better; empty if unknown.
        limits: Past the first (above it; below it if larger is better) a value is a warning, past the second a failure;
            None if the figure is not judged.
        words: Its name in words.
        complaint: Sentence for a value past a limit, with fields of the dataclass in braces; the default gives value
            and limit.
        kind: Type of its column: float, int or str.
        is_nullable: Whether the column may be null.
    """

    name: str
    unit: str
    meaning: str
    better: str = ""
    limits: tuple[float, float] | None = None
    words: str = ""
    complaint: str = ""
    kind: str = "float"
    is_nullable: bool = False

    @property
    def metric(self) -> str:
        """The name of its scores, without mean, worst and so on."""
        return self.name.removesuffix("_m")

    def num_past(self, value: Any, limits: tuple[float, float]) -> Integers:
        """Return how many limits a value, or each value of an array, is past; 0 for NaN and None."""
        sign = -1.0 if self.better == "larger" else 1.0
        warned, failed = (sign * np.asarray(value, dtype=np.float64) > sign * limit for limit in limits)
        return np.add(warned, failed, dtype=np.int64)


def figure(meaning: str = "", limits: tuple[float, float] | None = None, **more: str) -> Any:
    """Declare a field of a dataclass as a `Figure`, optionally with `better`, `words` and `complaint`.

    The unit comes from the field's name, and so do the words by default.  By default, limits give the better direction.
    """
    given = {"meaning": meaning, "limits": limits, **more}
    return field(metadata={name: value for name, value in given.items() if value})


def figures_of(owner: type, like: Mapping[str, Figure] = MappingProxyType({})) -> dict[str, Figure]:
    """Return the figures of a dataclass by name, in its order; `like` gives defaults for fields of the same name."""
    figures = {}
    for member in fields(owner):
        if member.metadata or member.name in like:
            ending = next((ending for ending in _UNITS if member.name.endswith(ending)), "")
            words = member.name.removesuffix(ending).replace("_", " ")
            kind = member.type if member.type in ("int", "str") else "float"
            warn, fail = member.metadata.get("limits", (0.0, 0.0))
            better = "smaller" if warn < fail else "larger" if fail < warn else ""
            plain = Figure(member.name, _UNITS.get(ending, ""), "", better, words=words, kind=kind)
            known = like.get(member.name, plain)
            figures[member.name] = replace(known, is_nullable="None" in str(member.type), **member.metadata)
    return figures


def limits_of(figures: Mapping[str, Figure]) -> dict[str, tuple[float, float]]:
    """Return the limits of all judged figures."""
    return {name: figure_.limits for name, figure_ in figures.items() if figure_.limits is not None}


def complete_limits(figures: Mapping[str, Figure], given: Limits) -> dict[str, tuple[float, float]]:
    """Return the limits of all judged figures: given ones replace declared ones.

    Raises:
        ValueError: A figure is not judged, or limits are negative or in the wrong order.
    """
    known = limits_of(figures)
    for name, (warn, fail) in given.items():
        if name not in known:
            raise ValueError(f"'{name}' is no figure that is judged; there are: {', '.join(known)}")
        is_falling = figures[name].better == "larger"
        if not min(warn, fail) >= 0 or (warn < fail if is_falling else fail < warn):
            order = "fail <= warn" if is_falling else "warn <= fail"
            raise ValueError(f"{name} has warn {warn:g}, fail {fail:g}: allowed is 0 <= {order}")
    return {**known, **given}


def complaints(measured: Any, figures: Mapping[str, Figure], limits: Limits) -> Iterator[tuple[Figure, Level, str]]:
    """Yield each measured figure that is past a limit, with its level and a sentence."""
    for name, both in limits.items():
        declared, value = figures[name], getattr(measured, name)
        if count := int(declared.num_past(value, both)):
            unit, factor = _SHOWN.get(declared.unit, ("", 1.0))
            side = "below" if declared.better == "larger" else "above"
            plain = f"{declared.words} {factor * value:.3g}{unit} is {side} {factor * both[count - 1]:.3g}{unit}"
            yield declared, LEVELS[count], declared.complaint.format(**vars(measured)) or plain
