"""Pictures of skeletons: sheets of moments, seen from two sides, as PNG bytes.

Left limbs are drawn darker than right ones, so that a mirrored figure is seen at a glance; the floor is a grey line.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.skeletons import Skeleton

if TYPE_CHECKING:  # matplotlib is imported where it draws: 0.3 s that planning does not need
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "COLOUR_NAMES",
    "PERSON_COLOURS",
    "TRUTH_COLOUR",
    "Panel",
    "Pose",
    "figure_png",
    "new_figure",
    "pair_panel",
    "shaded",
    "skeleton_sheet",
]

Array = npt.NDArray[np.float64]

PERSON_COLOURS = ("#c1440e", "#1f5fa8", "#8a5a9e", "#b58900", "#3f7f7f")
"""Colours of person A, B, ... in every picture; a sixth person has the first one again."""
COLOUR_NAMES = ("orange", "blue", "purple", "ochre", "teal")
"""What these are called."""
TRUTH_COLOUR = "#9a9a9a"
_SIDES = {"left_": 0.62, "right_": 1.0}
"""Brightness of left and right limbs."""


@dataclass(frozen=True)
class Pose:
    """One person to be drawn: positions (joint, 3) in metres, Y up, and a colour."""

    skeleton: Skeleton
    positions_m: Array
    colour: str


@dataclass(frozen=True)
class Panel:
    """One moment: a title, the people in it, point pairs (n, 2, 3) to be joined (contacts), and objects' axes alike."""

    title: str
    poses: tuple[Pose, ...]
    links_m: Array | None = None
    objects_m: Array | None = None


def pair_panel(
    title: str, skeleton: Skeleton, people_m: Array, links_m: Array | None = None, objects_m: Array | None = None
) -> Panel:
    """Return the panel of people (person, joint, 3) in everybody's colour."""
    poses = tuple(
        Pose(skeleton=skeleton, positions_m=positions, colour=colour)
        for positions, colour in zip(people_m, cycle(PERSON_COLOURS), strict=False)
    )
    return Panel(title=title, poses=poses, links_m=links_m, objects_m=objects_m)


def skeleton_sheet(panels: Sequence[Panel], *, yaws_rad: Sequence[float] = (0.0, np.pi / 2), title: str = "") -> bytes:
    """Draw one column per panel and one row per viewing direction; give PNG bytes.

    Args:
        panels: Moments from left to right; none gives an empty picture with the title.
        yaws_rad: Directions of the orthographic camera about +Y; 0 looks along -Z.
        title: Title of the sheet.
    """
    columns, rows = max(len(panels), 1), len(yaws_rad)
    figure, axes = new_figure(1.75 * columns + 0.2, 2.25 * rows + (0.35 if title else 0.1), rows, columns)
    reach = _reach(panels)
    for column in range(columns):
        for row, yaw in enumerate(yaws_rad):
            axis = axes[row][column]
            axis.set_axis_off()
            if column < len(panels):
                _draw_panel(axis, panels[column], float(yaw), reach)
                if row == 0:
                    axis.set_title(panels[column].title, fontsize=7)
    return figure_png(figure, title=title, pad=0.4)


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, *, has_common_axes: bool = False
) -> tuple[Figure, Any]:
    """Return an empty figure of this size in inches and its axes (row, column), all with the same ranges if wished."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110)
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=has_common_axes, sharey=has_common_axes)


def figure_png(figure: Figure, *, title: str = "", pad: float = 1.08) -> bytes:
    """Lay out a figure, with a title over all of it, and render it to PNG bytes that depend on the picture alone.

    256 colours do for drawings and make a third of the bytes, so that a report fits into a mail.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    if title:
        figure.suptitle(title, fontsize=9)
    figure.tight_layout(pad=pad)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    buffer = io.BytesIO()
    image.quantize(256, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def _reach(panels: Sequence[Panel]) -> float:
    """Half the width that holds every panel's people around their middle."""
    widest = 0.9
    for panel in panels:
        points = np.concatenate([pose.positions_m for pose in panel.poses])
        points = points[np.isfinite(points).all(axis=-1)]
        if len(points):
            middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
            widest = max(widest, float(np.abs(points - middle)[:, [0, 2]].max()) + 0.1)
    return widest


def _draw_panel(axis: Axes, panel: Panel, yaw_rad: float, reach: float) -> None:
    from matplotlib.collections import LineCollection

    points = np.concatenate([pose.positions_m for pose in panel.poses])
    finite = points[np.isfinite(points).all(axis=-1)]
    middle = 0.5 * (finite.min(axis=0) + finite.max(axis=0)) if len(finite) else np.zeros(3)
    turn = yaw_rotmat(-yaw_rad)
    for pose in panel.poses:
        seen = (pose.positions_m - middle * [1, 0, 1]) @ turn.T
        bones = np.array([[seen[parent], seen[child]] for parent, child in pose.skeleton.bones])
        order = np.argsort(bones[..., 2].mean(axis=1))
        colours = [shaded(pose.colour, pose.skeleton.joint_names[child]) for _, child in pose.skeleton.bones]
        axis.add_collection(
            LineCollection(
                list(bones[order][..., :2]), colors=[colours[i] for i in order], linewidths=1.6, capstyle="round"
            )
        )
        head = pose.skeleton.index("head")
        axis.plot(seen[head, 0], seen[head, 1], "o", color=pose.colour, markersize=4.5)
    for lines_m, colour, width in ((panel.objects_m, "#777777", 4.0), (panel.links_m, "#2a9d3a", 1.0)):
        if lines_m is not None and len(lines_m):
            lines = (lines_m - middle * [1, 0, 1]) @ turn.T
            axis.add_collection(LineCollection(list(lines[..., :2]), colors=colour, linewidths=width))
            if lines_m is panel.objects_m:
                # A ball's axis is a point, of which a line shows nothing.
                axis.plot(*lines[..., :2].reshape(-1, 2).T, "o", color=colour, markersize=width)
    axis.plot([-reach, reach], [0, 0], color="#bbbbbb", linewidth=0.8, zorder=0)
    top = float(finite[:, 1].max()) if len(finite) else 1.8
    axis.set_xlim(-reach, reach)
    axis.set_ylim(min(-0.08, float(finite[:, 1].min()) - 0.05 if len(finite) else -0.08), max(top + 0.15, 1.9))
    axis.set_aspect("equal")


def shaded(colour: str, joint_name: str = "right_") -> tuple[float, float, float]:
    """Return the red, green and blue, from 0 to 1, in which a limb is drawn; without a joint the colour itself."""
    rgb = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    factor = next((value for side, value in _SIDES.items() if joint_name.startswith(side)), 0.85)
    return (rgb[0] * factor, rgb[1] * factor, rgb[2] * factor)
