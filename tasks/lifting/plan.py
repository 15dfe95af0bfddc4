"""Which annotations are lifted: a shard for each artifact of annotated pairs that has views."""

from __future__ import annotations

from pasdedeux.sampling.density import PRIOR_ONLY
from storage_schema import Manifest
from tasks.draw_sets import draw_manifests
from tasks.lifting.parameters import VERSION, LiftingParameters
from tasks.poses import num_persons
from tasks.stage import Shard, StageInputs, named_refs
from tasks.torso_bases import shares_takes


def plan(inputs: StageInputs, parameters: LiftingParameters) -> list[Shard]:
    """Plan a shard per artifact of annotated pairs that has views; none without draws."""
    draws = [one for one in draw_manifests(inputs) if one.facts.get("density") != PRIOR_ONLY]
    if not draws:
        return []
    views = {ref: manifest for manifest in inputs.of("views") for ref in manifest.inputs}
    return [
        _shard(inputs, parameters, annotated, views[annotated.ref], draws)
        for annotated in inputs.of("annotations")
        if annotated.ref in views and num_persons(annotated) >= 2
    ]


def _shard(
    inputs: StageInputs, parameters: LiftingParameters, annotated: Manifest, views: Manifest, draws: list[Manifest]
) -> Shard:
    """Plan one source of annotations; joint limits and a torso basis of other takes serve the baselines."""
    bases = [one for one in inputs.of("torso_basis") if not shares_takes(annotated, one)]
    return Shard(
        stage="lifting",
        version=VERSION,
        partition=annotated.partition,
        name=annotated.name,
        parameters=parameters,
        inputs=named_refs(
            annotations=[annotated],
            views=[views],
            draws=draws,
            joint_limits=inputs.of("joint_limits") if parameters.baselines else (),
            torso_basis=bases if parameters.baselines else (),
        ),
        seed=inputs.seed,
    )
