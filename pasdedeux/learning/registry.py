"""Every model by name, and trained models as a description and named arrays, in a store or a safetensors file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from pasdedeux.errors import InputError
from pasdedeux.learning.baselines import CopyModel, NaiveFkModel
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.model import Arrays, VariantModel
from pasdedeux.learning.ridge_adapted import RidgeAdaptedModel
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.window_vae import Action2MotionLikeModel, ActorLikeModel, PaperCvaeModel
from pasdedeux.settings import Settings, first_problem
from pasdedeux.skeletons import BODY22

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
"""Models that learn nothing; every result is compared with them."""

DEFAULT_MODELS = (CopyModel.name, NaiveFkModel.name, RidgeScaleModel.name)
"""Models trained by default, because it takes seconds, and to be beaten by others: the baselines and the closed form,
mixed over takes if a take is not learned from."""


def model_class(name: str) -> type[VariantModel]:
    """Return the class of a model.

    Raises:
        InputError: Unknown model.
    """
    if name not in MODELS:
        raise InputError(f"model '{name}' is not known; known models: {', '.join(MODELS)}")
    return MODELS[name]


class ModelDescription(Settings):
    """A trained model without its arrays: its name, its configuration, and the model that it builds on."""

    model: str
    config: dict[str, Any] = Field({})
    built_on: ModelDescription | None = None


def describe_model(model: VariantModel) -> ModelDescription:
    """Return the description that `load_model` needs besides the arrays."""
    built_on = None if model.built_on is None else describe_model(model.built_on)
    return ModelDescription(model=model.name, config=dict(model.config()), built_on=built_on)


def model_arrays(model: VariantModel) -> dict[str, npt.NDArray[Any]]:
    """Return all learned arrays of a model, with those of the model that it is built on under `built_on/`."""
    arrays = model.arrays()
    if model.built_on is not None:
        arrays |= {f"{_BUILT_ON}{name}": values for name, values in model_arrays(model.built_on).items()}
    return arrays


def load_model(description: ModelDescription, arrays: Arrays) -> VariantModel:
    """Return a trained model; ask it with `predict(VariantRequest(...))`.

    Raises:
        InputError: Unknown model, or settings or arrays that do not fit it or are not finite.
    """
    name, kind = description.model, model_class(description.model)
    own_arrays = {key: values for key, values in arrays.items() if not key.startswith(_BUILT_ON)}
    inner = {key.removeprefix(_BUILT_ON): values for key, values in arrays.items() if key.startswith(_BUILT_ON)}
    for key, values in own_arrays.items():
        if values.dtype not in (np.float32, np.float64):
            raise InputError(f"{name}: array '{key}' is of {values.dtype}, not float32 or float64")
        if not np.isfinite(values).all():
            raise InputError(f"{name}: array '{key}' has a value that is not finite")
    built_on = None if description.built_on is None else load_model(description.built_on, inner)
    try:
        return kind.restore(description.config, own_arrays, built_on)
    except ValidationError as error:
        raise InputError(f"{name}: its settings do not fit: {first_problem(error)}") from None


@dataclass(frozen=True)
class Weights:
    """A trained model, and the takes that it knows.

    Args:
        model: The model.
        takes: Content digest of each take that it was trained on, by the take's name.
    """

    model: VariantModel
    takes: Mapping[str, str] = field(default_factory=dict)


_VERSION = 1
"""Version of the files; a file without one has the first."""


class _Versioned(Settings, extra="ignore"):
    """The part of the metadata that every later version has, too."""

    version: int = _VERSION


class _Header(_Versioned, extra="forbid"):
    """The one entry of a file's metadata: JSON, so that its order is ours and the bytes are the same every time."""

    description: ModelDescription
    joints: str
    takes: dict[str, str]


def write_weights(weights: Weights) -> bytes:
    """Return a safetensors file: every array in its own type, and the description in the metadata.

    Raises:
        InputError: safetensors is not installed.
    """
    _require_safetensors()
    from safetensors.numpy import save

    header = _Header(
        description=describe_model(weights.model), joints=_joints(weights.model), takes=dict(weights.takes)
    )
    arrays = {name: np.ascontiguousarray(values) for name, values in model_arrays(weights.model).items()}
    return bytes(save(arrays, metadata={_KEY: json.dumps(header.model_dump(mode="json"), sort_keys=True)}))


def read_weights(data: bytes, what: str) -> Weights:
    """Read what `write_weights` wrote.

    Args:
        data: The file.
        what: Its name, for messages.

    Raises:
        InputError: It is no safetensors file or none of ours, of a newer version, is cut off, is of other joints, or
            its arrays are not those of its model.
    """
    _require_safetensors()
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])  # `load` has checked its length
        words = header["__metadata__"][_KEY]
        if (version := _Versioned.model_validate_json(words).version) > _VERSION:
            raise InputError(
                f"{what}: weights of format version {version}, from a newer pasdedeux; this one reads up to {_VERSION}"
            )
        stored = _Header.model_validate_json(words)
    except (SafetensorError, RecursionError, ValueError, TypeError, KeyError) as problem:
        reason = f"{type(problem).__name__}: {problem}".splitlines()[0][:120]
        raise InputError(
            f"{what}: these are no weights of a model that `export --format safetensors` wrote ({reason})"
        ) from None
    try:
        model = load_model(stored.description, arrays)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    if stored.joints != _joints(model):
        count = stored.joints.count(",") + 1
        raise InputError(f"{what}: weights of another topology, {count} joints: {stored.joints[:60]}")
    return Weights(model, stored.takes)


def _joints(model: VariantModel) -> str:
    return ",".join((model.skeleton or BODY22).joint_names)


def _require_safetensors() -> None:
    if find_spec("safetensors") is None:
        raise InputError("weights in files need safetensors, which is not installed: pip install 'pasdedeux[learning]'")


_BUILT_ON = "built_on/"
_KEY = "pasdedeux"
