"""The viewer: one session that every browser on it shares, its panel, its keys, and the clock that plays."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import pyarrow

from flows.viewing.images import encode, encode_clip, plot_curves, presence_strip
from flows.viewing.kinds import KINDS, is_each_frame, qualities, thing_of
from flows.viewing.room import COMPARE, Room
from flows.viewing.scene import Flat, People, Scene
from flows.viewing.server import start_server
from flows.viewing.shelf import GROUPS, Item, Part, Shelf, figure_label, figure_words, moment_in, moment_reference
from flows.viewing.side import Pointer, SidePicture, flat_picture
from pasdedeux.arrays import Array
from pasdedeux.augmentation.variations import scale_axes
from pasdedeux.errors import InputError, PasdedeuxError
from pasdedeux.skeletons import BODY22, PAIR17
from storage_schema import StorageError
from tasks.curation import CLIPPED, UNDECIDED, Choice, Choosing, Decision

TICK_S = 1.0 / 30.0
STILLS_HZ = 10.0
"""Frames that do not follow each other in time are played at this rate."""
_CLIP_S = 4.0
_CLIP_HZ = 10.0
ALL, FAILS, WARNS, PASSES = "all", "fail", "warn", "pass"
STORED_ORDER = "as stored"
ONLY = (ALL, PASSES, WARNS, FAILS, "accepted", "rejected", UNDECIDED)
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


class Viewer:
    """What is shown, and the panel to change it with.

    Args:
        shelf: What can be looked at.
        port: Port, 0 for any that is free.
        at: Reference of the first moment; the first item where none is given.
        choosing: The file of choices; `curation.txt` here where none is given.
    """

    def __init__(self, shelf: Shelf, *, port: int = 0, at: str | None = None, choosing: Choosing | None = None) -> None:
        self.shelf, self.choosing = shelf, choosing or Choosing(Path("curation.txt"))
        self.lock = threading.RLock()
        self.part: Part = shelf.parts[0]
        self.order: list[int] = []
        self.index = self.frame = 0
        self.is_playing = False
        self.pose: Array | None = None
        """Positions that are shown in place of the scene's, while somebody changes them."""
        self.image_px: Array | None = None
        """The same for the 2D poses of the side picture (person, joint, 2), pixels."""
        self.clip: tuple[int, int] | None = None
        """First and last frame of the clip that choices are about; the whole item where it is None."""
        self.on_moment: list[Callable[[], None]] = []
        self.wants_flat = False
        """Whether 2D poses are shown as such, where they could be shown as what was captured."""
        self._figures: dict[tuple[str, ...], dict[str, Any]] = {}
        self._started = (0.0, 0)
        self._handles: dict[str, Any] = {}
        self._curves: list[Array] = []
        self._names: dict[str, str] = {}
        """Names of figures by the words that the panel has for them."""
        self._num_marks: tuple[int, ...] = (0, 0)
        self.ended = threading.Event()
        self._looked = threading.Event()
        self._pointers: queue.SimpleQueue[Pointer | None] = queue.SimpleQueue()
        first = shelf.find(at) if at is not None else None
        with self.lock:  # who visits early waits
            self.server = start_server(port, self.visit, self._pointers.put, "pasdedeux")
            self.room = Room(self.server)
            self._build()
            self.show_part(first[0] if first else self.part, first[1] if first else 0, first[2] if first else None)
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._play, self._look, self._point)]
        for thread in self._threads:
            thread.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    @property
    def item(self) -> Item:
        """The item that is shown."""
        return self.shelf.items(self.part)[self.index]

    @property
    def reference(self) -> str:
        """The reference of the moment that is shown."""
        return moment_reference(self.part, self.item, self.scene.row_of(self.frame))

    def stop(self) -> None:
        """End the clock and the server."""
        self.ended.set()
        self._looked.set()
        self._pointers.put(None)
        for thread in self._threads:
            thread.join(timeout=5.0)
        with suppress(RuntimeError):
            self.server.stop()

    # What is shown.

    def visit(self, text: str) -> None:
        """Go to the moment that a reference, or a link to one, points to; says so where it points to nothing."""
        with self.lock:
            try:
                part, index, row = self.shelf.find(moment_in(text))
            except (PasdedeuxError, StorageError) as error:
                self.tell(str(error))
                return
            self.show_part(part, index, row)

    def show_part(self, part: Part, index: int = 0, row: int | None = None) -> None:
        """Show an item of a part at one of its rows."""
        with self.lock:
            self.part = part
            self._figures = qualities(self.shelf, part)
            first = next(iter(self._figures.values()), {})
            numbers = [name for name, value in first.items() if _is_figure(part, name, value)]
            self._set("part", self._part_label(part))
            self._names |= {figure_label(name)[0]: name for name in numbers}
            self.gui_sort.options = (STORED_ORDER, *(figure_label(name)[0] for name in numbers))
            self.sort(index)
            self.show_item(index, row)

    def sort(self, kept: int | None = None) -> None:
        """Put the items into the order, and leave out those, that were asked for; `kept` stays in any case."""
        items, by = self.shelf.items(self.part), str(self.gui_sort.value)
        rows = [self._figures.get(item.names, {}) for item in items]
        wanted = str(self.gui_filter.value)
        shown = [{ALL, str(row.get("verdict", "")), self._chosen(at)} for at, row in enumerate(rows)]
        order = [at for at, words in enumerate(shown) if at == kept or wanted in words]
        if by != STORED_ORDER:
            order.sort(key=lambda at: -_number(rows[at].get(self._names[by])))
        self.order = order
        self.gui_item.options = tuple(self._item_label(at) for at in order) or ("none",)

    def show_item(self, index: int, row: int | None = None) -> None:
        """Read an item, and show it from its beginning or at one of its rows."""
        with self.lock:
            self.index, self.pose, self.image_px = index, None, None
            scene = KINDS[self.part.table].scene(self.shelf, self.part, self.item)
            if self.wants_flat and scene.flat is not None:
                scene = replace(scene, people=scene.flat, camera=None)
            self._show_scene(scene, row)
            pyarrow.default_memory_pool().release_unused()  # it keeps what the last item took, for the next one

    def show_beside(self, pair_m: Array, before_m: Array) -> None:
        """Show a pair in place of this moment, and over it the one of before, until another moment is shown."""
        row = self.scene.row_of(self.frame)
        rows = np.where(np.arange(len(self.scene.frame_of_row)) == row, 0, -1)
        pair, before = (People(PAIR17, one[None]) for one in (pair_m, before_m))
        flats = self.flats()
        scene = Scene(pair, rows, behind=before, behind_name="before", images=lambda _: flats, has_floor=False)
        self._show_scene(scene, row)

    def _show_scene(self, scene: Scene, row: int | None) -> None:
        with self.lock:
            self.scene: Scene = scene
            self._thing, self.clip = ("", ""), None
            self._set("item", self._item_label(self.index))
            self.room.show(scene, str(self._handles["compare"].value))
            self._draw_curve()
            known = {"compare": scene.behind, "through": scene.camera, "failing": scene.levels, "film": scene.film}
            for name, needed in known.items():
                self._handles[name].visible = needed is not None
            self._handles["nearest"].visible = scene.nearest is not None
            for name in ("start", "end"):
                self._handles[name].visible = self.part.table in CLIPPED
            self._handles["compare"].label = scene.behind_name or "compare"
            self._show_scales()
            self._handles["timeline"].max = max(scene.num_frames - 1, 1)
            self.seek(0 if row is None else int(scene.frame_of_row[row]))

    def step_item(self, by: int) -> None:
        """Go to another item, in the order of the list."""
        with self.lock:
            if self.order:
                at = self.order.index(self.index) if self.index in self.order else 0
                self.show_item(self.order[(at + by) % len(self.order)])

    def seek(self, frame: int) -> None:
        """Show a frame; the clock goes on from there."""
        with self.lock:
            self.frame = int(np.clip(frame, 0, self.scene.num_frames - 1))
            self._started = (time.monotonic(), self.frame)
            self.pose = self.image_px = None
            self.show_frame()
            self.look()
            for changed in self.on_moment:
                changed()

    def step(self, by: int) -> None:
        """Stop, and go some frames on."""
        self.play(False)
        self.seek(self.frame + by)

    def play(self, is_playing: bool | None = None) -> None:
        """Play, or stop; the other one of both where nothing is said."""
        with self.lock:
            self.is_playing = not self.is_playing if is_playing is None else is_playing
            self._handles["play"].label = "Stop (space)" if self.is_playing else "Play (space)"
            if self.is_playing and self.frame == self.scene.num_frames - 1:
                self.frame = 0
            self._started = (time.monotonic(), self.frame)
            self.look()

    def next_failing(self) -> None:
        """Go to the next frame that fails, or that is a warning where none fails."""
        with self.lock:
            levels = self.scene.levels
            worst = 0 if levels is None else int(levels.max(initial=0))
            if not worst:
                self.tell("no frame of this item fails or is a warning")
                return
            bad = np.flatnonzero(levels == worst)
            self.play(False)
            self.seek(int(bad[bad > self.frame][0] if (bad > self.frame).any() else bad[0]))

    def decide(self, decision: Decision | Literal["undo"]) -> None:
        """Accept or reject what is shown, for the reason that stands in the panel, and go on to the next thing."""
        with self.lock:
            name, content = self._thing_shown()
            if decision == "undo" and self.clip is None:
                at = self.scene.number_of(self.frame)
                here = (one.name for one in self._clips_chosen() if one.frames[0] <= at <= one.frames[1])
                name = next(here, name)
            reason = str(self._handles["reason"].value)
            self.tell(self.choosing.decide(decision, self.part.table, name, content, reason))
            self._handles["reason"].value = ""
            self.sort(self.index)
            self._set("item", self._item_label(self.index))
            self.step(1 if is_each_frame(self.part, self.item) and decision != "undo" else 0)

    def mark_clip(self, edge: Literal["start", "end"]) -> None:
        """Let the clip that choices are about start or end at this frame; the other edge gives way."""
        with self.lock:
            if self.part.table not in CLIPPED:
                raise InputError(f"clips are chosen of {', '.join(CLIPPED)}, not of {self.part.table}")
            first, last = self.clip or (0, self.scene.num_frames - 1)
            frame = self.frame
            self.clip = (frame, max(frame, last)) if edge == "start" else (min(first, frame), frame)
            self._thing = ("", "")
            self.look()

    def tell(self, text: str) -> None:
        """Say something in one line of the panel."""
        self._handles["said"].value = text

    def show_frame(self) -> None:
        """Send the bodies of this frame, what touches and what passes through, and what they are compared with."""
        with self.server.atomic():
            self._num_marks = self.room.show_frame(self.frame, self.pose, has_marks=bool(self._handles["marks"].value))
            self._set("timeline", self.frame)

    # The panel.

    def _build(self) -> None:
        """Lay out the panel and the keys."""
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        put = self._handles
        put["part"] = gui.add_dropdown("show", tuple(map(self._part_label, self.shelf.parts)))
        put["item"] = self.gui_item = gui.add_dropdown("item", ("none",))
        put["play"] = self._button("Play", lambda _: self.play(), "space")
        put["timeline"] = gui.add_slider("frame", 0, 1, 1, initial_value=0)
        put["facts"] = gui.add_text("about", "", multiline=True, disabled=True)
        self.side = SidePicture(gui)
        put["compare"] = gui.add_dropdown("compare", COMPARE)
        put["failing"] = self._button("Next failing frame", lambda _: self.next_failing(), "F")
        put["through"] = self._button("Look through its camera", lambda event: self.room.look_through(event.client))
        put["nearest"] = gui.add_checkbox("nearest poses of the database", initial_value=False)
        put["film"] = gui.add_checkbox("film behind people", initial_value=True)
        put["said"] = gui.add_text("message", "", multiline=True, disabled=True)
        with gui.add_folder("Playing", expand_by_default=False):
            put["speed"] = gui.add_dropdown("speed", SPEEDS, initial_value="1")
            put["loop"] = gui.add_checkbox("loop", initial_value=True)
            put["marks"] = gui.add_checkbox("contacts (green), penetration (red)", initial_value=True)
        with gui.add_folder("Filter and sort", expand_by_default=False):
            self.gui_filter = put["filter"] = gui.add_dropdown("only", ONLY)
            self.gui_sort = put["sort"] = gui.add_dropdown("largest first", (STORED_ORDER,))
        self._curve_folder = gui.add_folder("Curve")
        with self._curve_folder:
            put["strip"] = gui.add_image(flat_picture([]), label="who is there, and verdicts", visible=False)
            put["curve"] = gui.add_dropdown("figure", ("none",))
            put["plot"] = gui.add_image(flat_picture([]), visible=False)
        self._scales_folder = gui.add_folder("Scales", visible=False)
        with gui.add_folder("Accept or reject", expand_by_default=False):
            put["reason"] = gui.add_text("reason", "")
            self._button("Accept", lambda _: self.decide("accept"), "K")
            self._button("Reject", lambda _: self.decide("reject"), "X")
            self._button("Undo", lambda _: self.decide("undo"), "U")
            put["start"] = self._button("Clip starts here", lambda _: self.mark_clip("start"), "I")
            put["end"] = self._button("Clip ends here", lambda _: self.mark_clip("end"), "O")
        with gui.add_folder("Link and save", expand_by_default=False):
            put["link"] = gui.add_text("moment", "", hint="Copy it, or paste another one")
            self._button("Save picture", lambda event: self._save(event.client, is_clip=False), is_alone=False)
            self._button("Save clip", lambda event: self._save(event.client, is_clip=True), is_alone=False)
        self._scales: list[Any] = []
        changes: Mapping[str, Callable[[Any], None]] = {
            "part": lambda value: self.show_part(self.shelf.parts[put["part"].options.index(value)]),
            "item": lambda value: self.show_item(self.order[self.gui_item.options.index(value)]),
            "timeline": lambda value: self.step(int(value) - self.frame),
            "compare": lambda _: self.show_item(self.index, self.scene.row_of(self.frame)),
            "speed": lambda _: self.play(self.is_playing),
            "marks": lambda _: self.show_frame(),
            **dict.fromkeys(("film", "nearest"), lambda _: self.look()),
            "curve": lambda _: self._draw_curve(),
            **dict.fromkeys(("filter", "sort"), lambda _: self._sorted_again()),
            "link": self.visit,
        }
        for name, change in changes.items():
            put[name].on_update(self._from_client(change))
        steps = {"arrowleft": ("One frame back", -1), "arrowright": ("One frame on", 1)}
        steps |= {"home": ("First frame", -(10**9)), "end": ("Last frame", 10**9)}
        for key, (label, by) in steps.items():
            self._bind(label, key, lambda _, by=by: self.step(by))
        self._bind("Item before", "arrowup", lambda _: self.step_item(-1))
        self._bind("Next item", "arrowdown", lambda _: self.step_item(1))

    def _bind(self, label: str, key: str, action: Callable[..., None]) -> None:
        self.server.gui.add_command(label, hotkey=key).on_trigger(self.safely(action))

    def _button(self, label: str, action: Callable[..., None], key: str = "", *, is_alone: bool = True) -> Any:
        """Add a button, which a key may press too."""
        button = self.server.gui.add_button(f"{label} ({key})" if key else label)
        button.on_click(self.safely(action, is_alone=is_alone))
        if key:
            self._bind(label, key, action)
        return button

    def safely(self, action: Callable[[Any], None], *, is_alone: bool = True) -> Callable[[Any], None]:
        """Return a callback that says in the panel what went wrong; others wait for its end where it is alone."""

        def run(event: Any) -> None:
            try:
                with self.lock if is_alone else nullcontext():
                    action(event)
            except (PasdedeuxError, StorageError, OSError, RuntimeError, TimeoutError) as error:
                self.tell(str(error) or type(error).__name__)

        return run

    def _from_client(self, change: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback for what somebody changed in a browser; what the program sets is passed over."""
        return self.safely(lambda event: change(event.target.value) if event.client is not None else None)

    def _set(self, name: str, value: Any) -> None:
        if self._handles[name].value != value:
            self._handles[name].value = value

    def _part_label(self, part: Part) -> str:
        return f"{part.table.replace('_', ' ')}: {part.name}"

    def parts_changed(self) -> None:
        """Offer the parts that the shelf has now."""
        self._handles["part"].options = tuple(map(self._part_label, self.shelf.parts))

    def _item_label(self, index: int) -> str:
        item = self.shelf.items(self.part)[index]
        words = self._figures.get(item.names, {}).get("verdict", PASSES), self._chosen(index)
        known = [word for word in words if word not in (PASSES, UNDECIDED, "")]
        return " ".join([item.label, *(f"({word})" for word in known)])

    def _chosen(self, index: int) -> str:
        """Return what was chosen of an item, in one word; of items whose frames are chosen one by one nothing."""
        item = self.shelf.items(self.part)[index]
        if is_each_frame(self.part, item):
            return ""
        choice = self.choosing.about(self.part.table, "/".join(item.names))
        return UNDECIDED if choice is None else f"{choice.decision}ed"

    def _sorted_again(self) -> None:
        self.sort()
        self.tell("" if self.order else "no item is so")
        self.step_item(0)

    def _item_lines(self) -> list[str]:
        """Return what is known of the item: its figures as the store has them."""
        row = self._figures.get(self.item.names, {})
        figures = [figure_words(name, value) for name, value in row.items() if _is_figure(self.part, name, value)]
        heading = ["all frames together:"] if figures else []
        return [*filter(None, [str(row.get("reason") or "")]), *self.scene.facts, *heading, *figures]

    # Scales of variants.

    def _show_scales(self) -> None:
        """Offer a slider for whatever is scaled by itself - people, limbs, bones - through what was built."""
        rows = {item.names: self._figures.get(item.names, {}).get("bone_scale") for item in self.shelf.items(self.part)}
        known = {name: np.reshape(own, (-1, BODY22.num_joints)) for name, own in rows.items() if own is not None}
        axes = scale_axes(np.array(list(known.values()), dtype=np.float64)) if self.item.names in known else {}
        self._scaled_items = list(known), np.array(list(axes.values())).T
        self._scales_folder.visible = bool(axes)
        for axis in range(len(self._scales), len(axes)):
            with self._scales_folder:
                slider = self.server.gui.add_slider("scale", 0.0, 1.0, 0.01, initial_value=0.0)
            slider.on_update(self._from_client(partial(self._scaled, axis)))
            self._scales.append(slider)
        own = list(known).index(self.item.names) if axes else 0
        for axis, slider in enumerate(self._scales):
            slider.visible = axis < len(axes)
            if slider.visible:
                label, scales = list(axes.items())[axis]
                slider.label, slider.max, slider.min = label, float(scales.max()), float(scales.min())
                slider.value = float(scales[own])

    def _scaled(self, axis: int, value: float) -> None:
        """Show the variant nearest to the scales of the sliders, of which one was moved."""
        known, every = self._scaled_items
        wanted = every[known.index(self.item.names)].copy()
        wanted[axis] = value
        weight = np.where(np.arange(len(wanted)) == axis, 2.0, 1.0)
        names = known[int(np.argmin((weight * np.abs(every - wanted)).sum(axis=1)))]
        index = next(at for at, item in enumerate(self.shelf.items(self.part)) if item.names == names)
        if index != self.index:
            self.show_item(index, self.scene.row_of(self.frame))

    # Curves and pictures, which may come a moment later than the bodies.

    def _draw_curve(self) -> None:
        """Draw a figure over the frames, those of other chains beside it, and who is there."""
        scene = self.scene
        there = np.asarray(np.isfinite(scene.people.positions_m).all(axis=(2, 3)))
        self._handles["strip"].visible = has_strip = scene.levels is not None or not there.all()
        self._handles["strip"].image = presence_strip(there, scene.levels)
        known = {}
        for name, curve in scene.curves.items():
            label, factor, _ = figure_label(name)
            values = factor * np.asarray(curve, dtype=np.float64)
            if np.fmax.reduce(values) > np.fmin.reduce(values):
                known[label] = values
        chosen = self._handles["curve"]
        if known and tuple(known) != chosen.options:
            chosen.options = tuple(known)
        for handle in (chosen, self._handles["plot"]):
            handle.visible = bool(known)
        self._curve_folder.visible = bool(known) or has_strip
        others = scene.others if known and chosen.value == next(iter(known)) else ()
        self._curves = [*others, known[str(chosen.value)]] if known else []
        self._looked.set()

    def look(self) -> None:
        """Have the words, the curve and the pictures follow what is shown."""
        self._looked.set()

    def _look(self) -> None:
        """Bring the words, the curve and the pictures after the bodies, at most ten times a second."""
        while not self.ended.is_set():
            self._looked.wait()
            self._looked.clear()
            if self.ended.is_set():
                return
            with suppress(PasdedeuxError, StorageError):
                self.describe_frame()
            self.ended.wait(0.1 if not self.is_playing else 0.3)

    def describe_frame(self) -> None:
        """Say what is known of the frame that is shown: words, curve, pictures, its link."""
        with self.lock:
            scene, frame = self.scene, self.frame
            time_s = "" if scene.rate_hz is None else f", {frame / scene.rate_hz:.2f} s"
            level = "" if scene.levels is None else f", {(PASSES, WARNS, FAILS)[scene.levels[frame]]}"
            lines = [f"frame {frame} of {scene.num_frames}{time_s}{level}", *scene.say(frame)]
            lines += [figure_words(name, curve[frame]) for name, curve in scene.curves.items()]
            touch, through = self._num_marks
            if not scene.is_flat and self._handles["marks"].value:
                lines.append(f"{touch} contacts, {through} penetrations")
            marked = "" if self.clip is None else f"clip of frames {self.clip[0]} to {self.clip[1]}: "
            chosen = [marked + self.choosing.words(self.part.table, *self._thing_shown())]
            for one in self._clips_chosen():
                start, end = scene.frame_at(one.frames[0]), scene.frame_at(one.frames[1] + 1) - 1
                chosen.append(f"frames {start} to {end} {one.words}")
            self._set("facts", "\n".join([*lines, *chosen, *self._item_lines()]))
            self._set("link", f"{self.url}/?at={quote(self.reference, safe='@')}")
            if self._curves:
                self._handles["plot"].image = plot_curves(self._curves, frame)
            is_skipped = self.is_playing and scene.rate_hz is None
        flats = [] if is_skipped else self.flats()  # without the lock: a key need not wait for them
        if scene is self.scene:
            self.side.show(flats)
        if scene.film is not None and scene.camera is not None:
            image = scene.film(frame) if self._handles["film"].value else None
            with self.lock:
                if scene is self.scene:
                    self.room.show_film(image)

    def flats(self) -> list[Flat]:
        """Return the 2D pictures of this moment, with the 2D poses of the first as they were changed."""
        with self.lock:
            scene, frame, changed = self.scene, self.frame, self.image_px
        flats = scene.images(frame)
        if scene.nearest is not None and self._handles["nearest"].value:
            flats = [*flats, *scene.nearest(frame)]
        return flats if changed is None or not flats else [replace(flats[0], points_px=changed), *flats[1:]]

    def _point(self) -> None:
        """Follow the pointer over the side picture; of moves that wait the last counts."""
        while (pointer := self._pointers.get()) is not None:
            if pointer.phase != "move" or self._pointers.empty():
                self.safely(self.side.point)(pointer)

    def _thing_shown(self) -> tuple[str, str]:
        """Return name and content of what would be accepted or rejected now; an item's is read once."""
        if is_each_frame(self.part, self.item) or not self._thing[0]:
            number = self.scene.number_of
            clip = None if self.clip is None else (number(self.clip[0]), number(self.clip[1]))
            self._thing = thing_of(self.shelf, self.part, self.item, self.scene.row_of(self.frame), clip)
        return self._thing

    def _clips_chosen(self) -> list[Choice]:
        """Return what was chosen of clips of the item, in their order."""
        if self.part.table not in CLIPPED:
            return []
        return self.choosing.clips(self.part.table, "/".join(self.item.names))

    def _play(self) -> None:
        """Follow the clock while it plays: what is too slow leaves frames out, and time is kept."""
        while not self.ended.wait(TICK_S):
            if not self.is_playing:
                continue
            with self.lock:
                scene = self.scene
                began, first = self._started
                rate = (scene.rate_hz or STILLS_HZ) * float(self._handles["speed"].value)
                frame = first + int((time.monotonic() - began) * rate)
                if frame >= scene.num_frames and not self._handles["loop"].value:
                    self.frame = scene.num_frames - 1
                    self.show_frame()
                    self.play(False)
                elif frame % scene.num_frames != self.frame:
                    self.frame, self.pose, self.image_px = frame % scene.num_frames, None, None
                    self.show_frame()
                    self.look()

    # Pictures and clips.

    def _save(self, client: Any, *, is_clip: bool) -> None:
        """Send a browser what it shows, as a picture or as a clip of some seconds; nobody waits for it meanwhile."""
        name = f"{self.part.table}-{'-'.join(self.item.names)}-{self.frame}".replace("/", "-")
        width, height = client.camera.image_width, client.camera.image_height
        if not is_clip:
            image = client.get_render(height, width, timeout=60.0)
            client.send_file_download(f"{name}.png", encode(image, ".png"), save_immediately=True)
            return
        with self.lock:
            self.play(False)
            scene, first, rate = self.scene, self.frame, self.scene.rate_hz or STILLS_HZ
        step = max(1, round(rate / _CLIP_HZ))
        images, last = [], first
        for frame in range(first, min(first + int(_CLIP_S * rate), scene.num_frames), step):
            with self.lock:
                if self.scene is not scene or self.frame != last:
                    raise InputError("the clip was not saved: something else was shown meanwhile")
                self.seek(frame)
                last = frame
            images.append(client.get_render(height // 2, width // 2, timeout=60.0))
            self.tell(f"saving a clip: {frame - first} of {min(int(_CLIP_S * rate), scene.num_frames - first)} frames")
        client.send_file_download(f"{name}.webp", encode_clip(images, rate / step), save_immediately=True)
        self.tell(f"saved {name}.webp")


def _is_figure(part: Part, name: str, value: Any) -> bool:
    """Tell whether a column of the figures of a part's items is a number that names nothing."""
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool | np.bool_)
    return is_number and name not in {*GROUPS[part.table], "person"}


def _number(value: Any) -> float:
    return float(value) if value is not None and np.isfinite(value) else -np.inf
