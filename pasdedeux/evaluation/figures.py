"""Curves, bars and scatter pictures of scores, as PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.drawing import figure_png

__all__ = ["Curve", "CurvePanel", "box_figure", "curve_figure", "grid_figure", "panel_figure", "view_figure"]

Array = npt.NDArray[np.float64]

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


def panel_figure(panels: Sequence[CurvePanel], *, title: str, x_label: str) -> bytes:
    """Draw panels side by side over a logarithmic x of one meaning; give PNG bytes."""
    from matplotlib.figure import Figure  # here: planning does not draw

    figure = Figure(figsize=(3.6 * max(len(panels), 1), 3.2), dpi=110)
    axes = figure.subplots(1, max(len(panels), 1), squeeze=False)[0]
    for axis, panel in zip(axes, panels, strict=False):
        axis.set_xscale("log")
        _draw_panel(axis, panel, x_label)
    if panels and panels[0].curves:
        axes[0].legend(fontsize=6)
    figure.suptitle(title, fontsize=9)
    figure.tight_layout()
    return figure_png(figure)


def curve_figure(
    curves: Sequence[Curve],
    *,
    title: str,
    x_label: str,
    y_label: str,
) -> bytes:
    """Draw curves over a common x; give PNG bytes."""
    from matplotlib.figure import Figure  # here: planning does not draw

    figure = Figure(figsize=(6.0, 3.4), dpi=110)
    axis = figure.subplots()
    _draw_panel(axis, CurvePanel(curves, y_label, {}), x_label)
    axis.set_title(title, fontsize=9)
    if curves:
        axis.legend(fontsize=7)
    figure.tight_layout()
    return figure_png(figure)


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
    axis.set_xlabel(x_label, fontsize=8)
    axis.set_ylabel(panel.y_label, fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(visible=True, alpha=0.25)


def box_figure(groups: Mapping[str, Array], *, title: str, y_label: str) -> bytes:
    """Draw one box (median, quartiles, 5th and 95th percentile) per group of values; give PNG bytes."""
    from matplotlib.figure import Figure  # here: planning does not draw

    figure = Figure(figsize=(max(4.0, 0.6 * len(groups) + 2.0), 3.2), dpi=110)
    axis = figure.subplots()
    names = [name for name, values in groups.items() if np.isfinite(values).any()]
    data = [np.asarray(groups[name])[np.isfinite(groups[name])] for name in names]
    if data:
        axis.boxplot(data, whis=(5, 95), showfliers=False)
        axis.set_xticks(
            np.arange(1, len(names) + 1),
            names,
            rotation=45 if len(names) > 5 else 0,
            ha="right" if len(names) > 5 else "center",
        )
    axis.set_title(title, fontsize=9)
    axis.set_ylabel(y_label, fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(visible=True, axis="y", alpha=0.25)
    figure.tight_layout()
    return figure_png(figure)


def grid_figure(values: Array, *, rows: Sequence[str], columns: Sequence[str], title: str) -> bytes:
    """Draw figures between 0 and 1 (row, column) as a coloured grid with each figure in its cell; give PNG bytes.

    A figure that is not finite leaves its cell empty.
    """
    from matplotlib.figure import Figure  # here: planning does not draw

    figure = Figure(figsize=(2.6 + 0.62 * len(columns), 1.6 + 0.24 * len(rows)), dpi=110)
    axis = figure.subplots()
    axis.imshow(np.asarray(values, dtype=np.float64), vmin=0.0, vmax=1.0, cmap="RdYlGn", aspect="auto", alpha=0.8)
    for row, column in np.argwhere(np.isfinite(values)).tolist():
        axis.text(column, row, f"{values[row, column]:.2f}", fontsize=7, ha="center", va="center")
    axis.set_xticks(np.arange(len(columns)), columns, rotation=45, ha="right")
    axis.set_yticks(np.arange(len(rows)), rows)
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=7)
    figure.tight_layout()
    return figure_png(figure)


def view_figure(psi_rad: Array, phi_rad: Array, weight: Array, *, title: str) -> bytes:
    """Draw view hypotheses (n,) over psi and phi, size by weight, as in Yin et al. 2018, fig. 4b; give PNG bytes."""
    from matplotlib.figure import Figure  # here: planning does not draw

    figure = Figure(figsize=(5.6, 3.2), dpi=110)
    axis = figure.subplots()
    axis.scatter(psi_rad, phi_rad, s=1.0 + 12.0 * np.asarray(weight), alpha=0.35, linewidths=0, color="#1f5fa8")
    axis.set_xlim(-np.pi, np.pi)
    axis.set_ylim(np.pi, 0)
    axis.set_xlabel("psi (rad)", fontsize=8)
    axis.set_ylabel("phi (rad)", fontsize=8)
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=7)
    figure.tight_layout()
    return figure_png(figure)
