"""The mechanics of a stage: its definition, facts, commits, random streams and sweeps."""

from tasks.stage.definition import EarlyPlan, Parameters, Shard, SourceFile, Stage, StageInputs, StageName, with_fields

__all__ = ["EarlyPlan", "Parameters", "Shard", "SourceFile", "Stage", "StageInputs", "StageName", "with_fields"]
