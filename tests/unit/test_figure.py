"""Figures that are declared once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pasdedeux.figure import complaints, complete_limits, figure, figures_of, limits_of
from pasdedeux.verdict import Level


@dataclass(frozen=True)
class Landing:
    joint: str = figure("The joint")
    drop_m: float = figure("Greatest drop", (0.1, 0.5))
    speed_m_s: float | None = figure("Speed", (2.0, 3.0), complaint="the {joint} lands at {speed_m_s:.0f} m/s")
    held_share: float = figure("Share of the landing that is held", (0.5, 0.2), words="hold")


@dataclass(frozen=True)
class FrameOfLanding:
    time: np.ndarray
    drop_m: np.ndarray = figure("Drop", (0.2, 0.6))
    speed_m_s: np.ndarray = figure()


FIGURES = figures_of(Landing)
GOOD = Landing(joint="left_toe", drop_m=0.1, speed_m_s=None, held_share=0.5)


def test_what_a_figure_does_not_say_is_told_by_its_field_and_its_limits() -> None:
    assert [
        (figure.name, figure.words, figure.unit, figure.better, figure.kind, figure.is_nullable)
        for figure in FIGURES.values()
    ] == [
        ("joint", "joint", "", "", "str", False),
        ("drop_m", "drop", "m", "smaller", "float", False),
        ("speed_m_s", "speed", "m/s", "smaller", "float", True),
        ("held_share", "hold", "", "larger", "float", False),
    ]


def test_a_figure_that_says_nothing_is_as_the_one_that_it_is_like() -> None:
    frames = figures_of(FrameOfLanding, FIGURES)
    assert frames["speed_m_s"] == replace(FIGURES["speed_m_s"], is_nullable=False)
    assert frames["drop_m"] == replace(FIGURES["drop_m"], meaning="Drop", limits=(0.2, 0.6))
    assert list(frames) == ["drop_m", "speed_m_s"]


@pytest.mark.parametrize(
    ("changed", "level", "said"),
    [
        ({"drop_m": 0.2}, Level.WARN, "drop 200 mm is above 100 mm"),
        ({"drop_m": 0.6}, Level.FAIL, "drop 600 mm is above 500 mm"),
        ({"speed_m_s": 2.6}, Level.WARN, "the left_toe lands at 3 m/s"),
        ({"held_share": 0.1}, Level.FAIL, "hold 0.1 is below 0.2"),
    ],
)
def test_a_figure_past_a_limit_is_said_in_its_words(changed: dict[str, float], level: Level, said: str) -> None:
    limits = limits_of(FIGURES)
    assert not list(complaints(GOOD, FIGURES, limits))
    ((_, judged, sentence),) = complaints(replace(GOOD, **changed), FIGURES, limits)
    assert (judged, sentence) == (level, said)
    assert not list(complaints(replace(GOOD, **dict.fromkeys(changed, np.nan)), FIGURES, limits))


def test_limits_that_are_not_given_are_the_declared_ones() -> None:
    given = {"drop_m": (0.0, 1.0)}
    assert complete_limits(FIGURES, given) == {**limits_of(FIGURES), **given}
    for wrong, said in (
        ({"drop_m": (2.0, 1.0)}, "0 <= warn <= fail"),
        ({"held_share": (0.1, 0.2)}, "0 <= fail <= warn"),
        ({"drop_m": (-1.0, 1.0)}, "0 <= warn <= fail"),
        ({"drop": (1.0, 2.0)}, "there are: drop_m, speed_m_s, held_share"),
    ):
        with pytest.raises(ValueError, match=said):
            complete_limits(FIGURES, wrong)
