"""Stored figures for people: in words, in a convenient unit."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from pasdedeux.evaluation.names import in_words


class FigureLabel(NamedTuple):
    """The words of a figure with the displayed unit, the factor to it, and the format."""

    words: str
    factor: float
    form: str


_SHOWN = {
    "_m_s3": FigureLabel("m/s^3", 1.0, ".3g"),
    "_m_s": FigureLabel("m/s", 1.0, ".3g"),
    "_m": FigureLabel("cm", 100.0, ".2f"),
    "_rad": FigureLabel("degrees", 180.0 / np.pi, ".3g"),
    "_s": FigureLabel("s", 1.0, ".2f"),
}
"""Displayed unit, factor and format by the ending of a figure's name."""


def figure_label(name: str) -> FigureLabel:
    """Return how a figure is shown.

    >>> [figure_label(name).words for name in ("contact_drift_m", "rhat_max", "num_fail_frames")]
    ['contact drift (cm)', 'R-hat, largest', 'number of fail frames']
    """
    ending = next((ending for ending in _SHOWN if name.endswith(ending)), "")
    words = re.sub("^num ", "number of ", in_words(name.removesuffix(ending)))
    unit, factor, form = _SHOWN.get(ending, ("", 1.0, ".4g"))
    return FigureLabel(f"{words} ({unit})" if unit else words, factor, form)


def value_words(name: str, value: Any) -> str:
    """Return a figure in words, in a unit that people read.

    >>> value_words("contact_drift_m", 0.00152), value_words("rhat_max", 1.25), value_words("bend_rad", np.pi)
    ('contact drift 0.15 cm', 'R-hat, largest 1.25', 'bend 180 degrees')
    """
    label, factor, form = figure_label(name)
    words, _, unit = label.removesuffix(")").partition(" (")
    return f"{words} {value * factor:{form}} {unit}".rstrip() if _is_finite(value) else f"{words} {plain(value)}"


def _is_finite(value: Any) -> bool:
    return isinstance(value, float | np.floating) and bool(np.isfinite(value))


def plain(value: Any) -> str:
    """Return a value in its displayed unit."""
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else f"{value:.4g}"
    return "-" if value is None else str(value)
