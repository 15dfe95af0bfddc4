"""Figures over time in the panel: a curve, and a strip with people, contacts and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from flows.viewing.bodies import THROUGH_M, TOUCH_M
from flows.viewing.panel import Panel
from flows.viewing.scene import Scene
from flows.viewing.side_picture import INK, PAPER, flat_picture
from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.evaluation.pictures import person_rgb
from pasdedeux.evaluation.shown_figures import figure_label

TICKS = "contact (green), overlap (red), verdicts"
_WIDTH = 640
_GREEN, _RED = (20, 160, 60), (220, 20, 60)


class Curves:
    """The folder of the panel with figures over the frames of the scene.

    Args:
        panel: The panel.
    """

    def __init__(self, panel: Panel) -> None:
        self._folder = panel.gui.add_folder("Curve")
        with self._folder:
            self.chosen = panel.gui.add_dropdown("figure", ("none",))
            self._plot = panel.gui.add_image(flat_picture([]), visible=False)
        self._curves: list[Array] = []

    def show(self, scene: Scene) -> None:
        """Take the figures of a scene, and those of other chains."""
        known = {}
        for name, curve in scene.curves.items():
            label, factor, _ = figure_label(name)
            values = factor * np.asarray(curve, dtype=np.float64)
            if np.fmax.reduce(values) > np.fmin.reduce(values):
                known[label] = values
        if known and tuple(known) != self.chosen.options:
            self.chosen.options = tuple(known)
        self.chosen.visible = self._plot.visible = bool(known)
        self._folder.visible = bool(known)
        others = scene.others if known and self.chosen.value == next(iter(known)) else ()
        self._curves = [*others, known[str(self.chosen.value)]] if known else []

    def draw(self, frame: int) -> None:
        """Draw the chosen figure with a line at a frame."""
        if self._curves:
            self._plot.image = plot_curves(self._curves, frame)


def time_strip(is_there: Flags, levels: Integers | None, gap_m: Array | None) -> Array | None:
    """Return a strip of presence, contacts and verdicts over time, to the right; None if there is nothing to show.

    Args:
        is_there: Presence of people (frame, person); a row each, unless all are always there.
        levels: Verdict of each frame (frame,): green, amber or red.
        gap_m: Smallest gap of bodies (frame,), metres: green for contact, red for overlap.
    """
    rows: list[Array] = []
    if not is_there.all():
        rows += [np.where(is_there[:, p, None], person_rgb(p), PAPER) for p in range(is_there.shape[1])]
    if gap_m is not None:
        near = np.select([gap_m < -THROUGH_M, gap_m < TOUCH_M], [2, 1], 0)
        rows.append(np.array([(PAPER,) * 3, _GREEN, _RED])[near])
    if levels is not None:
        rows.append(np.array([(170, 200, 170), (230, 170, 40), _RED])[levels])
    if not rows:
        return None
    columns = np.linspace(0, len(is_there) - 1, 2 * _WIDTH).round().astype(int)
    return np.repeat(np.stack(rows)[:, columns], 12, axis=0).astype(np.uint8)


def plot_curves(curves: Sequence[Array], frame: int) -> Any:
    """Return figures over the frames as an image, the last one on top, with a line at a frame."""
    height, width, edge = 170, _WIDTH, 22
    image = np.full((height, width, 3), PAPER, dtype=np.uint8)
    low, high = (take([take(curve) for curve in curves if np.isfinite(curve).any()]) for take in (np.nanmin, np.nanmax))
    across = np.linspace(0, width - 1, len(curves[-1]))
    for number, curve in enumerate(curves, 1 - len(curves)):
        points = np.stack(
            [across, height - edge - (curve - low) / max(high - low, 1e-12) * (height - 2 * edge)], axis=-1
        )
        is_there = np.isfinite(points[:, 1])
        runs = np.split(points[is_there], np.flatnonzero(np.diff(np.flatnonzero(is_there)) > 1) + 1)
        colour = person_rgb((number + 2) % 3 + 2 if number else 1)
        cv2.polylines(image, [np.round(8 * run).astype(np.int32) for run in runs], False, colour, 1, cv2.LINE_AA, 3)
    at = round(across[min(frame, len(across) - 1)])
    cv2.line(image, [at, 0], [at, height], person_rgb(0), 2)
    for value, y in ((high, edge - 4), (low, height - 4)):
        cv2.putText(image, f"{value:.3g}", (4, y), cv2.FONT_HERSHEY_SIMPLEX, 0.6, INK, 1, cv2.LINE_AA)
    return image
