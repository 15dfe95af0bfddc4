"""Trained models as safetensors: arrays and text, nothing that runs when it is read; nothing here is ever unpickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np
from pydantic import TypeAdapter, ValidationError

from pasdedeux.errors import InputError
from pasdedeux.learning.model import VariantModel
from pasdedeux.learning.registry import load_model, model_arrays
from pasdedeux.skeletons import BODY22

_KEY = "pasdedeux"
"""The one entry of the file's metadata: JSON, so that its order is ours and the bytes are the same every time."""
_LARGEST_HEADER = 10_000_000


@dataclass(frozen=True)
class Weights:
    """A trained model, and the takes that it knows.

    Args:
        model: The model.
        takes: Content digest of each take that it was trained on, by the take's name.
    """

    model: VariantModel
    takes: Mapping[str, str] = field(default_factory=dict)


def write_weights(weights: Weights) -> bytes:
    """Return a safetensors file: every array in the type it has, and in the metadata what it is of.

    Raises:
        InputError: safetensors is not installed.
    """
    _require()
    from safetensors.numpy import save

    said = {
        "model": weights.model.name,
        "joints": _joints(weights.model),
        "takes": json.dumps(dict(weights.takes), sort_keys=True),
    }
    arrays = {name: np.ascontiguousarray(values) for name, values in model_arrays(weights.model).items()}
    return bytes(save(arrays, metadata={_KEY: json.dumps(said, sort_keys=True)}))


def read_weights(data: bytes, what: str) -> Weights:
    """Read what `write_weights` wrote.

    Args:
        data: The file.
        what: Its name, for messages.

    Raises:
        InputError: It is no safetensors file or none of ours, is cut off, is of other joints, or its arrays are not
            those of its model.
    """
    _require()
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(data)
        said = TypeAdapter(dict[str, str]).validate_json(json.loads(_header(data))["__metadata__"][_KEY])
        name, joints = said["model"], said["joints"]
        takes = TypeAdapter(dict[str, str]).validate_json(said["takes"])
    except (SafetensorError, ValidationError, RecursionError, ValueError, TypeError, KeyError) as problem:
        found = f"{type(problem).__name__}: {problem}".splitlines()[0][:120]
        raise InputError(
            f"{what}: these are no weights of a model that `export --format safetensors` wrote ({found})"
        ) from None
    try:
        model = load_model(name, arrays)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    if joints != _joints(model):
        raise InputError(f"{what}: weights of another topology, {joints.count(',') + 1} joints: {joints[:60]}")
    return Weights(model, takes)


def _joints(model: VariantModel) -> str:
    return ",".join((model.skeleton or BODY22).joint_names)


def _header(data: bytes) -> bytes:
    size = int.from_bytes(data[:8], "little")
    if size > _LARGEST_HEADER:
        raise ValueError(f"its header would be {size} bytes long")
    return data[8 : 8 + size]


def _require() -> None:
    if find_spec("safetensors") is None:
        raise InputError("weights in files need safetensors, which is not installed: pip install 'pasdedeux[learning]'")
