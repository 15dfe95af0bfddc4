"""Every table of the project, by name."""

from __future__ import annotations

from storage_schema.columns import Table
from storage_schema.tables.capture import ANNOTATIONS, CAMERAS, OBJECTS, POSES, TAKE_QUALITY, TAKES
from storage_schema.tables.lifted import IN_BETWEENS, LIFTED_PAIRS
from storage_schema.tables.products import (
    MODEL_STATES,
    MODELS,
    SCORES,
    TRAINING_LOG,
    VARIANT_FRAMES,
    VARIANT_QUALITY,
    VARIANTS,
    VERDICTS,
)
from storage_schema.tables.reconstruction import MOTIONS, PROJECTIONS
from storage_schema.tables.sampling import (
    CHAIN_INFO,
    CHAIN_STATES,
    DRAWS,
    JOINT_LIMITS,
    SEEDS,
    TORSO_BASIS,
    VIEWS,
)

__all__ = ["TABLES"]

TABLES: dict[str, Table] = {
    table.name: table
    for table in (
        TAKES,
        TAKE_QUALITY,
        POSES,
        OBJECTS,
        ANNOTATIONS,
        CAMERAS,
        TORSO_BASIS,
        JOINT_LIMITS,
        VIEWS,
        SEEDS,
        DRAWS,
        CHAIN_STATES,
        CHAIN_INFO,
        LIFTED_PAIRS,
        IN_BETWEENS,
        PROJECTIONS,
        MOTIONS,
        VARIANTS,
        VARIANT_QUALITY,
        VARIANT_FRAMES,
        MODELS,
        MODEL_STATES,
        TRAINING_LOG,
        SCORES,
        VERDICTS,
    )
}
