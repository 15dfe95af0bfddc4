"""Stage `chains`: Markov chains over 3D pairs, from every seed and for every density, in segments that continue."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pasdedeux.errors import InputError
from pasdedeux.sampling import (
    ChainState,
    Evaluation,
    MoveKind,
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
from tasks.chain_problem import LIKELIHOOD_PARAMETERS, chain_problem, read_seed_row
from tasks.densities import IMAGE_DENSITIES, DensityName, density_inputs
from tasks.seeds import start_indices
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, merge_takes, stream

__all__ = ["STAGE", "VERSION", "ChainsParameters", "plan", "run_shard"]

VERSION = 3

KernelName = Literal["unbiased", "velocity"]

_PRIOR_PARAMETERS = ("sigma_p_m", "alpha", "most_invalid_angles", "joint_limits", "length_tolerance", "truncation")
_STEP_PARAMETERS = (
    "segment_draws",
    "thin",
    "root_rotation_rad",
    "root_position_m",
    "joint_rotation_rad",
    "length_change",
    "most_blocks",
    "moves",
    "num_warm_up",
    "target_acceptance",
)


class ChainsParameters(Parameters):
    """What is sampled, how much, and with which steps."""

    densities: tuple[DensityName, ...] = Field(
        ("ic", "prior_only"),
        min_length=1,
        description="Densities: ic (interaction coordinates), cartesian, shape_context, prior_only, "
        "agreement (with grown seeds)",
    )
    num_chains: int = Field(2, ge=1, le=1000, description="Chains of each seed and density")
    num_draws: int = Field(500, ge=1, description="Draws kept of each chain; rounded up to whole segments")
    thin: int = Field(10, ge=1, description="Steps per kept draw")
    segment_draws: int = Field(250, ge=4, description="Draws of a segment, the unit that is stored and resumed")
    num_views: int = Field(20, ge=1, le=1000, description="Views of the fixed bank of each seed (m of eq. 6)")
    num_candidates: int = Field(500, ge=1, description="Annotations compared with each view, nearest by view")
    num_hypotheses: int = Field(4, ge=1, description="Likeliest view hypotheses of an annotation that are used")
    num_ranked: int = Field(192, ge=1, description="Candidates of a view compared in full, nearest by rigid residual")
    sigma_l: float = Field(0.01, gt=0, description="Bandwidth of the likelihood; 2 sigma_l^2 is in metres (eq. 9)")
    sigma_v_rad: float = Field(0.5, gt=0, description="Bandwidth of the view density (eq. 5), radians")
    beta_m: float = Field(0.05, gt=0, description="Edge length below which weights stop growing (eq. 8), metres")
    sigma_p_m: float = Field(0.05, gt=0, description="Bandwidth of the prior (eq. 2), metres")
    alpha: float = Field(10.0, ge=0, description="Weight of the squared penetration (eq. 2)")
    most_invalid_angles: int = Field(8, ge=0, description="Invalid joint angles beyond which a pair is impossible")
    joint_limits: Literal["table", "learned"] = Field(
        "table", description="Joint limits: the table's ranges, or also what the prior takes show (see priors)"
    )
    length_tolerance: float = Field(0.05, ge=0, lt=0.5, description="Greatest relative change of a bone's length")
    truncation: float = Field(100.0, gt=1, description="c of eq. 11: the density is cut below f0 / c and above c f0")
    reference: Literal["seed", "left_out"] = Field(
        "seed",
        description="f0 of eq. 11: the seed's density, or, where that is higher, that of a pair as likely as a real "
        "one that is not annotated",
    )
    left_out_quantile: float = Field(
        0.5, ge=0, le=1, description="How well that pair is annotated, as a quantile over left-out annotations"
    )
    root_rotation_rad: float = Field(0.02, ge=0, description="Step of a root's rotation, radians")
    root_position_m: float = Field(0.005, ge=0, description="Step of a root's position, metres")
    joint_rotation_rad: float = Field(0.04, ge=0, description="Step of a bone's rotation, radians")
    length_change: float = Field(0.005, ge=0, description="Step of a bone's relative length")
    most_blocks: int = Field(4, ge=1, le=34, description="Roots and bones moved by one step of `few`, at most")
    kernel: KernelName = Field(
        "unbiased", description="Steps: unbiased, or velocity, wider where nearby annotations move (eq. 12); ic only"
    )
    moves: dict[MoveKind, Annotated[float, Field(ge=0)]] = Field(
        {MoveKind.FEW: 1.0},
        min_length=1,
        description="How often steps move what together, as weights: few (bones or roots), limb, person, roots (both)",
    )
    guided_share: float = Field(
        0.0, ge=0, le=1, description="Share of steps towards or away from what a near annotation shows; 0: none"
    )
    guided_stretch: float = Field(
        0.3,
        gt=0,
        le=3,
        description="Guided steps change the distance to an annotation by a factor of at most its exp",
    )
    guided_width_m: float = Field(
        0.03, gt=0, description="Width of the preference for near annotations as guides, metres in the image"
    )
    num_warm_up: int = Field(
        50, ge=0, description="Draws before the first kept one, in which step sizes are learned; they are dropped"
    )
    target_acceptance: float = Field(0.234, gt=0, lt=1, description="Accepted share that step sizes are learned for")

    @model_validator(mode="after")
    def _something_moves(self) -> ChainsParameters:
        if not sum(self.moves.values()) > 0.0:
            raise ValueError("chains.moves gives every kind of move the weight 0; one must be drawn")
        scales = (self.root_rotation_rad, self.root_position_m, self.joint_rotation_rad)
        if (self.kernel == "velocity" or self.guided_share > 0.0) and not min(scales) > 0.0:
            wanted = "kernel = 'velocity'" if self.kernel == "velocity" else "guided_share"
            raise ValueError(
                f"chains.{wanted} needs positive root_rotation_rad, root_position_m and joint_rotation_rad"
            )
        return self

    @model_validator(mode="after")
    def _densities_are_named_once(self) -> ChainsParameters:
        if len(set(self.densities)) != len(self.densities):
            raise ValueError("chains.densities names a density twice")
        return self


def plan(inputs: StageInputs, parameters: ChainsParameters) -> list[Shard]:
    """Plan, per density and seed, the segments of every chain and then a summary.

    A segment's key knows its chain and number but not how many draws are asked for, so asking for more extends.
    """
    limits = [manifest.ref for manifest in inputs.of("joint_limits")]
    annotated = annotated_pairs(inputs)
    views = views_of(annotated, inputs)
    asked = parameters.model_dump(mode="json")
    num_segments = -(-parameters.num_draws // parameters.segment_draws)
    seen = (*annotated, *views) if annotated and views else ()
    found = {density: density_inputs(density, inputs, seen) for density in parameters.densities}
    if inputs.of("seeds") and all(needs is None for needs in found.values()):
        raise InputError(
            f"chains.densities asks for {', '.join(found)} alone, but there are no "
            + ("grown seeds (seeds.num_grown)" if "agreement" in found else "annotated pairs with views")
            + " to sample from"
        )
    shards: list[Shard] = []
    for density, needed in found.items():
        if needed is None:
            continue
        needs = [manifest.ref for manifest in needed]
        names = _PRIOR_PARAMETERS + _STEP_PARAMETERS + (LIKELIHOOD_PARAMETERS if density in IMAGE_DENSITIES else ())
        starts = [(seed.ref, index) for seed in inputs.of("seeds") for index in start_indices(seed)]
        for seed, index in starts:
            common = {"density": density, "seed_index": index, **{name: asked[name] for name in names}}
            refs = (seed, *limits, *needs)
            segments: list[Shard] = []
            for chain in range(parameters.num_chains):
                previous: tuple[str, ...] = ()
                for segment in range(num_segments):
                    shard = Shard(
                        stage="chains",
                        version=VERSION,
                        partition=f"{density}-seed{index}",
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
                partition=f"{density}-seed{index}",
                name="summary",
                parameters={
                    **common,
                    "num_chains": parameters.num_chains,
                    "num_segments": num_segments,
                },
                inputs=(seed,),
                after=tuple(shard.key for shard in segments),
                seed=inputs.seed,
            )
            shards += [*segments, summary]
    return shards


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Run one segment of a chain, or summarise the chains of a seed."""
    return _summarise(shard, store) if shard.name == "summary" else _run_segment(shard, store)


def _run_segment(shard: Shard, store: Store) -> ArtifactRef:
    options = shard.parameters
    density, seed_index = str(options["density"]), int(options["seed_index"])
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
    """Give generator, state and learned scales as the previous segment left them."""
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
        "density": [options["density"]] * num_chains,
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
            "density": options["density"],
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
