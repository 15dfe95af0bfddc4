"""A study to start from: written for given files, with what their content tells and how sure that is, as comments."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pasdedeux.errors import InputError
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
_SAID = 12
"""Takes that are named on the screen, of many."""
_SUFFIXES = {end for kind in (*MOTION_FORMATS.values(), *ANNOTATION_FORMATS.values()) for end in kind.suffixes}


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
        found = [f"found {line}" for line in self.found[:_SAID]]
        return (
            found
            + [f"found {len(self.found) - _SAID} more"] * (len(self.found) > _SAID)
            + [f"in doubt: {line}" for line in self.doubts]
        )


@dataclass(frozen=True)
class _Motion:
    """A motion file, its length, its digest, and what can be told of it."""

    path: Path
    num_frames: int
    sha256: str
    guess: MotionGuess

    @property
    def is_fetched(self) -> bool:
        """Whether `fetch` brought it from CMU."""
        return was_fetched(self.path, self.sha256)


@dataclass(frozen=True)
class _Annotations:
    """A file or folder of 2D poses, its format, and what it is in words."""

    path: Path
    format: str
    note: str
    num_persons: int
    is_video: bool

    @classmethod
    def read(cls, path: Path) -> _Annotations:
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
        return cls(
            path,
            formats.pop() if len(formats) == 1 else "auto",
            "; ".join(source.in_words() for source in found),
            max(people.values(), default=0),
            any(not why_no_video(np.array(own)) for own in numbers.values()),
        )


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
    sources = [source for path in _spread(files) if (source := _look_at(path)) is not None]
    motions = [source for source in sources if isinstance(source, _Motion)]
    annotations = [source for source in sources if isinstance(source, _Annotations)]
    lines = [
        "# A study: what comes in, and what is made of it.  Everything not said here has its default;",
        "# `pasdedeux plan` shows what a run would do, `pasdedeux run` does it.",
        "# Lines that start with # are notes, and settings to be switched on by removing it.",
        "",
        "[study]",
        f"name = {_quoted(name)}",
        f"title = {_quoted(name)}",
        "seed = 1",
        "",
        "[ingest]",
        "rate_hz = 30            # frame rate of all poses of the study",
    ]
    takes = _pair_up(motions)
    if takes:
        lines.append(f"# held_out = [{_quoted(next(iter(takes)))}]   # takes kept for evaluation, never learned from")
    if not sources:
        lines += [
            "# Without sources a study gets the default duets: waltz, hug, judo, push_hands.",
            "# [[ingest.takes]]",
            '# id = "dance"',
            '# files = ["a.bvh", "b.bvh"]',
        ]
    found: list[str] = []
    doubted: dict[str, list[str]] = {}
    for take_id, people in takes.items():
        lines += ["", *_take(take_id, people, base)]
        found.append(_found(take_id, people))
        for doubt in _doubts(people, motions):
            doubted.setdefault(doubt, []).append(take_id)
    for source in annotations:
        lines += ["", *_annotations(source, base)]
        found.append(f"2D poses {source.path.name}: {source.note}")
    doubts = tuple(f"{_named(take_ids)}: {doubt}" for doubt, take_ids in doubted.items())
    are_pairs = any(one.num_persons >= 2 for one in annotations)
    if are_pairs:
        lines += ["", *_assumptions()]
    if annotations and not takes:
        are_videos = any(one.is_video for one in annotations)
        lines += ["", *(_from_2d_alone(are_videos=are_videos) if are_pairs else _one_person_alone())]
        return NewStudy("\n".join([*lines, ""]), tuple(found), doubts)
    lines += [
        "",
        "[ingest.virtual_video]  # virtual cameras that see the takes",
        "num_videos = 1          # cameras that see each whole take",
        "num_random_views = 100  # annotated pairs from random views, of each take that is not held out",
        "distance_m = 4.0",
        "noise_px = 1.0          # for a person 600 px tall",
        "",
    ]
    return NewStudy("\n".join(lines), tuple(found), doubts)


def _spread(files: Sequence[Path]) -> list[Path]:
    """Return the files, folders of motion files replaced by what lies in them; a folder of JSON stays one source."""
    found: list[Path] = []
    for number, path in enumerate(files):
        if path.resolve() in (other.resolve() for other in files[:number]):
            raise InputError(f"{path} is given twice; a person has a file of their own, so name each file once")
        if not path.exists():
            raise InputError(f"file {path} does not exist")
        inside = sorted(item for item in path.iterdir() if item.suffix.lower() in _SUFFIXES) if path.is_dir() else []
        if inside and not any(item.suffix.lower() == ".json" for item in inside):
            found += inside
        else:
            found.append(path)
    return list(dict.fromkeys(found))


def _look_at(path: Path) -> _Motion | _Annotations | None:
    """Tell what a file is and what its content says; None for one that only serves those beside it."""
    try:
        if path.is_dir():
            return _Annotations.read(path)
        refuse_film([path], path)
        loaded = load_file(path)
        if is_companion(loaded.data):
            return None
        kind = recognise_format(loaded.data)
        if isinstance(kind, AnnotationFormat):
            if kind.is_file_per_frame:
                raise InputError("a single file of this format is one frame; give the folder")
            return _Annotations.read(path)
        companion = find_companion(path, kind)
        motion = kind.read(loaded.data, read_again(companion) if companion else b"")
        return _Motion(path, motion.num_frames, loaded.file.sha256, guess_motion(motion))
    except InputError as error:
        raise type(error)(f"{path.name}: {error}") from None


def _pair_up(motions: Sequence[_Motion]) -> dict[str, list[_Motion]]:
    """Return the files of each take: two files in all, or equally long ones of one take."""
    if len(motions) == 2:
        return {_identifier(motions[0].path.stem): list(motions)}
    takes: dict[str, list[_Motion]] = {}
    open_takes: dict[tuple[Path, str], str] = {}
    for source in motions:
        subject, _, take = source.path.stem.rpartition("_")
        key = (source.path.parent, take)
        partner = takes[open_takes[key]] if key in open_takes else []
        if subject and partner and partner[0].num_frames == source.num_frames:
            partner.append(source)
            continue
        take_id = _identifier(source.path.stem)
        while take_id in takes:
            take_id += "_2"
        takes[take_id] = [source]
        if subject:
            open_takes[key] = take_id
    return takes


def _take(take_id: str, people: Sequence[_Motion], base: Path | None) -> list[str]:
    files = ", ".join(_quoted(_shown(source.path, base)) for source in people)
    lines = ["[[ingest.takes]]", f"id = {_quoted(take_id)}", f"files = [{files}]"]
    first = people[0].guess
    lengths = [source.num_frames for source in people]
    if len(set(lengths)) > 1:
        said = f"the files have {' and '.join(map(str, lengths))} frames"
        is_near = min(lengths) >= ONE_TAKE * max(lengths)
        lines.append(
            f'on_unequal = "trim"      # {said}'
            if is_near
            else f'# on_unequal = "trim"    # {said}: ARE THEY OF ONE TAKE? Then switch this on'
        )
    if first.layout is None:
        lines.append("# layout: its joints fit no known layout; write one under [ingest.mappings]")
    else:
        lines.append(f"layout = {_quoted(first.layout)}    # told from the names of the joints: sure")
    up = common_up_axis([one.guess.up for one in people])
    lines.append(f"up_axis = {_quoted(up.axis)}         # bodies stand along it: {_words(up.confidence)}")
    known = _known(people[0])
    if known.rate_hz is not None:
        lines.append(
            f"rate_hz = {known.rate_hz:g}         # known of CMU's files{_against(first.rate_hz, known.rate_hz)}"
        )
    elif first.rate_hz is None:
        usual = usual_rate_hz(people[0].path.name)
        lines.append(
            "# rate_hz = 120       # the files state none: A GUESS - SET IT, it is needed"
            if usual is None
            else f"rate_hz = {usual:g}         # the file states none, CMU's of this name has it: A GUESS - CHECK IT"
        )
    else:
        seconds = people[0].num_frames / first.rate_hz
        lines.append(
            f"rate_hz = {first.rate_hz:g}         # stated by the file; then it lasts {seconds:.1f} s - "
            "files lie about this: compare with the video or a clock"
        )
    for source in people:
        unit = source.guess.unit
        lines.append("[[ingest.takes.persons]]")
        known_unit = _known(source).metres_per_unit
        if known_unit is not None:
            lines.append(f"metres_per_unit = {known_unit:g}   # known of CMU's salsa BVH: sure")
        elif unit.confidence >= MIN_UNIT_CONFIDENCE:
            why = f"{unit.reason}, stature {unit.height_m:.2f} m: {_words(unit.confidence)}"
            lines.append(f"metres_per_unit = {unit.metres_per_unit:.10g}   # {source.path.name}: {why}")
        else:
            value = unit.metres_per_unit * USUAL_HEIGHT_M / (unit.height_m or 1.0)
            why = f"{unit.reason}; this would make it {USUAL_HEIGHT_M} m: A GUESS - SET IT, it is needed"
            lines.append(f"# metres_per_unit = {value:.10g}   # {source.path.name}: {why}")
    return lines


def _found(take_id: str, people: Sequence[_Motion]) -> str:
    """Say what a take is: its files, its length, how tall its people are."""
    first = people[0]
    rate_hz = _known(first).rate_hz or first.guess.rate_hz or usual_rate_hz(first.path.name)
    lasts = "" if rate_hz is None else f" ({first.num_frames / rate_hz:.1f} s at {rate_hz:g} Hz)"
    tall = " and ".join(f"{_height_m(one):.2f}" for one in people)
    names = " and ".join(one.path.name for one in people)
    return f"take {take_id}: {names}, {first.num_frames} frames{lasts}, about {tall} m tall"


def _doubts(people: Sequence[_Motion], motions: Sequence[_Motion]) -> list[str]:
    """Return what is doubted of a take, in words; a second person who is a copy of the first is refused."""
    doubts = []
    for one in people:
        other = next(motion for motion in motions if motion.sha256 == one.sha256)
        if other is not one and other in people:
            raise InputError(
                f"{other.path} and {one.path} are the same, byte for byte; a person has a file of their own"
            )
        if other is not one:
            doubts.append(f"{one.path.name} is the same as {other.path.name}, byte for byte")
    lengths = [one.num_frames for one in people]
    numbers = {one.path.stem.rpartition("_")[2] for one in people if one.path.stem.rpartition("_")[0]}
    if len(set(lengths)) > 1:
        doubts.append(f"its files have {' and '.join(map(str, lengths))} frames: are they of one take?")
    if len(numbers) > 1 and all(number.isdigit() for number in numbers):
        doubts.append(f"by their names its files are of takes {' and '.join(sorted(numbers))}")
    if len(people) == 1 and len(motions) > 1:
        doubts.append("it has one person: no other file of this take and this length was given")
    first = people[0]
    if _known(first).rate_hz is None and first.guess.rate_hz is None:
        usual = usual_rate_hz(first.path.name)
        why = f"{usual:g} Hz is a guess from its name; check" if usual else "set"
        doubts.append(f"no file states its frame rate; {why} rate_hz")
    up = common_up_axis([one.guess.up for one in people])
    if up.confidence < LIKELY:
        doubts.append(f"its up axis {up.axis} is a guess; check up_axis")
    for one in people:
        unit = one.guess.unit
        if _known(one).metres_per_unit is not None or unit.confidence >= LIKELY:
            continue
        todo = "check" if unit.confidence >= MIN_UNIT_CONFIDENCE else "set"
        doubts.append(f"{one.path.name}: {unit.reason}; {todo} metres_per_unit")
    return doubts


def _named(take_ids: Sequence[str]) -> str:
    """Name takes, of many the first."""
    more = f" and {len(take_ids) - _SAID} more" if len(take_ids) > _SAID else ""
    return f"take{'s' if len(take_ids) > 1 else ''} {', '.join(take_ids[:_SAID])}{more}"


def _known(source: _Motion) -> KnownSource:
    layout, stated_hz = source.guess.layout or "", source.guess.rate_hz
    return known_source(source.path.name, layout, stated_hz=stated_hz, is_fetched=source.is_fetched)


def _height_m(source: _Motion) -> float:
    known, unit = _known(source).metres_per_unit, source.guess.unit
    return unit.height_m if known is None else unit.height_m / unit.metres_per_unit * known


def _against(stated_hz: float | None, known_hz: float) -> str:
    """Say that a file states another rate than is known of it."""
    return f"; the header says {stated_hz:g}" if stated_hz is not None and abs(stated_hz - known_hz) > 0.01 else ""


def _annotations(source: _Annotations, base: Path | None) -> list[str]:
    return [
        "[[ingest.annotations]]",
        f"id = {_quoted(_identifier(source.path.stem))}",
        f"path = {_quoted(_shown(source.path, base))}",
        f"# {source.note}",
        f"format = {_quoted(source.format)}",
        "# rate_hz = 30",
        "# image_size_px = [1920, 1080]",
        '# on_unreadable = "skip"   # go on without damaged OpenPose files, and count them',
    ]


def _assumptions() -> list[str]:
    """Return what is assumed of the camera, as keys: the defaults, from where they stand."""
    views = ViewsParameters()
    return [
        "[views]                     # 2D shows neither how far away the camera is nor how it is tilted: assumed",
        f"distance_m = {views.distance_m}            # from the camera to the people, metres",
        f"camera_pitch_deg = {views.camera_pitch_deg}     # how far the camera looks down",
        f"camera_pitch_deviation_deg = {views.camera_pitch_deviation_deg}   # how sure that is: standard deviation",
        f"lean_deviation_deg = {views.lean_deviation_deg}   # backs are upright, this far from it: standard deviation",
    ]


def _from_2d_alone(*, are_videos: bool) -> list[str]:
    """Return the sections that make 3D of annotated pairs where no take is there; motion where they are videos."""
    motion = [
        "",
        "[projections]               # the draws are the database that motion is reconstructed from; takes of such",
        "include_draws = true        # motion are a better one: [[ingest.takes]], `pasdedeux fetch cmu`",
        "",
        "[reconstruction]            # motion of everybody, also where only one person is seen",
        'sequences = "given"',
    ]
    return [
        "[seeds]                     # no take is there to start from: pairs of two people are lifted from 2D alone",
        f"num_lifted = {LIFTED_OF_2D_ALONE}             # annotated pairs that stand for all",
        f"num_grown = {GROWN_OF_2D_ALONE}            # at most: annotated pairs that those lift in turn",
        "",
        "[chains]                    # 3D pairs that agree with the annotations",
        'densities = ["ic"]',
        "num_chains = 1              # of each seed",
        "num_draws = 250             # of each chain; more of both show whether chains agree",
        "",
        "[lifting]",
        "max_frames = 40             # annotated pairs of each source that are lifted with the draws",
        *(motion if are_videos else ()),
    ]


def _one_person_alone() -> list[str]:
    """Return the section that asks for motion of single people, which needs takes."""
    return [
        "# Nobody is seen with a partner, so nothing can be lifted from 2D alone: takes of such motion are needed.",
        "# [[ingest.takes]]          # or `pasdedeux fetch cmu`, see `pasdedeux study show everyday`",
        '# id = "walk"',
        '# files = ["walk.bvh"]',
        "",
        "[reconstruction]",
        'sequences = "given"',
    ]


def _words(confidence: float) -> str:
    if confidence >= SURE:
        return "sure"
    return "likely" if confidence >= LIKELY else "A GUESS - CHECK IT"


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
