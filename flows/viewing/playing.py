"""Time in the viewer: speed, loop, and the current frame of the clock."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from flows.viewing.panel import Panel
from flows.viewing.scene import Scene

if TYPE_CHECKING:
    from flows.viewing.viewer import Viewer

STILLS_HZ = 10.0
"""Rate of frames that are no motion."""
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


@dataclass
class PlayingPane:
    """The folder of the panel for playing; when the clock was started, seconds, and at which frame."""

    speed: Any
    loop: Any
    marks: Any
    started_s: float = 0.0
    first: int = 0

    @classmethod
    def build(cls, panel: Panel, viewer: Viewer) -> Self:
        """Add the widgets to the panel."""
        with panel.gui.add_folder("Playing", expand_by_default=False):
            pane = cls(
                speed=panel.gui.add_dropdown("speed", SPEEDS, initial_value="1"),
                loop=panel.gui.add_checkbox("loop", initial_value=True),
                marks=panel.gui.add_checkbox("contacts (green), penetration (red)", initial_value=True),
            )
        panel.on_change(pane.speed, lambda _: viewer.play(viewer.is_playing))
        panel.on_change(pane.marks, lambda _: viewer.show_frame())
        return pane

    def start(self, frame: int) -> None:
        """Start the clock at a frame."""
        self.started_s, self.first = time.monotonic(), frame

    def frame(self, scene: Scene) -> tuple[int, bool]:
        """Return the frame of the clock, and whether it is at its end; late frames are skipped."""
        rate_hz = (scene.rate_hz or STILLS_HZ) * float(self.speed.value)
        frame = self.first + int((time.monotonic() - self.started_s) * rate_hz)
        if frame >= scene.num_frames and not self.loop.value:
            return scene.num_frames - 1, True
        return frame % scene.num_frames, False
