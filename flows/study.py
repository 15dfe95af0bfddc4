"""A study: one TOML file that says what is built, as frozen models, one section per stage."""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny, ValidationError, field_validator

from flows.renamed import renamed_key
from tasks.graph import Graph
from tasks.stage import Parameters

__all__ = ["Study", "StudyError", "StudyHead", "load_study", "shipped_studies", "study_from_tree"]

ENVIRONMENT_PREFIX = "PASDEDEUX_SET__"
_HEAD = "study"
M = TypeVar("M", bound=BaseModel)
V = TypeVar("V")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


class StudyError(Exception):
    """A study cannot be used; `problems` has one clear sentence for each thing that is wrong."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__(list(problems))
        self.problems = list(problems)

    def __str__(self) -> str:
        """Return the problems, one a line."""
        return "\n".join(self.problems)


class StudyHead(BaseModel):
    """The `[study]` section: what the study is called, its seed, and the stages it stops at."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(description="Name of the study: letters, digits, '-' and '_'; runs are recorded under it")
    title: str = Field(
        "", description="One line for people, shown where studies are listed; the report has `evaluation.title`"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="Seed of every random stream of the study")
    stages: tuple[str, ...] | None = Field(None, description="Stages to build; all of them when not given")

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        if not _NAME.fullmatch(name):
            raise ValueError("a study's name has letters, digits, '-' and '_' only")
        return name


class Study(BaseModel):
    """A study with everything resolved: defaults filled in, overrides applied, paths absolute."""

    model_config = ConfigDict(frozen=True)

    head: StudyHead
    parameters: Mapping[str, SerializeAsAny[Parameters]]

    @property
    def name(self) -> str:
        """Return the study's name."""
        return self.head.name

    def resolved(self) -> dict[str, Any]:
        """Return the whole study as JSON values, as it could have been written in its file."""
        sections = {name: model.model_dump(mode="json") for name, model in self.parameters.items()}
        return {_HEAD: self.head.model_dump(mode="json"), **sections}


def shipped_studies() -> dict[str, str]:
    """Return the text of every study that comes with the package, by name."""
    folder = resources.files("flows").joinpath("studies")
    files = sorted((item for item in folder.iterdir() if item.name.endswith(".toml")), key=lambda item: item.name)
    return {item.name.removesuffix(".toml"): item.read_text(encoding="utf-8") for item in files}


def load_study(
    name_or_path: str,
    graph: Graph,
    *,
    settings: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> tuple[Study, Graph]:
    """Read a study that ships (by name) or a file (by path), with its overrides; give it with the graph of its stages.

    What is said first wins: `settings` ("a.b=c"), the environment (`PASDEDEUX_SET__A__B=c`), the file, the defaults.
    Relative paths are relative to the study's file; those of settings, of the environment and of a shipped study to
    `folder` (the current one).

    Raises:
        StudyError: Lists every problem: no such study, not TOML, unknown keys, values that are not allowed.
    """
    here = (folder or Path.cwd()).resolve()
    text, base, label = _find(name_or_path, here)
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise StudyError([f"study {label} is not valid TOML: {error}"]) from None
    return study_from_tree(tree, graph, label=label, base=base, here=here, settings=settings, environment=environment)


def study_from_tree(
    tree: dict[str, Any],
    graph: Graph,
    *,
    label: str,
    base: Path,
    here: Path,
    settings: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
) -> tuple[Study, Graph]:
    """Make a study of what its file says, section by section, with its overrides, as `load_study` does.

    Args:
        tree: The file's tables; overrides are put into it.
        graph: All stages.
        label: What to call the study in messages.
        base: Folder that the file's relative paths start from.
        here: Folder that those of overrides start from.
        settings: Overrides, "a.b=c".
        environment: Environment with further ones, the process's own when None.

    Raises:
        StudyError: Lists every problem.
    """
    problems: list[str] = []
    overridden: list[tuple[str, ...]] = []
    for path, value, origin in _overrides(settings, os.environ if environment is None else environment, problems):
        problem = _put(tree, path, value)
        if problem:
            problems.append(f"{origin}: {problem}")
        overridden.append(path)
    known = (_HEAD, *graph.names)
    for name in tree:
        if name not in known:
            renamed = renamed_key([name])
            problems.append(_unknown(name, known) if renamed is None else f"{name}: {renamed}")
    head = _validate(StudyHead, tree.get(_HEAD, {}), _HEAD, problems)
    parameters: dict[str, Parameters] = {}
    for stage in graph.stages:
        section = _validate(stage.parameters, tree.get(stage.name, {}), stage.name, problems)
        if section is not None:
            parameters[stage.name] = _with_absolute_paths(section, (stage.name,), base, here, overridden)
    if head is not None and head.stages is not None:
        problems.extend(
            _unknown(f"{_HEAD}.stages: '{name}'", graph.names, name) for name in head.stages if name not in graph.names
        )
    if problems or head is None:
        raise StudyError([f"study {label}: {problem}" for problem in problems])
    wanted = graph if head.stages is None else graph.only(head.stages)
    return Study(head=head, parameters={name: parameters[name] for name in wanted.names}), wanted


def _find(name_or_path: str, here: Path) -> tuple[str, Path, str]:
    """Return a study's text, the folder its relative paths start from, and what to call it in messages."""
    shipped = shipped_studies()
    if name_or_path in shipped:
        return shipped[name_or_path], here, name_or_path
    path = here / Path(name_or_path).expanduser()
    looks_like_path = name_or_path.endswith(".toml") or "/" in name_or_path or os.sep in name_or_path
    if not looks_like_path and not path.is_file():
        raise StudyError([_unknown(f"study '{name_or_path}'", tuple(shipped), name_or_path) + "; or give a .toml file"])
    try:
        return path.read_text(encoding="utf-8"), path.resolve().parent, name_or_path
    except FileNotFoundError:
        raise StudyError([f"study file {name_or_path} does not exist"]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError([f"study file {name_or_path} cannot be read: {error}"]) from None


def _overrides(
    settings: Sequence[str], environment: Mapping[str, str], problems: list[str]
) -> Iterable[tuple[tuple[str, ...], Any, str]]:
    """Return the overrides, weakest first, as (path, value, where it was said)."""
    for variable in sorted(environment):
        if variable.startswith(ENVIRONMENT_PREFIX):
            path = tuple(variable.removeprefix(ENVIRONMENT_PREFIX).lower().split("__"))
            yield path, _value(environment[variable]), variable
    for setting in settings:
        name, equals, text = setting.partition("=")
        path = tuple(name.strip().split("."))
        if not equals or not all(path) or len(path) < 2:
            problems.append(f"--set {setting}: expected section.name=value, for example chains.num_chains=4")
            continue
        yield path, _value(text), f"--set {setting}"


def _value(text: str) -> Any:
    """Read a value as TOML would (4, 0.5, true, [1, 2], "text"); anything else is text as it stands."""
    try:
        return tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _put(tree: dict[str, Any], path: tuple[str, ...], value: Any) -> str:
    """Put a value at a path of tables and list positions; the problem in words, or nothing."""
    node: Any = tree
    for depth, step in enumerate(path):
        is_last = depth == len(path) - 1
        where = ".".join(path[: depth + 1])
        if isinstance(node, list):
            if not step.isdigit() or int(step) >= len(node):
                return f"{where}: expected a position from 0 to {len(node) - 1}"
            if is_last:
                node[int(step)] = value
            else:
                node = node[int(step)]
        elif isinstance(node, dict):
            if is_last:
                node[step] = value
            else:
                node = node.setdefault(step, {})
        else:
            return f"{'.'.join(path[:depth])} is a single value, so {where} cannot be set"
    return ""


def _validate(model: type[M], values: Any, section: str, problems: list[str]) -> M | None:
    """Build a section's model, or add what is wrong with it in words."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        for item in error.errors():
            problems.append(_in_words(model, section, item))
        return None


def _in_words(model: type[BaseModel], section: str, item: Any) -> str:
    """Say one validation error as a sentence with the full path of the key."""
    location = [str(step) for step in item["loc"]]
    path = ".".join([section, *location])
    renamed = renamed_key([section, *item["loc"]], item["input"])
    if renamed is not None:
        return f"{path}: {renamed}"
    if item["type"] == "extra_forbidden":
        return _unknown(path, _known_names(model, item["loc"][:-1]), location[-1])
    if item["type"] == "missing":
        return f"{path}: missing, a value is needed"
    message = str(item["msg"]).removeprefix("Value error, ")
    if message.startswith(f"{section}."):
        return message
    if message.startswith("Input should"):
        message = message.replace("Input should", "should", 1)
    found = item["input"]
    return f"{path}: {message}" + ("" if isinstance(found, dict | BaseModel) else f"; found {found!r}")


def _unknown(path: str, known: Sequence[str], name: str | None = None) -> str:
    """Say that a name is unknown, with the nearest known name or all of them."""
    near = difflib.get_close_matches(name or path, known, n=1, cutoff=0.5)
    if near:
        return f"{path}: unknown; did you mean {near[0]}?"
    return f"{path}: unknown; known: {', '.join(known) or 'none'}"


def _known_names(model: type[BaseModel], location: Sequence[str | int]) -> tuple[str, ...]:
    """Return the field names allowed at a place inside a model, through lists, tables and unions."""
    models = [model]
    for step in location:
        inner = [m for m in models if str(step) in m.model_fields]
        if inner:
            models = [found for m in inner for found in _models_in(m.model_fields[str(step)].annotation)]
    return tuple(dict.fromkeys(name for m in models for name in m.model_fields))


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return every model class that an annotation mentions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for argument in get_args(annotation) for found in _models_in(argument)]


def _with_absolute_paths(
    value: V, path: tuple[str, ...], base: Path, here: Path, overridden: list[tuple[str, ...]]
) -> V:
    """Return a validated value with every relative path in it made absolute."""
    if isinstance(value, Path):
        start = here if any(path[: len(other)] == other for other in overridden) else base
        return start / value.expanduser()
    if isinstance(value, BaseModel):
        changed = {
            name: _with_absolute_paths(getattr(value, name), (*path, name), base, here, overridden)
            for name in type(value).model_fields
        }
        return value.model_copy(update={k: v for k, v in changed.items() if v is not getattr(value, k)})
    if isinstance(value, Mapping):
        return {k: _with_absolute_paths(v, (*path, str(k)), base, here, overridden) for k, v in value.items()}  # type: ignore[return-value]
    if isinstance(value, list | tuple):
        items = [_with_absolute_paths(v, (*path, str(i)), base, here, overridden) for i, v in enumerate(value)]
        return type(value)(items)
    return value
