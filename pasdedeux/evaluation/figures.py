"""Curves, bars and scatter pictures of scores, as PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.drawing import figure_png

__all__ = ["Curve", "box_figure", "curve_figure", "view_figure"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """A named curve: x (n,), y (n,); baselines are drawn dashed."""

    name: str
    x: Array
    y: Array
    is_baseline: bool = False


def curve_figure(
    curves: Sequence[Curve],
    *,
    title: str,
    x_label: str,
    y_label: str,
    is_log_x: bool = False,
    levels: Mapping[str, float] | None = None,
) -> bytes:
    """Draw curves over a common x, with named horizontal levels; give PNG bytes."""
    from matplotlib.figure import Figure  # here: planning does not draw

    figure = Figure(figsize=(6.0, 3.4), dpi=110)
    axis = figure.subplots()
    for curve in curves:
        axis.plot(curve.x, curve.y, linestyle="--" if curve.is_baseline else "-", marker=".", label=curve.name)
    for name, level in (levels or {}).items():
        axis.axhline(level, color="#999999", linewidth=0.8)
        axis.annotate(name, (1.0, level), xycoords=("axes fraction", "data"), fontsize=6, ha="right", va="bottom")
    if is_log_x:
        axis.set_xscale("log")
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(x_label, fontsize=8)
    axis.set_ylabel(y_label, fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(visible=True, alpha=0.25)
    if curves:
        axis.legend(fontsize=7)
    figure.tight_layout()
    return figure_png(figure)


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
