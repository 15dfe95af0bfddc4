"""What a chain samples and how it steps, put together from a seed, the annotations and a shard's parameters."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.plausibility import JointLimits, LearnedLimits
from pasdedeux.sampling import (
    AnnotatedPairs,
    GaussianBlocks,
    InteractionLikelihood,
    MoveKind,
    MoveMixture,
    PairChart,
    PairDensity,
    PhysicalPrior,
    Speeds,
    VelocityBias,
    annotation_speeds,
    build_bank,
    undo_swaps,
)
from pasdedeux.sampling.agreement import SHARPNESS
from pasdedeux.sampling.density import Likelihood
from pasdedeux.sampling.guided import Guided, Guides
from pasdedeux.sampling.likelihood import LEAST_CANDIDATES
from pasdedeux.sampling.measured_likelihood import MeasuredLikelihood
from pasdedeux.sampling.reference import left_out_dissimilarity, left_out_log_likelihood
from storage_schema import ArtifactRef, Store
from tasks.annotated_pairs import gather, gather_tracks
from tasks.chain_parameters import LIKELIHOOD_PARAMETERS
from tasks.densities import IMAGE_DENSITIES, agreement_of, image_likelihood
from tasks.priors import read_limits, read_occupancy
from tasks.stage import Shard, stream

__all__ = ["ChainProblem", "SeedRow", "chain_problem", "look_at_annotations", "read_seed_row"]

NUM_GUIDES = 1000
"""Annotations that may guide a chain's steps, at most: spread evenly over those that any view of the bank meets."""


@dataclass(frozen=True)
class ChainProblem:
    """A target, the kernel that is to sample it, and what the annotations said; None without annotations."""

    chart: PairChart
    target: PairDensity
    propose: GaussianBlocks | Guided
    seen: Seen | None


def chain_problem(shard: Shard, store: Store, seed: SeedRow) -> ChainProblem:
    """Put together what the chains of a shard's density and seed sample.

    Raises:
        InputError: The seed has density 0, with the term that made it so, or is no pair; names the seed.
    """
    options = shard.parameters
    seen = look_at_annotations(shard, store) if options["density"] in IMAGE_DENSITIES else None
    is_agreement = options["density"] == "agreement"
    try:
        chart = PairChart(seed.pair_m)
        prior = PhysicalPrior(
            chart,
            _limits(shard, store),
            sigma_p=options["sigma_p_m"] / (SHARPNESS**0.5 if is_agreement else 1.0),
            # Agreement has the bodies' mutual penetration in its likelihood, and leaves that within a body out.
            alpha=0.0 if is_agreement else options["alpha"],
            most_invalid=options["most_invalid_angles"],
            length_tolerance=options["length_tolerance"],
        )
        likelihood: Likelihood | None = None if seen is None else seen.likelihood
        if is_agreement:
            likelihood = agreement_of(shard, store, seed.pair_m)
        left_out = None if seen is None else seen.log_left_out
        target = PairDensity(chart, prior, likelihood, truncation=options["truncation"], log_left_out=left_out)
    except InputError as error:
        raise InputError(f"seed {options['seed_index']} ({seed.origin}): {error}") from None
    propose = GaussianBlocks(
        root_rotation_rad=options["root_rotation_rad"],
        root_position_m=options["root_position_m"],
        joint_rotation_rad=options["joint_rotation_rad"],
        length_change=options["length_change"],
        mixture=MoveMixture(
            weights={MoveKind(kind): weight for kind, weight in options["moves"].items()},
            most_blocks=options["most_blocks"],
        ),
        bias=None if seen is None else seen.bias(chart),
    )
    return ChainProblem(chart, target, propose if seen is None else seen.guided(propose, chart, options), seen)


def _limits(shard: Shard, store: Store) -> JointLimits | LearnedLimits:
    """Return the joint limits that a shard asks for: the table's ranges, or what capture allows beside them."""
    table = read_limits(store, shard.all_inputs)
    return (
        table
        if shard.parameters["joint_limits"] == "table"
        else LearnedLimits(table, read_occupancy(store, shard.all_inputs))
    )


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


@dataclass(frozen=True)
class Seen:
    """What the annotations say about pairs near one seed."""

    likelihood: InteractionLikelihood | MeasuredLikelihood
    speeds: Speeds | None
    guides: AnnotatedPairs
    log_left_out: float | None
    num_annotations: int
    num_skipped: int
    num_swapped: int

    def bias(self, chart: PairChart) -> VelocityBias | None:
        """Return what the velocity-biased kernel looks round with; None for the unbiased one."""
        if self.speeds is None:
            return None
        return VelocityBias(self.speeds, lambda parameters: self.likelihood.nearest(chart.positions_fast(parameters)))

    def guided(self, propose: GaussianBlocks, chart: PairChart, options: Mapping[str, Any]) -> GaussianBlocks | Guided:
        """Return a proposal with the share of steps guided by annotations that is asked for."""
        if not options["guided_share"]:
            return propose
        guides = Guides(self.guides, chart, width_m=options["guided_width_m"])
        return Guided(propose, guides, share=options["guided_share"], stretch=options["guided_stretch"])

    def note(self) -> str:
        """Say what is unusual about the annotations; nothing when all is well."""
        notes = []
        if self.num_annotations < LEAST_CANDIDATES:
            notes.append(
                f"{self.num_annotations} annotations are fewer than the {LEAST_CANDIDATES} that a view should be "
                "compared with: the likelihood says little"
            )
        if self.num_skipped:
            total = self.num_annotations + self.num_skipped
            notes.append(
                f"{self.num_skipped} of {total} annotations lack a joint, a person or a view and were left out"
            )
        if self.num_swapped:
            notes.append(f"round {self.num_swapped} annotations people were numbered anew, which speeds undo")
        return "; ".join(notes)


# Building a likelihood reads every annotation; the segments that one worker runs in a row mostly share it.
_KEPT: OrderedDict[str, Seen] = OrderedDict()
_MOST_KEPT = 2


def look_at_annotations(shard: Shard, store: Store) -> Seen:
    """Return what the annotations say about pairs near a seed."""
    options = {name: shard.parameters[name] for name in LIKELIHOOD_PARAMETERS}
    seed_index = int(shard.parameters["seed_index"])
    identity = json.dumps(
        [
            str(store.root),
            shard.seed,
            shard.parameters["density"],
            seed_index,
            options,
            [ref.content_digest for ref in shard.inputs],
        ]
    )
    if identity not in _KEPT:
        placed = gather(
            store,
            annotations=shard.all_inputs,
            views=shard.all_inputs,
            num_hypotheses=int(shard.parameters["num_hypotheses"]),
        )
        pairs = placed.gathered.pairs
        rng = stream(shard.seed, "chains", "views", seed_index)
        views = placed.gathered.view_density(deviation_rad=options["sigma_v_rad"]).sample(rng, options["num_views"])
        bank = build_bank(
            views, pairs, num_candidates=options["num_candidates"], view_bandwidth_rad=options["sigma_v_rad"]
        )
        likelihood = image_likelihood(str(shard.parameters["density"]), pairs, bank, options)
        speeds, num_swapped = None, 0
        if options["kernel"] == "velocity":
            tracks, was_swapped = undo_swaps(gather_tracks(store, shard.all_inputs, placed))
            speeds = annotation_speeds(tracks)
            num_swapped = len(np.unique(pairs.annotation_index[was_swapped]))
        log_left_out = _left_out(pairs, options, stream(shard.seed, "chains", "left_out", seed_index))
        num_annotations = len(np.unique(pairs.annotation_index))
        guides = _some(pairs, np.unique(bank.candidates[bank.candidates >= 0]))
        _KEPT[identity] = Seen(
            likelihood, speeds, guides, log_left_out, num_annotations, placed.gathered.num_skipped, num_swapped
        )
        while len(_KEPT) > _MOST_KEPT:
            _KEPT.popitem(last=False)
    return _KEPT[identity]


def _some(pairs: AnnotatedPairs, entries: np.ndarray) -> AnnotatedPairs:
    """Return some of these entries, evenly spread, that may guide steps."""
    count = min(NUM_GUIDES, len(entries))
    chosen = entries[np.linspace(0, len(entries) - 1, count).round().astype(int)]
    return AnnotatedPairs(pairs.points_m[chosen], pairs.directions[chosen], pairs.annotation_index[chosen])


def _left_out(pairs: AnnotatedPairs, options: Mapping[str, Any], rng: np.random.Generator) -> float | None:
    """Return the log likelihood of a real pair that is not annotated, where the truncation refers to it too."""
    if options["reference"] == "seed":
        return None
    least = left_out_dissimilarity(pairs, view_bandwidth_rad=options["sigma_v_rad"], beta_m=options["beta_m"])
    return left_out_log_likelihood(
        least, options["num_views"], rng, sigma_l=options["sigma_l"], quantile=options["left_out_quantile"]
    )
