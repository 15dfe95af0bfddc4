"""Planning of the stage `chains`: the segments of every chain of every seed and density, and a summary of each."""

from __future__ import annotations

from collections.abc import Sequence

from pasdedeux.errors import InputError
from pasdedeux.sampling.density import Reads, TargetSettings
from pasdedeux.sampling.proposals import PROPOSALS
from storage_schema import ArtifactRef, Manifest
from tasks.annotated_pairs import annotated_pairs, views_of
from tasks.chains.densities import DENSITIES
from tasks.chains.parameters import ChainsParameters, RunSettings, SegmentParameters, SummaryParameters
from tasks.draw_sets import GROWN
from tasks.seeds import start_indices
from tasks.stage import Shard, StageInputs, named_refs

VERSION = 14

Inputs = dict[str, Sequence[Manifest]]


def plan(inputs: StageInputs, parameters: ChainsParameters) -> list[Shard]:
    """Plan, per density and seed, the segments of every chain and then a summary.

    A segment's key knows its chain and number but not how many draws are asked for, so asking for more extends.
    """
    wanted: dict[str, ChainsParameters] = {
        name: parameters.model_copy(update={"densities": (name,)}) for name in parameters.densities
    }
    wanted |= {name: parameters.variant(name) for name in parameters.variants}
    read = {name: _read_by(own.densities[0], inputs) for name, own in wanted.items()}
    if inputs.of("seeds") and all(needed is None for needed in read.values()):
        densities = list(dict.fromkeys(own.densities[0] for own in wanted.values()))
        raise InputError(
            f"chains.densities asks for {', '.join(densities)} alone, but there are no annotated pairs with views to "
            "sample from"
        )
    shards: list[Shard] = []
    for name, own in wanted.items():
        needed = read[name]
        if needed is None:
            continue
        for seed, index in _starts(inputs, own.starts):
            refs = named_refs(seed=[seed], joint_limits=inputs.of("joint_limits"), **needed)
            shards += _plan_seed(inputs.seed, name, own, index, refs)
    return shards


def _read_by(density: str, inputs: StageInputs) -> Inputs | None:
    """Return what a density reads beside a seed and joint limits; None where a study has not got it."""
    match DENSITIES[density].reads:
        case Reads.ANNOTATIONS:
            annotations = annotated_pairs(inputs)
            views = views_of(annotations, inputs)
            return {"annotations": annotations, "views": views} if annotations and views else None
        case Reads.NOTHING:
            return {}


def _starts(inputs: StageInputs, which: str) -> list[tuple[Manifest, int]]:
    """Return the seeds that chains start from, each with the artifact it is in."""
    return [
        (seed, index)
        for seed in inputs.of("seeds")
        if which == "all" or (which == "grown") == (seed.facts["kind"] == GROWN)
        for index in start_indices(seed)
    ]


def _plan_seed(
    seed: int, name: str, own: ChainsParameters, index: int, refs: dict[str, tuple[ArtifactRef, ...]]
) -> list[Shard]:
    """Plan the segments of every chain of a seed, and their summary."""
    density = DENSITIES[own.densities[0]]
    proposal = PROPOSALS[own.proposal]
    if proposal.reads_annotations and density.reads is not Reads.ANNOTATIONS:
        proposal = next(iter(PROPOSALS.values()))
    num_segments = -(-own.num_draws // own.segment_draws)
    segments: list[Shard] = []
    for chain in range(own.num_chains):
        previous: tuple[str, ...] = ()
        for segment in range(num_segments):
            shard = Shard(
                stage="chains",
                version=VERSION,
                partition=f"{name}-seed{index}",
                name=f"chain{chain}-segment{segment}",
                parameters=SegmentParameters(
                    name=name,
                    density=density.name,
                    seed_index=index,
                    chain=chain,
                    segment=segment,
                    run=own.part(RunSettings),
                    target=own.part(TargetSettings),
                    density_settings=own.settings_of(density),
                    proposal=proposal.name,
                ),
                inputs=refs,
                after=previous,
                seed=seed,
            )
            previous = (shard.key,)
            segments.append(shard)
    summary = Shard(
        stage="chains",
        version=VERSION,
        partition=f"{name}-seed{index}",
        name="summary",
        parameters=SummaryParameters(
            name=name, seed_index=index, num_chains=own.num_chains, num_segments=num_segments, thin=own.thin
        ),
        inputs={"seed": refs["seed"]},
        after=tuple(shard.key for shard in segments),
        seed=seed,
    )
    return [*segments, summary]
