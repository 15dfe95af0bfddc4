"""Stage `chains`: Markov chains over 3D pairs, from every seed and for every density, in segments that continue."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.sampling import (
    ChainState,
    Evaluation,
    Scales,
    diagnose,
    generator_from_json,
    generator_to_json,
    kernel_from_json,
    kernel_to_json,
    run_segment,
    warm_up,
)
from storage_schema import ArtifactRef, Manifest, Store
from tasks.annotated_pairs import annotated_pairs, views_of
from tasks.chain_parameters import ChainsParameters, segment_parameters
from tasks.chain_problem import chain_problem, read_seed_row
from tasks.densities import density_inputs
from tasks.draw_sets import GROWN
from tasks.seeds import start_indices
from tasks.stage import Shard, Stage, StageInputs, commit, merge_takes, stream

__all__ = ["STAGE", "VERSION", "ChainsParameters", "plan", "run_shard"]

VERSION = 5


def plan(inputs: StageInputs, parameters: ChainsParameters) -> list[Shard]:
    """Plan, per density and seed, the segments of every chain and then a summary.

    A segment's key knows its chain and number but not how many draws are asked for, so asking for more extends.
    """
    limits = [manifest.ref for manifest in inputs.of("joint_limits")]
    annotated = annotated_pairs(inputs)
    views = views_of(annotated, inputs)
    seen = (*annotated, *views) if annotated and views else ()
    wanted: list[tuple[str, str, ChainsParameters]] = [
        (density, density, parameters) for density in parameters.densities
    ]
    for name in parameters.variants:
        own = parameters.variant(name)
        wanted.append((name, own.densities[0], own))
    found = {density: density_inputs(density, inputs, seen) for _, density, _ in wanted}
    if inputs.of("seeds") and all(needs is None for needs in found.values()):
        raise InputError(
            f"chains.densities asks for {', '.join(found)} alone, but there are no "
            + ("grown seeds (seeds.num_grown)" if "agreement" in found else "annotated pairs with views")
            + " to sample from"
        )
    shards: list[Shard] = []
    for name, density, own in wanted:
        needed = found[density]
        if needed is None:
            continue
        needs = [manifest.ref for manifest in needed]
        for seed, index in _starts(inputs, own.starts):
            shards += _plan_seed(inputs, name, density, own, index, refs=(seed, *limits, *needs))
    return shards


def _starts(inputs: StageInputs, which: str) -> list[tuple[ArtifactRef, int]]:
    """Return the seeds that chains start from, each with the artifact it is in."""
    return [
        (seed.ref, index)
        for seed in inputs.of("seeds")
        if which == "all" or (which == "grown") == (seed.facts["kind"] == GROWN)
        for index in start_indices(seed)
    ]


def _plan_seed(
    inputs: StageInputs,
    name: str,
    density: str,
    parameters: ChainsParameters,
    index: int,
    *,
    refs: tuple[ArtifactRef, ...],
) -> list[Shard]:
    """Plan the segments of every chain of a seed, which is in the first of `refs`, and their summary."""
    common = {"seed_index": index, **segment_parameters(parameters, density)}
    if name != density:
        common["variant"] = name
    num_segments = -(-parameters.num_draws // parameters.segment_draws)
    segments: list[Shard] = []
    for chain in range(parameters.num_chains):
        previous: tuple[str, ...] = ()
        for segment in range(num_segments):
            shard = Shard(
                stage="chains",
                version=VERSION,
                partition=f"{name}-seed{index}",
                name=f"chain{chain}-segment{segment}",
                parameters={**common, "chain": chain, "segment": segment},
                inputs=refs,
                after=previous,
                seed=inputs.seed,
            )
            previous = (shard.key,)
            segments.append(shard)
    summary = Shard(
        stage="chains",
        version=VERSION,
        partition=f"{name}-seed{index}",
        name="summary",
        parameters={**common, "num_chains": parameters.num_chains, "num_segments": num_segments},
        inputs=refs[:1],
        after=tuple(shard.key for shard in segments),
        seed=inputs.seed,
    )
    return [*segments, summary]


def _name(options: Mapping[str, Any]) -> str:
    """Return the name under which draws are kept: the variant's, or the density's."""
    return str(options.get("variant", options["density"]))


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Run one segment of a chain, or summarise the chains of a seed."""
    return _summarise(shard, store) if shard.name == "summary" else _run_segment(shard, store)


def _run_segment(shard: Shard, store: Store) -> ArtifactRef:
    options = shard.parameters
    density, seed_index = _name(options), int(options["seed_index"])
    chain, segment, count = int(options["chain"]), int(options["segment"]), int(options["segment_draws"])
    seed = read_seed_row(store, shard.inputs[0], seed_index)
    problem = chain_problem(shard, store, seed)
    chart, target, propose, seen = problem.chart, problem.target, problem.propose, problem.seen
    if segment == 0:
        rng = stream(shard.seed, "chains", density, seed_index, chain)
        start = chart.seed_parameters()
        state, propose = warm_up(
            rng,
            ChainState(start, target.seed_evaluation, propose.look_round(start)),
            target,
            propose,
            num_steps=int(options["num_warm_up"]) * int(options["thin"]),
            target_acceptance=options["target_acceptance"],
            settle=chart.gauge_fixed,
        )
    else:
        rng, state, scales = _resume(shard, store)
        propose = propose.with_scales(scales)
    state, draws = run_segment(
        rng, state, target, propose, num_draws=count, thin=int(options["thin"]), settle=chart.gauge_fixed
    )
    identity: dict[str, list[Any]] = {"density": [density], "seed_index": [seed_index], "chain": [chain]}
    tables: dict[str, dict[str, Any]] = {
        "draws": {
            **{name: value * count for name, value in identity.items()},
            "draw": np.arange(segment * count, (segment + 1) * count),
            "pair17_m": chart.positions(draws.parameters),
            "parameters": draws.parameters,
            "log_density": draws.log_density,
            "log_prior": draws.log_prior,
            "log_likelihood": draws.log_likelihood,
            "num_accepted": draws.num_accepted,
            "take_id": [seed.take_id] * count,
        },
        "chain_states": {
            **identity,
            "segment": [segment],
            "num_draws": [(segment + 1) * count],
            "parameters": state.parameters[None],
            "log_density": [state.evaluation.log_density],
            "log_prior": [state.evaluation.log_prior],
            "log_likelihood": [state.evaluation.log_likelihood],
            "generator_state": [generator_to_json(rng)],
            "kernel_state": [kernel_to_json(propose.scales, state.local)],
        },
    }
    facts = {
        "kind": "draws",
        "density": density,
        "seed_index": seed_index,
        "chain": chain,
        "segment": segment,
        "num_draws": count,
        "log_seed": target.log_seed,
        "log_ceiling": target.log_ceiling,
        "num_annotations_skipped": 0 if seen is None else seen.num_skipped,
        "note": "" if seen is None else seen.note(),
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
    }
    return commit(shard, store, tables=tables, facts=facts)


def _resume(shard: Shard, store: Store) -> tuple[np.random.Generator, ChainState, Scales]:
    """Return generator, state and learned scales as the previous segment left them."""
    table = store.read(_done(shard.after[0], store).ref, "chain_states")
    evaluation = Evaluation(
        log_density=float(table["log_density"][0]),
        log_prior=float(table["log_prior"][0]),
        log_likelihood=float(table["log_likelihood"][0]),
    )
    parameters = np.array(table["parameters"][0], dtype=np.float64)
    scales, local = kernel_from_json(str(table["kernel_state"][0]))
    rng = generator_from_json(str(table["generator_state"][0]))
    return rng, ChainState(parameters, evaluation, local), scales


def _done(key: str, store: Store) -> Manifest:
    manifest = store.find("chains", key)
    if manifest is None:
        raise InputError(f"the segment chains@{key[:12]} that this one continues is not in the store")
    return manifest


def _summarise(shard: Shard, store: Store) -> ArtifactRef:
    """Diagnose all chains of one density and seed."""
    options = shard.parameters
    num_chains, num_segments = int(options["num_chains"]), int(options["num_segments"])
    done = [_done(key, store) for key in shard.after]
    columns = ("pair17_m", "log_density", "num_accepted")
    tables = [store.read(manifest.ref, "draws", columns=list(columns)) for manifest in done]
    stacked = {
        name: np.stack(
            [
                np.concatenate([tables[chain * num_segments + segment][name] for segment in range(num_segments)])
                for chain in range(num_chains)
            ]
        )
        for name in columns
    }
    facts = done[0].facts
    reports = diagnose(
        stacked["pair17_m"],
        stacked["log_density"],
        stacked["num_accepted"],
        thin=int(options["thin"]),
        seed_m=read_seed_row(store, shard.inputs[0], int(options["seed_index"])).pair_m,
        log_ceiling=float(facts["log_ceiling"]),
    )
    info = {
        "density": [_name(options)] * num_chains,
        "seed_index": [options["seed_index"]] * num_chains,
        "chain": list(range(num_chains)),
        "num_draws": [report.num_draws for report in reports],
        "acceptance_rate": [report.acceptance_rate for report in reports],
        "ess_min": [report.ess_min for report in reports],
        "rhat_max": [report.rhat_max for report in reports],
        "log_density_first": [float(facts["log_seed"])] * num_chains,
        "log_density_mean": [report.log_density_mean for report in reports],
        "travelled_m": [report.travelled_m for report in reports],
        "verdict": [report.verdict for report in reports],
        "reason": [report.reason for report in reports],
        "note": [str(facts["note"])] * num_chains,
    }
    return commit(
        shard,
        store,
        tables={"chain_info": info},
        facts={
            "kind": "chain_info",
            "density": _name(options),
            "seed_index": options["seed_index"],
            "takes": merge_takes(*done),
        },
    )


STAGE = Stage(
    name="chains",
    version=VERSION,
    reads=("annotations", "views", "seeds", "joint_limits"),
    writes=("draws", "chain_states", "chain_info"),
    parameters=ChainsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="draws of 3D pose pairs from the density that the annotations support",
)
