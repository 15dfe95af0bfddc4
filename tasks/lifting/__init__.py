"""Stage `lifting`: annotations lifted to 3D by the draws that look like them, and the pairs between them."""

from tasks.lifting.parameters import VERSION, LiftingParameters
from tasks.lifting.plan import plan
from tasks.lifting.run import run_shard
from tasks.stage import Stage

__all__ = ["STAGE", "VERSION", "LiftingParameters", "plan", "run_shard"]

STAGE = Stage(
    name="lifting",
    version=VERSION,
    reads=("annotations", "views", "seeds", "draws", "joint_limits", "torso_basis"),
    writes=("lifted_pairs", "in_betweens"),
    parameters=LiftingParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="annotations lifted to 3D by the draws that look like them",
    needs="annotations of two people ([[ingest.annotations]]), and draws of a density "
    "beside prior_only (chains.densities) or grown seeds (seeds.num_grown)",
)
