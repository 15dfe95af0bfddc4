"""Sliders for everything that is scaled separately (people, limbs, bones), which select among the built variants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from flows.viewing.panel import Panel
from pasdedeux.arrays import Array
from pasdedeux.augmentation.variations import scale_axes
from pasdedeux.skeletons import BODY22


class Scales:
    """The folder of the panel with these sliders.

    Args:
        panel: The panel.
        show: Shows the variant of this number.
    """

    def __init__(self, panel: Panel, show: Callable[[int], None]) -> None:
        self._panel, self._show = panel, show
        self._folder = panel.gui.add_folder("Scales", visible=False)
        self.sliders: list[Any] = []

    def offer(self, scales: Mapping[int, Any], own_scale: int) -> None:
        """Set the sliders to the scales of the shown item, or hide them if it has none.

        Args:
            scales: Scales of bones by number of the item.
            own_scale: Number of the item.
        """
        known = {at: np.reshape(scale, (-1, BODY22.num_joints)) for at, scale in scales.items()}
        axes = scale_axes(np.array(list(known.values()), dtype=np.float64)) if own_scale in known else {}
        self._items, self._scales, self._own = list(known), np.array(list(axes.values())).T, own_scale
        self._folder.visible = bool(axes)
        for axis in range(len(self.sliders), len(axes)):
            with self._folder:
                self.sliders.append(self._panel.gui.add_slider("scale", 0.0, 1.0, 0.01, initial_value=0.0))
            self._panel.on_change(self.sliders[axis], partial(self.move, axis))
        for slider in self.sliders[len(axes) :]:
            slider.visible = False
        for slider, (label, values) in zip(self.sliders, axes.items(), strict=False):
            slider.visible, slider.label = True, label
            slider.max, slider.min = float(values.max()), float(values.min())
            slider.value = float(values[self._items.index(own_scale)])

    def move(self, axis: int, value: float) -> None:
        """Show the variant nearest to the scales of the sliders after one was moved."""
        wanted: Array = self._scales[self._items.index(self._own)].copy()
        wanted[axis] = value
        weight = np.where(np.arange(len(wanted)) == axis, 2.0, 1.0)
        nearest = self._items[int(np.argmin((weight * np.abs(self._scales - wanted)).sum(axis=1)))]
        if nearest != self._own:
            self._show(nearest)
