"""Stage `seeds`: real pairs from which chains start, named in the study or chosen among the takes."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.sampling.seeds import choose_seeds, seed_quality
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, merge_takes

__all__ = ["STAGE", "VERSION", "SeedFrame", "SeedsParameters", "plan", "read_limits", "run_shard"]

VERSION = 1


class SeedFrame(Parameters):
    """A frame of a take that becomes a seed."""

    take: str = Field(description="Name of the take")
    frame: int = Field(ge=0, description="Frame at the study's rate")


class SeedsParameters(Parameters):
    """How many seeds there are and where they come from."""

    num_seeds: int = Field(2, ge=1, le=10_000, description="Seeds chosen automatically when no frames are named")
    frames: tuple[SeedFrame, ...] = Field((), description="Frames that become seeds, in this order")
    max_frames_per_take: int = Field(300, ge=1, description="Frames of each take that are looked at, evenly spread")


def plan(inputs: StageInputs, parameters: SeedsParameters) -> list[Shard]:
    """Plan a shard per seed, from pair takes that are not held out."""
    takes = {str(manifest.facts["take_id"]): manifest for manifest in inputs.of("poses") if _is_usable(manifest)}
    limits = tuple(manifest.ref for manifest in inputs.of("joint_limits"))
    if not takes:
        return []
    shards = []
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
        shards.append(_shard(inputs, index, chosen, (takes[frame.take].ref,)))
    if not parameters.frames:
        refs = (*(manifest.ref for manifest in takes.values()), *limits)
        for index in range(parameters.num_seeds):
            chosen = {"seed_index": index, "max_frames_per_take": parameters.max_frames_per_take}
            shards.append(_shard(inputs, index, chosen, refs))
    return shards


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
    """Read or choose one seed and commit it, gauge-fixed."""
    index = int(shard.parameters["seed_index"])
    poses = [ref for ref in shard.inputs if "poses" in store.manifest(ref).tables]
    if "take" in shard.parameters:
        frames = np.array([int(shard.parameters["frame"])])
        pairs, take_id, frame = _read_pairs(store, poses[0], frames)[0], shard.parameters["take"], int(frames[0])
        pair = pairs
    else:
        pair, take_id, frame = _choose(shard, store, poses, index)
    columns = {
        "seed_index": [index],
        "origin": ["frame"],
        "take_id": [take_id],
        "take_frame": [frame],
        "sequence_id": [None],
        "pair17_m": gauge_fix(pair)[None],
    }
    facts = {
        "kind": "seed",
        "seed_index": index,
        "take_id": take_id,
        "take_frame": frame,
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
    }
    return commit(shard, store, tables={"seeds": columns}, facts=facts)


def _choose(shard: Shard, store: Store, poses: list[ArtifactRef], index: int) -> tuple[np.ndarray, str, int]:
    """Give the pair, take and frame of an automatically chosen seed; the choice of earlier seeds is repeated."""
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
    """Give the pairs (frame, 2, 17, 3) of some frames of a take."""
    table = store.read(ref, "poses", columns=["person", "frame", "pair17_m"])
    person, frame = np.asarray(table["person"]), np.asarray(table["frame"])
    positions = np.asarray(table["pair17_m"], dtype=np.float64)
    parts = []
    for one in range(2):
        own = np.flatnonzero(person == one)
        own = own[np.argsort(frame[own], kind="stable")]
        parts.append(positions[own[np.searchsorted(frame[own], frames)]])
    return np.stack(parts, axis=1)


def read_limits(shard: Shard, store: Store) -> JointLimits:
    """Give the joint limits among a shard's inputs; the published ones where no stage wrote any."""
    for ref in shard.inputs:
        if "joint_limits" in store.manifest(ref).tables:
            table = store.read(ref, "joint_limits")
            order = np.argsort(np.asarray(table["angle_id"]), kind="stable")
            return JointLimits(
                lower_rad=np.asarray(table["lower_rad"], dtype=np.float64)[order],
                upper_rad=np.asarray(table["upper_rad"], dtype=np.float64)[order],
                source=tuple(str(table["source"][row]) for row in order),
            )
    return JointLimits.published()


STAGE = Stage(
    name="seeds",
    version=VERSION,
    reads=("poses", "joint_limits"),
    writes=("seeds",),
    parameters=SeedsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="3D pose pairs from which chains start",
)
