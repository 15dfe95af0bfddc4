"""The plan of takes: a shard for each, after all source files were checked."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path

from pydantic import ValidationError

from pasdedeux.choreography.duet import MIN_DURATION_S
from pasdedeux.choreography.duets import duet_style
from pasdedeux.errors import InputError, named
from pasdedeux.formats.rates import one_rate
from pasdedeux.interaction.known_contacts import check_contacts, read_contacts
from pasdedeux.interaction.objects import read_objects
from pasdedeux.plain_text import counted
from tasks.ingest.common import INGEST, frames_in
from tasks.ingest.files import LoadedFile, load_file
from tasks.ingest.parameters import IngestParameters, SkippedParameters
from tasks.ingest.takes.known_sources import DUET_CREDIT, known_performance
from tasks.ingest.takes.parameters import (
    DuetOptions,
    DuetParameters,
    PairOptions,
    PersonOptions,
    PersonParameters,
    TakeOptions,
    TakeParameters,
)
from tasks.ingest.takes.resolution import PersonSource, credit_of, find_person
from tasks.stage import Shard, StageInputs

_ALMOST = 1e-6
"""Largest fraction of a frame that counts as rounding."""


def plan_takes(inputs: StageInputs, parameters: IngestParameters) -> tuple[list[Shard], list[Shard]]:
    """Return the shards of all takes, and those that report skipped files of families.

    Raises:
        InputError: A file is missing or damaged, the files of a take do not fit, or the study lacks a needed statement.
    """
    takes = [
        *(_duet_shard(inputs, parameters, duet) for duet in parameters.resolved_duets()),
        *(_take_shard(inputs, parameters, take) for take in parameters.takes),
    ]
    _refuse_missing(parameters)
    skips: list[Shard] = []
    awaited = parameters.awaited()
    for name, family in parameters.pairs.items():
        shards, skipped = _family_shards(inputs, parameters, name, family)
        takes += shards
        if family.is_watched:
            skipped |= dict.fromkeys(awaited, "the study names it, and it has not come yet")
            awaited = ()
        if skipped:
            skips.append(INGEST.shard(inputs, name, "skipped", SkippedParameters(skipped=skipped)))
    _refuse_twins([take.parameters for take in takes if isinstance(take.parameters, TakeParameters)])
    return takes, skips


def _refuse_twins(takes: Sequence[TakeParameters]) -> None:
    """Refuse parts of a performance that one take holds out and another may be learned from.

    Files of the same performance have the same bytes, or are AMC and BVH of one CMU motion.

    Raises:
        InputError: The message has the names of both takes.
    """
    uses: dict[str, list[tuple[TakeParameters, PersonParameters]]] = {}
    for take in takes:
        for person in take.persons:
            suffix = Path(person.source_name).suffix.lower()
            performance = known_performance(person.source_name)
            # AMC and BVH of one name are the same motion; two files of one name and format need not be.
            keys = [person.motion_sha256, *([f"{performance} {suffix}"] if performance else [])]
            twins = [
                person.motion_sha256,
                *(f"{performance} {ending}" for ending in (".amc", ".bvh") if ending != suffix),
            ]
            for other, twin in (use for key in twins for use in uses.get(key, ())):
                (start, stop), (its_start, its_stop) = _seconds(person), _seconds(twin)
                if other.is_held_out != take.is_held_out and max(start, its_start) < min(stop, its_stop):
                    name, its_name = person.source_name, twin.source_name
                    shown = name if suffix == Path(its_name).suffix.lower() else f"{its_name}, also {name}"
                    raise InputError(
                        f"takes {other.take_id} and {take.take_id} share frames of {shown}, but only one of them "
                        "is held out: the other would be learned from"
                    )
            for key in keys:
                uses.setdefault(key, []).append((take, person))


def _seconds(person: PersonParameters) -> tuple[float, float]:
    """Return start and stop of a person's motion in its file, seconds."""
    start = person.first_frame / person.rate_hz
    return start, start + person.num_frames / person.rate_hz


def _family_shards(
    inputs: StageInputs, parameters: IngestParameters, name: str, family: PairOptions
) -> tuple[list[Shard], dict[str, str]]:
    """Return a shard for each take of a family, and the reasons for skipped takes, if takes are not named.

    Raises:
        InputError: A named take cannot be used, or there is no take.
    """
    shards, skipped = [], {}
    takes = family.take_names()
    if not takes and family.takes is None:
        raise InputError(f"ingest.pairs.{name}: no file {' or '.join(family.patterns)} is in {family.folder}")
    common = family.model_dump(exclude={"folder", "pattern", "subjects", "takes", "id", "is_watched"})
    for take in takes:
        take_id = family.take_id(take)
        try:
            files = tuple(_family_file(family, subject, take) for subject in family.subjects)
            shards.append(_take_shard(inputs, parameters, TakeOptions(id=take_id, files=files, **common)))
        except (InputError, ValidationError) as error:
            if family.takes is not None:
                raise
            skipped[take_id] = (
                str(error) if isinstance(error, InputError) else f"'{take_id}' cannot be the name of a take"
            )
    return shards, skipped


def _refuse_missing(parameters: IngestParameters) -> None:
    """Refuse named takes without files; the InputError has their number and how to get them."""
    wanted = [
        (family, subject, take)
        for family in parameters.pairs.values()
        for take in family.takes or ()
        for subject in family.subjects
    ]
    missing = [family for family in wanted if not any(path.is_file() for path in _family_paths(*family))]
    if missing:
        first = _family_paths(*missing[0])
        others = f", nor do {len(missing) - 1} others of the {len(wanted)} that ingest.pairs names"
        raise InputError(
            f"file {' or '.join(path.name for path in first)} does not exist in {first[0].parent}"
            + (others if len(missing) > 1 else "")
            + (f"; {parameters.obtain}" if parameters.obtain else "")
        )


def _family_paths(family: PairOptions, subject: str, take: str) -> list[Path]:
    return [family.folder / pattern.format(subject=subject, take=take) for pattern in family.patterns]


def _family_file(family: PairOptions, subject: str, take: str) -> Path:
    paths = _family_paths(family, subject, take)
    existing = [path for path in paths if path.is_file()]
    if not existing:
        names = " or ".join(path.name for path in paths)
        raise InputError(f"file {names} does not exist in {family.folder}")
    return existing[0]


def _duet_shard(inputs: StageInputs, parameters: IngestParameters, duet: DuetOptions) -> Shard:
    duet_style(duet.name, **duet.settings)
    take_id = duet.take_id
    if parameters.take_seconds is not None:
        duet = duet.model_copy(
            update={"duration_s": min(duet.duration_s, max(parameters.take_seconds, MIN_DURATION_S))}
        )
    parameters_of_shard = DuetParameters(
        take_id=take_id,
        rate_hz=parameters.rate_hz,
        is_held_out=take_id in parameters.held_out,
        is_prior=take_id in parameters.prior,
        source=DUET_CREDIT,
        capture=parameters.capture,
        duet=duet.model_copy(update={"id": None}),
    )
    return INGEST.shard(inputs, take_id, "take", parameters_of_shard)


def _take_shard(inputs: StageInputs, parameters: IngestParameters, take: TakeOptions) -> Shard:
    with named(f"take {take.id}"):
        if len(take.persons) > len(take.files):
            raise InputError(
                f"options for {counted(len(take.persons), 'person')}, but it has {counted(len(take.files), 'file')}"
            )
        people = [
            find_person(path, person.over(take), parameters.mappings, number=take.files[:at].count(path))
            for at, (path, person) in enumerate(zip(take.files, _options(take), strict=True))
        ]
        persons = _cut(take, people, parameters.take_seconds)
        objects, contacts = (load_file(path) if path else None for path in (take.objects, take.contacts))
        _check_things(people, objects, contacts)
    layouts = {person.parameters.layout for person in people}
    parameters_of_shard = TakeParameters(
        take_id=take.id,
        rate_hz=parameters.rate_hz,
        is_held_out=take.id in parameters.held_out,
        is_prior=take.id in parameters.prior,
        source=credit_of(people, take.licence, take.credit),
        capture=parameters.capture,
        floor=take.floor,
        persons=persons,
        mappings={name: tables for name, tables in parameters.mappings.items() if name in layouts},
        objects_sha256=objects.file.sha256 if objects else "",
        contacts_sha256=contacts.file.sha256 if contacts else "",
    )
    files = [file for person in people for file in person.files]
    files += [loaded.file for loaded in (objects, contacts) if loaded is not None]
    notes = [f"{person.parameters.source_name}: {note}" for person in people for note in person.notes]
    return INGEST.shard(inputs, take.id, "take", parameters_of_shard, files=files, notes=dict.fromkeys(notes))


def _check_things(people: Sequence[PersonSource], objects: LoadedFile | None, contacts: LoadedFile | None) -> None:
    """Refuse objects of other frames than person A's file, and contacts of unknown people or objects."""
    name, num_frames, things = people[0].parameters.source_name, people[0].num_frames, None
    if objects is not None:
        file_name = Path(objects.file.path).name
        with named(file_name):
            things = read_objects(objects.data)
        if things.num_frames != num_frames:
            raise InputError(
                f"{file_name} has {counted(things.num_frames, 'frame')}, but {name} has {num_frames}; objects need all "
                "frames of person A's file"
            )
    if contacts is not None:
        file_name = Path(contacts.file.path).name
        with named(file_name):
            stated = read_contacts(contacts.data)
        check_contacts(stated, name=file_name, num_frames=num_frames, num_people=len(people), objects=things)


def _cut(take: TakeOptions, people: Sequence[PersonSource], take_seconds: float | None) -> tuple[PersonParameters, ...]:
    """Return all people with the part of their file in the take, all of one duration; refuse files that do not fit.

    `frames` are those of person A's file; in files of another rate they are those at the same times.
    """
    rates = one_rate([person.parameters.rate_hz for person in people])
    stated = [person.over(take).offset_s or 0.0 for person in _options(take)]
    offsets = [offset - min(stated) for offset in stated]
    begins, lengths = [], []
    for person, rate_hz, offset_s in zip(people, rates, offsets, strict=True):
        name, begin = person.parameters.source_name, person.parameters.first_frame + offset_s * rate_hz
        first, last = (frame * rate_hz / rates[0] for frame in take.frames or (0.0, 0.0))
        begin += first
        wanted = last - first if take.frames else person.num_frames - begin
        if begin >= person.num_frames or (take.frames and begin + wanted > person.num_frames + _ALMOST):
            stop = f" to {begin + wanted:.0f}" if take.frames else ""
            raise InputError(
                f"frames from {begin:.0f}{stop} are wanted, but {name} has {counted(person.num_frames, 'frame')}"
            )
        begins.append(begin)
        lengths.append(wanted)
    durations = [length / rate_hz for length, rate_hz in zip(lengths, rates, strict=True)]
    whole = [duration + offset for duration, offset in zip(durations, offsets, strict=True)]
    slack = 0.0 if len(set(rates)) == 1 else 1.0 / min(rates)
    if max(whole) - min(whole) > slack + _ALMOST / max(rates) and take.on_unequal == "refuse":
        is_in_frames = len(set(rates)) == 1 and not any(offsets)
        shown = [f"{length:.0f}" for length in lengths] if is_in_frames else [f"{seconds:.2f}" for seconds in whole]
        names = " and ".join(f"{p.parameters.source_name} {n}" for p, n in zip(people, shown, strict=True))
        raise InputError(
            f"its files have unequal lengths ({names} {'frames' if is_in_frames else 'seconds'}); set "
            'on_unequal = "trim" to keep what both have'
        )
    duration = min(durations)
    if take_seconds is not None:
        duration = min(duration, frames_in(take_seconds, rates[0]) / rates[0])
    parts = []
    for person, begin, rate_hz in zip(people, begins, rates, strict=True):
        first = int(begin + _ALMOST)
        start = max(begin - first, 0.0) if begin - first > _ALMOST else 0.0
        count = min(person.num_frames - first, ceil(start + duration * rate_hz - _ALMOST) + (start > 0))
        part = {"first_frame": first, "num_frames": count, "start_s": start / rate_hz}
        parts.append(person.parameters.model_copy(update=part))
    return tuple(parts)


def _options(take: TakeOptions) -> list[PersonOptions]:
    """Return the options of each person's file."""
    return [*take.persons, *(PersonOptions() for _ in take.files[len(take.persons) :])]
