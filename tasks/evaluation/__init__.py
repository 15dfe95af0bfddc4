"""Evaluation: a shard per topic and item scores what the stages made; the last assembles report and card."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from pydantic import create_model

from storage_schema import ArtifactRef, Store
from tasks.evaluation import (
    augmentation,
    chains,
    clips,
    coverage,
    detector,
    downstream,
    film,
    generation,
    leave_one_out,
    lifting,
    models,
    realism,
    reconstruction,
    report,
    sets,
    takes,
    unseen_views,
    views,
)
from tasks.evaluation.topic import EVALUATION, Topic, run_topic
from tasks.stage import EarlyPlan, Parameters, Shard, Stage, StageInputs

__all__ = ["STAGE", "TOPICS", "evaluation_stage"]

TOPICS: tuple[Topic[Any], ...] = (
    takes.TOPIC,
    film.TOPIC,
    clips.TOPIC,
    views.TOPIC,
    chains.TOPIC,
    sets.TOPIC,
    coverage.TOPIC,
    leave_one_out.TOPIC,
    lifting.TOPIC,
    reconstruction.TOPIC,
    detector.TOPIC,
    unseen_views.PARALLEL_VIEWS,
    augmentation.TOPIC,
    models.TOPIC,
    realism.TOPIC,
    generation.TOPIC,
    downstream.RECOGNITION,
    downstream.PREDICTION,
)
"""Every topic, in the order of the page."""


def evaluation_stage(topics: Sequence[Topic[Any]]) -> Stage:
    """Return the stage that answers these topics: it reads their tables, and its keys are those of their settings."""
    settings = dict.fromkeys(topic.settings for topic in topics if topic.settings is not Parameters)
    return Stage(
        *EVALUATION,
        reads=tuple(dict.fromkeys(table for topic in topics for table in topic.reads) | dict.fromkeys(report.READS)),
        writes=("scores", "verdicts"),
        parameters=create_model(
            "EvaluationParameters", __base__=(report.PageSettings, *settings), __doc__="What is scored and shown."
        ),
        plan=partial(_plan, tuple(topics)),
        run_shard=partial(_run_shard, tuple(topics)),
        meaning="Scores everything against ground truth and baselines; writes the report and the dataset card.",
        needs="results to score or to show",
        early=tuple(EarlyPlan(topic.plan, reads=topic.reads) for topic in topics),
    )


def _plan(topics: Sequence[Topic[Any]], inputs: StageInputs, parameters: report.PageSettings) -> list[Shard]:
    """Plan the topics there is something for, and the report over them."""
    planned = [shard for topic in topics for shard in topic.plan(inputs, parameters)]
    return [*planned, report.plan(inputs, parameters, planned)] if planned else []


def _run_shard(topics: Sequence[Topic[Any]], shard: Shard, store: Store) -> ArtifactRef:
    """Score one topic, or assemble the report."""
    if shard.partition == report.PARTITION:
        return report.run_shard(topics, shard, store)
    return run_topic(next(topic for topic in topics if topic.name == shard.partition), shard, store)


STAGE = evaluation_stage(TOPICS)
