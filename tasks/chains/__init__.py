"""Stage `chains`: Markov chains over 3D pairs, from every seed and for every density, in segments that continue."""

from tasks.chains.parameters import ChainSegmentParameters, ChainsParameters, SummaryParameters
from tasks.chains.plan import CHAINS, plan
from tasks.chains.run import run_shard
from tasks.stage import Stage

__all__ = ["STAGE", "ChainSegmentParameters", "ChainsParameters", "SummaryParameters", "plan", "run_shard"]

STAGE = Stage(
    *CHAINS,
    reads=("annotations", "views", "seeds", "joint_limits"),
    writes=("draws", "chain_states", "chain_info"),
    parameters=ChainsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="draws of 3D pose pairs from the density that the annotations support",
    needs="seeds: takes of two people (seeds.num_seeds), annotations of two people (seeds.num_lifted) or seeds.files",
)
