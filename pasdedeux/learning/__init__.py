"""Learning: models that give a pair's motion for new body proportions, and the splits they are judged on."""

from __future__ import annotations

from pasdedeux.learning.baselines import CopyModel, NaiveFkModel
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.model import (
    Arrays,
    Items,
    LogEntry,
    NoSettings,
    Trained,
    Training,
    TrainingItem,
    VariantModel,
    VariantRequest,
    mapped_item,
    mapped_source,
)
from pasdedeux.learning.registry import (
    BASELINES,
    DEFAULT_MODELS,
    MODELS,
    ModelDescription,
    Weights,
    describe,
    load_model,
    model_arrays,
    model_class,
    read_weights,
    write_weights,
)
from pasdedeux.learning.ridge_adapted import RidgeAdaptedModel
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.settings import has_torch
from pasdedeux.learning.splits import SPLIT_NAMES, Split, SplitName, VariantKey, make_split

__all__ = [
    "BASELINES",
    "DEFAULT_MODELS",
    "MODELS",
    "SPLIT_NAMES",
    "Arrays",
    "CopyModel",
    "Items",
    "LogEntry",
    "MeshRefineModel",
    "ModelDescription",
    "NaiveFkModel",
    "NoSettings",
    "RidgeAdaptedModel",
    "RidgeScaleModel",
    "Split",
    "SplitName",
    "Trained",
    "Training",
    "TrainingItem",
    "VariantKey",
    "VariantModel",
    "VariantRequest",
    "Weights",
    "describe",
    "has_torch",
    "load_model",
    "make_split",
    "mapped_item",
    "mapped_source",
    "model_arrays",
    "model_class",
    "read_weights",
    "write_weights",
]
