"""Accepts and rejects whole items, single frames and clips; with its folder of the panel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from flows.viewing.panel import Panel, set_value
from flows.viewing.scene import Scene
from flows.viewing.shelf import SINGLE_IMAGES, Item, Shelf, ViewedPartition, moment_reference
from flows.viewing.table_views import TABLE_VIEWS
from tasks.files.curation import CLIPPED, UNDECIDED, Choice, Choosing, Decision, content_columns, refuse_clips, thing_at

if TYPE_CHECKING:
    from flows.viewing.viewer import Viewer


@dataclass(frozen=True)
class Moment:
    """A frame of an item of a part."""

    part: ViewedPartition
    item: Item
    scene: Scene
    frame: int

    @property
    def row(self) -> int:
        """First row of the frame in the item."""
        return self.scene.row_of(self.frame)

    @property
    def reference(self) -> str:
        """Its reference."""
        return moment_reference(self.part, self.item, self.row)

    @property
    def is_thing(self) -> bool:
        """Whether the frame is accepted or rejected on its own."""
        return is_each_frame(self.part, self.item)


@dataclass(frozen=True)
class ChoicesPane:
    """The folder of the panel in which items, frames and clips are accepted and rejected."""

    viewer: Viewer
    reason: Any
    start: Any
    end: Any

    @classmethod
    def build(cls, panel: Panel, viewer: Viewer) -> Self:
        """Add the widgets to the panel."""
        with panel.gui.add_folder("Accept or reject", expand_by_default=False):
            reason = panel.gui.add_text("reason", "")
            panel.button("Accept", lambda _: pane.decide("accept"), "K")
            panel.button("Reject", lambda _: pane.decide("reject"), "X")
            panel.button("Undo", lambda _: pane.decide("undo"), "U")
            start = panel.button("Clip starts here", lambda _: pane.mark_clip("start"), "I")
            end = panel.button("Clip ends here", lambda _: pane.mark_clip("end"), "O")
        pane = cls(viewer, reason, start, end)
        return pane

    def show(self, table: str) -> None:
        """Show the buttons for clips, if clips of a table can be chosen."""
        self.start.visible = self.end.visible = table in CLIPPED

    def decide(self, decision: Decision | Literal["undo"]) -> None:
        """Accept or reject the shown item, with the reason in the panel, and go to the next one."""
        viewer = self.viewer
        with viewer.lock:
            moment = viewer.moment
            viewer.panel.tell(viewer.curation.decide(decision, moment, str(self.reason.value)))
            set_value(self.reason, "")
            viewer.listing.sort(viewer.index)
            viewer.listing.mark(viewer.index)
            viewer.step(1 if moment.is_thing and decision != "undo" else 0)

    def mark_clip(self, edge: Literal["start", "end"]) -> None:
        """Let the clip to choose start or end at this frame."""
        with self.viewer.lock:
            self.viewer.curation.mark(edge, self.viewer.moment)
            self.viewer.look()


class Curation:
    """Choices on the shown items.

    Args:
        shelf: The contents.
        choosing: The file of choices.
    """

    def __init__(self, shelf: Shelf, choosing: Choosing) -> None:
        self._shelf, self.choosing = shelf, choosing
        self.begin()

    def begin(self, clip: tuple[int, int] | None = None) -> None:
        """Apply choices to a clip from now on, by its first and last frame; without one to the whole item."""
        self.clip, self._thing = clip, ("", "")

    def mark(self, edge: Literal["start", "end"], moment: Moment) -> None:
        """Let the clip start or end at a frame; the other end moves if necessary.

        Raises:
            InputError: Clips of this table cannot be chosen.
        """
        refuse_clips(moment.part.table)
        frame, (first, last) = moment.frame, self.clip or (0, moment.scene.num_frames - 1)
        self.begin((frame, max(frame, last)) if edge == "start" else (min(first, frame), frame))

    def decide(self, decision: Decision | Literal["undo"], moment: Moment, reason: str) -> str:
        """Write or undo a choice, without a marked clip that on the clip around the frame; return it in words."""
        name, content = self.thing(moment)
        if decision == "undo" and self.clip is None:
            at = moment.scene.number_of(moment.frame)
            here = (clip.name for (first, last), clip in self._clips(moment).items() if first <= at <= last)
            name = next(here, name)
        return self.choosing.decide(decision, moment.part.table, name, content, reason)

    def lines(self, moment: Moment) -> list[str]:
        """Return the choices on a moment and on clips of its item, a line each."""
        marked = "" if self.clip is None else f"clip of frames {self.clip[0]} to {self.clip[1]}: "
        lines = [marked + self.choosing.words(moment.part.table, *self.thing(moment))]
        for (first, last), choice in self._clips(moment).items():
            start, end = moment.scene.frame_at(first), moment.scene.frame_at(last + 1) - 1
            lines.append(f"frames {start} to {end} {choice.words}")
        return lines

    def of_item(self, part: ViewedPartition, item: Item) -> str:
        """Return the choice on an item in one word; empty if its frames are chosen one by one."""
        if is_each_frame(part, item):
            return ""
        choice = self.choosing.about(part.table, "/".join(item.names))
        return UNDECIDED if choice is None else f"{choice.decision}ed"

    def thing(self, moment: Moment) -> tuple[str, str]:
        """Return name and content that a choice would apply to now; those of an item are read once."""
        if moment.is_thing or not self._thing[0]:
            number = moment.scene.number_of
            clip = None if self.clip is None else (number(self.clip[0]), number(self.clip[1]))
            self._thing = thing_of(self._shelf, moment.part, moment.item, moment.row, clip)
        return self._thing

    def _clips(self, moment: Moment) -> dict[tuple[int, int], Choice]:
        return self.choosing.clips(moment.part.table, "/".join(moment.item.names))


def is_each_frame(part: ViewedPartition, item: Item) -> bool:
    """Return whether frames of an item are accepted or rejected one by one."""
    return TABLE_VIEWS[part.table].is_each or item.names == (SINGLE_IMAGES,)


def thing_of(
    shelf: Shelf, part: ViewedPartition, item: Item, row: int, clip: tuple[int, int] | None = None
) -> tuple[str, str]:
    """Return name and content that a choice at a row of an item applies to; the item may hold more.

    Args:
        shelf: The contents.
        part: A part of it.
        item: An item of the part.
        row: A row of the item.
        clip: First and last frame of a clip of a reconstruction; None for the whole item.

    Raises:
        InputError: Clips of this table cannot be chosen, or the item has no such frames.
    """
    if TABLE_VIEWS[part.table].is_each:
        ref, at = item.row(row)
        item, row = Item(item.names, ((ref, np.array([at])),), item.label), 0
    return thing_at(item.read(shelf.store, part.table, content_columns(part.table) or []), row, clip)
