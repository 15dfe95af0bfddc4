"""Lifting by sampling: the density of 3D pairs given 2D annotations, chains that sample it, and how well they cover."""

from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs, ViewBank, build_bank, gather_pairs
from pasdedeux.sampling.chain import (
    ChainState,
    Segment,
    StepInfo,
    generator_from_json,
    generator_to_json,
    run_segment,
    step,
)
from pasdedeux.sampling.coverage import Coverage, CoverageCurve, coverage_curve
from pasdedeux.sampling.density import Evaluation, PairDensity
from pasdedeux.sampling.diagnostics import ChainReport, diagnose, invariants
from pasdedeux.sampling.direct_lifting import LiftedSeeds, lift_seeds
from pasdedeux.sampling.growth import Growth, GrowthOptions, grow
from pasdedeux.sampling.likelihood import InteractionLikelihood, Match, plain_log_likelihood
from pasdedeux.sampling.parameters import NUM_PARAMETERS, PairChart, gauge_fix
from pasdedeux.sampling.prior import PhysicalPrior, PriorSettings, PriorTerms
from pasdedeux.sampling.proposals import (
    PROPOSALS,
    Correction,
    GaussianBlocks,
    Proposed,
    Scales,
    StepSettings,
    VelocityBlocks,
)
from pasdedeux.sampling.seeds import SeedQuality, choose_seeds, seed_quality
from pasdedeux.sampling.speeds import Speeds, annotation_speeds, undo_swaps
from pasdedeux.sampling.warm_up import proposal_from_json, proposal_to_json, warm_up

__all__ = [
    "NUM_PARAMETERS",
    "PROPOSALS",
    "AnnotatedPairs",
    "ChainReport",
    "ChainState",
    "Correction",
    "Coverage",
    "CoverageCurve",
    "Evaluation",
    "GatheredPairs",
    "GaussianBlocks",
    "Growth",
    "GrowthOptions",
    "InteractionLikelihood",
    "LiftedSeeds",
    "Match",
    "PairChart",
    "PairDensity",
    "PhysicalPrior",
    "PriorSettings",
    "PriorTerms",
    "Proposed",
    "Scales",
    "SeedQuality",
    "Segment",
    "Speeds",
    "StepInfo",
    "StepSettings",
    "VelocityBlocks",
    "ViewBank",
    "annotation_speeds",
    "build_bank",
    "choose_seeds",
    "coverage_curve",
    "diagnose",
    "gather_pairs",
    "gauge_fix",
    "generator_from_json",
    "generator_to_json",
    "grow",
    "invariants",
    "lift_seeds",
    "plain_log_likelihood",
    "proposal_from_json",
    "proposal_to_json",
    "run_segment",
    "seed_quality",
    "step",
    "undo_swaps",
    "warm_up",
]
