"""Stage `priors`: torso basis and joint limits, learned from the takes named as prior takes."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from pasdedeux.cameras.torso import TorsoBasis, learn_torso_basis
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.choreography.duets import duet_torso_basis
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.rows.takes import read_motion
from tasks.stage import Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.committing import commit
from tasks.stage.facts import PriorFacts, SequenceFacts, TakeFacts, facts_of, merge_takes

PRIORS = StageName("priors", 4)

BUILT_IN_DUETS = "built-in duets"
BODY_PROPORTIONS = "body proportions"
"""Origin of a default torso basis."""
MIN_POSES = 10
"""With fewer poses than this, a torso basis would be one person in one pose, so the default is used instead."""
_FRAMES_PER_TAKE = 2000
"""Frames of each take that are learned from, evenly spread, because neighbours in time are alike."""


class PriorsParameters(Parameters):
    """Constants of learning torsos and joint angles from prior takes; no study needs to set them."""


class PriorsShard(Parameters):
    """Parameters of the one shard of the priors."""

    default_basis: str


def plan(inputs: StageInputs, parameters: PriorsParameters) -> list[Shard]:
    """Plan one shard over all prior takes; a take that is held out is never among them."""
    takes = [
        manifest
        for manifest in inputs.of("poses")
        if (facts := TakeFacts.of(manifest)).is_prior and not facts.is_held_out
    ]
    parameters_of_shard = PriorsShard(default_basis=default_origin(inputs.of("poses")))
    return [PRIORS.shard(inputs, "body", "priors", parameters_of_shard, {"poses": takes})]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Learn the torso basis, widen the published joint limits; without prior takes both are the defaults."""
    options = shard.options(PriorsShard)
    parts = [_read_poses(store, ref) for ref in shard.refs("poses")]
    poses = np.concatenate(parts) if parts else np.zeros((0, PAIR17.num_joints, 3))
    is_learned = len(poses) >= MIN_POSES
    origin = options.default_basis
    basis = learn_torso_basis(poses) if is_learned else default_torso_basis(origin)
    published = JointLimits.published()
    limits = published
    if is_learned:
        limits = published.widened(poses, name="prior takes")
    verdict = _verdict(poses, limits, published, origin)
    facts = PriorFacts(
        takes=merge_takes(*(store.manifest(ref) for ref in shard.refs("poses"))),
        num_poses=len(poses),
        origin="prior takes" if is_learned else f"{origin}: {_why_default(poses)}",
        explained_variance=float(basis.explained_variance.sum()),
        valid_share=verdict.value if len(poses) else None,
    )
    tables = {"torso_basis": _basis_columns(basis), "joint_limits": _limit_columns(limits)}
    return commit(shard, store, tables=tables, facts=facts, verdict=verdict)


def _why_default(poses: np.ndarray) -> str:
    return f"{len(poses)} prior poses are too few" if len(poses) else "no prior take is named"


def _verdict(poses: np.ndarray, limits: JointLimits, published: JointLimits, origin: str) -> Verdict:
    """Return the share of the prior poses within the joint limits, beside the share within the published ones."""
    level, reason = Level.PASS, ""
    if not len(poses):
        reason = f"no prior take is named: published joint limits and a torso basis of {origin}"
    elif len(poses) < MIN_POSES:
        level, reason = Level.WARN, f"{len(poses)} prior poses are too few to learn from; {MIN_POSES} are needed"
    return Verdict(
        level,
        reason,
        figure="share of prior poses within the joint limits",
        value=float(limits.is_valid(poses).mean()) if len(poses) else math.nan,
        baseline=float(published.is_valid(poses).mean()) if len(poses) else math.nan,
        baseline_name="published joint limits",
    )


def default_origin(shown: Iterable[Manifest]) -> str:
    """Return the origin of the default basis: the built-in duets, where these artifacts show none of them.

    For the duets themselves it comes from body proportions alone, so that nothing is evaluated on its training data.
    """
    return (
        BODY_PROPORTIONS
        if any(
            facts.is_built_in
            for manifest in shown
            if isinstance(facts := facts_of(manifest), TakeFacts | SequenceFacts)
        )
        else BUILT_IN_DUETS
    )


def default_torso_basis(origin: str) -> TorsoBasis:
    """Return the torso basis of studies that name no prior takes, learned from what `default_origin` gave."""
    make = duet_torso_basis if origin == BUILT_IN_DUETS else proportions_torso_basis
    return make()


def read_torso_basis(store: Store, refs: Iterable[ArtifactRef]) -> TorsoBasis:
    """Return the torso basis among these artifacts, or the default for the motion that they show."""
    manifests = [store.manifest(ref) for ref in refs]
    for manifest in manifests:
        if "torso_basis" in manifest.tables:
            table = store.read(manifest.ref, "torso_basis")
            return TorsoBasis(
                mean_m=np.asarray(table["torso_m"][0]),
                components_m=np.asarray(table["torso_m"][1:]),
                standard_deviation_m=np.asarray(table["standard_deviation_m"][1:]),
                explained_variance=np.asarray(table["explained_variance"][1:]),
            )
    return default_torso_basis(default_origin(manifests))


def read_limits(store: Store, refs: Iterable[ArtifactRef]) -> JointLimits:
    """Return the joint limits among these artifacts; the published ones where no stage wrote any."""
    for ref in refs:
        if "joint_limits" in store.manifest(ref).tables:
            table = store.read(ref, "joint_limits")
            order = np.argsort(np.asarray(table["angle_id"]), kind="stable")
            return JointLimits(
                lower_rad=np.asarray(table["lower_rad"], dtype=np.float64)[order],
                upper_rad=np.asarray(table["upper_rad"], dtype=np.float64)[order],
                source=tuple(str(table["source"][row]) for row in order),
            )
    return JointLimits.published()


def _read_poses(store: Store, ref: ArtifactRef) -> np.ndarray:
    """Return poses (row, 17, 3) of every person of a take, evenly spread over its frames."""
    poses = read_motion(store, ref, "pair17_m")["pair17_m"]
    chosen = poses[evenly_spread(len(poses), _FRAMES_PER_TAKE)]
    return chosen.swapaxes(0, 1).reshape(-1, *chosen.shape[2:])


def _basis_columns(basis: TorsoBasis) -> dict[str, object]:
    return {
        "component": np.arange(1 + len(basis.components_m)),
        "torso_m": np.concatenate([basis.mean_m[None], basis.components_m]),
        "standard_deviation_m": np.concatenate([[0.0], basis.standard_deviation_m]),
        "explained_variance": np.concatenate([[0.0], basis.explained_variance]),
    }


def _limit_columns(limits: JointLimits) -> dict[str, object]:
    return {
        "angle_id": np.arange(len(ANGLES)),
        "joint": [angle.joint for angle in ANGLES],
        "angle": [angle.angle for angle in ANGLES],
        "lower_rad": limits.lower_rad,
        "upper_rad": limits.upper_rad,
        "source": list(limits.source),
    }


STAGE = Stage(
    *PRIORS,
    reads=("poses",),
    writes=("torso_basis", "joint_limits"),
    parameters=PriorsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="torso basis and joint limits from prior takes",
)
