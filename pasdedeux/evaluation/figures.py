"""Curves, bars and people as SVG: text stays text, and every figure can go into a paper."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.players import PERSON_COLOURS
from pasdedeux.skeletons import PAIR17

if TYPE_CHECKING:  # matplotlib is imported where it draws: 0.3 s that planning does not need
    from matplotlib.figure import Figure

CLOUD: Mapping[str, Any] = {"linewidths": 0, "rasterized": True}
"""Clouds of points are drawn as an image within the figure: thousands of shapes would be megabytes."""
_DOTS_PER_INCH = 90
_ORIGIN = np.zeros(2)
_LEVEL_GAP = 0.045  # share of an axis that the name of a level takes


@dataclass(frozen=True)
class CurvePanel:
    """Curves over a common x: by name x (n,) and y (n,), baselines dashed, and horizontal levels by name."""

    y_label: str
    curves: Mapping[str, tuple[Array, Array]]
    baselines: Collection[str] = ()
    levels: Mapping[str, float] = field(default_factory=dict)


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, *, has_common_axes: bool = False
) -> tuple[Figure, Any]:
    """Return an empty figure of this size in inches and its axes (row, column), all with the same ranges if wished."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=has_common_axes, sharey=has_common_axes)


def figure_svg(figure: Figure, *, title: str = "") -> bytes:
    """Lay out a figure, with a title over all of it, and render it to SVG bytes that depend on the picture alone."""
    from matplotlib import rc_context

    if title:
        figure.suptitle(title, fontsize=9)
    figure.tight_layout()
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "pasdedeux", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", dpi=_DOTS_PER_INCH, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def label_axis(axis: Any, x_label: str = "", y_label: str = "") -> None:
    """Name both directions of an axis."""
    axis.set_xlabel(x_label, fontsize=8)
    axis.set_ylabel(y_label, fontsize=8)
    axis.tick_params(labelsize=7)


def fit_map(figure: Figure, axis: Any, *, scale: float, limits: tuple[float, float]) -> None:
    """Give both directions of a map the same scale, and the figure the height that this needs, inches in limits."""
    axis.set_aspect("equal")
    width, height = (float(np.ptp(ends)) for ends in (axis.get_xlim(), axis.get_ylim()))
    figure.set_figheight(float(np.clip(0.9 + scale * height / width, *limits)))


def curve_figure(panels: Sequence[CurvePanel], *, title: str, x_label: str, is_log: bool = False) -> bytes:
    """Draw panels side by side over an x of one meaning; give SVG bytes."""
    columns = max(len(panels), 1)
    figure, ((*axes,),) = new_figure(6.0 if columns == 1 else 3.6 * columns, 3.3, columns=columns)
    for axis, panel in zip(axes, panels, strict=False):
        if is_log:
            axis.set_xscale("log")
        _draw_panel(axis, panel, x_label)
        axis.minorticks_off()  # over less than a decade their names would overlap
    if panels and panels[0].curves:
        axes[0].legend(fontsize=6)
    return figure_svg(figure, title=title)


def _draw_panel(axis: Any, panel: CurvePanel, x_label: str) -> None:
    """Draw curves and levels; a level too close above another keeps its line and goes without its name."""
    for name, (x, y) in panel.curves.items():
        axis.plot(x, y, linestyle="--" if name in panel.baselines else "-", marker=".", label=name)
    for level in panel.levels.values():
        axis.axhline(level, color="#999999", linewidth=0.7)
    bottom, top = axis.get_ylim()
    named = bottom - (top - bottom)
    for name, level in sorted(panel.levels.items(), key=lambda item: item[1]):
        if level - named > _LEVEL_GAP * (top - bottom):
            axis.annotate(name, (1.0, level), xycoords=("axes fraction", "data"), fontsize=6, ha="right", va="bottom")
            named = level
    label_axis(axis, x_label, panel.y_label)
    axis.grid(visible=True, alpha=0.25)


def compared_figure(values: Mapping[str, float], baselines: Collection[str], *, goal: float, x_label: str) -> bytes:
    """Draw a bar for each method, hatched for baselines, and a line at what has to be beaten; give SVG bytes."""
    figure, ((axis,),) = new_figure(6.0, 0.9 + 0.28 * len(values))
    for row, (name, value) in enumerate(values.items()):
        is_baseline = name in baselines
        axis.barh(row, value, color="#c9ced6" if is_baseline else "#1f5fa8", hatch="//" if is_baseline else None)
        axis.annotate(f"{value:.3g}", (value, row), xytext=(3, 0), textcoords="offset points", fontsize=7, va="center")
    axis.set_yticks(np.arange(len(values)), list(values))
    axis.invert_yaxis()
    axis.margins(x=0.12)
    if np.isfinite(goal):
        axis.axvline(goal, color="#a3123a", linestyle="--", linewidth=1.2)
    label_axis(axis, x_label)
    return figure_svg(figure)


def draw_pair(axis: Any, points: Array, place: Array = _ORIGIN) -> None:
    """Draw two people (person=2, joint=17, 2) as sticks with the middle of the joints there at a place (2,)."""
    shown = points - np.nanmean(points.reshape(-1, 2), axis=0) + place
    for person, colour in zip(shown, PERSON_COLOURS, strict=False):
        # One line for all bones, broken between them: hundreds of figures stay small.
        ends = np.array([[person[parent], person[child], (np.nan, np.nan)] for parent, child in PAIR17.bones])
        axis.plot(*ends.reshape(-1, 2).T, color=colour, linewidth=0.9, solid_capstyle="round")
