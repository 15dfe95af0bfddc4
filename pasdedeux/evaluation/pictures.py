"""Pictures of the report: SVG figures with selectable text, and moving people for the page's own player.

Positions are packed compactly, and a reader can rotate the view.  Left limbs are drawn darker than right ones,
so that a mirrored person is seen at a glance.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.styles import method_style
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton

if TYPE_CHECKING:  # matplotlib is imported only for drawing: it takes 0.3 s that planning does not need
    from matplotlib.figure import Figure

PLAYER = ".player.json"
"""Suffix of a player's file."""
PERSON_COLOURS = ("#c1440e", "#1f5fa8", "#cc79a7", "#b58900", "#3f7f7f")
"""Colours of person A, B, ... in every picture; a sixth person has the first one again."""
COLOUR_NAMES = ("orange", "blue", "pink", "ochre", "teal")
"""Names of these colours."""
_TRUTH_COLOUR, LINK_COLOUR, _OBJECT_COLOUR = "#8c8c8c", "#12a150", "#777777"
_SHADES = {"left_": 0.62, "right_": 1.0}
"""Brightness of left and right limbs."""
_SHADE_BETWEEN = 0.85

_MISSING = -32768
_UNIT_M = 0.001
"""Positions are kept to the millimetre, coarser only where people are further apart than int16 reaches."""
_MAX_RATE_HZ = 12.5
_MAX_S = 5.0
CLOUD: Mapping[str, Any] = {"linewidths": 0, "rasterized": True}
"""Clouds of points are drawn as an image within the figure: thousands of shapes would be megabytes."""
_DOTS_PER_INCH = 90
_ORIGIN = np.zeros(2)
_PAPER: Mapping[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
"""Background of values and names that lines would cross."""
_LEVEL_GAP = 0.045  # share of an axis that the name of a level takes


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the three numbers of a colour.

    >>> rgb("#c1440e")
    (193, 68, 14)
    """
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def person_rgb(person: int) -> tuple[int, int, int]:
    """Return the colour of a person, numbered from 0."""
    return rgb(PERSON_COLOURS[person % len(PERSON_COLOURS)])


@dataclass(frozen=True)
class Picture:
    """A figure (.svg) or moving people (.player.json), by its file name, with a caption.

    In a section with many pictures, the first are shown and the others folded.
    """

    name: str
    caption: str
    content: bytes

    @property
    def is_player(self) -> bool:
        """Whether it shows moving people."""
        return self.name.endswith(PLAYER)

    @property
    def is_broad(self) -> bool:
        """Whether its panels need the page's width."""
        return self.content.count(b'"title":') > 1

    @property
    def scene(self) -> str:
        """The JSON of a player, escaped so that nothing in it ends a script in a page."""
        return self.content.decode().replace("<", "\\u003c").replace("&", "\\u0026")

    def of_panels(self, count: int) -> Picture:
        """Return a player with its first panels only; the caption says so where there are more."""
        scene = json.loads(self.content)
        total = len(scene["panels"])
        rest = f" Shown: the first {count} of {total} panels; the section below has all." if total > count else ""
        return replace(self, caption=self.caption + rest, content=_packed(scene | {"panels": scene["panels"][:count]}))

    @property
    def data_uri(self) -> str:
        """The figure as a data URI, so that the page needs no other file."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True)
class CurvePanel:
    """Curves over a common x: by method x (n,) and y (n,), baselines dashed, and horizontal levels by name."""

    y_label: str
    curves: Mapping[str, tuple[Array, Array]]
    baselines: Collection[str] = ()
    levels: Mapping[str, float] = field(default_factory=dict)


def new_figure(width: float, height: float, *, columns: int = 1, has_common_axes: bool = False) -> tuple[Figure, Any]:
    """Return an empty figure of this size in inches and its axes (1, column), optionally with common ranges."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(1, columns, squeeze=False, sharex=has_common_axes, sharey=has_common_axes)


def figure_svg(figure: Figure, *, title: str = "") -> bytes:
    """Lay out a figure, with a title over all of it, and render it to SVG bytes that depend on the picture alone."""
    from matplotlib import rc_context
    from matplotlib.layout_engine import TightLayoutEngine

    if title:
        figure.suptitle(title, fontsize=9)
    TightLayoutEngine().execute(figure)  # with a layout engine, saving would draw the figure once more
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "pasdedeux", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", dpi=_DOTS_PER_INCH, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def label_axis(axis: Any, x_label: str = "", y_label: str = "") -> None:
    """Name both directions of an axis."""
    axis.set_xlabel(x_label, fontsize=8)
    axis.set_ylabel(y_label, fontsize=8)
    axis.tick_params(labelsize=7)


def legend_beside(axis: Any) -> None:
    """Put the legend to the right of the last axis of a figure, where it hides nothing."""
    axis.legend(fontsize=6, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def fit_map(figure: Figure, axis: Any, *, scale: float, limits: tuple[float, float]) -> None:
    """Give both directions of a map the same scale, and adapt the height of the figure, within limits, inches."""
    axis.set_aspect("equal")
    width, height = (float(np.ptp(ends)) for ends in (axis.get_xlim(), axis.get_ylim()))
    figure.set_figheight(float(np.clip(0.9 + scale * height / width, *limits)))


def curve_figure(panels: Sequence[CurvePanel], *, title: str, x_label: str, is_log: bool = False) -> bytes:
    """Draw panels side by side over an x of one meaning; give SVG bytes."""
    columns = max(len(panels), 1)
    figure, ((*axes,),) = new_figure(7.4 if columns == 1 else 3.6 * columns + 1.4, 3.3, columns=columns)
    for axis, panel in zip(axes, panels, strict=False):
        if is_log:
            axis.set_xscale("log")
            axis.xaxis.set_major_formatter("{x:,.0f}")  # powers of ten are formulas to lay out
        _draw_panel(axis, panel, x_label)
        axis.minorticks_off()  # on less than a decade their labels would overlap
    if panels and panels[0].curves:
        legend_beside(axes[-1])
    return figure_svg(figure, title=title)


def _draw_panel(axis: Any, panel: CurvePanel, x_label: str) -> None:
    """Draw curves and levels; a level too close above another has a line but no name."""
    for name, (x, y) in panel.curves.items():
        style = method_style(name)
        line = {"linestyle": "--" if name in panel.baselines else "-", "color": style.colour}
        axis.plot(x, y, **line, marker=style.marker, markersize=4, label=in_words(name))
    for level in panel.levels.values():
        axis.axhline(level, color="#999999", linewidth=0.7)
    bottom, top = axis.get_ylim()
    named = bottom - (top - bottom)
    for name, level in sorted(panel.levels.items(), key=lambda item: item[1]):
        if level - named > _LEVEL_GAP * (top - bottom):
            axis.annotate(
                in_words(name), (1.0, level), xycoords=("axes fraction", "data"), fontsize=6, ha="right", va="bottom",
                bbox=_PAPER, zorder=4,
            )  # fmt: skip
            named = level
    label_axis(axis, x_label, panel.y_label)
    axis.grid(visible=True, alpha=0.25)


def compared_figure(values: Mapping[str, float], baselines: Collection[str], *, goal: float, x_label: str) -> bytes:
    """Draw a bar for each method, hatched for baselines, and a line at the goal; give SVG bytes."""
    figure, ((axis,),) = new_figure(6.0, 0.9 + 0.28 * len(values))
    for row, (name, value) in enumerate(values.items()):
        is_baseline = name in baselines
        axis.barh(row, value, color=method_style(name).colour, hatch="//" if is_baseline else None, edgecolor="white")
        place = {"xytext": (3, 0), "textcoords": "offset points", "fontsize": 7, "va": "center"}
        axis.annotate(f"{value:.3g}", (value, row), **place, bbox=_PAPER, zorder=4)
    axis.set_yticks(np.arange(len(values)), list(map(in_words, values)))
    axis.invert_yaxis()
    axis.margins(x=0.12)
    if np.isfinite(goal):
        axis.axvline(goal, color="#a3123a", linestyle="--", linewidth=1.2)
    label_axis(axis, x_label)
    return figure_svg(figure)


def draw_pair(axis: Any, points: Array, place: Array = _ORIGIN) -> None:
    """Draw two people (person=2, joint=17, 2) as sticks, centred at a place (2,)."""
    shown = points - np.nanmean(points.reshape(-1, 2), axis=0) + place
    for person, colour in zip(shown, PERSON_COLOURS, strict=False):
        # One line for all bones, broken between them: hundreds of figures stay small.
        ends = np.array([[person[parent], person[child], (np.nan, np.nan)] for parent, child in PAIR17.bones])
        axis.plot(*ends.reshape(-1, 2).T, color=colour, linewidth=0.9, solid_capstyle="round")


@dataclass(frozen=True)
class ShownPerson:
    """One person: positions (frame, joint, 3) in metres, Y up, NaN where absent, and a colour."""

    skeleton: Skeleton
    positions_m: Array
    colour: str
    is_thin: bool = False

    @property
    def radii_m(self) -> list[float]:
        """Radius of each joint's bone, to the millimetre; empty for people drawn thin, and if none are known."""
        there = self.positions_m[np.isfinite(self.positions_m).all(axis=(1, 2))]
        if self.is_thin or self.skeleton not in (BODY22, PAIR17, OP14) or not len(there):
            return []
        return np.round(capsule_model(self.skeleton).radii_of(there[:, None])[0], 3).tolist()


@dataclass(frozen=True)
class PlayerPanel:
    """A panel of a player: a title, people, ends (frame, n, 2, 3) of contacts and of objects' axes, NaN without one.

    A flat panel is not turned: it shows an image, whose middle is the origin.  With several cameras, a reader may
    choose one: `view` has its name, and the yaw and pitch from which it sees the panels that are not flat.
    """

    title: str
    figures: tuple[ShownPerson, ...]
    links_m: Array | None = None
    objects_m: Array | None = None
    is_flat: bool = False
    view: tuple[str, float, float] | None = None


def people_panel(
    title: str,
    skeleton: Skeleton,
    people_m: Array,
    links_m: Array | None = None,
    objects_m: Array | None = None,
    *,
    truth_m: Array | None = None,
) -> PlayerPanel:
    """Return the panel of people (frame, person, joint, 3) in everybody's colour, over the thin grey ground truth."""
    behind = [] if truth_m is None else [truth_m[:, person] for person in range(truth_m.shape[1])]
    colours = zip(range(people_m.shape[1]), cycle(PERSON_COLOURS), strict=False)
    figures = (
        *(ShownPerson(skeleton, person_m, _TRUTH_COLOUR, is_thin=True) for person_m in behind),
        *(ShownPerson(skeleton, people_m[:, person], colour) for person, colour in colours),
    )
    return PlayerPanel(title, figures, links_m, objects_m)


def image_panel(title: str, skeleton: Skeleton, people_px: Array, size_px: tuple[int, int]) -> PlayerPanel:
    """Return the panel of an image and its edge: people (frame, person, joint, 2), pixels, y down, NaN: missing."""
    width, height = size_px
    edge = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    edge = np.broadcast_to(np.stack([edge, np.roll(edge, -1, axis=0)], axis=1), (len(people_px), 4, 2, 2))

    def placed(points_px: Array) -> Array:
        return np.insert((points_px - [width / 2, height / 2]) * [1.0, -1.0] / height, 2, 0.0, axis=-1)

    return replace(people_panel(title, skeleton, placed(people_px), None, placed(edge)), is_flat=True)


def shown_frames(num_frames: int, rate_hz: float) -> tuple[Integers, float]:
    """Return the frames of a motion that are shown, some seconds from its middle, thinned, and their rate.

    >>> shown_frames(300, 30.0)[0][:3], shown_frames(300, 30.0)[1]
    (array([75, 77, 79]), 15.0)
    """
    step = max(1, round(rate_hz / _MAX_RATE_HZ))
    count = min(num_frames, max(1, round(_MAX_S * rate_hz)))
    start = (num_frames - count) // 2
    return np.arange(start, start + count, step), rate_hz / step


def times_shown(frames: Integers, num_frames: int, rate_hz: float) -> list[str]:
    """Return a label with the time of each shown frame of a longer motion; none if all of it is shown.

    >>> times_shown(np.array([75, 77]), 300, 30.0), times_shown(np.array([0, 2]), 3, 30.0)
    (['2.5 of 10.0 s', '2.6 of 10.0 s'], [])
    """
    if frames[0] == 0:
        return []
    return [f"{frame / rate_hz:.1f} of {num_frames / rate_hz:.1f} s" for frame in frames]


def pack_player(
    panels: Sequence[PlayerPanel], *, rate_hz: float, labels: Sequence[str] = (), has_floor: bool = True
) -> bytes:
    """Return the JSON of a player; the same panels always give the same bytes.

    Args:
        panels: Panels of the same number of frames.
        rate_hz: Frames per second.
        labels: A label for each frame; its time where there are none.
        has_floor: The floor, y = 0, is drawn.
    """
    num_frames = len(panels[0].figures[0].positions_m) if panels and panels[0].figures else 0
    skeletons: list[Skeleton] = []
    parts: list[Array] = []
    num_points = 0

    def add(points: Array) -> int:
        nonlocal num_points
        parts.append(points.reshape(num_frames, int(np.prod(points.shape[1:-1])), 3))
        num_points += parts[-1].shape[1]
        return num_points - parts[-1].shape[1]

    described = []
    for panel in panels:
        figures, lines = [], []
        for figure in panel.figures:
            if figure.skeleton not in skeletons:
                skeletons.append(figure.skeleton)
            figures.append(
                {
                    "skeleton": skeletons.index(figure.skeleton),
                    "start": add(figure.positions_m),
                    "num_points": figure.skeleton.num_joints,
                    "colour": figure.colour,
                    "is_thin": figure.is_thin,
                    "radii_m": [] if panel.is_flat else figure.radii_m,
                }
            )
        for ends, colour, width in (
            (panel.objects_m, _OBJECT_COLOUR, 1 if panel.is_flat else 6),
            (panel.links_m, LINK_COLOUR, 2),
        ):
            if ends is not None and ends.size:
                lines.append({"start": add(ends), "num_lines": ends.shape[1], "colour": colour, "width": width})
        view = {} if panel.view is None else {"view": panel.view}
        described.append({"title": panel.title, "figures": figures, "lines": lines, "is_flat": panel.is_flat, **view})
    points = np.concatenate(parts, axis=1) if parts else np.zeros((0, 0, 3))
    points = np.where(np.isfinite(points).all(axis=-1, keepdims=True), points, np.nan)
    unit = (
        max(_UNIT_M, float(np.nanmax(np.abs(points), initial=0.0)) / 32000.0) if np.isfinite(points).any() else _UNIT_M
    )
    whole = np.where(np.isfinite(points), np.round(points / unit), _MISSING).astype("<i2")
    scene = {
        "rate_hz": round(rate_hz, 6),
        "num_frames": num_frames,
        "num_points": num_points,
        "unit_m": unit,
        "has_floor": has_floor,
        "labels": list(labels),
        "skeletons": [_described(skeleton) for skeleton in skeletons],
        "panels": described,
        "data": base64.b64encode(whole.tobytes()).decode(),
    }
    return _packed(scene)


def _packed(scene: Mapping[str, Any]) -> bytes:
    return json.dumps(scene, separators=(",", ":"), allow_nan=False).encode()


def _described(skeleton: Skeleton) -> dict[str, object]:
    shades = list(map(shade_of, skeleton.joint_names))
    return {
        "bones": [[parent, child, shades[child]] for parent, child in skeleton.bones],
        "head": skeleton.index("head"),
        "body": skeleton.name,
    }


def shade_of(joint_name: str) -> float:
    """Return the brightness of the bone that ends in a joint: left limbs are darker than right ones."""
    return next((shade for side, shade in _SHADES.items() if joint_name.startswith(side)), _SHADE_BETWEEN)
