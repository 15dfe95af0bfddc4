"""All that is guessed of a motion file at once."""

from __future__ import annotations

from dataclasses import dataclass

from pasdedeux.formats.rigs.guess import (
    AxisGuess,
    MirrorGuess,
    UnitGuess,
    draft_motion,
    guess_mirrored,
    guess_unit,
    guess_up_axis,
)
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.skeletons.layouts import Draft, find_layout


@dataclass(frozen=True)
class MotionGuess:
    """What a motion file seems to be; `layout` is the name of a known layout, `draft` is there where none fits."""

    layout: str | None
    draft: Draft | None
    up: AxisGuess
    unit: UnitGuess
    mirror: MirrorGuess


def guess_motion(source: SourceMotion) -> MotionGuess:
    """Return estimates of everything that a motion file may not state."""
    known = find_layout(source.skeleton, source.rest_offsets)
    draft = None if known else draft_motion(source)
    layout = draft.layout("draft") if draft and draft.is_whole else known
    return MotionGuess(
        layout=known.name if known else None,
        draft=draft,
        up=guess_up_axis(source, layout),
        unit=guess_unit(source, layout),
        mirror=guess_mirrored(source, layout),
    )
