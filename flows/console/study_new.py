"""A study to start from: written for given files, with what their content tells and how sure that is, as comments."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pasdedeux.errors import InputError, named
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.guess import USUAL_HEIGHT_M, MotionGuess, common_up_axis, guess_motion
from pasdedeux.formats.registry import ANNOTATION_FORMATS, MOTION_FORMATS, is_companion, recognise_format
from pasdedeux.people.video import why_no_video
from tasks.ingest.annotations import find_annotations
from tasks.ingest.cameras import refuse_film
from tasks.ingest.known_sources import KnownSource, known_source, usual_rate_hz, was_fetched
from tasks.ingest.parameters import AnnotationOptions
from tasks.ingest.sources import MIN_UNIT_CONFIDENCE, find_companion, load_file, read_again
from tasks.seeds.parameters import GROWN_OF_2D_ALONE, LIFTED_OF_2D_ALONE
from tasks.views import ViewsParameters

SURE, LIKELY = 0.9, 0.6
ONE_TAKE = 0.98
"""Of the length of the longer of two files that the shorter has at least, where both are taken to be of one take."""
_MAX_SHOWN = 12
"""Takes that are named on the screen, of many."""
_SUFFIXES = {end for kind in (*MOTION_FORMATS.values(), *ANNOTATION_FORMATS.values()) for end in kind.suffixes}

_HEAD = """\
# A study: what comes in, and what is made of it.  Keys that are not set take their defaults.
# `pasdedeux plan` shows what a run would do, `pasdedeux run` does it.
# Lines that start with # are notes, or keys that are set by removing the #.

[study]
name = {name}
title = {name}
seed = 1

[ingest]
rate_hz = 30            # frame rate of all poses of the study
"""
_NO_SOURCES = """\
# Without sources a study gets the default duets: waltz, hug, judo, push_hands.
# [[ingest.takes]]
# id = "dance"
# files = ["a.bvh", "b.bvh"]
"""
_VIRTUAL_VIDEO = """
[ingest.virtual_video]  # virtual cameras that see the takes
num_videos = 1          # cameras that see each whole take
num_random_views = 100  # annotated pairs from random views, of each take that is not held out
distance_m = 4.0
noise_px = 1.0          # for a person 600 px tall
"""
_ASSUMED = """
[views]                     # 2D determines neither the distance of the camera nor its pitch: assumed
distance_m = {0.distance_m}            # from the camera to the people, metres
camera_pitch_deg = {0.camera_pitch_deg}     # how far the camera looks down
camera_pitch_deviation_deg = {0.camera_pitch_deviation_deg}   # standard deviation of that assumption
lean_deviation_deg = {0.lean_deviation_deg}   # standard deviation of backs from the vertical
"""
_FROM_2D_ALONE = f"""
[seeds]                     # no take is there to start from: pairs of two people are lifted from 2D alone
num_lifted = {LIFTED_OF_2D_ALONE}             # annotated pairs that stand for all
num_grown = {GROWN_OF_2D_ALONE}            # at most: annotated pairs that those lift in turn

[chains]                    # 3D pairs that agree with the annotations
densities = ["ic"]
num_chains = 1              # of each seed
num_draws = 250             # of each chain; more of both show whether chains agree

[lifting]
max_frames = 40             # annotated pairs of each source that are lifted with the draws
"""
_MOTION_FROM_DRAWS = """
[projections]               # the draws are the database that motion is reconstructed from; takes of such
include_draws = true        # motion are a better one: [[ingest.takes]], `pasdedeux fetch cmu`

[reconstruction]            # motion of everybody, also where only one person is seen
sequences = "given"
"""
_ONE_PERSON_ALONE = """
# Nobody is seen with a partner, so nothing can be lifted from 2D alone: takes of such motion are needed.
# [[ingest.takes]]          # or `pasdedeux fetch cmu`, see `pasdedeux study show everyday`
# id = "walk"
# files = ["walk.bvh"]

[reconstruction]
sequences = "given"
"""


@dataclass(frozen=True)
class NewStudy:
    """A study to start from.

    Args:
        text: What its file says.
        found: What was found in the files, a line each.
        doubts: What is doubted of that, a line each.
    """

    text: str
    found: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    def in_lines(self) -> list[str]:
        """Return what was found and what is doubted, of many files the first."""
        more = len(self.found) - _MAX_SHOWN
        found = [*self.found[:_MAX_SHOWN], *([f"{more} more"] if more > 0 else [])]
        return [f"found {line}" for line in found] + [f"in doubt: {line}" for line in self.doubts]


class _Line(NamedTuple):
    """A line of the study, and what is doubted of it; either may be empty."""

    text: str
    doubt: str = ""


@dataclass(frozen=True)
class _Motion:
    """A motion file, its length, its digest, what its content shows, and what is known of it otherwise."""

    path: Path
    num_frames: int
    sha256: str
    guess: MotionGuess
    known: KnownSource

    @property
    def height_m(self) -> float:
        """Return about how tall the person is."""
        unit = self.guess.unit
        return unit.height_m / unit.metres_per_unit * (self.known.metres_per_unit or unit.metres_per_unit)


@dataclass(frozen=True)
class _Annotations:
    """A file or folder of 2D poses, its format, and what it is in words."""

    path: Path
    format: str
    note: str
    num_persons: int
    is_video: bool


def write_new_study(path: Path, files: Sequence[Path] = ()) -> NewStudy:
    """Write a commented study to a new file.

    Raises:
        InputError: The file is there already, a source cannot be read, or nothing can be written there.
    """
    if path.exists():
        raise InputError(f"{path} is there already; choose another name or remove it")
    made = new_study(_identifier(path.stem), files, base=path.parent)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(made.text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from None
    return made


def new_study(name: str, files: Sequence[Path] = (), *, base: Path | None = None) -> NewStudy:
    """Return a study over these files; over the built-in duets without any.

    Two motion files are a take; of more, those whose take and length match are (60_01 with 61_01, and 62_01 where there
    is one).  ASF files serve the AMC files beside them; folders are looked through.

    Args:
        name: Name of the study.
        files: Motion files, files of 2D poses, or folders of either.
        base: Folder that the study will lie in; paths inside it are written relative to it.

    Raises:
        InputError: A file does not exist, is given twice, or is none of the known formats.
    """
    sources = [source for path in _spread(files) if (source := _inspect(path)) is not None]
    motions = [source for source in sources if isinstance(source, _Motion)]
    annotations = [source for source in sources if isinstance(source, _Annotations)]
    takes = _pair_up(motions)
    text, found = _HEAD.format(name=_quoted(name)), []
    doubted: dict[str, list[str]] = {}
    if takes:
        text += f"# held_out = [{_quoted(next(iter(takes)))}]   # takes kept for evaluation, never learned from\n"
    if not sources:
        text += _NO_SOURCES
    for take_id, people in takes.items():
        found.append(_found(take_id, people))
        shown = ", ".join(_quoted(_shown(one.path, base)) for one in people)
        text += f"\n[[ingest.takes]]\nid = {_quoted(take_id)}\nfiles = [{shown}]\n"
        alone = [_Line("", "it has one person: no other file of this take and this length was given")]
        lines = alone if len(people) == 1 < len(motions) else _lengths(people)
        for line in (
            *_copies(people, motions),
            *lines,
            _layout(people),
            _up_axis(people),
            _rate(people),
            *_units(people),
        ):
            text += f"{line.text}\n" if line.text else ""
            if line.doubt:
                doubted.setdefault(line.doubt, []).append(take_id)
    for source in annotations:
        found.append(f"2D poses {source.path.name}: {source.note}")
        text += "\n".join(
            [
                "",
                "[[ingest.annotations]]",
                f"id = {_quoted(_identifier(source.path.stem))}",
                f"path = {_quoted(_shown(source.path, base))}",
                f"# {source.note}",
                f"format = {_quoted(source.format)}",
                "# rate_hz = 30",
                "# image_size_px = [1920, 1080]",
                '# on_unreadable = "skip"   # go on without damaged OpenPose files, and count them\n',
            ]
        )
    are_pairs = any(one.num_persons >= 2 for one in annotations)
    text += _ASSUMED.format(ViewsParameters()) if are_pairs else ""
    if takes or not annotations:
        text += _VIRTUAL_VIDEO
    elif are_pairs:
        text += _FROM_2D_ALONE + (_MOTION_FROM_DRAWS if any(one.is_video for one in annotations) else "")
    else:
        text += _ONE_PERSON_ALONE
    return NewStudy(text, tuple(found), tuple(f"{_named(ids)}: {doubt}" for doubt, ids in doubted.items()))


def _spread(files: Sequence[Path]) -> list[Path]:
    """Return the files, folders of motion files replaced by what lies in them; a folder of JSON stays one source."""
    found: list[Path] = []
    for number, path in enumerate(files):
        if path.resolve() in (other.resolve() for other in files[:number]):
            raise InputError(f"{path} is given twice; a person has a file of their own, so name each file once")
        if not path.exists():
            raise InputError(f"file {path} does not exist")
        inside = sorted(item for item in path.iterdir() if item.suffix.lower() in _SUFFIXES) if path.is_dir() else []
        found += [path] if not inside or any(item.suffix.lower() == ".json" for item in inside) else inside
    return list(dict.fromkeys(found))


def _inspect(path: Path) -> _Motion | _Annotations | None:
    """Inspect a file; None for one that only serves those beside it."""
    with named(path.name):
        if path.is_dir():
            return _read_annotations(path)
        refuse_film([path], path)
        loaded = load_file(path)
        if is_companion(loaded.data):
            return None
        kind = recognise_format(loaded.data)
        if isinstance(kind, AnnotationFormat):
            if kind.is_file_per_frame:
                raise InputError("a single file of this format is one frame; give the folder")
            return _read_annotations(path)
        companion = find_companion(path, kind)
        motion = kind.read(loaded.data, read_again(companion) if companion else b"")
        sha256, guess = loaded.file.sha256, guess_motion(motion)
        known = known_source(
            path.name, guess.layout or "", stated_hz=guess.rate_hz, is_fetched=was_fetched(path, sha256)
        )
        return _Motion(path, motion.num_frames, sha256, guess, known)


def _read_annotations(path: Path) -> _Annotations:
    """Read a source as a study will; what is no video are single images, such as key frames."""
    found = find_annotations(AnnotationOptions(id=_identifier(path.stem), path=path))
    formats = {source.parameters.format for source in found}
    people: Counter[tuple[str, int]] = Counter()
    for source in found:
        frames = source.read()
        people.update(zip(frames.sequence_id, frames.frame.tolist(), strict=True))
    numbers: dict[str, list[int]] = {}
    for sequence_id, frame in people:
        numbers.setdefault(sequence_id, []).append(frame)
    return _Annotations(
        path,
        formats.pop() if len(formats) == 1 else "auto",
        "; ".join(source.in_words() for source in found),
        max(people.values(), default=0),
        any(not why_no_video(np.array(own)) for own in numbers.values()),
    )


def _pair_up(motions: Sequence[_Motion]) -> dict[str, list[_Motion]]:
    """Return the files of each take: two files in all, or equally long ones of one take."""
    if len(motions) == 2:
        return {_identifier(motions[0].path.stem): list(motions)}
    takes: dict[str, list[_Motion]] = {}
    open_takes: dict[tuple[Path, str], list[_Motion]] = {}
    for source in motions:
        subject, _, take = source.path.stem.rpartition("_")
        key = (source.path.parent, take)
        partner = open_takes.get(key, [])
        if subject and partner and partner[0].num_frames == source.num_frames:
            partner.append(source)
            continue
        take_id = _identifier(source.path.stem)
        while take_id in takes:
            take_id += "_2"
        takes[take_id] = [source]
        if subject:
            open_takes[key] = takes[take_id]
    return takes


def _found(take_id: str, people: Sequence[_Motion]) -> str:
    """Say what a take is: its files, its length, how tall its people are."""
    first = people[0]
    rate_hz = first.known.rate_hz or first.guess.rate_hz or usual_rate_hz(first.path.name)
    lasts = "" if rate_hz is None else f" ({first.num_frames / rate_hz:.1f} s at {rate_hz:g} Hz)"
    tall = " and ".join(f"{one.height_m:.2f}" for one in people)
    names = " and ".join(one.path.name for one in people)
    return f"take {take_id}: {names}, {first.num_frames} frames{lasts}, about {tall} m tall"


def _copies(people: Sequence[_Motion], motions: Sequence[_Motion]) -> list[_Line]:
    """Doubt files of a take that copy those of takes before it; a second person who is a copy is refused."""
    lines = []
    for one in people:
        other = next(motion for motion in motions if motion.sha256 == one.sha256)
        if other is not one and other in people:
            raise InputError(
                f"{other.path} and {one.path} are the same, byte for byte; a person has a file of their own"
            )
        if other is not one:
            lines.append(_Line("", f"{one.path.name} is the same as {other.path.name}, byte for byte"))
    return lines


def _lengths(people: Sequence[_Motion]) -> list[_Line]:
    """Say whether the files are of one take, by their names and lengths."""
    numbers = {number for subject, _, number in (one.path.stem.rpartition("_") for one in people) if subject}
    lines = []
    if len(numbers) > 1 and all(number.isdigit() for number in numbers):
        lines.append(_Line("", f"by their names its files are of takes {' and '.join(sorted(numbers))}"))
    lengths = [one.num_frames for one in people]
    if len(set(lengths)) == 1:
        return lines
    words = f"files have {' and '.join(map(str, lengths))} frames"
    text = f'on_unequal = "trim"      # the {words}'
    is_near = min(lengths) >= ONE_TAKE * max(lengths)
    if not is_near:
        text = f'# on_unequal = "trim"    # the {words}: ARE THEY OF ONE TAKE? Then switch this on'
    return [*lines, _Line(text, f"its {words}: are they of one take?")]


def _layout(people: Sequence[_Motion]) -> _Line:
    layout = people[0].guess.layout
    if layout is None:
        return _Line("# layout: its joints fit no known layout; write one under [ingest.mappings]")
    return _Line(f"layout = {_quoted(layout)}    # by the names of the joints: sure")


def _rate(people: Sequence[_Motion]) -> _Line:
    first = people[0]
    stated_hz, known_hz = first.guess.rate_hz, first.known.rate_hz
    if known_hz is not None:
        is_other = stated_hz is not None and abs(stated_hz - known_hz) > 0.01
        header = f"; the header says {stated_hz:g}" if is_other else ""
        return _Line(f"rate_hz = {known_hz:g}         # known of CMU's files{header}")
    if stated_hz is not None:
        lasts = f"then it lasts {first.num_frames / stated_hz:.1f} s"
        lie = "files lie about this: compare with the video or a clock"
        return _Line(f"rate_hz = {stated_hz:g}         # stated by the file; {lasts} - {lie}")
    usual_hz = usual_rate_hz(first.path.name)
    if usual_hz is None:
        return _Line(
            "# rate_hz = 120       # the files state none: A GUESS - SET IT, it is needed",
            "no file states its frame rate; set rate_hz",
        )
    return _Line(
        f"rate_hz = {usual_hz:g}         # the file states none, CMU's of this name has it: A GUESS - CHECK IT",
        f"no file states its frame rate; {usual_hz:g} Hz is a guess from its name; check rate_hz",
    )


def _up_axis(people: Sequence[_Motion]) -> _Line:
    up = common_up_axis([one.guess.up for one in people])
    return _Line(
        f"up_axis = {_quoted(up.axis)}         # bodies stand along it: {_words(up.confidence)}",
        "" if up.confidence >= LIKELY else f"its up axis {up.axis} is a guess; check up_axis",
    )


def _units(people: Sequence[_Motion]) -> list[_Line]:
    """Return the length unit of each person, under a heading of their own."""
    lines = []
    for one in people:
        unit, name, known_m = one.guess.unit, one.path.name, one.known.metres_per_unit
        is_told = unit.confidence >= MIN_UNIT_CONFIDENCE
        if known_m is not None:
            text = f"metres_per_unit = {known_m:g}   # known of CMU's salsa BVH: sure"
        elif is_told:
            why = f"{unit.reason}, stature {unit.height_m:.2f} m: {_words(unit.confidence)}"
            text = f"metres_per_unit = {unit.metres_per_unit:.10g}   # {name}: {why}"
        else:
            value = unit.metres_per_unit * USUAL_HEIGHT_M / (unit.height_m or 1.0)
            why = f"{unit.reason}; this would make it {USUAL_HEIGHT_M} m: A GUESS - SET IT, it is needed"
            text = f"# metres_per_unit = {value:.10g}   # {name}: {why}"
        is_doubted = known_m is None and unit.confidence < LIKELY
        doubt = f"{name}: {unit.reason}; {'check' if is_told else 'set'} metres_per_unit" if is_doubted else ""
        lines += [_Line("[[ingest.takes.persons]]"), _Line(text, doubt)]
    return lines


def _words(confidence: float) -> str:
    if confidence >= SURE:
        return "sure"
    return "likely" if confidence >= LIKELY else "A GUESS - CHECK IT"


def _named(take_ids: Sequence[str]) -> str:
    """Name takes, of many the first."""
    more = f" and {len(take_ids) - _MAX_SHOWN} more" if len(take_ids) > _MAX_SHOWN else ""
    return f"take{'s' if len(take_ids) > 1 else ''} {', '.join(take_ids[:_MAX_SHOWN])}{more}"


def _shown(path: Path, base: Path | None) -> str:
    """Return a path as the study should say it: relative inside its folder, else absolute."""
    resolved = path.resolve()
    folder = (base or Path()).resolve()
    return resolved.relative_to(folder).as_posix() if resolved.is_relative_to(folder) else resolved.as_posix()


def _identifier(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", text).lstrip("_-") or "study"


def _quoted(text: str) -> str:
    """Return a TOML basic string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
