"""The plan of the ingest stage: a shard per take, shards of virtual video over it, a shard per source of 2D poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pasdedeux.choreography import DUETS
from pasdedeux.errors import InputError
from tasks.ingest.annotation_sources import file_frames, find_annotations
from tasks.ingest.known_sources import DUET_CREDIT, known_performance
from tasks.ingest.parameters import DuetOptions, IngestParameters, PairOptions, PersonOptions, TakeOptions
from tasks.ingest.sources import PersonSource, credit_of, find_person
from tasks.stage import Shard, StageInputs

__all__ = ["VERSION", "plan"]

VERSION = 1


def plan(inputs: StageInputs, parameters: IngestParameters) -> list[Shard]:
    """Plan all shards of the stage, after checking every source file.

    Raises:
        InputError: A file is missing or mangled, the files of a pair do not fit, or something must be said in the
            study and is not; names the take and the file.
    """
    shards: list[Shard] = []
    takes = [
        *(_duet_shard(inputs.seed, parameters, duet) for duet in parameters.resolved_duets()),
        *(_take_shard(inputs.seed, parameters, take) for take in _all_takes(parameters)),
    ]
    _refuse_twins(takes)
    for take in takes:
        shards.append(take)
        shards.extend(_virtual_video_shards(parameters, take))
    shards.extend(_annotation_shards(inputs.seed, parameters))
    return shards


def _refuse_twins(takes: Sequence[Shard]) -> None:
    """Refuse a moment of a performance that one take holds out and another learns from.

    The same performance is the same bytes, or a CMU motion that is there as AMC and as BVH.

    Raises:
        InputError: With the names of both takes.
    """
    uses: dict[str, list[tuple[Shard, Path, float, float]]] = {}
    for take in takes:
        files = iter(take.files)
        for person in take.parameters.get("persons", ()):
            motion, *_ = (next(files) for _ in range(person["num_files"]))
            path = Path(motion.path)
            start = person["first_frame"] / person["rate_hz"]
            stop = start + take.parameters["num_frames"] / person["rate_hz"]
            performance = known_performance(path.name)
            # Two files of one name and format need not be the same motion, AMC and BVH of one name are.
            keys = [motion.sha256, *([f"{performance} {path.suffix.lower()}"] if performance else [])]
            twins = [
                motion.sha256,
                *(f"{performance} {other}" for other in (".amc", ".bvh") if other != path.suffix.lower()),
            ]
            for other, its_path, its_start, its_stop in (use for key in twins for use in uses.get(key, ())):
                is_split = other.parameters["is_held_out"] != take.parameters["is_held_out"]
                if is_split and max(start, its_start) < min(stop, its_stop):
                    shown = path.name if path.suffix == its_path.suffix else f"{its_path.name}, also {path.name}"
                    raise InputError(
                        f"takes {other.partition} and {take.partition} share frames of {shown}, but only one of them "
                        "is held out: the other would be learned from"
                    )
            for key in keys:
                uses.setdefault(key, []).append((take, path, start, stop))


def _all_takes(parameters: IngestParameters) -> Iterator[TakeOptions]:
    """Return the takes named one by one, then those of each family, spelled out."""
    yield from parameters.takes
    for family in parameters.pairs.values():
        for take in family.takes:
            files = tuple(_family_file(family, subject, take) for subject in family.subjects)
            common = family.model_dump(exclude={"folder", "pattern", "subjects", "takes", "id"})
            yield TakeOptions(id=family.id.format(subject=family.subjects[0], take=take), files=files, **common)


def _family_file(family: PairOptions, subject: str, take: str) -> Path:
    patterns = ["{subject}_{take}.bvh", "{subject}_{take}.amc"] if family.pattern == "auto" else [family.pattern]
    paths = [family.folder / pattern.format(subject=subject, take=take) for pattern in patterns]
    found = [path for path in paths if path.is_file()]
    if not found:
        names = " or ".join(path.name for path in paths)
        raise InputError(f"file {names} does not exist in {family.folder}")
    return found[0]


def _duet_shard(seed: int, parameters: IngestParameters, duet: DuetOptions) -> Shard:
    if duet.name not in DUETS:
        raise InputError(f"duet '{duet.name}' is not known; known duets: {', '.join(DUETS)}")
    take_id = duet.take_id
    return Shard(
        stage="ingest",
        version=VERSION,
        partition=take_id,
        name="take",
        parameters={
            "kind": "duet",
            "take_id": take_id,
            "rate_hz": parameters.rate_hz,
            "duet": duet.model_dump(mode="json", exclude={"id"}),
            "is_held_out": take_id in parameters.held_out,
            "is_prior": parameters.is_prior(take_id),
            "source": _credit(DUET_CREDIT),
        },
        seed=seed,
    )


def _take_shard(seed: int, parameters: IngestParameters, take: TakeOptions) -> Shard:
    options = [*take.persons, *(PersonOptions() for _ in take.files)][: len(take.files)]
    if len(take.persons) > len(take.files):
        raise InputError(
            f"take {take.id}: options for {len(take.persons)} persons, but it has {len(take.files)} file(s)"
        )
    people = []
    for path, person in zip(take.files, options, strict=True):
        try:
            people.append(find_person(path, take, person, parameters.mappings))
        except InputError as error:
            raise type(error)(f"take {take.id}: {error}") from None
    starts = [(take.frames[0] if take.frames else 0) + person.first_frame for person in options]
    num_frames = _common_length(take, people, starts)
    order = [1, 0] if take.swap_persons and len(people) == 2 else list(range(len(people)))
    mappings: dict[str, Any] = {
        name: {skeleton: dict(table) for skeleton, table in tables.items()}
        for name, tables in parameters.mappings.items()
        if name in {person.layout for person in people}
    }
    credit = credit_of(people[0].layout, take.licence, take.credit)
    return Shard(
        stage="ingest",
        version=VERSION,
        partition=take.id,
        name="take",
        parameters={
            "kind": "files",
            "take_id": take.id,
            "rate_hz": parameters.rate_hz,
            "num_frames": num_frames,
            "floor": take.floor,
            "persons": [
                {
                    "source_name": Path(people[i].files[0].path).name,
                    "format": people[i].format,
                    "num_files": len(people[i].files),
                    "layout": people[i].layout,
                    "rate_hz": people[i].rate_hz,
                    "metres_per_unit": people[i].metres_per_unit,
                    "up_axis": people[i].up_axis,
                    "first_frame": starts[i],
                    "translation_m": list(options[i].translation_m),
                    "yaw_deg": options[i].yaw_deg,
                }
                for i in order
            ],
            "mappings": mappings,
            "is_held_out": take.id in parameters.held_out,
            "is_prior": parameters.is_prior(take.id),
            "source": _credit(credit),
        },
        files=tuple(file for i in order for file in people[i].files),
        seed=seed,
    )


def _common_length(take: TakeOptions, people: list[PersonSource], starts: list[int]) -> int:
    """Return the number of source frames that all people of a take have, or refuse a pair that does not fit."""
    rates = {person.rate_hz for person in people}
    if len(rates) > 1:
        found = " and ".join(f"{person.rate_hz:g}" for person in people)
        raise InputError(f"take {take.id}: its files have different frame rates, {found} Hz; set rate_hz")
    lengths = []
    for person, start in zip(people, starts, strict=True):
        name = Path(person.files[0].path).name
        wanted = take.frames[1] - take.frames[0] if take.frames else person.num_frames - start
        if start >= person.num_frames or (take.frames and start + wanted > person.num_frames):
            stop = f" to {start + wanted}" if take.frames else ""
            raise InputError(
                f"take {take.id}: frames from {start}{stop} are wanted, but {name} has {person.num_frames} frames"
            )
        lengths.append(wanted)
    if len(set(lengths)) > 1 and take.on_unequal == "refuse":
        names = " and ".join(f"{Path(p.files[0].path).name} {n}" for p, n in zip(people, lengths, strict=True))
        raise InputError(
            f"take {take.id}: its files have unequal lengths ({names} frames); "
            'set on_unequal = "trim" to keep what both have'
        )
    return min(lengths)


def _virtual_video_shards(parameters: IngestParameters, take: Shard) -> Iterator[Shard]:
    """Return the shards of virtual video over a take: whole takes, and random views unless it is held out."""
    options = parameters.virtual_video
    take_id, is_held_out = take.parameters["take_id"], bool(take.parameters["is_held_out"])
    views = options.model_dump(mode="json", exclude={"takes", "num_videos", "num_random_views"})
    views["pitch_deviation_deg"] = min(options.pitch_deviation_deg, 1e9)
    shared: dict[str, Any] = {"take_id": take_id, "is_held_out": is_held_out, "rate_hz": parameters.rate_hz, **views}
    if options.takes is not None and take_id not in options.takes:
        return
    is_pair = take.parameters["kind"] == "duet" or len(take.parameters["persons"]) == 2
    num_random_views = options.num_random_views if is_pair and not is_held_out else 0
    wanted = [("video", options.num_videos), ("random_views", num_random_views)]
    for purpose, count in wanted:
        if count:
            yield Shard(
                stage="ingest",
                version=VERSION,
                partition=take_id,
                name=purpose,
                parameters={"kind": purpose, "count": count, **shared},
                after=(take.key,),
                seed=take.seed,
            )


def _annotation_shards(seed: int, parameters: IngestParameters) -> Iterator[Shard]:
    for options in parameters.annotations:
        source = find_annotations(options)
        yield Shard(
            stage="ingest",
            version=VERSION,
            partition=options.id,
            name="annotations",
            parameters={
                "kind": "annotations",
                **options.model_dump(mode="json", exclude={"path", "format"}),
                "format": source.format,
                "is_held_out": options.take_id in parameters.held_out,
                # OpenPose tells the frame by the file's name, which no digest of the content knows.
                "frames": file_frames(source),
            },
            files=source.files,
            seed=seed,
        )


def _credit(credit: Any) -> dict[str, str]:
    return {"name": credit.name, "licence": credit.licence, "credit": credit.credit}
