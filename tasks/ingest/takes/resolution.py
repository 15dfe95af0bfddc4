"""Source files before any work: found, hashed, and refused while it is cheap to do so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from pasdedeux.errors import InputError, named
from pasdedeux.formats.file_format import MotionFormat, MotionHead
from pasdedeux.formats.guess import UnitGuess, guess_unit
from pasdedeux.formats.registry import MOTION_FORMATS, find_format
from pasdedeux.formats.working_poses import check_layout
from pasdedeux.skeletons.layouts import resolve_layout
from storage_schema import SourceCredit
from tasks.ingest.files import load_file, read_again
from tasks.ingest.takes.known_sources import CMU_CREDIT, known_source, usual_rate_hz, was_fetched
from tasks.ingest.takes.parameters import CommonOptions, PersonOptions, PersonParameters
from tasks.stage import SourceFile

Tables = Mapping[Any, Mapping[str, Any]]
"""For each working skeleton the changed entries of its table."""

NOT_STATED = "not stated"
OWN_FILES = "files given in the study"
MIN_UNIT_CONFIDENCE = 0.3
"""A length unit that is guessed with less must be stated."""


@dataclass(frozen=True)
class PersonSource:
    """One person's file after the checks.

    Args:
        parameters: Those of the shard: every choice is made.
        files: The motion file, then the file beside it that its format needs.
        num_frames: Frames in the motion file.
    """

    parameters: PersonParameters
    files: tuple[SourceFile, ...]
    num_frames: int


def find_person(
    path: Path, take: CommonOptions, person: PersonOptions, mappings: Mapping[str, Tables], *, number: int = 0
) -> PersonSource:
    """Find and check one person's file, or the person of this number in a file of several.

    Raises:
        InputError: With the file's name in front: missing, mangled, unknown joints, a bone of length zero, or
            something that must be said in the study and is not.
    """
    loaded = load_file(path)
    with named(path.name):
        kind = find_format(MOTION_FORMATS, take.format, loaded.data)
        companion = find_companion(path, kind, person.skeleton)
        head = _head(kind.name, loaded.file, companion, number)
        layout_name = person.layout or take.layout
        layout = resolve_layout(layout_name, head.rest.skeleton, head.rest.rest_offsets, mappings)
        is_fetched = was_fetched(path, loaded.file.sha256)
        known = known_source(path.name, layout.name, stated_hz=head.rest.rate_hz, is_fetched=is_fetched)
        rate = person.rate_hz or take.rate_hz or known.rate_hz or head.rest.rate_hz
        if rate is None:
            usual = usual_rate_hz(path.name)
            hint = f" (CMU's file of this name has {usual:g} Hz)" if usual else ""
            raise InputError(f"the file states no frame rate; set rate_hz for this take{hint}")
        stated = person.metres_per_unit or take.metres_per_unit or known.metres_per_unit
        unit = guess_unit(head.rest) if stated is None else UnitGuess(stated, 1.0, "it is known", 0.0)
        if unit.confidence < MIN_UNIT_CONFIDENCE:
            raise InputError(f"its unit of length is unknown ({unit.reason}); set metres_per_unit for this take")
        check_layout(head.rest.to_motion(metres_per_unit=unit.metres_per_unit, rate_hz=rate), layout)
    parameters = PersonParameters(
        source_name=path.name,
        motion_sha256=loaded.file.sha256,
        companion_sha256=companion.sha256 if companion else "",
        format=kind.name,
        layout=layout_name if layout_name != "auto" else layout.name,
        rate_hz=rate,
        metres_per_unit=unit.metres_per_unit,
        unit_confidence=unit.confidence,
        up_axis=person.up_axis or take.up_axis,
        first_frame=(take.frames[0] if take.frames else 0) + person.first_frame,
        translation_m=person.translation_m,
        yaw_deg=person.yaw_deg,
    )
    return PersonSource(parameters, (loaded.file, companion) if companion else (loaded.file,), head.num_frames)


def find_companion(path: Path, kind: MotionFormat, stated: Path | None = None) -> SourceFile | None:
    """Return the file that a format needs beside its motion: the one that is stated, else where it usually lies.

    Raises:
        InputError: It is not there, or mangled, which is told under its own name.
    """
    if not kind.companion:
        return None
    names = kind.companion_names(path.name)
    places = [path.parent / name for name in names] if stated is None else [stated]
    place = next((place for place in places if stated or place.is_file()), None)
    if place is None:
        raise InputError(
            f"its {kind.companion} {' or '.join(names)} is not beside it; set `skeleton` under `persons` of this take"
        )
    loaded = load_file(place)
    with named(place.name):
        kind.check_companion(loaded.data)
    return loaded.file


def credit_of(people: Sequence[PersonSource], licence: str | None, credit: str | None) -> SourceCredit:
    """Return licence and credit of a take: what the study says, else CMU's where `fetch` brought all of its people."""
    is_cmu = all(was_fetched(Path(person.files[0].path), person.files[0].sha256) for person in people)
    known = CMU_CREDIT if is_cmu else SourceCredit(name=OWN_FILES, licence=NOT_STATED, credit=NOT_STATED)
    return SourceCredit(
        name=CMU_CREDIT.name if credit == CMU_CREDIT.credit else known.name,
        licence=licence or known.licence,
        credit=credit or known.credit,
    )


@lru_cache(maxsize=1000)
def _head(kind: str, motion: SourceFile, companion: SourceFile | None, number: int) -> MotionHead:
    """Check a file as far as that is cheap; remembered, because a study is planned several times in a run."""
    return MOTION_FORMATS[kind].read_head(
        read_again(motion), read_again(companion) if companion else b"", number=number
    )
