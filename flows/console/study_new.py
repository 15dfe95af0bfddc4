"""A study to start from: written for the files of a take or for 2D poses, what their content tells as comments."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from flows.templates import render
from pasdedeux.errors import InputError, named
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.guess import USUAL_HEIGHT_M, MotionGuess, common_up_axis, guess_motion
from pasdedeux.formats.registry import recognise_format
from pasdedeux.formats.resolution import MIN_UNIT_CONFIDENCE, KnownSource
from pasdedeux.people.video import why_no_video
from tasks.ingest.files import load_file, read_again
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.readers import refuse_film
from tasks.ingest.poses2d.resolution import find_annotations
from tasks.ingest.takes.known_sources import known_source, usual_rate_hz, was_fetched
from tasks.ingest.takes.resolution import find_companion
from tasks.seeds.parameters import GROWN_OF_2D_ALONE, LIFTED_OF_2D_ALONE
from tasks.views import ViewsParameters

_SURE, _LIKELY = 0.9, 0.6
ONE_TAKE = 0.98
"""Of the length of the longer of two files that the shorter has at least, where both are taken to be of one take."""


_DOUBTS = "A GUESS", "ARE THEY"
"""What a line of the study has in it that somebody has to look at."""
_quoted = partial(json.dumps, ensure_ascii=False)


@dataclass(frozen=True)
class _Person:
    """Somebody of a motion file: its length, its digest, what its content shows, what is known of it, notes on it."""

    path: Path
    num_frames: int
    sha256: str
    guess: MotionGuess
    known: KnownSource
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Video:
    """A file or folder of 2D poses as the study names it, how many people it shows at once, and whether they move."""

    id: str
    path: str
    format: str
    note: str
    num_persons: int
    is_moving: bool


def write_new_study(path: Path, files: Sequence[Path] = ()) -> list[str]:
    """Write a commented study over files to a new file; gives what was found and what is doubted, a line each.

    Motion files are the people of one take, person A first.  Without files, the study is of the built-in duets.

    Raises:
        InputError: The study is there already or cannot be written, a file does not exist, is given twice, or is none
            of the known formats.
    """
    if path.exists():
        raise InputError(f"{path} is there already; choose another name or remove it")
    sources = [source for file in files for source in _inspect(file, path.parent)]
    people = [source for source in sources if isinstance(source, _Person)]
    videos = [source for source in sources if isinstance(source, _Video)]
    lines = _take_lines(people) if people else []
    shown = [_quoted(_shown(person.path, path.parent)) for person in people]
    take = {"id": _identifier(people[0].path.stem), "files": shown, "lines": lines} if people else None
    text = render(
        "new_study.toml",
        name=_identifier(path.stem),
        take=take,
        videos=videos,
        are_pairs=any(video.num_persons >= 2 for video in videos),
        are_moving=any(video.is_moving for video in videos),
        views=ViewsParameters(),
        num_lifted=LIFTED_OF_2D_ALONE,
        num_grown=GROWN_OF_2D_ALONE,
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    doubted = (line.removeprefix("# ").partition("#") for line in lines if any(mark in line for mark in _DOUBTS))
    return [
        *(f"found {_said(person)}" for person in people),
        *dict.fromkeys(f"note: {person.path.name}: {note}" for person in people for note in person.notes),
        *(f"found 2D poses {one.path}: {one.note}" for one in videos),
        *(f"in doubt: {key.strip()}: {why.strip()}" for key, _, why in doubted),
    ]


def _inspect(path: Path, base: Path) -> Sequence[_Person | _Video]:
    """Read everybody of a motion file, or a file or folder of 2D poses."""
    if not path.exists():
        raise InputError(f"file {path} does not exist")
    with named(path.name):
        if path.is_dir():
            return [_read_video(path, base)]
        refuse_film([path], path)
        loaded = load_file(path)
        kind = recognise_format(loaded.data)
        if isinstance(kind, AnnotationFormat):
            if kind.is_file_per_frame:
                raise InputError("a single file of this format is one frame; give the folder")
            return [_read_video(path, base)]
        companion = find_companion(path, kind)
        people, sha256 = [], loaded.file.sha256
        is_fetched = was_fetched(path, sha256)
        for motion in kind.read_people(loaded.data, read_again(companion) if companion else b""):
            guess = guess_motion(motion)
            known = known_source(path.name, guess.layout or "", stated_hz=guess.rate_hz, is_fetched=is_fetched)
            people.append(_Person(path, motion.num_frames, sha256, guess, known, motion.notes))
        return people


def _read_video(path: Path, base: Path) -> _Video:
    """Read 2D poses as a study will; what is no video are single images, such as key frames."""
    found = find_annotations(AnnotationOptions(id=_identifier(path.stem), path=path))
    formats = {source.parameters.format for source in found}
    people: Counter[tuple[str, int]] = Counter()
    for source in found:
        frames = source.read()
        people.update(zip(frames.sequence_id, frames.frame.tolist(), strict=True))
    numbers = defaultdict(list)
    for sequence_id, frame in people:
        numbers[sequence_id].append(frame)
    return _Video(
        id=_identifier(path.stem),
        path=_quoted(_shown(path, base)),
        format=formats.pop() if len(formats) == 1 else "auto",
        note="; ".join(source.in_words() for source in found),
        num_persons=max(people.values(), default=0),
        is_moving=any(not why_no_video(np.array(own)) for own in numbers.values()),
    )


def _take_lines(people: Sequence[_Person]) -> list[str]:
    """Return the lines of a take below its files."""
    by_digest = {person.sha256: person.path for person in reversed(people)}
    for person in people:
        if (other := by_digest[person.sha256]) is not person.path:
            raise InputError(f"{other} and {person.path} are the same, byte for byte; a person has a file of their own")
    layout, up = people[0].guess.layout, common_up_axis([person.guess.up for person in people])
    return [
        *_length(people),
        "# layout: its joints fit no known layout; write one under [ingest.mappings]"
        if layout is None
        else f'layout = "{layout}"    # by the names of the joints: sure',
        f'up_axis = "{up.axis}"         # bodies stand along it: {_words(up.confidence)}',
        _rate(people[0]),
        *(line for person in people for line in ("[[ingest.takes.persons]]", _unit(person))),
    ]


def _said(person: _Person) -> str:
    """Say what a motion file holds."""
    unit, rate_hz = person.guess.unit, person.known.rate_hz or person.guess.rate_hz or usual_rate_hz(person.path.name)
    lasts = "" if rate_hz is None else f" ({person.num_frames / rate_hz:.1f} s at {rate_hz:g} Hz)"
    height_m = unit.height_m / unit.metres_per_unit * (person.known.metres_per_unit or unit.metres_per_unit)
    return f"{person.path.name}: {person.num_frames} frames{lasts}, about {height_m:.2f} m tall"


def _length(people: Sequence[_Person]) -> list[str]:
    """Say whether the files are of one take, by their lengths."""
    lengths = [person.num_frames for person in people]
    if len(set(lengths)) == 1:
        return []
    is_near = min(lengths) >= ONE_TAKE * max(lengths)
    asked = f"files have {' and '.join(map(str, lengths))} frames: ARE THEY OF ONE TAKE?"
    near = f'on_unequal = "trim"      # the {asked}'
    return [near if is_near else f"# {near} Then switch this on"]


def _rate(person: _Person) -> str:
    stated_hz, known_hz = person.guess.rate_hz, person.known.rate_hz
    if known_hz is not None:
        is_other = stated_hz is not None and abs(stated_hz - known_hz) > 0.01
        header = f"; the header says {stated_hz:g}" if is_other else ""
        return f"rate_hz = {known_hz:g}         # known of CMU's files{header}"
    if stated_hz is not None:
        lasts = f"the take lasts {person.num_frames / stated_hz:.1f} s then"
        check = "compare with the video, stated rates are often wrong"
        return f"rate_hz = {stated_hz:g}         # stated by the file; {lasts}: {check}"
    usual_hz = usual_rate_hz(person.path.name)
    if usual_hz is None:
        return "# rate_hz = 120       # no file states its frame rate: A GUESS - SET IT, it is needed"
    return f"rate_hz = {usual_hz:g}         # the file states none, CMU's of this name has it: A GUESS - CHECK IT"


def _unit(person: _Person) -> str:
    """Return the length unit of a person."""
    unit, name, known_m = person.guess.unit, person.path.name, person.known.metres_per_unit
    if known_m is not None:
        return f"metres_per_unit = {known_m:g}   # known of CMU's salsa BVH: sure"
    if unit.confidence >= MIN_UNIT_CONFIDENCE:
        why = f"{unit.reason}: {_words(unit.confidence)}"
        return f"metres_per_unit = {unit.metres_per_unit:.10g}   # {name}: {why}"
    why = f"{unit.reason}; this would make it {USUAL_HEIGHT_M} m: A GUESS - SET IT, it is needed"
    return (
        f"# metres_per_unit = {unit.metres_per_unit * USUAL_HEIGHT_M / (unit.height_m or 1.0):.10g}   # {name}: {why}"
    )


def _words(confidence: float) -> str:
    if confidence >= _SURE:
        return "sure"
    return "likely" if confidence >= _LIKELY else "A GUESS - CHECK IT"


def _shown(path: Path, base: Path) -> str:
    """Return a path as the study should say it: relative inside its folder, else absolute."""
    resolved, folder = path.resolve(), base.resolve()
    return resolved.relative_to(folder).as_posix() if resolved.is_relative_to(folder) else resolved.as_posix()


def _identifier(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", text).lstrip("_-") or "study"
