"""Curves, grids and scatter pictures of scores, as SVG: text stays text, and every figure can go into a paper."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.players import PERSON_COLOURS
from pasdedeux.skeletons import PAIR17

if TYPE_CHECKING:  # matplotlib is imported where it draws: 0.3 s that planning does not need
    from matplotlib.figure import Figure

_DOTS_PER_INCH = 90
"""Clouds of points are drawn as an image within the figure: thousands of shapes would be megabytes."""
_ORIGIN = np.zeros(2)
_LEVEL_GAP = 0.045  # share of an axis that the name of a level takes


@dataclass(frozen=True)
class Curve:
    """A named curve: x (n,), y (n,); baselines are drawn dashed."""

    name: str
    x: Array
    y: Array
    is_baseline: bool = False


@dataclass(frozen=True)
class CurvePanel:
    """Curves that share a panel, with the name of their y and horizontal levels by name."""

    curves: Sequence[Curve]
    y_label: str
    levels: Mapping[str, float]


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


def panel_figure(panels: Sequence[CurvePanel], *, title: str, x_label: str) -> bytes:
    """Draw panels side by side over a logarithmic x of one meaning; give SVG bytes."""
    columns = max(len(panels), 1)
    figure, ((*axes,),) = new_figure(3.6 * columns, 3.2, columns=columns)
    for axis, panel in zip(axes, panels, strict=False):
        axis.set_xscale("log")
        _draw_panel(axis, panel, x_label)
        axis.minorticks_off()  # over less than a decade their names would overlap
    if panels and panels[0].curves:
        axes[0].legend(fontsize=6)
    return figure_svg(figure, title=title)


def curve_figure(
    curves: Sequence[Curve],
    *,
    title: str,
    x_label: str,
    y_label: str,
) -> bytes:
    """Draw curves over a common x; give SVG bytes."""
    figure, ((axis,),) = new_figure(6.0, 3.4)
    _draw_panel(axis, CurvePanel(curves, y_label, {}), x_label)
    axis.set_title(title, fontsize=9)
    if curves:
        axis.legend(fontsize=7)
    return figure_svg(figure)


def _draw_panel(axis: Any, panel: CurvePanel, x_label: str) -> None:
    """Draw curves and levels; a level too close above another keeps its line and goes without its name."""
    for curve in panel.curves:
        axis.plot(curve.x, curve.y, linestyle="--" if curve.is_baseline else "-", marker=".", label=curve.name)
    for level in panel.levels.values():
        axis.axhline(level, color="#999999", linewidth=0.7)
    bottom, top = axis.get_ylim()
    named = bottom - (top - bottom)
    for name, level in sorted(panel.levels.items(), key=lambda item: item[1]):
        if level - named > _LEVEL_GAP * (top - bottom):
            axis.annotate(name, (1.0, level), xycoords=("axes fraction", "data"), fontsize=6, ha="right", va="bottom")
            named = level
    _label(axis, x_label, panel.y_label)
    axis.grid(visible=True, alpha=0.25)


def _label(axis: Any, x_label: str = "", y_label: str = "") -> None:
    axis.set_xlabel(x_label, fontsize=8)
    axis.set_ylabel(y_label, fontsize=8)
    axis.tick_params(labelsize=7)


def compared_figure(values: Mapping[str, float], baselines: Collection[str], *, goal: float, x_label: str) -> bytes:
    """Draw a bar for each method, hatched for baselines, and a line at what has to be beaten; give SVG bytes."""
    figure, ((axis,),) = new_figure(6.0, 0.9 + 0.28 * len(values))
    for row, (name, value) in enumerate(values.items()):
        is_plain = name in baselines
        axis.barh(row, value, color="#c9ced6" if is_plain else "#1f5fa8", hatch="//" if is_plain else None)
        axis.annotate(f"{value:.3g}", (value, row), xytext=(3, 0), textcoords="offset points", fontsize=7, va="center")
    axis.set_yticks(np.arange(len(values)), list(values))
    axis.invert_yaxis()
    axis.margins(x=0.12)
    if np.isfinite(goal):
        axis.axvline(goal, color="#a3123a", linestyle="--", linewidth=1.2)
    _label(axis, x_label)
    return figure_svg(figure)


def draw_pair(axis: Any, points: Array, place: Array = _ORIGIN) -> None:
    """Draw two people (person=2, joint=17, 2) as sticks with the middle of the joints there at a place (2,)."""
    shown = points - np.nanmean(points.reshape(-1, 2), axis=0) + place
    for person, colour in zip(shown, PERSON_COLOURS, strict=False):
        # One line for all bones, broken between them: hundreds of figures stay small.
        ends = np.array([[person[parent], person[child], (np.nan, np.nan)] for parent, child in PAIR17.bones])
        axis.plot(*ends.reshape(-1, 2).T, color=colour, linewidth=0.9, solid_capstyle="round")


def view_figure(psi_rad: Array, phi_rad: Array, weight: Array, *, title: str) -> bytes:
    """Draw view hypotheses (n,) over psi and phi, size by weight, as in Yin et al. 2018, fig. 4b; give SVG bytes."""
    figure, ((axis,),) = new_figure(5.6, 3.2)
    size = 1.0 + 12.0 * np.asarray(weight)
    axis.scatter(psi_rad, phi_rad, s=size, alpha=0.35, linewidths=0, color="#1f5fa8", rasterized=True)
    axis.set_xlim(-np.pi, np.pi)
    axis.set_ylim(np.pi, 0)
    _label(axis, "psi (rad)", "phi (rad)")
    axis.set_title(title, fontsize=9)
    return figure_svg(figure)
