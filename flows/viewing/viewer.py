"""The viewer: one session for all browsers, with panel, keys and clock."""

from __future__ import annotations

import queue
import secrets
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow

from flows.viewing.bodies import GAP, surface_gap_curve
from flows.viewing.curating import ChoicesPane, Curation, Moment
from flows.viewing.curves import Curves
from flows.viewing.listing import FAILS, PASSES, WARNS, Listing
from flows.viewing.panel import Panel, set_value
from flows.viewing.playing import PlayingPane
from flows.viewing.room import Room
from flows.viewing.saving import LinkPane
from flows.viewing.scales import Scales
from flows.viewing.scene import Flat, People, Scene
from flows.viewing.server import start_server
from flows.viewing.shelf import Item, Shelf, ViewedPartition, moment_in
from flows.viewing.shown import MOST_FIGURES, ShownPane, part_label
from flows.viewing.side_picture import Pointer
from flows.viewing.table_views import TABLE_VIEWS
from pasdedeux.arrays import Array
from pasdedeux.evaluation.shown_figures import value_words
from pasdedeux.skeletons import PAIR17, WORKING_SKELETONS
from tasks.files.curation import Choosing

TICK_S = 1.0 / 30.0


class Viewer:
    """The shown item, and the panel that controls it.

    Args:
        shelf: The contents.
        port: Port, 0 for any that is free.
        at: Reference of the first moment; by default that of the first item.
        choosing: The file of choices; by default `curation.txt` here.
    """

    def __init__(self, shelf: Shelf, *, port: int = 0, at: str | None = None, choosing: Choosing | None = None) -> None:
        self.shelf = shelf
        self.curation = Curation(shelf, choosing or Choosing(Path("curation.txt")))
        self.lock = threading.RLock()
        self.part: ViewedPartition = shelf.parts[0]
        self.index = self.frame = 0
        self.is_playing = False
        self.pose: Array | None = None
        """Positions shown in place of the scene's, while they are changed."""
        self.image_px: Array | None = None
        """The same for the 2D poses of the side picture (person, joint, 2), pixels."""
        self.on_moment: list[Callable[[], None]] = []
        self.wants_flat = False
        """Whether 2D poses are shown as such, even if the captured people are known."""
        self._token = secrets.token_urlsafe(24)
        self._num_marks: tuple[int, ...] = (0, 0)
        self.ended = threading.Event()
        self._looked = threading.Event()
        self._pointers: queue.SimpleQueue[Pointer | None] = queue.SimpleQueue()
        first = shelf.find(at) if at is not None else (self.part, 0, None)
        with self.lock:  # early visitors wait
            self.server = start_server(port, self._token, self.visit, self._pointers.put, "pasdedeux")
            self.panel = Panel(self.server, self.lock)
            self.room = Room(self.panel)
            self._build()
            self.show_part(*first)
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._play, self._look, self._point)]
        for thread in self._threads:
            thread.start()

    @property
    def url(self) -> str:
        """Address of the page, with its secret token."""
        return f"http://127.0.0.1:{self.server.get_port()}/{self._token}/"

    @property
    def item(self) -> Item:
        """The shown item."""
        return self.shelf.items(self.part)[self.index]

    @property
    def moment(self) -> Moment:
        """The shown moment."""
        return Moment(self.part, self.item, self.scene, self.frame)

    def stop(self) -> None:
        """Stop the clock and the server."""
        self.ended.set()
        self._looked.set()
        self._pointers.put(None)
        for thread in self._threads:
            thread.join(timeout=5.0)
        with suppress(RuntimeError):
            self.server.stop()

    # The shown item.

    def visit(self, text: str) -> None:
        """Go to the moment of a reference or a link; show a message if it does not exist."""
        with self.lock:
            self.panel.safely(lambda _: self.show_part(*self.shelf.find(moment_in(text))))(None)

    def show_part(self, part: ViewedPartition, index: int = 0, row: int | None = None) -> None:
        """Show an item of a part at one of its rows; nothing changes if it cannot be read."""
        with self.lock:
            scene = self._read(part, index)
            self.part = part
            set_value(self.shown.part, part_label(part))
            self.listing.show(part, index)
            self._show_item(index, scene, row)

    def show_item(self, index: int, row: int | None = None) -> None:
        """Show another item of the part from its beginning or at one of its rows."""
        with self.lock:
            self._show_item(index, self._read(self.part, index), row)

    def _show_item(self, index: int, scene: Scene, row: int | None) -> None:
        self.index, self.pose, self.image_px = index, None, None
        self.panel.tell("")  # the message was about another item
        self._show_scene(scene, row)
        pyarrow.default_memory_pool().release_unused()  # else it keeps the memory of the last item

    def _read(self, part: ViewedPartition, index: int) -> Scene:
        scene = TABLE_VIEWS[part.table].scene(self.shelf, part, self.shelf.items(part)[index])
        if self.wants_flat and scene.flat:
            return replace(scene, people=scene.flat, camera=None)
        gaps = None if scene.rate_hz is None or scene.is_flat else surface_gap_curve(scene.people)
        return scene if gaps is None else replace(scene, curves={**scene.curves, GAP: gaps})

    def show_beside(self, pair_m: Array, before_m: Array) -> None:
        """Show a pair in place of this moment, with the previous pair over it, until another moment is shown."""
        row = self.moment.row
        rows = np.where(np.arange(len(self.scene.frame_of_row)) == row, 0, -1)
        pair, before = (People(PAIR17, positions_m[None]) for positions_m in (pair_m, before_m))
        flats = self.flats()
        scene = Scene(pair, rows, behind=before, behind_name="before", images=lambda _: flats, has_floor=False)
        self._show_scene(scene, row)

    def _show_scene(self, scene: Scene, row: int | None) -> None:
        with self.lock:
            self.scene = scene
            self.side.flats = ()  # it still shows the previous scene
            self.curation.begin()
            self.listing.mark(self.index)
            self.room.show(scene, str(self.shown.compare.value), self._beside())
            self.curves.show(scene)
            self.shown.show(scene)
            self.choices.show(self.part.table)
            scales = {at: self.listing.figures(item).get("bone_scale") for at, item in enumerate(self.listing.items)}
            self.scales.offer({at: scale for at, scale in scales.items() if scale is not None}, self.index)
            self.seek(0 if row is None else int(scene.frame_of_row[row]))

    def _beside(self) -> dict[str, Scene]:
        """Return the items to show beside this one, by label: those that follow it in the list."""
        wanted = [self.listing.after(self.index, by) for by in range(1, int(self.shown.beside.value))]
        others = [at for at in dict.fromkeys(wanted) if at is not None and at != self.index]
        return {self.listing.label(at): self._read(self.part, at) for at in others}

    def step_item(self, by: int) -> None:
        """Go to another item, in the order of the list."""
        with self.lock:
            if (index := self.listing.after(self.index, by)) is not None:
                self.show_item(index)

    def seek(self, frame: int) -> None:
        """Show a frame; the clock continues from there."""
        with self.lock:
            self.frame = int(np.clip(frame, 0, self.scene.num_frames - 1))
            self.playing.start(self.frame)
            self.pose = self.image_px = None
            self.show_frame()
            self.look()
            for changed in self.on_moment:
                changed()

    def step(self, by: int) -> None:
        """Stop, and move by some frames."""
        self.play(False)
        self.seek(self.frame + by)

    def play(self, is_playing: bool | None = None) -> None:
        """Play or stop; toggle by default."""
        with self.lock:
            self.is_playing = not self.is_playing if is_playing is None else is_playing
            self.shown.play.label = "Stop (space)" if self.is_playing else "Play (space)"
            if self.is_playing and self.frame == self.scene.num_frames - 1:
                self.frame = 0
            self.playing.start(self.frame)
            self.look()

    def next_failing(self) -> None:
        """Go to the next frame that fails, or has a warning if none fails."""
        with self.lock:
            levels = self.scene.levels
            worst = 0 if levels is None else int(levels.max(initial=0))
            if not worst:
                self.panel.tell("no frame of this item fails or has a warning")
                return
            bad = np.flatnonzero(levels == worst)
            self.play(False)
            self.seek(int(bad[bad > self.frame][0] if (bad > self.frame).any() else bad[0]))

    def show_frame(self) -> None:
        """Send the bodies of this frame, contacts, penetrations, and figures for comparison."""
        with self.server.atomic():
            self._num_marks = self.room.show_frame(self.frame, self.pose, has_marks=bool(self.playing.marks.value))
            set_value(self.shown.timeline, self.frame)

    def _build(self) -> None:
        """Build the panes of the panel, and their keys."""
        panel = self.panel
        panel.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self.shown = ShownPane.build(panel, self)
        self.side = self.shown.side
        self.playing = PlayingPane.build(panel, self)
        self.listing = Listing(panel, self.shelf, self.curation, self.shown.item)
        self.curves = Curves(panel)
        self.scales = Scales(panel, lambda index: self.show_item(index, self.moment.row))
        self.choices = ChoicesPane.build(panel, self)
        self.link = LinkPane.build(panel, self)
        panel.on_change(self.curves.chosen, lambda _: self._change_curve())
        for widget in (self.listing.only, self.listing.by):
            panel.on_change(widget, lambda _: self.list_anew())

    def list_anew(self) -> None:
        """Update the list of items, and show a listed one."""
        self.listing.sort()
        self.panel.tell("" if self.listing.order else "no item matches the filter")
        self.step_item(0)

    def _change_curve(self) -> None:
        self.curves.show(self.scene)
        self.look()

    # Words, curves and pictures, which may follow the bodies with a short delay.

    def look(self) -> None:
        """Request an update of words, curve and pictures."""
        self._looked.set()

    def _look(self) -> None:
        """Update words, curve and pictures after the bodies, at most ten times a second."""
        describe = self.panel.safely(lambda _: self.describe_frame(), is_alone=False)
        while not self.ended.is_set():
            self._looked.wait()
            self._looked.clear()
            if self.ended.is_set():
                return
            describe(None)
            self.ended.wait(0.1 if not self.is_playing else 0.3)

    def describe_frame(self) -> None:
        """Update everything about the shown frame: words, curve, pictures, link."""
        with self.lock:
            scene, frame, moment = self.scene, self.frame, self.moment
            time_s = "" if scene.rate_hz is None else f", {frame / scene.rate_hz:.2f} s"
            level = "" if scene.levels is None else f", {(PASSES, WARNS, FAILS)[scene.levels[frame]]}"
            said = scene.say(frame)
            lines = [f"frame {frame} of {scene.num_frames}{time_s}{level}", *said]
            lines += [value_words(name, curve[frame]) for name, curve in scene.curves.items()]
            is_body = scene.people.skeleton.name in WORKING_SKELETONS and not scene.is_flat
            if is_body and self.playing.marks.value:
                lines.append("{} contacts, {} penetrations".format(*self._num_marks))
            lines += [*self.curation.lines(moment), *scene.facts]
            figures = self.listing.figure_lines(moment.item)
            reason = str(self.listing.figures(moment.item).get("reason") or "")
            set_value(self.shown.facts, "\n".join([*lines, *filter(None, [reason]), *figures[:MOST_FIGURES]]))
            self.shown.more.show(figures[MOST_FIGURES:])
            self.link.show(self)
            self.curves.draw(frame)
            is_skipped = self.is_playing and scene.rate_hz is None
        flats = [] if is_skipped else self.flats()  # without the lock, so that keys do not wait for them
        with self.lock:
            if scene is not self.scene:
                return
            self.side.flats = flats
        self.side.draw(flats)
        if scene.film is not None and scene.camera is not None:
            image = scene.film(frame) if self.shown.film.value else None
            with self.lock:
                if scene is self.scene:
                    self.room.show_film(image)
        if scene.say(frame) != said:  # now with the reason why the film cannot be read
            self.look()

    def flats(self) -> list[Flat]:
        """Return the 2D pictures of this moment, the first one with changed 2D poses."""
        with self.lock:
            scene, frame, changed = self.scene, self.frame, self.image_px
        flats = scene.images(frame)
        if scene.nearest is not None and self.shown.nearest.value:
            flats = [*flats, *scene.nearest(frame)]
        return flats if changed is None or not flats else [replace(flats[0], points_px=changed), *flats[1:]]

    def _point(self) -> None:
        """Follow the pointer over the side picture; of waiting moves the last one counts."""
        while (pointer := self._pointers.get()) is not None:
            if pointer.phase != "move" or self._pointers.empty():
                self.panel.safely(self.side.point)(pointer)

    def _play(self) -> None:
        """Follow the clock while it plays; an error stops it and is shown."""
        tick, stop = (self.panel.safely(action) for action in (self._tick, lambda _: self.play(False)))
        while not self.ended.wait(TICK_S):
            if self.is_playing and not tick(None):
                stop(None)

    def _tick(self, _: object) -> None:
        """Show the clock's frame."""
        frame, is_over = self.playing.frame(self.scene)
        if frame != self.frame or is_over:
            self.frame, self.pose, self.image_px = frame, None, None
            self.show_frame()
            self.look()
        if is_over:
            self.play(False)
