"""Learning: models that give a pair's motion for new body proportions, and the splits they are judged on."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from pasdedeux.errors import InputError
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
)
from pasdedeux.learning.ridge_adapted import RidgeAdaptedModel
from pasdedeux.learning.ridge_scale import RidgeScaleModel, RidgeSettings
from pasdedeux.learning.splits import SPLIT_NAMES, Split, SplitName, VariantKey, make_split
from pasdedeux.learning.start_net import StartNetModel
from pasdedeux.learning.torch_settings import has_torch

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
    "NaiveFkModel",
    "NoSettings",
    "RidgeAdaptedModel",
    "RidgeScaleModel",
    "RidgeSettings",
    "Split",
    "SplitName",
    "StartNetModel",
    "Trained",
    "Training",
    "TrainingItem",
    "VariantKey",
    "VariantModel",
    "VariantRequest",
    "has_torch",
    "load_model",
    "make_split",
    "model_arrays",
    "model_class",
]

MODELS: dict[str, type[VariantModel]] = {
    model.name: model
    for model in (
        CopyModel,
        NaiveFkModel,
        RidgeScaleModel,
        RidgeAdaptedModel,
        MeshRefineModel,
        StartNetModel,
    )
}
"""Every model, by name: a new one is a file with a `VariantModel` and a line here (and its import)."""

BASELINES = (CopyModel.name, NaiveFkModel.name)
"""Models that learn nothing and stand beside every result."""

DEFAULT_MODELS = (CopyModel.name, NaiveFkModel.name, RidgeScaleModel.name)
"""What is trained where nothing is asked for: what takes seconds."""


def model_class(name: str) -> type[VariantModel]:
    """Return the class of a model.

    Raises:
        InputError: Unknown model.
    """
    if name not in MODELS:
        raise InputError(f"model '{name}' is not known; known models: {', '.join(MODELS)}")
    return MODELS[name]


def model_arrays(model: VariantModel) -> dict[str, npt.NDArray[Any]]:
    """Return everything a model knows, with what it is built on under `on:<model>/`."""
    arrays = dict(model.arrays())
    if model.built_on is not None:
        inner = model_arrays(model.built_on)
        arrays |= {f"{_BUILT_ON}{model.built_on.name}/{name}": values for name, values in inner.items()}
    return arrays


def load_model(name: str, arrays: Arrays) -> VariantModel:
    """Return a trained model from its name and `model_arrays`; ask it with `predict(VariantRequest(...))`.

    Raises:
        InputError: Unknown model, or arrays that do not fit it.
    """
    own = {key: values for key, values in arrays.items() if not key.startswith(_BUILT_ON)}
    inner: dict[str, dict[str, npt.NDArray[Any]]] = {}
    for key in set(arrays) - set(own):
        kind, _, rest = key.removeprefix(_BUILT_ON).partition("/")
        inner.setdefault(kind, {})[rest] = arrays[key]
    built_on = [load_model(kind, found) for kind, found in inner.items()]
    return model_class(name).from_arrays(own, *built_on[:1])


_BUILT_ON = "on:"
