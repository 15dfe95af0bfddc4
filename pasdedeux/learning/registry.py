"""Every model by name, and trained models as named arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.learning.baselines import CopyModel, NaiveFkModel
from pasdedeux.learning.class_vaes import Action2MotionLikeModel, ActorLikeModel
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.model import Arrays, VariantModel
from pasdedeux.learning.paper_cvae import PaperCvaeModel
from pasdedeux.learning.ridge_adapted import RidgeAdaptedModel
from pasdedeux.learning.ridge_scale import RidgeScaleModel

MODELS: dict[str, type[VariantModel]] = {
    model.name: model
    for model in (
        CopyModel,
        NaiveFkModel,
        RidgeScaleModel,
        RidgeAdaptedModel,
        MeshRefineModel,
        PaperCvaeModel,
        ActorLikeModel,
        Action2MotionLikeModel,
    )
}
"""Every model, by name: a new one is a file with a `VariantModel` and a line here (and its import)."""

BASELINES = (CopyModel.name, NaiveFkModel.name)
"""Models that learn nothing and stand beside every result."""

DEFAULT_MODELS = (CopyModel.name, NaiveFkModel.name, RidgeScaleModel.name)
"""What is trained where nothing is asked for, as it takes seconds, and what a model has to beat: the baselines and the
closed form, mixed over takes where a take is not learned from."""


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
        InputError: Unknown model, or arrays that do not fit it or are not finite.
    """
    own = {key: values for key, values in arrays.items() if not key.startswith(_BUILT_ON)}
    inner: dict[str, dict[str, npt.NDArray[Any]]] = {}
    for key in sorted(set(arrays) - set(own)):
        below, _, rest = key.removeprefix(_BUILT_ON).partition("/")
        if rest.count(_BUILT_ON) > len(MODELS):
            raise InputError(f"{name}: array '{key[:60]}' is of a model that builds on too many others")
        inner.setdefault(below, {})[rest] = arrays[key]
    kind = model_class(name)
    for key, values in own.items():
        if not np.isfinite(values).all():
            raise InputError(f"{name}: array '{key}' has a value that is not finite")
    built_on = [load_model(below, found) for below, found in inner.items()]
    return kind.from_arrays(own, *built_on[:1])


_BUILT_ON = "on:"
