"""The folder of the panel in which things, frames and clips are accepted and rejected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

from flows.viewing.panel import Panel, set_value
from tasks.curation import CLIPPED, Decision

if TYPE_CHECKING:
    from flows.viewing.viewer import Viewer


@dataclass(frozen=True)
class ChoicesPane:
    """Its widgets, and the viewer whose moment is decided on."""

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
        """Offer clips where those of a table can be chosen."""
        self.start.visible = self.end.visible = table in CLIPPED

    def decide(self, decision: Decision | Literal["undo"]) -> None:
        """Accept or reject what is shown, for the reason in the panel, and go on to the next thing."""
        viewer = self.viewer
        with viewer.lock:
            moment = viewer.moment
            viewer.panel.tell(viewer.curation.decide(decision, moment, str(self.reason.value)))
            set_value(self.reason, "")
            viewer.listing.sort(viewer.index)
            viewer.listing.mark(viewer.index)
            viewer.step(1 if moment.is_thing and decision != "undo" else 0)

    def mark_clip(self, edge: Literal["start", "end"]) -> None:
        """Let the clip that choices are about start or end at this frame."""
        with self.viewer.lock:
            self.viewer.curation.mark(edge, self.viewer.moment)
            self.viewer.look()
