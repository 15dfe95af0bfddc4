"""Stage `seeds`: where chains start: frames of takes, pairs lifted from 2D alone, and what grows from both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.sampling.direct_lifting import lift_seeds
from pasdedeux.sampling.growth import GrowthOptions, grow
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.sampling.seeds import choose_seeds, seed_quality
from storage_schema import ArtifactRef, Manifest, Store
from tasks.annotated_pairs import annotated_pairs, gather, views_of
from tasks.priors import read_limits
from tasks.seed_files import SeedFile, credits_of, load_seed, read_seed
from tasks.seed_parameters import GROWTH_PARAMETERS, SeedFrame, SeedsParameters
from tasks.stage import Shard, Stage, StageInputs, commit, merge_takes, stream
from tasks.torso_bases import read_torso_basis, shares_takes

__all__ = [
    "STAGE",
    "VERSION",
    "SeedFrame",
    "SeedsParameters",
    "check",
    "plan",
    "run_shard",
    "start_indices",
]

VERSION = 4


def plan(inputs: StageInputs, parameters: SeedsParameters) -> list[Shard]:
    """Plan a shard per frame of takes that are not held out, one for all lifted seeds and one for all grown ones."""
    takes = {str(manifest.facts["take_id"]): manifest for manifest in inputs.of("poses") if _is_usable(manifest)}
    limits = tuple(manifest.ref for manifest in inputs.of("joint_limits"))
    shards: list[Shard] = []
    for index, frame in enumerate(parameters.frames):
        if frame.take not in takes:
            raise InputError(
                f"seeds.frames: take '{frame.take}' is no take of two people that may be learned from; "
                f"known ones: {', '.join(sorted(takes))}"
            )
        last = int(takes[frame.take].facts["num_frames"]) - 1
        if frame.frame > last:
            raise InputError(f"seeds.frames: take '{frame.take}' has frames 0 to {last}, found {frame.frame}")
        chosen = {"seed_index": index, "take": frame.take, "frame": frame.frame}
        shards.append(_shard(inputs, index, chosen, (takes[frame.take].ref, *limits)))
    if not parameters.frames and takes:
        refs = (*(manifest.ref for manifest in takes.values()), *limits)
        for index in range(parameters.num_seeds):
            chosen = {"seed_index": index, "max_frames_per_take": parameters.max_frames_per_take}
            shards.append(_shard(inputs, index, chosen, refs))
    shards += [_file_shard(inputs, len(shards) + at, file) for at, file in enumerate(parameters.files)]
    annotated = annotated_pairs(inputs)
    views = views_of(annotated, inputs)
    if not annotated or not views:
        return shards
    seen = tuple(manifest.ref for manifest in (*annotated, *views))
    if parameters.num_lifted:
        names = {"num_lifted", "max_annotations", "num_hypotheses"}
        chosen = {**parameters.model_dump(mode="json", include=names), "first_index": len(shards)}
        bases = (basis for basis in inputs.of("torso_basis") if not any(shares_takes(one, basis) for one in annotated))
        refs = (*limits, *seen, *(basis.ref for basis in bases))
        shards.append(_shared_shard(inputs, "lifted", chosen, refs, ()))
    if parameters.num_grown and shards:
        chosen = parameters.model_dump(mode="json", include=set(GROWTH_PARAMETERS))
        chosen["first_index"] = len(shards) + max(parameters.num_lifted - 1, 0)
        before = tuple(shard.key for shard in shards)
        shards.append(_shared_shard(inputs, "grown", chosen, (*limits, *seen), before))
    return shards


def check(parameters: SeedsParameters) -> None:
    """Refuse files that are no seeds, before anything runs.

    Raises:
        InputError: Names the file and what is wrong with it.
    """
    for file in parameters.files:
        load_seed(file)


def _file_shard(inputs: StageInputs, index: int, file: SeedFile) -> Shard:
    loaded = load_seed(file)
    hidden = {take for manifest in inputs.of("poses") if manifest.facts.get("is_held_out") for take in _takes(manifest)}
    seen = sorted(hidden.intersection(loaded.pair.takes))
    if seen:
        raise InputError(
            f"seeds.files: {file.path.name} was made from take '{seen[0]}', which this study holds out: "
            "nothing that is learned may have seen it"
        )
    return Shard(
        stage="seeds",
        version=VERSION,
        partition=f"seed{index}",
        name="file",
        parameters={"seed_index": index, **loaded.options},
        inputs=tuple(manifest.ref for manifest in inputs.of("joint_limits")),
        files=loaded.files,
        seed=inputs.seed,
    )


def _takes(manifest: Manifest) -> list[str]:
    return [str(take) for take in manifest.facts.get("takes", [])]


def _shared_shard(
    inputs: StageInputs, name: str, chosen: dict[str, object], refs: tuple[ArtifactRef, ...], after: tuple[str, ...]
) -> Shard:
    return Shard(
        stage="seeds",
        version=VERSION,
        partition=name,
        name=name,
        parameters=chosen,
        inputs=refs,
        after=after,
        seed=inputs.seed,
    )


def start_indices(manifest: Manifest) -> list[int]:
    """Return the indices of the seeds in an artifact from which chains start, from its facts."""
    facts = manifest.facts
    return [int(index) for index in facts["starts"]] if "starts" in facts else [int(facts["seed_index"])]


def _is_usable(manifest: Manifest) -> bool:
    facts = manifest.facts
    return facts.get("kind") == "take" and not facts.get("is_held_out", False) and int(facts.get("num_persons", 1)) == 2


def _shard(inputs: StageInputs, index: int, chosen: dict[str, object], refs: tuple[ArtifactRef, ...]) -> Shard:
    return Shard(
        stage="seeds",
        version=VERSION,
        partition=f"seed{index}",
        name="seed",
        parameters=chosen,
        inputs=refs,
        seed=inputs.seed,
    )


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Read or choose one seed, lift or grow many, and commit them, gauge-fixed."""
    if shard.name == "lifted":
        return _lift(shard, store)
    if shard.name == "grown":
        return _grow(shard, store)
    if shard.name == "file":
        return _take_in(shard, store)
    index = int(shard.parameters["seed_index"])
    poses = [ref for ref in shard.inputs if "poses" in store.manifest(ref).tables]
    if "take" in shard.parameters:
        frames = np.array([int(shard.parameters["frame"])])
        pairs, take_id, frame = _read_pairs(store, poses[0], frames)[0], shard.parameters["take"], int(frames[0])
        pair = pairs
    else:
        pair, take_id, frame = _choose(shard, store, poses, index)
    log_prior = seed_quality(pair[None], read_limits(shard, store)).log_prior
    columns = _columns("frame", [index], gauge_fix(pair)[None], log_prior, take_id=[take_id], take_frame=[frame])
    facts = {
        "kind": "seed",
        "seed_index": index,
        "take_id": take_id,
        "take_frame": frame,
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
    }
    return commit(shard, store, tables={"seeds": columns}, facts=facts)


def _columns(
    origin: str, indices: Sequence[int] | np.ndarray, pairs_m: np.ndarray, log_prior: np.ndarray, **known: Any
) -> dict[str, Any]:
    """Return the table of seeds of one origin; what is not known of them is empty."""
    count = len(pairs_m)
    unknown = (
        "take_id",
        "take_frame",
        "sequence_id",
        "sequence_frame",
        "parent_seed_index",
        "made_from",
        "image_distance_m",
    )
    return {
        "seed_index": indices,
        "origin": [origin] * count,
        **{name: [None] * count for name in unknown},
        "generation": [0] * count,
        "log_prior": log_prior,
        "pair17_m": pairs_m,
        **known,
    }


def _take_in(shard: Shard, store: Store) -> ArtifactRef:
    """Commit a seed that came in a file, gauge-fixed, with the lineage that the file states."""
    index = int(shard.parameters["seed_index"])
    pair = read_seed(shard)
    origin = "draw" if pair.made_from.startswith("draws@") else "file"
    log_prior = seed_quality(pair.pair_m[None], read_limits(shard, store)).log_prior
    made_from = [pair.made_from or None]
    columns = _columns(origin, [index], gauge_fix(pair.pair_m)[None], log_prior, made_from=made_from)
    facts = {
        "kind": "seed",
        "seed_index": index,
        "made_from": pair.made_from,
        "takes": sorted({*pair.takes, *merge_takes(*(store.manifest(ref) for ref in shard.inputs))}),
    }
    return commit(shard, store, tables={"seeds": columns}, facts=facts, sources=credits_of(pair))


def _lift(shard: Shard, store: Store) -> ArtifactRef:
    """Lift annotations that stand for all of them from 2D alone."""
    options = shard.parameters
    placed = gather(shard, store)
    gathered = placed.gathered
    seeds = lift_seeds(
        gathered.pairs,
        gathered.weights,
        read_limits(shard, store),
        read_torso_basis(store, shard.inputs),
        num_seeds=int(options["num_lifted"]),
        max_annotations=int(options["max_annotations"]),
    )
    count = len(seeds.pairs_m)
    places = [placed.places[index] for index in gathered.pairs.annotation_index[seeds.entry].tolist()]
    indices = int(options["first_index"]) + np.arange(count)
    columns = _columns(
        "lifted",
        indices,
        seeds.pairs_m,
        seeds.log_prior,
        sequence_id=[sequence for sequence, _ in places],
        sequence_frame=[frame for _, frame in places],
    )
    facts = {
        "kind": "lifted_seeds",
        "starts": indices.tolist(),
        "num_annotations_skipped": gathered.num_skipped,
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
    }
    return commit(shard, store, tables={"seeds": columns}, facts=facts)


def _grow(shard: Shard, store: Store) -> ArtifactRef:
    """Grow pairs over the annotations from the seeds of the shards before this one."""
    options = shard.parameters
    before = [_done(key, store) for key in shard.after]
    roots = np.concatenate([np.asarray(store.read(one.ref, "seeds")["pair17_m"], dtype=np.float64) for one in before])
    placed = gather(shard, store)
    pairs = placed.gathered.pairs
    growth = grow(
        roots,
        pairs,
        read_limits(shard, store),
        num_grown=int(options["num_grown"]),
        options=GrowthOptions(
            image_deviation_m=options["image_deviation_m"],
            depth_deviation_m=options["depth_deviation_m"],
            farthest_m=options["farthest_m"],
            num_neighbours=int(options["num_neighbours"]),
            num_sweeps=int(options["num_sweeps"]),
        ),
    )
    first, count = int(options["first_index"]), len(growth.pairs_m)
    # Neighbours agree after the last pair was judged: a few may have left the joint limits and can start no chain.
    # Starts are drawn, not spread out: the farthest ones are those that went wrong (14 against 59 real frames).
    possible = stream(shard.seed, "seeds", "starts").permutation(np.flatnonzero(growth.is_possible))
    places = [placed.places[index] for index in pairs.annotation_index[growth.entry].tolist()]
    columns = _columns(
        "grown",
        first + np.arange(count),
        growth.pairs_m,
        growth.log_prior,
        sequence_id=[sequence for sequence, _ in places],
        sequence_frame=[frame for _, frame in places],
        parent_seed_index=growth.parent,
        generation=growth.generation,
        image_distance_m=growth.image_distance_m,
    )
    facts = {
        "kind": "grown_seeds",
        "num_grown": count,
        "num_refused": growth.num_refused,
        "num_left": growth.num_left,
        "num_annotations_skipped": placed.gathered.num_skipped,
        "starts": (first + possible[: int(options["num_starts"])]).tolist(),
        "takes": merge_takes(*before, *(store.manifest(ref) for ref in shard.inputs)),
    }
    return commit(shard, store, tables={"seeds": columns}, facts=facts)


def _done(key: str, store: Store) -> Manifest:
    manifest = store.find("seeds", key)
    if manifest is None:
        raise InputError(f"the seed seeds@{key[:12]} that others grow from is not in the store")
    return manifest


def _choose(shard: Shard, store: Store, poses: list[ArtifactRef], index: int) -> tuple[np.ndarray, str, int]:
    """Return the pair, take and frame of an automatically chosen seed; the choice of earlier seeds is repeated."""
    pairs, take_of, frame_of, take_ids = [], [], [], []
    for take, ref in enumerate(poses):
        facts = store.manifest(ref).facts
        count = min(int(shard.parameters["max_frames_per_take"]), int(facts["num_frames"]))
        frames = np.unique(np.linspace(0, int(facts["num_frames"]) - 1, count).round().astype(int))
        pairs.append(_read_pairs(store, ref, frames))
        take_of.append(np.full(len(frames), take))
        frame_of.append(frames)
        take_ids.append(str(facts["take_id"]))
    every = np.concatenate(pairs)
    takes = np.concatenate(take_of)
    quality = seed_quality(every, read_limits(shard, store))
    chosen = choose_seeds(every, takes, quality, index + 1)[index]
    return every[chosen], take_ids[int(takes[chosen])], int(np.concatenate(frame_of)[chosen])


def _read_pairs(store: Store, ref: ArtifactRef, frames: np.ndarray) -> np.ndarray:
    """Return the pairs (frame, 2, 17, 3) of some frames of a take."""
    table = store.read(ref, "poses", columns=["person", "frame", "pair17_m"])
    person, frame = np.asarray(table["person"]), np.asarray(table["frame"])
    positions = np.asarray(table["pair17_m"], dtype=np.float64)
    parts = []
    for one in range(2):
        own = np.flatnonzero(person == one)
        own = own[np.argsort(frame[own], kind="stable")]
        parts.append(positions[own[np.searchsorted(frame[own], frames)]])
    return np.stack(parts, axis=1)


STAGE = Stage(
    name="seeds",
    version=VERSION,
    reads=("poses", "annotations", "views", "torso_basis", "joint_limits"),
    writes=("seeds",),
    parameters=SeedsParameters,
    plan=plan,
    run_shard=run_shard,
    check=check,
    meaning="3D pose pairs from which chains start",
)
