"""Run one segment of a chain, diagnose the chains of a seed, or repair hundreds of pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.evaluation.verdicts import merge_verdicts
from pasdedeux.sampling.annotations import MIN_CANDIDATES
from pasdedeux.sampling.chain import (
    ChainState,
    generator_from_json,
    generator_to_json,
    proposal_from_json,
    proposal_to_json,
    run_segment,
)
from pasdedeux.sampling.densities import DENSITIES
from pasdedeux.sampling.densities.annotated import AnnotationSettings
from pasdedeux.sampling.densities.density import Evaluation, Likelihood, PairDensity
from pasdedeux.sampling.diagnostics import FIGURES, diagnose
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior
from pasdedeux.sampling.proposals import PROPOSALS
from pasdedeux.sampling.proposals.proposal import Proposal, ProposalInputs
from pasdedeux.sampling.repair import learn_scales, repair
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import MIN_LOG_PRIOR
from pasdedeux.sampling.speeds import Speeds, annotation_speeds
from pasdedeux.sampling.warm_up import disperse, warm_up
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.chains.parameters import ChainSegmentParameters, RepairParameters, SummaryParameters
from tasks.priors import read_limits
from tasks.rows.annotated_pairs import PairPlace, PlacedPairs, annotation_columns, gather, gather_tracks
from tasks.stage import Shard
from tasks.stage.committing import commit, followed
from tasks.stage.facts import ChainFacts, DrawFacts, merge_takes
from tasks.stage.kept import kept
from tasks.stage.streams import stream

Refs = tuple[ArtifactRef, ...]
MIN_PLAUSIBLE_SHARE = 0.9
"""Share of repaired pairs that must be plausible to be no warning."""
_NUM_HYPOTHESES = 4
"""Likeliest view hypotheses of an annotation that are used."""
_ONE_VIEW_RAD = float(np.deg2rad(15.0))
"""Views closer together than this count as one: estimated views are about 10 degrees off."""


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Run one segment of a chain, summarise the chains of a seed, or repair pairs."""
    if isinstance(shard.parameters, ChainSegmentParameters):
        return _run_segment(shard, shard.parameters, store)
    if isinstance(shard.parameters, RepairParameters):
        return _repair(shard, shard.parameters, store)
    return _summarise(shard, shard.options(SummaryParameters), store)


def _run_segment(shard: Shard, options: ChainSegmentParameters, store: Store) -> ArtifactRef:
    """Run a segment of a chain on from where the one before ended, or from the seed."""
    problem = chain_problem(shard, options, store)
    chart, target, proposal = problem.chart, problem.target, problem.proposal
    run, gauge = options.run, problem.chart.gauge_fixed
    if options.segment == 0:
        rng = stream(shard.seed, "chains", options.name, options.seed_index, options.chain)
        state = disperse(rng, chart.seed_parameters(), target, proposal, num_steps=run.num_dispersing * run.thin)
        state = warm_up(rng, state, target, proposal.propose, num_steps=run.num_warm_up * run.thin, gauge=gauge)
    else:
        rng, state = _resume(shard, chart, store)
    count = run.segment_draws
    state, draws = run_segment(rng, state, target, proposal.propose, num_draws=count, thin=run.thin, gauge=gauge)
    identity: dict[str, list[Any]] = {
        "density": [options.name],
        "seed_index": [options.seed_index],
        "chain": [options.chain],
    }
    tables: dict[str, dict[str, Any]] = {
        "draws": {
            **{name: value * count for name, value in identity.items()},
            "draw": np.arange(options.segment * count, (options.segment + 1) * count),
            "pair17_m": chart.positions(draws.parameters),
            "parameters": draws.parameters,
            "log_density": draws.log_density,
            "log_prior": draws.log_prior,
            "log_likelihood": draws.log_likelihood,
            "num_accepted": draws.num_accepted,
            **_nearest(problem.evidence, chart.positions(draws.parameters)),
            "take_id": [problem.seed.take_id] * count,
        },
        "chain_states": {
            **identity,
            "segment": [options.segment],
            "num_draws": [(options.segment + 1) * count],
            "parameters": state.parameters[None],
            "log_density": [state.evaluation.log_density],
            "log_prior": [state.evaluation.log_prior],
            "log_likelihood": [state.evaluation.log_likelihood],
            "generator_state": [generator_to_json(rng)],
            "proposal_state": [proposal_to_json(state)],
        },
    }
    facts = DrawFacts(
        density=options.name,
        seed_index=options.seed_index,
        chain=options.chain,
        segment=options.segment,
        num_draws=count,
        log_seed=target.log_seed,
        log_ceiling=target.log_ceiling if np.isfinite(target.log_ceiling) else None,
        sigma_l=problem.evidence.likelihood.sigma_l,
        num_annotations_skipped=problem.evidence.num_skipped,
        note=problem.evidence.note(),
        takes=merge_takes(*(store.manifest(ref) for ref in shard.all_inputs)),
    )
    return commit(shard, store, tables=tables, facts=facts)


def _repair(shard: Shard, options: RepairParameters, store: Store) -> ArtifactRef:
    """Run a short chain from each of some grown or filled pairs that are possible, and commit where they end."""
    rows = slice(options.first_row, options.first_row + options.num_rows)
    table = store.read(shard.ref("seed"), "seeds", columns=["seed_index", "pair17_m"], rows=rows)
    pairs, indices = np.asarray(table["pair17_m"], dtype=np.float64), np.asarray(table["seed_index"])
    limits = read_limits(store, shard.refs("joint_limits"))
    is_possible = seed_quality(pairs, limits, options.target).is_possible
    pairs, indices = pairs[is_possible], indices[is_possible]
    facts = DrawFacts(
        density=options.name,
        seed_index=int(indices[0]) if len(indices) else 0,
        num_draws=len(pairs),
        num_starts=options.num_rows,
        takes=merge_takes(*(store.manifest(ref) for ref in shard.all_inputs)),
    )
    if not len(pairs):
        reason = "none of the pairs to repair keeps the joint limits"
        return commit(shard, store, tables={}, facts=facts, verdict=Verdict(Level.WARN, reason))
    annotations, views, settings = shard.refs("annotations"), shard.refs("views"), options.annotations
    if settings is not None:
        sigma_l = options.repair.repair_sigma_l * settings.bandwidth(_gathered(store, annotations, views).gathered)
        settings = settings.model_copy(update={"sigma_l": sigma_l})
    # One bank of views for all: with one for each, most of the time would go into making them.
    evidence = _evidence(store, annotations, views, options.density, settings, shard.seed, 0, needs_speeds=False)
    sharp = options.target.model_copy(update={"sigma_p_m": options.repair.repair_sigma_p * options.target.sigma_p_m})
    targets = []
    for pair in pairs:
        chart = PairChart(pair)
        targets.append(PairDensity(chart, PhysicalPrior(chart, limits, sharp), evidence.likelihood, sharp))
    labels = ("chains", options.name, "repair")
    scales = learn_scales(targets, stream(shard.seed, *labels, "scales", int(indices[0])))
    ends = [
        repair(target, stream(shard.seed, *labels, int(index)), scales, options.repair.repair_steps)
        for target, index in zip(targets, indices, strict=True)
    ]
    facts = facts.model_copy(
        update={
            "sigma_l": evidence.likelihood.sigma_l,
            "num_annotations_skipped": evidence.num_skipped,
            "note": evidence.note(),
        }
    )
    parameters = np.concatenate([end.parameters for end in ends])
    repaired = np.stack([target.chart.positions(vector) for target, vector in zip(targets, parameters, strict=True)])
    quality = seed_quality(repaired, limits, options.target)
    columns = {
        "density": [options.name] * len(ends),
        "seed_index": indices,
        "chain": [0] * len(ends),
        "draw": [0] * len(ends),
        "pair17_m": repaired,
        "parameters": parameters,
        "log_density": [end.log_density[0] for end in ends],
        "log_prior": quality.log_prior,
        "log_likelihood": [end.log_likelihood[0] for end in ends],
        "num_accepted": [end.num_accepted[0] for end in ends],
        **_nearest(evidence, repaired),
        "take_id": [None] * len(ends),
    }
    share = float(np.mean(quality.log_prior >= MIN_LOG_PRIOR))
    is_good = share >= MIN_PLAUSIBLE_SHARE
    verdict = Verdict(
        Level.PASS if is_good else Level.WARN,
        ""
        if is_good
        else "many pairs are not plausible after these steps: more of them (chains.repair_steps) may help",
        figure="repaired pairs that are plausible",
        value=100.0 * share,
        unit="%",
        count=len(ends),
        thing="pairs",
    )
    return commit(shard, store, tables={"draws": columns}, facts=facts, verdict=verdict)


def _nearest(evidence: AnnotationEvidence, pairs_m: np.ndarray) -> dict[str, Any]:
    """Return the annotation that each pair (draw, 2, 17, 3) is nearest to, the view, and how near, as columns."""
    count, likelihood = len(pairs_m), evidence.likelihood
    places: list[PairPlace | None] = [None] * count
    views, distances = np.full((count, 3), np.nan), np.full(count, np.nan)
    for draw, pair_m in enumerate(pairs_m if len(likelihood.directions) else ()):
        nearest = likelihood.nearest(pair_m)
        view = int(np.argmin(nearest.dissimilarity_m))
        places[draw] = evidence.places[int(nearest.entry[view])]
        views[draw], distances[draw] = likelihood.directions[view], nearest.dissimilarity_m[view]
    return {**annotation_columns(places), "view": views, "dissimilarity_m": distances}


@dataclass(frozen=True)
class ChainProblem:
    """A seed, the target around it, the proposal that samples it, and the artifacts it was made from."""

    seed: SeedRow
    chart: PairChart
    target: PairDensity
    proposal: Proposal
    evidence: AnnotationEvidence


def chain_problem(shard: Shard, options: ChainSegmentParameters, store: Store) -> ChainProblem:
    """Assemble the target of a segment: from seed and evidence to density and proposal.

    Raises:
        InputError: The seed has density 0, with the term that made it so, or is no pair; names the seed.
    """
    seed = read_seed_row(store, shard.ref("seed"), options.seed_index)
    kind = PROPOSALS[options.proposal]
    try:
        evidence = _evidence(
            store,
            shard.refs("annotations"),
            shard.refs("views"),
            options.density,
            options.annotations,
            shard.seed,
            options.seed_index,
            needs_speeds=kind.reads_annotations,
        )
        chart = PairChart(seed.pair_m)
        prior = PhysicalPrior(chart, read_limits(store, shard.refs("joint_limits")), options.target)
        target = PairDensity(chart, prior, evidence.likelihood, options.target)
    except InputError as error:
        raise InputError(f"seed {options.seed_index} ({seed.origin}): {error}") from None
    inputs = ProposalInputs(chart, lambda pair_m: evidence.likelihood.nearest(pair_m).entry, evidence.speeds)
    return ChainProblem(seed, chart, target, kind.init(inputs), evidence)


@dataclass(frozen=True)
class AnnotationEvidence:
    """Evidence of the annotations about pairs near one seed; only the likelihood if annotations are not read.

    `places` are sequence and frame of each entry of the annotations.
    """

    likelihood: Likelihood
    places: tuple[PairPlace, ...] = ()
    speeds: Speeds | None = None
    num_annotations: int = 0
    view_spread_rad: float = np.pi
    num_skipped: int = 0

    def note(self) -> str:
        """Describe anything unusual about the annotations; empty if there is nothing."""
        notes = []
        if 0 < self.num_annotations < MIN_CANDIDATES:
            count = f"{self.num_annotations} annotations are" if self.num_annotations > 1 else "1 annotation is"
            notes.append(
                f"{count} fewer than the {MIN_CANDIDATES} that a view should be compared with: the likelihood says "
                "little"
            )
        if self.num_annotations > 1 and self.view_spread_rad < _ONE_VIEW_RAD:
            notes.append(
                f"nearly all annotations see the pair from one side, within {np.rad2deg(self.view_spread_rad):.0f} "
                "degrees: depth follows from how bodies move alone"
            )
        if self.num_skipped:
            total = self.num_annotations + self.num_skipped
            notes.append(f"{self.num_skipped} of {total} annotations show too little or have no view, and were skipped")
        return "; ".join(notes)


@kept(2)
def _evidence(
    store: Store,
    annotations: Refs,
    views: Refs,
    density: str,
    settings: AnnotationSettings | None,
    study_seed: int,
    seed_index: int,
    *,
    needs_speeds: bool,
) -> AnnotationEvidence:
    """Return the evidence of the annotations about pairs near a seed.

    This reads every annotation; the segments that one worker runs in a row mostly share it.
    """
    rng = stream(study_seed, "chains", "views", seed_index)
    if not DENSITIES[density].reads_annotations:
        return AnnotationEvidence(DENSITIES[density].init(None, rng, None))
    placed = _gathered(store, annotations, views)
    pairs = placed.gathered.pairs
    return AnnotationEvidence(
        likelihood=DENSITIES[density].init(settings, rng, placed.gathered),
        places=tuple(placed.places[index] for index in pairs.annotation_index),
        speeds=annotation_speeds(gather_tracks(placed)) if needs_speeds else None,
        num_annotations=len(np.unique(pairs.annotation_index)),
        view_spread_rad=placed.gathered.view_spread_rad,
        num_skipped=placed.gathered.num_skipped,
    )


@kept()
def _gathered(store: Store, annotations: Refs, views: Refs) -> PlacedPairs:
    """Return the annotated pairs, which are the same for all seeds, with everything computed from them once."""
    return gather(store, annotations=annotations, views=views, num_hypotheses=_NUM_HYPOTHESES)


@dataclass(frozen=True)
class SeedRow:
    """A seed as stored: the pair (2, 17, 3), metres, the take it came from, and its origin in words."""

    pair_m: np.ndarray
    take_id: str | None
    origin: str


def read_seed_row(store: Store, ref: ArtifactRef, seed_index: int) -> SeedRow:
    """Return a seed of an artifact by its index in the study."""
    names = ["seed_index", "pair17_m", "origin", "take_id", "take_frame", "sequence_id", "sequence_frame", "made_from"]
    table = store.read(ref, "seeds", columns=names)
    row = int(np.flatnonzero(np.asarray(table["seed_index"]) == seed_index)[0])
    take_id, sequence_id, made_from = (table[name][row] for name in ("take_id", "sequence_id", "made_from"))
    origin = str(table["origin"][row])
    if take_id is not None:
        origin = f"take {take_id}, frame {int(table['take_frame'][row])}"
    elif sequence_id is not None:
        origin += f" from {sequence_id}, frame {int(table['sequence_frame'][row])}"
    elif made_from is not None:
        origin = str(made_from)
    return SeedRow(
        pair_m=np.array(table["pair17_m"][row], dtype=np.float64),
        take_id=None if take_id is None else str(take_id),
        origin=origin,
    )


def _resume(shard: Shard, chart: PairChart, store: Store) -> tuple[np.random.Generator, ChainState]:
    """Return generator and state as the previous segment left them."""
    table = store.read(followed(shard, store)[0].ref, "chain_states")
    parameters = np.array(table["parameters"][0], dtype=np.float64)
    evaluation = Evaluation(
        log_density=float(table["log_density"][0]),
        log_prior=float(table["log_prior"][0]),
        log_likelihood=float(table["log_likelihood"][0]),
        log_measure=chart.log_measure(parameters),
    )
    log_scales, context = proposal_from_json(str(table["proposal_state"][0]))
    rng = generator_from_json(str(table["generator_state"][0]))
    return rng, ChainState(parameters, evaluation, context, log_scales)


def _summarise(shard: Shard, options: SummaryParameters, store: Store) -> ArtifactRef:
    """Diagnose all chains of one density and seed."""
    done = followed(shard, store)
    columns = ("pair17_m", "log_density", "num_accepted")
    tables = [store.read(manifest.ref, "draws", columns=list(columns)) for manifest in done]
    stacked = {
        name: np.concatenate([table[name] for table in tables]).reshape(
            options.num_chains, -1, *np.shape(tables[0][name])[1:]
        )
        for name in columns
    }
    facts = DrawFacts.of(done[0])
    reports = diagnose(
        stacked["pair17_m"],
        stacked["log_density"],
        stacked["num_accepted"],
        thin=options.thin,
        log_ceiling=np.inf if facts.log_ceiling is None else facts.log_ceiling,
        log_seed=facts.log_seed,
        sigma_l=np.nan if facts.sigma_l is None else facts.sigma_l,
    )
    count = options.num_chains
    info = {
        "density": [options.name] * count,
        "seed_index": [options.seed_index] * count,
        "chain": list(range(count)),
        **{name: [getattr(report, name) for report in reports] for name in FIGURES},
        "verdict": [report.verdict.level.value for report in reports],
        "reason": [report.verdict.reason for report in reports],
        "note": [facts.note] * count,
    }
    return commit(
        shard,
        store,
        tables={"chain_info": info},
        facts=ChainFacts(density=options.name, seed_index=options.seed_index, takes=merge_takes(*done)),
        verdict=merge_verdicts(report.verdict for report in reports),
    )
