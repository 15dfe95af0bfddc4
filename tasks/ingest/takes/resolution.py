"""Finding, hashing and checking the motion files of takes in planning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pasdedeux.errors import InputError, named
from pasdedeux.formats.file_format import MotionFormat, MotionHead
from pasdedeux.formats.registry import MOTION_FORMATS, find_format
from pasdedeux.formats.rigs.resolution import KnownSource, Mappings, Resolution, Stated, resolve_motion
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.skeletons import Skeleton
from storage_schema import SourceCredit
from tasks.ingest.files import find_file, load_file, read_again, read_start
from tasks.ingest.takes.known_sources import CMU_CREDIT, known_source, usual_rate_hz, was_fetched
from tasks.ingest.takes.parameters import PersonOptions, PersonParameters
from tasks.stage import SourceFile

NOT_STATED = "not stated"
OWN_FILES = "files given in the study"


@dataclass(frozen=True)
class PersonSource:
    """The checked file of one person.

    Args:
        parameters: Its parameters in the shard, with all choices made.
        files: The motion file, then its companion, if it needs one.
        num_frames: Number of frames in the motion file.
        notes: Assumptions of its reader, a sentence each.
    """

    parameters: PersonParameters
    files: tuple[SourceFile, ...]
    num_frames: int
    notes: tuple[str, ...]


def find_person(path: Path, options: PersonOptions, mappings: Mappings, *, number: int = 0) -> PersonSource:
    """Find and check the file of one person, or the person of this number in a file of several.

    Raises:
        InputError: The file, named in the message, is missing or damaged, has unknown joints or a bone of length zero,
            or the study lacks a needed statement.
    """
    file, start = find_file(path), read_start(path)
    with named(path.name):
        kind = find_format(MOTION_FORMATS, options.format or "auto", start)
        companion = find_companion(path, kind, options.skeleton)
        head = _head(kind.name, file, companion, number)
        rest = head.rest.with_sides_exchanged() if options.mirrored == "names" else head.rest
        taken = resolve_file(file, rest, options, mappings)
        layout, usual = taken.required_layout(), usual_rate_hz(path.name)
        parameters = PersonParameters(
            source_name=path.name,
            motion_sha256=file.sha256,
            companion_sha256=companion.sha256 if companion else "",
            format=kind.name,
            layout=layout.name if options.layout in (None, "auto") else str(options.layout),
            rate_hz=taken.required_rate_hz(f" (CMU's file of this name has {usual:g} Hz)" if usual else ""),
            metres_per_unit=taken.required_unit_m(),
            unit_confidence=taken.unit.confidence,
            up_axis=options.up_axis or "auto",
            mirrored=options.mirrored or False,
            number=number,
            first_frame=options.first_frame or 0,
            translation_m=options.translation_m or (0.0, 0.0, 0.0),
            yaw_deg=options.yaw_deg or 0.0,
        )
    files = (file, companion) if companion else (file,)
    return PersonSource(parameters, files, head.num_frames, head.rest.notes)


def resolve_file(
    file: SourceFile, rest: SourceMotion, options: PersonOptions | None = None, mappings: Mappings | None = None
) -> Resolution:
    """Determine layout, rate and unit of a motion file from statements, facts about published files, and content."""
    stated = Stated()
    if options is not None:
        stated = Stated(options.layout or "auto", options.rate_hz, options.metres_per_unit)
    path = Path(file.path)
    of_rest = rest.skeleton, rest.rest_offsets.tobytes(), rest.rate_hz, rest.metres_per_unit

    def resolved(known: KnownSource) -> Resolution:
        return resolve_motion(rest, stated, known, mappings) if mappings else _resolved(*of_rest, stated, known)

    guessed = resolved(KnownSource())
    layout_name = guessed.layout.name if guessed.layout else ""
    is_fetched = was_fetched(path, file.sha256)
    known = known_source(path.name, layout_name, stated_hz=rest.rate_hz, is_fetched=is_fetched)
    return guessed if known == KnownSource() else resolved(known)


@lru_cache(maxsize=64)
def _resolved(
    skeleton: Skeleton,
    rest_offsets: bytes,
    rate_hz: float | None,
    metres_per_unit: float | None,
    stated: Stated,
    known: KnownSource,
) -> Resolution:
    """Determine them for a rest pose; cached, because thousands of files of one rig may have the same."""
    offsets = np.frombuffer(rest_offsets).reshape(-1, 3)
    rest = SourceMotion.at_rest(skeleton, offsets, rate_hz=rate_hz, metres_per_unit=metres_per_unit)
    return resolve_motion(rest, stated, known)


def find_companion(path: Path, kind: MotionFormat, stated: Path | None = None) -> SourceFile | None:
    """Return the companion of a motion file: the stated one, else the one at its usual path; None if not needed.

    Raises:
        InputError: It does not exist, or is damaged (the message has its name).
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
    """Return licence and credit of a take: as stated, else those of CMU if `fetch` downloaded all its files."""
    is_cmu = all(was_fetched(Path(person.files[0].path), person.files[0].sha256) for person in people)
    known = CMU_CREDIT if is_cmu else SourceCredit(name=OWN_FILES, licence=NOT_STATED, credit=NOT_STATED)
    return SourceCredit(
        name=CMU_CREDIT.name if credit == CMU_CREDIT.credit else known.name,
        licence=licence or known.licence,
        credit=credit or known.credit,
    )


@lru_cache(maxsize=1000)
def _head(kind: str, motion: SourceFile, companion: SourceFile | None, number: int) -> MotionHead:
    """Check the cheap properties of a file; cached, because a study is planned several times in a run."""
    return MOTION_FORMATS[kind].read_head(
        read_again(motion), read_again(companion) if companion else b"", number=number
    )
