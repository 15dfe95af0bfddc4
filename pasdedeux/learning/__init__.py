"""Learning: models that give a pair's motion for new body proportions, and the splits they are judged on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.learning.baselines import CopyModel, NaiveFkModel
from pasdedeux.learning.model import Items, LogEntry, TrainingItem, VariantModel, VariantRequest
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.splits import SPLIT_NAMES, Split, SplitName, VariantKey, make_split

__all__ = [
    "BASELINES",
    "MODELS",
    "SPLIT_NAMES",
    "CopyModel",
    "Items",
    "LogEntry",
    "NaiveFkModel",
    "RidgeScaleModel",
    "Split",
    "SplitName",
    "TrainingItem",
    "VariantKey",
    "VariantModel",
    "VariantRequest",
    "load_model",
    "make_split",
    "model_class",
]

MODELS: dict[str, type[VariantModel]] = {
    model.name: model
    for model in (
        CopyModel,
        NaiveFkModel,
        RidgeScaleModel,
    )
}
"""Every model, by name: a new one is a file with a `VariantModel` and a line here (and its import)."""

BASELINES = tuple(name for name, model in MODELS.items() if not model.is_trained)
"""Models that learn nothing and stand beside every result."""


def model_class(name: str) -> type[VariantModel]:
    """Return the class of a model.

    Raises:
        InputError: Unknown model.
    """
    if name not in MODELS:
        raise InputError(f"model '{name}' is not known; known models: {', '.join(MODELS)}")
    return MODELS[name]


def load_model(name: str, arrays: Mapping[str, npt.NDArray[np.float64]]) -> VariantModel:
    """Return a trained model from its name and arrays; ask it with `predict(VariantRequest(...))`.

    Raises:
        InputError: Unknown model, or arrays that do not fit it.
    """
    return model_class(name).from_arrays(arrays)
