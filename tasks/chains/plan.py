"""Planning of the stage `chains`: the segments of every chain of every seed and density, and a summary of each."""

from __future__ import annotations

from collections.abc import Sequence

from pasdedeux.errors import InputError
from pasdedeux.sampling.densities import DENSITIES
from pasdedeux.sampling.densities.annotated import AnnotationSettings
from pasdedeux.sampling.densities.density import TargetSettings
from pasdedeux.sampling.proposals import PROPOSALS
from pasdedeux.sampling.repair import RepairSettings
from storage_schema import Manifest
from tasks.chains.parameters import (
    ChainSegmentParameters,
    ChainsParameters,
    RepairParameters,
    RunSettings,
    SummaryParameters,
)
from tasks.rows.annotated_pairs import annotated_pairs, views_of
from tasks.rows.draw_sets import GROWN, is_set
from tasks.stage import Shard, StageInputs, StageName
from tasks.stage.facts import SeedFacts

CHAINS = StageName("chains", 18)
_STARTS_OF_A_SHARD = 200

Inputs = dict[str, Sequence[Manifest]]


def plan(inputs: StageInputs, parameters: ChainsParameters) -> list[Shard]:
    """Plan, per density and seed, the segments of every chain and then a summary; or the repair of hundreds of pairs.

    A segment's key contains its chain and number but not the number of draws, so a request for more extends the chain.

    Raises:
        InputError: Only densities of annotations are asked for and there are none, or chains are to start from every
            grown pair and none are to grow.
    """
    wanted = parameters.named()
    read = {name: _read_by(options.densities[0], inputs) for name, options in wanted.items()}
    if inputs.of("seeds") and all(needed is None for needed in read.values()):
        densities = list(dict.fromkeys(options.densities[0] for options in wanted.values()))
        raise InputError(
            f"chains.densities asks for {', '.join(densities)} alone, but there are no annotated pairs with views to "
            "sample from"
        )
    shards: list[Shard] = []
    for name, options in wanted.items():
        needed = read[name]
        if needed is None:
            continue
        if options.starts == "every":
            shards += _plan_repair(inputs, name, options, needed)
            continue
        for seed, index in _starts(inputs, options.starts):
            shards += _plan_seed(inputs, name, options, seed, index, needed)
    return shards


def _read_by(density: str, inputs: StageInputs) -> Inputs | None:
    """Return the artifacts that a density reads besides a seed and joint limits; None if a study lacks them."""
    if not DENSITIES[density].reads_annotations:
        return {}
    annotations = annotated_pairs(inputs)
    views = views_of(annotations, inputs)
    return {"annotations": annotations, "views": views} if annotations and views else None


def _starts(inputs: StageInputs, which: str) -> list[tuple[Manifest, int]]:
    """Return the seeds that chains start from, each with the artifact it is in."""
    return [
        (seed, index)
        for seed in inputs.of("seeds")
        if which == "all" or (which == "grown") == (SeedFacts.of(seed).kind == GROWN)
        for index in SeedFacts.of(seed).start_indices
    ]


def _plan_repair(inputs: StageInputs, name: str, options: ChainsParameters, needed: Inputs) -> list[Shard]:
    """Plan the short chains from every grown and filled pair, some hundreds a shard."""
    pairs = list(filter(is_set, inputs.of("seeds")))
    if inputs.of("seeds") and not pairs:
        raise InputError("chains.starts is every, but no pairs grow to start from: say seeds.num_grown")
    density = DENSITIES[options.densities[0]]
    return [
        CHAINS.shard(
            inputs,
            name,
            f"{manifest.name}{first}",
            RepairParameters(
                name=name,
                density=density.name,
                first_row=first,
                num_rows=min(_STARTS_OF_A_SHARD, manifest.tables["seeds"].rows - first),
                repair=options.part(RepairSettings),
                target=options.part(TargetSettings),
                annotations=options.part(AnnotationSettings) if density.reads_annotations else None,
            ),
            {"seed": [manifest], "joint_limits": inputs.of("joint_limits"), **needed},
        )
        for manifest in pairs
        for first in range(0, manifest.tables["seeds"].rows, _STARTS_OF_A_SHARD)
    ]


def _plan_seed(
    inputs: StageInputs, name: str, options: ChainsParameters, seed: Manifest, index: int, needed: Inputs
) -> list[Shard]:
    """Plan the segments of every chain of a seed, and their summary."""
    read = {"seed": [seed], "joint_limits": inputs.of("joint_limits"), **needed}
    density = DENSITIES[options.densities[0]]
    proposal = PROPOSALS[options.proposal]
    if proposal.reads_annotations and not density.reads_annotations:
        proposal = next(iter(PROPOSALS.values()))
    partition, num_segments = f"{name}-seed{index}", -(-options.num_draws // options.segment_draws)
    segments: list[Shard] = []
    run, target = options.part(RunSettings), options.part(TargetSettings)
    annotations = options.part(AnnotationSettings) if density.reads_annotations else None
    for chain in range(options.num_chains):
        previous: tuple[str, ...] = ()
        for segment in range(num_segments):
            shard = CHAINS.shard(
                inputs,
                partition,
                f"chain{chain}-segment{segment}",
                ChainSegmentParameters(
                    name=name,
                    density=density.name,
                    seed_index=index,
                    chain=chain,
                    segment=segment,
                    run=run,
                    target=target,
                    annotations=annotations,
                    proposal=proposal.name,
                ),
                read,
                after=previous,
            )
            previous = (shard.key,)
            segments.append(shard)
    summary = CHAINS.shard(
        inputs,
        partition,
        "summary",
        SummaryParameters(
            name=name, seed_index=index, num_chains=options.num_chains, num_segments=num_segments, thin=options.thin
        ),
        {"seed": [seed]},
        after=tuple(shard.key for shard in segments),
    )
    return [*segments, summary]
