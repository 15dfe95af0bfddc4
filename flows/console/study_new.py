"""Writes a study to start from, for motion files, 2D poses or a film, with findings from their content as comments."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from flows.console.display import format_table
from flows.templates import fill_template
from pasdedeux.errors import InputError, named
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.rates import one_rate
from pasdedeux.formats.registry import recognise_format
from pasdedeux.formats.rigs.guess import USUAL_HEIGHT_M, AxisGuess, draft_motion, guess_mirrored
from pasdedeux.formats.rigs.resolution import (
    MIN_UNIT_CONFIDENCE,
    KnownSource,
    Resolution,
    mend_of_mirror,
    resolve_up_axes,
)
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.people.video import why_no_video
from pasdedeux.plain_text import counted, visible
from pasdedeux.skeletons.layouts import Draft, find_layout
from tasks.files.user_files import exported_unit_m
from tasks.ingest.files import load_file, read_again
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import find_videos
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.readers import refuse_film
from tasks.ingest.poses2d.resolution import find_annotations
from tasks.ingest.takes.known_sources import known_source, usual_rate_hz, was_fetched
from tasks.ingest.takes.parameters import PersonOptions
from tasks.ingest.takes.resolution import find_companion, resolve_file
from tasks.seeds.parameters import GROWN_OF_2D_ALONE, LIFTED_OF_2D_ALONE
from tasks.stage import SourceFile
from tasks.views import ViewsParameters

_SURE, _LIKELY = 0.9, 0.6
ONE_TAKE = 0.98
"""Two files count as one take if the shorter has at least this share of the length of the longer."""
_DOUBTS = "A GUESS", "ARE THEY"
"""Marks of lines in the study that need a decision."""
_quoted = partial(json.dumps, ensure_ascii=False)


@dataclass(frozen=True)
class _DraftedPerson:
    """A person of a motion file: motion, resolved properties, and a drafted mapping if no layout fits.

    `layout` is the name of the layout or mapping; empty if a mapping lacks required joints.
    """

    path: Path
    sha256: str
    motion: SourceMotion
    taken: Resolution
    known: KnownSource
    layout: str
    draft: Draft | None

    @property
    def num_frames(self) -> int:
        """Length of the file."""
        return self.motion.num_frames

    @property
    def duration_s(self) -> float | None:
        """Length of the file in seconds, where its rate is known."""
        return None if self.taken.rate_hz is None else self.num_frames / self.taken.rate_hz


@dataclass(frozen=True)
class _Video:
    """2D poses or a film as the study names them, the number of people at once, and whether they move.

    `given` is the key that states the origin of a film's 2D poses; empty for 2D poses.
    """

    id: str
    path: str
    format: str
    note: str
    num_persons: int
    is_moving: bool
    given: str = ""


def write_new_study(path: Path, files: Sequence[Path] = (), films: Sequence[FilmOptions] = ()) -> list[str]:
    """Write a commented study for files to a new file; return findings and doubts as lines.

    Motion files are the people of one take, person A first.  Without files, the study is of the built-in duets.

    Raises:
        InputError: The study exists already or cannot be written; a file does not exist, is given twice, or has an
            unknown format.
    """
    if path.exists():
        raise InputError(f"{path} already exists; choose another name or remove it")
    sources = [source for file in files for source in _inspect(file, path.parent)]
    sources += [_read_film(film, path.parent) for film in films]
    people = _with_one_draft([source for source in sources if isinstance(source, _DraftedPerson)])
    videos = [source for source in sources if isinstance(source, _Video)]
    # Names of files and joints in them must not become lines of the study.
    lines = [visible(line, is_line=True) for line in _take_lines(people)] if people else []
    shown = [_quoted(_shown(person.path, path.parent)) for person in people]
    take = {"id": _identifier(people[0].path.stem), "files": shown, "lines": lines} if people else None
    mappings = [draft.toml(mapping) for _, mapping, draft in _drafts(people)]
    text = fill_template(
        "new_study.toml",
        name=_identifier(path.stem),
        take=take,
        mappings=mappings,
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
    said = [
        *(f"found {_said(person)}" for person in people),
        *dict.fromkeys(f"note: {person.path.name}: {note}" for person in people for note in person.motion.notes),
        *_drafted(people),
        *(f"found {'film' if video.given else '2D poses'} {video.path}: {video.note}" for video in videos),
        *(f"in doubt: {key.strip()}: {why.strip()}" for key, _, why in doubted),
    ]
    return [visible(line, is_line=True) for line in said]


def _inspect(path: Path, base: Path) -> Sequence[_DraftedPerson | _Video]:
    """Read all people of a motion file, or a file or folder of 2D poses."""
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
        motions = kind.read_people(loaded.data, read_again(companion) if companion else b"")
        return [_person(path, loaded.file, motion) for motion in motions]


def _person(path: Path, file: SourceFile, motion: SourceMotion) -> _DraftedPerson:
    """Resolve a person's motion as a study will, with a drafted mapping if no known layout fits."""
    options = PersonOptions(metres_per_unit=exported_unit_m(path))
    taken, draft, layout = resolve_file(file, motion, options), None, ""
    if taken.layout is not None:
        layout = taken.layout.name
    elif find_layout(motion.skeleton, motion.rest_offsets) is None:
        draft, name = draft_motion(motion), _identifier(path.stem)
        if not draft.missing:
            parts = {part.part: part.joint for part in draft.parts}
            taken = resolve_file(file, motion, options.model_copy(update={"layout": name}), {name: {"parts": parts}})
            layout = name if taken.layout is not None else ""
    known = known_source(path.name, layout, stated_hz=motion.rate_hz, is_fetched=was_fetched(path, file.sha256))
    return _DraftedPerson(path, file.sha256, motion, taken, known, layout, draft)


def _read_video(path: Path, base: Path) -> _Video:
    """Read 2D poses as a study will, as video or as single images such as key frames."""
    sources = find_annotations(AnnotationOptions(id=_identifier(path.stem), path=path))
    formats = {source.parameters.format for source in sources}
    people: Counter[tuple[str, int]] = Counter()
    for source in sources:
        frames = source.read()
        people.update(zip(frames.sequence_id, frames.frame.tolist(), strict=True))
    numbers = defaultdict(list)
    for sequence_id, frame in people:
        numbers[sequence_id].append(frame)
    return _Video(
        id=_identifier(path.stem),
        path=_quoted(_shown(path, base)),
        format=formats.pop() if len(formats) == 1 else "auto",
        note=visible("; ".join(source.in_words() for source in sources), is_line=True),
        num_persons=max(people.values(), default=0),
        is_moving=any(not why_no_video(np.array(frames)) for frames in numbers.values()),
    )


def _read_film(film: FilmOptions, base: Path) -> _Video:
    """Find a film as a study will; its people are counted in key frames or detections, without running a detector."""
    shots = [shot.parameters for shot in find_videos(film)]
    frames = counted(sum(shot.num_frames for shot in shots), "frame")
    cuts = f" in {len(shots)} shots" if len(shots) > 1 else ""
    width, height = shots[0].video_size_px or (0, 0)
    key = next(name for name in ("keys", "detections", "detect") if getattr(film, name))
    poses = film.keys or film.detections
    value = (
        _quoted(_shown(poses, base))
        if poses
        else _quoted([_shown(Path(name), base) if Path(name).exists() else name for name in film.detect])
    )
    return _Video(
        id=_identifier(film.path.stem),
        path=_quoted(_shown(film.path, base)),
        format="",
        note=f"{frames}{cuts} at {shots[0].video_rate_hz:g} Hz, {width} x {height}",
        num_persons=_read_video(poses, base).num_persons if poses else 2,
        is_moving=True,
        given=f"{key} = {value}",
    )


def _take_lines(people: Sequence[_DraftedPerson]) -> list[str]:
    """Return the lines of a take below its files."""
    by_digest = {person.sha256: person.path for person in reversed(people)}
    for person in people:
        if (other := by_digest[person.sha256]) is not person.path:
            raise InputError(f"{other} and {person.path} are identical; give one file per person")
    axes = resolve_up_axes(
        [person.motion for person in people],
        [person.taken.layout for person in people],
        ["auto"] * len(people),
        [sum(person.sha256 == other.sha256 for other in people) == 1 for person in people],
    )
    mirrors = [guess_mirrored(person.motion, person.taken.layout) for person in people]
    exchanged = [mirror.is_mirrored and mirror.confidence >= _LIKELY for mirror in mirrors]
    drafts = [
        [_layout(person), _axis(axis), _rate(person), *[_mirror(person, exchanged)] * is_exchanged, _unit(person)]
        for person, axis, is_exchanged in zip(people, axes, exchanged, strict=True)
    ]
    # Lines that are the same for all people are written once, with the take.
    shared = [line for line in drafts[0][:-1] if all(_key(line) in map(_key, lines) for lines in drafts[1:])]
    keys = set(map(_key, shared))
    different = [[line for line in lines if _key(line) not in keys] for lines in drafts]
    return [*_length(people), *shared, *(line for lines in different for line in ("[[ingest.takes.persons]]", *lines))]


def _key(line: str) -> str:
    """Return a line without its comment."""
    return line.removeprefix("# ").partition("#")[0].strip()


def _with_one_draft(people: Sequence[_DraftedPerson]) -> list[_DraftedPerson]:
    """Return people, where those whose drafts have the same joints share the draft of the first."""
    first: dict[tuple[str, ...], _DraftedPerson] = {}
    shared: list[_DraftedPerson] = []
    for person in people:
        if person.draft is not None:
            owner = first.setdefault(tuple(part.joint for part in person.draft.parts), person)
            name = _identifier(owner.path.stem)
            # A file of the same name may have another rig.
            name += f"_{len(first)}" * any(other.layout == name and other.draft is not owner.draft for other in shared)
            person = replace(person, draft=owner.draft, layout=name if person.layout else "")
        shared.append(person)
    return shared


def _drafts(people: Sequence[_DraftedPerson]) -> list[tuple[Path, str, Draft]]:
    """Return each draft once, with its first file and its name."""
    named_drafts = {
        id(person.draft): (person.path, person.layout, person.draft) for person in reversed(people) if person.draft
    }
    return [(path, name or _identifier(path.stem), draft) for path, name, draft in reversed(named_drafts.values())]


def _drafted(people: Sequence[_DraftedPerson]) -> list[str]:
    """Return the drafts as a table for the terminal, and the missing joints."""
    lines = []
    for path, _, draft in _drafts(people):
        rows = [
            (part.part, part.joint or "none", "sure" if part.is_sure else "A GUESS", part.reason)
            for part in draft.parts
        ]
        lines.append(f"{path.name}: no known layout fits its joints; drafted mapping:")
        lines += format_table(("part", "joint", "is it sure", "by"), rows, text_columns=range(4))
        if draft.missing:
            lines.append(f"{path.name}: no joint was found for {', '.join(draft.missing)}; set them in the study")
    lines += [
        f"{person.path.name}: {person.taken.why_no_layout}"
        for person in people
        if not person.layout and not (person.draft and person.draft.missing)
    ]
    return lines


def _layout(person: _DraftedPerson) -> str:
    if not person.layout:
        return f"# layout: {person.taken.why_no_layout.partition(';')[0]}: SET IT, it is needed"
    if person.draft is not None:
        return f'layout = "{person.layout}"    # drafted below: look at its guesses'
    assert person.taken.layout is not None
    derived = person.taken.layout.derived
    rest = f"; not in the file, derived: {', '.join(derived)}" if derived else ""
    return f'layout = "{person.layout}"    # by the names of the joints: sure{rest}'


def _axis(axis: AxisGuess) -> str:
    return f'up_axis = "{axis.axis}"         # bodies stand along it: {_words(axis.confidence)}'


def _mirror(person: _DraftedPerson, exchanged: Sequence[bool]) -> str:
    """Return the line that exchanges left and right, for a file that has them reversed."""
    mend = "true" if all(exchanged) else '"names"'
    return (
        f"mirrored = {mend}       # {person.path.name}: toes and knees point backwards, left and right are exchanged, "
        f"{mend_of_mirror(exchanged)}: A GUESS - CHECK IT"
    )


def _said(person: _DraftedPerson) -> str:
    """Describe a motion file."""
    rate_hz = person.taken.rate_hz or usual_rate_hz(person.path.name)
    lasts = "" if rate_hz is None else f" ({person.num_frames / rate_hz:.1f} s at {rate_hz:g} Hz)"
    frames, height_m = counted(person.num_frames, "frame"), person.taken.unit.height_m
    return f"{person.path.name}: {frames}{lasts}, about {height_m:.2f} m tall"


def _length(people: Sequence[_DraftedPerson]) -> list[str]:
    """Return a line if files differ in length, in seconds if their rates differ: they may not be one take."""
    lengths: list[float] = [person.num_frames for person in people]
    shown, what, slack = [str(length) for length in lengths], "frames", 0.0
    rates = one_rate([person.taken.rate_hz for person in people if person.taken.rate_hz])
    if len(set(rates)) > 1 and len(rates) == len(people):
        lengths, slack = [person.duration_s or 0.0 for person in people], 1.0 / min(rates)
        shown, what = [f"{length:.2f}" for length in lengths], "seconds"
    if max(lengths) - min(lengths) <= slack:
        return []
    is_near = min(lengths) >= ONE_TAKE * max(lengths)
    asked = f"files have {' and '.join(shown)} {what}: ARE THEY OF ONE TAKE?"
    near = f'on_unequal = "trim"      # the {asked}'
    return [near if is_near else f"# {near} Then switch this on"]


def _rate(person: _DraftedPerson) -> str:
    stated_hz, known_hz = person.motion.rate_hz, person.known.rate_hz
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


def _unit(person: _DraftedPerson) -> str:
    """Return the length unit of a person."""
    unit, name, known_m = person.taken.unit, person.path.name, person.known.metres_per_unit
    if exported_unit_m(person.path) is not None:
        return f"metres_per_unit = {unit.metres_per_unit:.10g}   # stated by the npz beside it: sure"
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
    """Return a path for the study: relative inside its folder, else absolute."""
    resolved, folder = path.resolve(), base.resolve()
    return resolved.relative_to(folder).as_posix() if resolved.is_relative_to(folder) else resolved.as_posix()


def _identifier(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", text).lstrip("_-") or "study"
