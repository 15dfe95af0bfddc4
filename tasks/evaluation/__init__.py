"""Evaluation: a shard per topic and item scores what the stages made; the last assembles report and card."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import Field

from storage_schema import ArtifactRef, Store
from tasks.evaluation import (
    augmentation,
    chains,
    clips,
    coverage,
    density,
    lifting,
    models,
    people,
    reconstruction,
    report,
    takes,
    unseen_views,
    views,
)
from tasks.evaluation.topic import STAGE_NAME, VERSION, TopicResult, commit_topic
from tasks.stage import Parameters, Shard, Stage, StageInputs

__all__ = ["STAGE", "EvaluationParameters"]


class EvaluationParameters(Parameters):
    """What is scored and shown."""

    title: str = Field("A dataset of close two-person motion", description="Title of the report and the card")
    description: str = Field(
        "Made with pasdedeux from the takes and annotations named in the study.",
        description="What the study makes, a sentence or two for the report and the card",
    )
    num_truth_pairs: int = Field(300, ge=1, description="Real pairs of each part that coverage is measured on, at most")
    num_judged_pairs: int = Field(
        0, ge=0, description="Real pairs of held-out takes that terms of the density are judged on; 0: none are judged"
    )
    num_curve_points: int = Field(12, ge=2, description="Points of the coverage curve")
    num_completed_pairs: int = Field(
        12, ge=0, description="Real pairs of each part whose joints are hidden and completed from draws; 0: none"
    )
    clip_seconds: float = Field(4.0, gt=0, le=60, description="Length of the overlay clips in seconds")
    clip_rate_hz: float = Field(12.5, gt=0, description="Frames per second of the overlay clips")
    unseen_views_deg: tuple[float, ...] = Field(
        (),
        description="Directions from which held-out takes are seen and reconstructed by every method: on the "
        "projection database's body by parallel rays, as in the paper on it, and on their own by a pinhole",
    )
    has_unseen_view_sweeps: bool = Field(
        False, description="Also at growing noise and with more and more joints missing, from the same directions"
    )
    num_crowd_views: int = Field(
        0, ge=0, description="Random views per take of two people that identities are followed through; 0: none"
    )
    has_left_out_clips: bool = Field(
        False, description="Each take of the projection database against the rest of it, from the same directions"
    )


_RUN: dict[str, Callable[[Shard, Store], TopicResult]] = {
    takes.TOPIC: takes.run,
    clips.TOPIC: clips.run,
    views.TOPIC: views.run,
    chains.TOPIC: chains.run,
    coverage.TOPIC: coverage.run,
    density.TOPIC: density.run,
    lifting.TOPIC: lifting.run,
    reconstruction.TOPIC: reconstruction.run,
    **dict.fromkeys(unseen_views.TOPICS, unseen_views.run),
    people.TOPIC: people.run,
    unseen_views.LEFT_OUT_TOPIC: unseen_views.run_left_out,
    augmentation.TOPIC: augmentation.run,
    models.TOPIC: models.run,
    report.TOPIC: report.run,
}


def plan(inputs: StageInputs, parameters: EvaluationParameters) -> list[Shard]:
    """Plan the topics there is something for, and the report over them."""
    topics = [
        *takes.shards(inputs),
        *clips.shards(inputs, seconds=parameters.clip_seconds, rate_hz=parameters.clip_rate_hz),
        *views.shards(inputs),
        *chains.shards(inputs),
        *coverage.shards(
            inputs, num_truth_pairs=parameters.num_truth_pairs, num_curve_points=parameters.num_curve_points
        ),
        *density.shards(inputs, num_judged_pairs=parameters.num_judged_pairs),
        *lifting.shards(inputs, num_completed_pairs=parameters.num_completed_pairs),
        *reconstruction.shards(inputs),
        *unseen_views.shards(
            inputs, yaws_deg=parameters.unseen_views_deg, has_sweeps=parameters.has_unseen_view_sweeps
        ),
        *unseen_views.left_out_shards(
            inputs, yaws_deg=parameters.unseen_views_deg, is_wanted=parameters.has_left_out_clips
        ),
        *people.shards(inputs, num_views=parameters.num_crowd_views),
        *augmentation.shards(inputs),
        *models.shards(inputs),
    ]
    if not topics:
        return []
    return [*topics, report.shard(inputs, topics, title=parameters.title, description=parameters.description)]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Score one topic, or assemble the report."""
    return commit_topic(shard, store, _RUN[shard.partition](shard, store))


STAGE = Stage(
    name=STAGE_NAME,
    version=VERSION,
    reads=(
        "takes",
        "poses",
        "annotations",
        "cameras",
        "torso_basis",
        "joint_limits",
        "views",
        "seeds",
        "draws",
        "chain_info",
        "lifted_pairs",
        "in_betweens",
        "projections",
        "codebook",
        "motions",
        "variants",
        "variant_quality",
        "models",
        "training_log",
    ),
    writes=("scores",),
    parameters=EvaluationParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Scores everything against truth and baselines; writes the report and the dataset card.",
)
