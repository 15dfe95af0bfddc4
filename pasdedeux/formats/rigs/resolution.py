"""Layout, rate, length unit and up axis of a motion file.

`study new`, ingest and `retarget` decide here, so they agree.  Statements of the user come first, then facts about
published files, then statements of the file, then estimates from its content.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pasdedeux.errors import InputError
from pasdedeux.formats.rigs.guess import AxisGuess, UnitGuess, common_up_axis, guess_unit, guess_up_axis
from pasdedeux.formats.rigs.working_poses import check_layout
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.skeletons.layouts import Layout, resolve_layout
from pasdedeux.skeletons.layouts.layout import Table

MIN_UNIT_CONFIDENCE = 0.3
"""A length unit guessed with a lower confidence must be stated."""
SURE = 0.6
"""Confidence of a guessed unit or axis below which a take gets a warning; a very small or tall adult has 0.5."""

Mappings = Mapping[str, Mapping[Any, Table]]
"""Layouts of a study, and changes to known ones, see `resolve_layout`."""


@dataclass(frozen=True)
class Stated:
    """Statements of the user about a motion file; None and "auto" if nothing is stated."""

    layout: str = "auto"
    rate_hz: float | None = None
    metres_per_unit: float | None = None


@dataclass(frozen=True)
class KnownSource:
    """Facts about a published file that override its statements; None if there are none."""

    rate_hz: float | None = None
    metres_per_unit: float | None = None


@dataclass(frozen=True)
class Resolution:
    """Layout, rate and unit of a motion file.

    Args:
        layout: The layout fitted to its skeleton; None if none fits.
        why_no_layout: The reason if none fits, else empty.
        rate_hz: Its true frame rate; None if unknown.
        unit: Length of its unit, with confidence 1 if it is stated, known or in the file.
    """

    layout: Layout | None
    why_no_layout: str
    rate_hz: float | None
    unit: UnitGuess

    def required_layout(self) -> Layout:
        """Return the layout.

        Raises:
            InputError: There is none; the message has the reason.
        """
        if self.layout is None:
            raise InputError(self.why_no_layout)
        return self.layout

    def required_rate_hz(self, hint: str = "") -> float:
        """Return the rate.

        Raises:
            InputError: There is none.
        """
        if self.rate_hz is None:
            raise InputError(f"the file states no frame rate; set rate_hz for this take{hint}")
        return self.rate_hz

    def required_unit_m(self) -> float:
        """Return the length of the unit, metres.

        Raises:
            InputError: It is a guess of too low confidence.
        """
        if self.unit.confidence < MIN_UNIT_CONFIDENCE:
            raise InputError(f"its unit of length is unknown ({self.unit.reason}); set metres_per_unit for this take")
        return self.unit.metres_per_unit


def resolve_motion(
    source: SourceMotion,
    stated: Stated = Stated(),
    known: KnownSource = KnownSource(),
    mappings: Mappings | None = None,
) -> Resolution:
    """Determine layout, rate and unit of a motion file; its rest pose is enough.

    A layout that puts two joints of the rest pose in one place does not fit.
    """
    layout, why_not = None, ""
    try:
        layout = resolve_layout(stated.layout, source.skeleton, source.rest_offsets, mappings)
    except InputError as error:
        why_not = str(error)
    rate_hz = stated.rate_hz or known.rate_hz or source.rate_hz
    unit_m = stated.metres_per_unit or known.metres_per_unit
    unit = guess_unit(source, layout)
    if unit_m is not None:
        unit = UnitGuess(unit_m, 1.0, "it is known", unit.height_m / unit.metres_per_unit * unit_m)
    if layout is not None and unit.confidence >= MIN_UNIT_CONFIDENCE:
        try:
            check_layout(source.to_motion(metres_per_unit=unit.metres_per_unit, rate_hz=rate_hz or 1.0), layout)
        except InputError as error:
            layout, why_not = None, str(error)
    return Resolution(layout, why_not, rate_hz, unit)


def resolve_up_axes(
    sources: Sequence[SourceMotion],
    layouts: Sequence[Layout | None],
    stated: Sequence[str],
    stands_alone: Sequence[bool],
) -> list[AxisGuess]:
    """Return the up axis of each person's file: as stated, else detected from the standing bodies.

    A person who clearly stands along the same axis as the rest pose has that axis.  Others get the axis of the person
    who stands most clearly, because one of two people captured together may lie on the floor all the time.

    Args:
        sources: Motion of each person.
        layouts: Layout of the joints of each person; None if unknown.
        stated: Stated axis of each person, or "auto".
        stands_alone: Whether each person has a separate file with a rest pose.
    """
    guesses = [
        guess_up_axis(source, layout) if axis == "auto" else AxisGuess(axis, 1.0)
        for source, layout, axis in zip(sources, layouts, stated, strict=True)
    ]
    free = [at for at, axis in enumerate(stated) if axis == "auto"]
    if not free:
        return guesses
    common = common_up_axis([guesses[at] for at in free])
    for at in free:
        guess = guesses[at]
        is_clear = stands_alone[at] and guess.confidence >= SURE
        if guess.axis == common.axis or not (
            is_clear and guess_up_axis(sources[at].rest, layouts[at]).axis == guess.axis
        ):
            guesses[at] = common
    return guesses


def mend_of_mirror(exchanged: Sequence[bool]) -> str:
    """Return the setting that corrects exchanged left and right for the people in this mask.

    A mirror affects all people of a scene; if only some are exchanged, only names are.  For one person alone this
    cannot be decided, because a body looks like its mirror image.
    """
    if all(exchanged):
        return 'set mirrored = true, or "names" where the scene is right and only names are exchanged'
    return 'set mirrored = "names", because others of the take are right'
