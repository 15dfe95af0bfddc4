"""All keys of a study with type, default, unit and meaning, from the models of the sections."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from flows.study import PublishSettings, StudyHead, models_in, shared_keys
from flows.study_files import HEAD, PUBLISH
from pasdedeux.settings import NOT_A_KEY
from tasks.graph import Graph

_UNITS = {"m": "m", "s": "s", "px": "px", "deg": "deg", "rad": "rad", "hz": "Hz", "kg": "kg"}
_UNIT_WORDS = {"metres": "m", "seconds": "s", "pixels": "px", "degrees": "deg", "radians": "rad"}
_TYPES = {bool: "true or false", int: "whole number", float: "number", str: "text", Path: "path"}
_BOUNDS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


@dataclass(frozen=True)
class StudyKey:
    """A key: its path for `--set` (N is a position in a list, NAME a name of your own), and its description.

    `default` is a JSON value; `is_needed` means that there is none.
    """

    name: str
    type: str
    default: Any
    is_needed: bool
    unit: str
    meaning: str


def study_keys(graph: Graph, section: str | None = None) -> list[StudyKey]:
    """Return the keys of a section or of all, in the order of the models; none for an unknown section."""
    models: dict[str, type[BaseModel]] = {HEAD: StudyHead, PUBLISH: PublishSettings, **graph.shared}
    elsewhere: set[str] = set()
    for stage in graph.stages:
        models[stage.name] = stage.parameters
        elsewhere |= {f"{stage.name}.{key}" for key in shared_keys(stage.parameters, graph.shared.values())}
    keys = (key for name, model in models.items() if section in (None, name) for key in _keys_of(model, name, {}))
    return [key for key in keys if key.name not in elsewhere]


def _keys_of(model: type[BaseModel], path: str, places: dict[type[BaseModel], str]) -> Iterator[StudyKey]:
    """Yield the keys of a table; keys of a model that occurs again in the section are listed once."""
    again: dict[str, list[str]] = {}
    for name, field in model.model_fields.items():
        if field.json_schema_extra is NOT_A_KEY:
            continue
        place, kind = f"{path}.{name}", _declaring(model, name)
        first = places.setdefault(kind, path)
        if first != path:
            again.setdefault(first, []).append(name)
            continue
        default = to_jsonable_python(field.get_default(call_default_factory=True), fallback=str)
        yield StudyKey(
            name=place,
            type=_type_words(field.annotation) + _bounds(field),
            default=None if field.is_required() or isinstance(field.default, BaseModel) else default,
            is_needed=field.is_required(),
            unit=_unit(name, field.description or ""),
            meaning=field.description or "",
        )
        for deeper, inner_model in models_in(field.annotation, place):
            yield from _keys_of(inner_model, deeper, places)
    for first, names in again.items():
        yield StudyKey(
            f"{path}.*", f"as {first}.*", None, is_needed=False, unit="", meaning=f"The same keys: {', '.join(names)}"
        )


def _declaring(model: type[BaseModel], name: str) -> type[BaseModel]:
    """Return the model that declares a field."""
    return next(kind for kind in model.__mro__ if name in vars(kind).get("__annotations__", {}))


def _type_words(annotation: Any) -> str:
    """Return the name of a type for readers of TOML."""
    origin, arguments = get_origin(annotation), [a for a in get_args(annotation) if a not in (Ellipsis, NoneType)]
    if origin is Literal:
        return " or ".join(to_jsonable_python(argument, fallback=str).__repr__() for argument in arguments)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_type_words(argument) for argument in arguments))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"table of {_type_words(arguments[1])} by name"
    if isinstance(origin, type) and issubclass(origin, Sequence):
        kinds = list(dict.fromkeys(_type_words(argument) for argument in arguments))
        number = "" if Ellipsis in get_args(annotation) or origin is list else f"{len(arguments)} "
        return f"list of {number}{', '.join(kinds)}"
    if origin is not None:  # Annotated
        return _type_words(arguments[0])
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return " or ".join(repr(member.value) for member in annotation)
    if annotation is Any:
        return "any value"
    return _TYPES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _bounds(field: FieldInfo) -> str:
    words = [
        f"{sign} {getattr(limit, name):g}"
        for limit in field.metadata
        for name, sign in _BOUNDS.items()
        if getattr(limit, name, None) is not None
    ]
    return f" {', '.join(words)}" if words else ""


def _unit(name: str, meaning: str) -> str:
    last = name.rsplit("_", 1)[-1]
    if last in _UNITS and last != name:
        return _UNITS[last]
    match = re.search(rf"(?:\bin|,) ({'|'.join(_UNIT_WORDS)})\b", meaning)
    return _UNIT_WORDS[match.group(1)] if match else ""
