"""What a pane of the panel may ask of the viewer that it belongs to."""

from __future__ import annotations

import threading
from typing import Protocol

from flows.viewing.curating import Curation, Moment
from flows.viewing.listing import Listing
from flows.viewing.panel import Panel
from flows.viewing.room import Room
from flows.viewing.scene import Scene
from flows.viewing.shelf import Item, Part, Shelf


class Session(Protocol):
    """The state that all browsers share, and the actions of buttons and keys; `Viewer` is the one that there is."""

    lock: threading.RLock
    shelf: Shelf
    panel: Panel
    room: Room
    listing: Listing
    curation: Curation
    part: Part
    scene: Scene
    index: int
    frame: int
    is_playing: bool

    @property
    def url(self) -> str:
        """Address of the page."""

    @property
    def item(self) -> Item:
        """The item that is shown."""

    @property
    def moment(self) -> Moment:
        """The moment that is shown."""

    def visit(self, text: str) -> None:
        """Go to the moment that a reference, or a link to one, points to."""

    def show_part(self, part: Part) -> None:
        """Show the first item of a part."""

    def show_item(self, index: int, row: int | None = None) -> None:
        """Show another item of the part, at one of its rows."""

    def show_frame(self) -> None:
        """Send the bodies of this frame."""

    def step_item(self, by: int) -> None:
        """Go to another item, in the order of the list."""

    def step(self, by: int) -> None:
        """Stop, and go some frames on."""

    def seek(self, frame: int) -> None:
        """Show a frame; the clock goes on from there."""

    def play(self, is_playing: bool | None = None) -> None:
        """Play, or stop; the other one of both where nothing is said."""

    def next_failing(self) -> None:
        """Go to the next frame that fails, or that is a warning where none fails."""

    def look(self) -> None:
        """Have the words, the curve and the pictures follow what is shown."""
