"""Pictures of lifted pairs: expected errors over true ones, examples, rows of pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.names import in_words, part_in_words
from pasdedeux.evaluation.pictures import (
    CLOUD,
    draw_pair,
    figure_svg,
    label_axis,
    legend_beside,
    new_figure,
    pack_player,
    people_panel,
)
from pasdedeux.skeletons import PAIR17

_CELL_M = np.array([1.75, 2.7])
"""Width and height that a pair has in a picture of many, metres."""


def expected_figure(parts: Mapping[str, tuple[Array, Array]]) -> bytes:
    """Draw true errors (n,) over expected ones (n, 3), metres, of each part, with 80 % intervals; give SVG bytes."""
    figure, ((axis,),) = new_figure(5.8, 3.6)
    for marker, (name, (expected, errors)) in zip("os^D", parts.items(), strict=False):
        label = part_in_words(name)
        axis.scatter(100 * expected[:, 0], 100 * errors, s=14, marker=marker, label=label, alpha=0.7, **CLOUD)
    every = 100 * np.concatenate([expected for expected, _ in parts.values()])
    every = every[np.argsort(every[:, 0])]
    axis.plot(every[:, 0], every[:, 0], color="#444444", linewidth=0.8)
    axis.fill_between(every[:, 0], every[:, 1], every[:, 2], color="#444444", alpha=0.12, linewidth=0)
    label_axis(axis, "expected error (cm)", "true error (cm)")
    legend_beside(axis)
    return figure_svg(figure)


def lifted_player(examples: Sequence[Mapping[str, Array]]) -> bytes:
    """Show examples one after another, a panel for each method that any of them has.

    Args:
        examples: For each example the pairs (2, 17, 3) by method, camera axes, metres; each is shown about its middle.
    """
    panels = []
    for method in dict.fromkeys(name for example in examples for name in example):
        pairs = [example.get(method, np.full((2, PAIR17.num_joints, 3), np.nan)) for example in examples]
        people = np.stack([pair - pair.reshape(-1, 3).mean(axis=0) for pair in pairs])
        panels.append(people_panel(in_words(method), PAIR17, people))
    labels = [f"example {number + 1} of {len(examples)}" for number in range(len(examples))]
    return pack_player(panels, rate_hz=0.5, labels=labels, has_floor=False)


def rows_figure(rows: Sequence[tuple[str, Sequence[tuple[str, Array]]]]) -> bytes:
    """Draw rows of pairs (person=2, joint=17, 2), metres, NaN where not seen, with their words; give SVG bytes."""
    width, height = max(len(pairs) for _, pairs in rows) * _CELL_M[0], len(rows) * _CELL_M[1]
    figure, ((axis,),) = new_figure(9.0, 9.0 * height / width)
    axis.set_xlim(0.0, width)
    axis.set_ylim(-height, 0.0)
    axis.set_aspect("equal")
    axis.set_axis_off()
    for row, (label, pairs) in enumerate(rows):
        for column, (words, points) in enumerate(pairs):
            middle, top = _CELL_M[0] * (column + 0.5), -_CELL_M[1] * row
            draw_pair(axis, points, np.array([middle, top - 0.56 * _CELL_M[1]]))
            lines = words.replace(", ", "\n")
            axis.text(middle, top - 0.17 * _CELL_M[1], lines, fontsize=7, ha="center", va="center")
        axis.text(0.0, -_CELL_M[1] * (row + 0.05), label, fontsize=7, fontweight="bold")
    return figure_svg(figure)
