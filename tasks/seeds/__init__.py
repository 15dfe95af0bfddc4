"""Stage `seeds`: starts of chains: frames of takes, files, pairs lifted from 2D alone, and pairs grown from them."""

from tasks.seeds.parameters import SEEDS, SeedFrame, SeedsParameters
from tasks.seeds.plan import check_study, plan
from tasks.seeds.run import run_shard
from tasks.stage import Stage

__all__ = [
    "STAGE",
    "SeedFrame",
    "SeedsParameters",
    "check_study",
    "plan",
    "run_shard",
]

STAGE = Stage(
    *SEEDS,
    reads=("poses", "annotations", "views", "torso_basis", "joint_limits"),
    writes=("seeds",),
    parameters=SeedsParameters,
    plan=plan,
    run_shard=run_shard,
    check_study=check_study,
    meaning="3D pose pairs from which chains start",
    needs="takes of two people that are not held out ([[ingest.takes]], ingest.held_out), "
    "annotations of two people ([[ingest.annotations]], seeds.num_lifted), or seeds.files",
)
