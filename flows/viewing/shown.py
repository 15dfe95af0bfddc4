"""The top of the panel, with the item and its display, and the timeline below the room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from flows.viewing.bodies import GAP
from flows.viewing.curves import TICKS, time_strip
from flows.viewing.panel import Panel, set_value
from flows.viewing.room import COMPARE, MOST_BESIDE, VIEWS
from flows.viewing.scene import Scene
from flows.viewing.server import STRIP_LEFT_PX
from flows.viewing.shelf import ViewedPartition
from flows.viewing.side_picture import SidePicture, flat_picture

if TYPE_CHECKING:
    from flows.viewing.viewer import Viewer

MOST_FIGURES = 6
"""Figures of an item that are shown unfolded."""


class Folded:
    """Text in a closed folder, which is hidden if empty."""

    def __init__(self, gui: Any, label: str) -> None:
        self._folder = gui.add_folder(label, expand_by_default=False, visible=False)
        with self._folder:
            self._text = gui.add_text("", "", multiline=True, disabled=True)

    def show(self, lines: Sequence[str]) -> None:
        """Show lines."""
        set_value(self._text, "\n".join(lines))
        self._folder.visible = bool(lines)


@dataclass(frozen=True)
class ShownPane:
    """The top of the panel; widgets from above."""

    part: Any
    item: Any
    play: Any
    timeline: Any
    ticks: Any
    facts: Any
    more: Folded
    view: Any
    side: SidePicture
    compare: Any
    beside: Any
    failing: Any
    through: Any
    nearest: Any
    film: Any

    @classmethod
    def build(cls, panel: Panel, viewer: Viewer) -> Self:
        """Add the widgets to the panel, and the keys for frames and items."""
        gui = panel.gui
        strip = gui.add_panel()  # below the room and as wide (`server.py`)
        with strip.add_tab("Time"):
            timeline = gui.add_slider("frame", 0, 1, 1, initial_value=0)
            ticks = gui.add_image(flat_picture([]), label=TICKS, visible=False)
        strip.float(x=STRIP_LEFT_PX, y=-STRIP_LEFT_PX)
        pane = cls(
            part=gui.add_dropdown("show", tuple(map(part_label, viewer.shelf.parts))),
            item=gui.add_dropdown("item", ("none",)),
            play=panel.button("Play", lambda _: viewer.play(), "space"),
            timeline=timeline,
            ticks=ticks,
            facts=gui.add_text("about", "", multiline=True, disabled=True),
            more=Folded(gui, "More figures"),
            side=SidePicture(gui),
            view=gui.add_button_group("view", tuple(VIEWS)),
            compare=gui.add_dropdown("compare", COMPARE),
            beside=gui.add_dropdown("side by side", tuple(map(str, range(1, MOST_BESIDE + 1)))),
            failing=panel.button("Next failing frame", lambda _: viewer.next_failing(), "F"),
            through=panel.button("Look through its camera", lambda event: viewer.room.look_through(event.client)),
            nearest=gui.add_checkbox("nearest poses of the database", initial_value=False),
            film=gui.add_checkbox("film behind people", initial_value=True),
        )
        panel.add_message()
        change = panel.on_change
        change(pane.part, lambda value: viewer.show_part(viewer.shelf.parts[pane.part.options.index(value)]))
        change(pane.item, lambda value: viewer.show_item(viewer.listing.order[pane.item.options.index(value)]))
        change(pane.timeline, lambda value: viewer.step(int(value) - viewer.frame))
        pane.view.on_click(panel.safely(lambda event: viewer.room.view(event.client, event.target.value)))
        for widget in (pane.compare, pane.beside):
            change(widget, lambda _: viewer.show_item(viewer.index, viewer.moment.row))
        for widget in (pane.film, pane.nearest):
            change(widget, lambda _: viewer.look())
        steps = {"arrowleft": ("One frame back", -1), "arrowright": ("One frame on", 1)}
        steps |= {"home": ("First frame", -(10**9)), "end": ("Last frame", 10**9)}
        for key, (label, by) in steps.items():
            panel.bind(label, key, lambda _, by=by: viewer.step(by))
        panel.bind("Item before", "arrowup", lambda _: viewer.step_item(-1))
        panel.bind("Next item", "arrowdown", lambda _: viewer.step_item(1))
        return pane

    def offer_parts(self, parts: list[ViewedPartition], shown: ViewedPartition) -> None:
        """Offer the parts of the shelf."""
        self.part.options = tuple(map(part_label, parts))
        set_value(self.part, part_label(shown))

    def show(self, scene: Scene) -> None:
        """Show the widgets that apply to a scene: comparison, verdicts, camera, film, nearest poses."""
        needed = {"compare": scene.behind, "through": scene.camera, "failing": scene.levels, "film": scene.film}
        for name, value in {**needed, "nearest": scene.nearest}.items():
            getattr(self, name).visible = value is not None
        self.compare.label = f"compare with {scene.behind_name}" if scene.behind_name else "compare"
        there = np.asarray(np.isfinite(scene.people.positions_m).all(axis=(2, 3)))
        strip = time_strip(there, scene.levels, scene.curves.get(GAP))
        self.ticks.visible = strip is not None
        if strip is not None:
            self.ticks.image = strip
        self.timeline.max = max(scene.num_frames - 1, 1)


def part_label(part: ViewedPartition) -> str:
    """Return the name of a part, with its table."""
    return f"{part.table.replace('_', ' ')}: {part.name}"
