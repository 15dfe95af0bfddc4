"""The top of the panel: the item, its frame, and the way it is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from flows.viewing.panel import Panel, set_value
from flows.viewing.room import COMPARE
from flows.viewing.scene import Scene
from flows.viewing.session import Session
from flows.viewing.shelf import Part
from flows.viewing.side import SidePicture


@dataclass(frozen=True)
class ShownPane:
    """Its widgets, from above."""

    part: Any
    item: Any
    play: Any
    timeline: Any
    facts: Any
    side: SidePicture
    compare: Any
    failing: Any
    through: Any
    nearest: Any
    film: Any

    @classmethod
    def build(cls, panel: Panel, viewer: Session) -> Self:
        """Add the widgets to the panel, and the keys that move through frames and items."""
        gui = panel.gui
        pane = cls(
            part=gui.add_dropdown("show", tuple(map(part_label, viewer.shelf.parts))),
            item=gui.add_dropdown("item", ("none",)),
            play=panel.button("Play", lambda _: viewer.play(), "space"),
            timeline=gui.add_slider("frame", 0, 1, 1, initial_value=0),
            facts=gui.add_text("about", "", multiline=True, disabled=True),
            side=SidePicture(gui),
            compare=gui.add_dropdown("compare", COMPARE),
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
        change(pane.compare, lambda _: viewer.show_item(viewer.index, viewer.moment.row))
        for widget in (pane.film, pane.nearest):
            change(widget, lambda _: viewer.look())
        steps = {"arrowleft": ("One frame back", -1), "arrowright": ("One frame on", 1)}
        steps |= {"home": ("First frame", -(10**9)), "end": ("Last frame", 10**9)}
        for key, (label, by) in steps.items():
            panel.bind(label, key, lambda _, by=by: viewer.step(by))
        panel.bind("Item before", "arrowup", lambda _: viewer.step_item(-1))
        panel.bind("Next item", "arrowdown", lambda _: viewer.step_item(1))
        return pane

    def offer_parts(self, parts: list[Part], shown: Part) -> None:
        """Offer the parts of the shelf."""
        self.part.options = tuple(map(part_label, parts))
        set_value(self.part, part_label(shown))

    def show(self, scene: Scene) -> None:
        """Offer what a scene has: something to compare with, verdicts, a camera, film, nearest poses."""
        needed = {"compare": scene.behind, "through": scene.camera, "failing": scene.levels, "film": scene.film}
        for name, value in {**needed, "nearest": scene.nearest}.items():
            getattr(self, name).visible = value is not None
        self.compare.label = scene.behind_name or "compare"
        self.timeline.max = max(scene.num_frames - 1, 1)


def part_label(part: Part) -> str:
    """Return the name of a part, with its table."""
    return f"{part.table.replace('_', ' ')}: {part.name}"
