"""Planning of the stage `seeds`: a shard for each single seed and each video, and one for all others of each kind."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from pasdedeux.errors import InputError
from pasdedeux.plain_text import counted
from pasdedeux.sampling.prior import PriorSettings
from storage_schema import Manifest
from tasks.rows.annotated_pairs import annotated_pairs, views_of
from tasks.seeds.files import SeedFile, load_seed
from tasks.seeds.over_time import is_video
from tasks.seeds.parameters import (
    GROWN_OF_2D_ALONE,
    LIFTED_OF_2D_ALONE,
    NUM_CHOSEN,
    SEEDS,
    ChosenSeed,
    FilledSeeds,
    FrameSeed,
    GrownSeeds,
    LiftedSeedsShard,
    OverTimeSeeds,
    SeedsParameters,
)
from tasks.stage import Shard, StageInputs
from tasks.stage.facts import SequenceFacts, TakeFacts, shares_takes


def plan(inputs: StageInputs, parameters: SeedsParameters) -> list[Shard]:
    """Plan a shard per seed from takes that are not held out or from files, one each for lifted, grown and filled ones.

    If pairs grow, plan one for each video that may be learned from, provided that there are takes that it does not
    show. Without takes and files, seeds are lifted from 2D alone, unless the study states how many.

    Raises:
        InputError: A named frame or file cannot be a seed, or seeds are asked of takes or of annotations and there are
            none, or more starts than pairs that grow, or pairs are to be filled in between none.
    """
    known_takes = [(TakeFacts.of(manifest), manifest) for manifest in inputs.of("poses")]
    takes = {take.take_id: manifest for take, manifest in known_takes if not take.is_held_out and take.num_persons == 2}
    annotated = annotated_pairs(inputs)
    views = views_of(annotated, inputs)
    _check_sources(parameters, takes, has_annotations=bool(annotated and views))
    shards = _from_takes(inputs, parameters, takes)
    shards += [_from_file(inputs, parameters, len(shards) + at, file) for at, file in enumerate(parameters.files)]
    is_2d_alone = bool(not shards and annotated and views)
    num_lifted, num_grown = parameters.num_lifted, parameters.num_grown
    if num_lifted is None:
        num_lifted = LIFTED_OF_2D_ALONE if is_2d_alone else 0
    if num_grown is None:
        num_grown = GROWN_OF_2D_ALONE if is_2d_alone else 0
    if parameters.num_starts > num_grown:
        raise InputError(
            f"seeds.num_starts is {parameters.num_starts}, but {num_grown} are grown here: say seeds.num_grown"
        )
    if parameters.num_filled and not num_grown:
        raise InputError(f"seeds.num_filled is {parameters.num_filled}, but none are grown here: say seeds.num_grown")
    read = {"joint_limits": inputs.of("joint_limits"), "annotations": annotated, "views": views}
    if num_lifted:
        bases = [
            manifest
            for manifest in inputs.of("torso_basis")
            if not any(shares_takes(pair, manifest) for pair in annotated)
        ]
        lifted = parameters.model_copy(update={"num_lifted": num_lifted}).part(
            LiftedSeedsShard, first_index=len(shards)
        )
        shards.append(SEEDS.shard(inputs, "lifted", "lifted", lifted, {**read, "torso_basis": bases}))
    if num_grown and shards:
        first = len(shards) + max(num_lifted - 1, 0)
        videos = _of_videos(inputs, parameters, takes, first)
        shards += videos
        first += parameters.num_over_time * len(videos)
        after = tuple(shard.key for shard in shards)
        grown = parameters.model_copy(update={"num_grown": num_grown}).part(GrownSeeds, first_index=first)
        shards.append(SEEDS.shard(inputs, "grown", "grown", grown, read, after=after))
        if parameters.num_filled:
            filled = parameters.part(FilledSeeds, first_index=first + num_grown)
            limits, last = {"joint_limits": read["joint_limits"]}, tuple(shard.key for shard in (*videos, shards[-1]))
            shards.append(SEEDS.shard(inputs, "filled", "filled", filled, limits, after=last))
    return shards


def check_study(sections: Mapping[str, Any]) -> None:
    """Refuse files that are no seeds, and seeds of takes or annotations that the study is known to lack.

    Raises:
        InputError: Names the file and its fault, or the key that requests missing data.
    """
    section, ingest = sections["seeds"], sections.get("ingest")
    for file in section.files:
        load_seed(file)
    if ingest is None or any(family.takes is None for family in ingest.pairs.values()):
        return  # files of a folder are known only when it is read
    takes = ingest.take_ids()
    video = ingest.virtual_video
    has_annotations = bool(
        ingest.annotations or ingest.videos or (takes and (video.num_videos or video.num_random_views))
    )
    _check_sources(section, [take for take in takes if take not in ingest.held_out], has_annotations=has_annotations)


def _check_sources(parameters: SeedsParameters, takes: Collection[str], *, has_annotations: bool) -> None:
    """Refuse seeds of missing takes or annotations; `takes` are those that may be learned from.

    Raises:
        InputError: Names the key that requests missing data.
    """
    if parameters.num_seeds and not takes:
        raise InputError(
            f"seeds.num_seeds asks for {counted(parameters.num_seeds, 'frame')} of takes, but there is no take of two "
            "people that is not held out; seeds.num_lifted lifts seeds from 2D alone"
        )
    for frame in parameters.frames:
        if frame.take not in takes:
            raise InputError(
                f"seeds.frames: take '{frame.take}' is no take of two people that may be learned from; "
                f"known ones: {', '.join(sorted(takes)) or 'none'}"
            )
    if (parameters.num_lifted or parameters.num_grown) and not has_annotations:
        raise InputError(
            "seeds.num_lifted and seeds.num_grown lift annotations, but there are no annotated pairs with views, "
            "neither of annotations ([[ingest.annotations]], [[ingest.videos]]) nor of virtual video of takes "
            "(ingest.virtual_video)"
        )


def _from_takes(inputs: StageInputs, parameters: SeedsParameters, takes: Mapping[str, Manifest]) -> list[Shard]:
    """Plan a shard per named frame, or one per frame to choose."""
    limits = inputs.of("joint_limits")
    prior = parameters.part(PriorSettings).model_dump()
    wanted: list[FrameSeed | ChosenSeed] = []
    poses: list[list[Manifest]] = []
    for index, frame in enumerate(parameters.frames):
        last = TakeFacts.of(takes[frame.take]).num_frames - 1
        if frame.frame > last:
            raise InputError(f"seeds.frames: take '{frame.take}' has frames 0 to {last}, found {frame.frame}")
        wanted.append(frame.part(FrameSeed, seed_index=index, **prior))
        poses.append([takes[frame.take]])
    if not parameters.frames and takes:
        count = NUM_CHOSEN if parameters.num_seeds is None else parameters.num_seeds
        wanted += [parameters.part(ChosenSeed, seed_index=index) for index in range(count)]
        poses += [list(takes.values())] * count
    return [
        SEEDS.shard(inputs, f"seed{options.seed_index}", "seed", options, {"poses": take, "joint_limits": limits})
        for options, take in zip(wanted, poses, strict=True)
    ]


def _of_videos(
    inputs: StageInputs, parameters: SeedsParameters, takes: Mapping[str, Manifest], first_index: int
) -> list[Shard]:
    """Plan a shard for each artifact with a video that may be learned from; it reads takes that are not shown there."""
    shards: list[Shard] = []
    for video in inputs.of("annotations") if parameters.num_over_time else ():
        facts = SequenceFacts.of(video)
        others = [take for take in takes.values() if not shares_takes(take, video)]
        if others and is_video(facts) and not facts.is_held_out and facts.num_persons >= 2:
            options = parameters.part(OverTimeSeeds, first_index=first_index + parameters.num_over_time * len(shards))
            read = {"annotations": [video], "poses": others, "joint_limits": inputs.of("joint_limits")}
            shards.append(SEEDS.shard(inputs, "over_time", f"{video.partition}-{video.name}", options, read))
    return shards


def _from_file(inputs: StageInputs, parameters: SeedsParameters, index: int, file: SeedFile) -> Shard:
    loaded = load_seed(file, seed_index=index)
    held_out = {take.take_id for take in map(TakeFacts.of, inputs.of("poses")) if take.is_held_out}
    seen = sorted(held_out.intersection(loaded.pair.takes))
    if seen:
        raise InputError(
            f"seeds.files: {file.path.name} was made from take '{seen[0]}', which this study holds out: "
            "nothing that is learned may have seen it"
        )
    options = loaded.parameters.model_copy(update=parameters.part(PriorSettings).model_dump())
    read = {"joint_limits": inputs.of("joint_limits")}
    return SEEDS.shard(inputs, f"seed{index}", "file", options, read, files=loaded.files)
