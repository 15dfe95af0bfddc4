"""A study: one TOML file that defines a build, as frozen models, one section per stage."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny, ValidationError, field_validator

from flows.study_files import HEAD, PUBLISH, StudyError, StudyTree, read_study_tree, unknown
from pasdedeux.errors import InputError
from pasdedeux.settings import Settings
from tasks.files.curation import CurationSettings, choices_in
from tasks.graph import Graph
from tasks.stage import Parameters
from tasks.stage.sweep import SweptParameters

M = TypeVar("M", bound=BaseModel)
V = TypeVar("V")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


class StudyHead(BaseModel):
    """The `[study]` section: name, seed, and stages to build."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(description="Name of the study: letters, digits, '-' and '_'; runs are recorded under it")
    extends: str | None = Field(
        None,
        exclude=True,
        description="Study whose keys hold where this one does not say otherwise: one that ships, or a path from here",
    )
    title: str = Field(
        "", description="One line for people, where studies are listed and on the report without `evaluation.title`"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="Seed of every random stream of the study")
    stages: tuple[str, ...] | None = Field(None, description="Stages to build; all of them when not given")

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        if not _NAME.fullmatch(name):
            raise ValueError("a study's name has letters, digits, '-' and '_' only")
        return name


class PublishSettings(Settings):
    """The `[publish]` section: a run of the whole study becomes a version of a dataset unless a verdict prevents it."""

    name: str | None = Field(
        None, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="Name of the dataset; the study's when not given"
    )
    required: tuple[str, ...] | None = Field(
        None,
        description="Verdicts that must not fail, by the names that `status` gives ('augmentation', 'evaluation: "
        "lifting'); those on the products in the version when not given",
    )


class Study(BaseModel):
    """A study with everything resolved: defaults filled in, overrides applied, paths absolute.

    `asked` are the stages that its files name, by a section or in `stages`, and that must make something. `shared` are
    the sections that several stages share, also contained in the parameters of each. `publish` says how a finished run
    is published; None: not at all.
    """

    model_config = ConfigDict(frozen=True)

    head: StudyHead
    parameters: Mapping[str, SerializeAsAny[Parameters]]
    shared: Mapping[str, SerializeAsAny[Settings]] = {}
    asked: frozenset[str] = frozenset()
    publish: PublishSettings | None = None

    @property
    def name(self) -> str:
        """Return the study's name."""
        return self.head.name

    def resolved(self) -> dict[str, Any]:
        """Return the whole study as JSON values, as it could stand in a file."""
        sections = {name: section.model_dump(mode="json") for name, section in self.shared.items()}
        for name in self.parameters:
            sections |= self.sections_of(name)
        published = {} if self.publish is None else {PUBLISH: self.publish.model_dump(mode="json")}
        return {HEAD: self.head.model_dump(mode="json"), **sections, **published}

    def sections_of(self, stage: str) -> dict[str, dict[str, Any]]:
        """Return the settings of a stage as JSON values: its own section and the shared ones."""
        parameters = self.parameters[stage]
        shared = {name: section for name, section in self.shared.items() if isinstance(parameters, type(section))}
        sections = {name: section.model_dump(mode="json") for name, section in shared.items()}
        keys = shared_keys(type(parameters), map(type, shared.values()))
        return {stage: parameters.model_dump(mode="json", exclude=keys), **sections}


def load_study(
    name_or_path: str,
    graph: Graph,
    *,
    settings: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> tuple[Study, Graph]:
    """Load a study that ships (by name) or a file (by path) with overrides, and return it with the graph of its stages.

    Precedence, highest first: `settings` ("a.b=c"), the environment (`PASDEDEUX_SET__A__B=c`), the file, the study that
    it extends, the defaults. Tables are merged, lists replaced. Relative paths start at the file that states them;
    those of settings, of the environment and of a shipped study at `folder` (the current one).

    Raises:
        StudyError: Lists every problem: no such study, not TOML, unknown keys, values that are not allowed.
    """
    here = (folder or Path.cwd()).resolve()
    return study_from_tree(
        read_study_tree(name_or_path, here), graph, here=here, settings=settings, environment=environment
    )


def study_from_tree(
    tree: StudyTree,
    graph: Graph,
    *,
    here: Path,
    settings: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
) -> tuple[Study, Graph]:
    """Validate the values of a study with its overrides, as `load_study` does.

    Args:
        tree: The values of its files; overrides are merged into it.
        graph: All stages.
        here: Folder that the relative paths of overrides start from.
        settings: Overrides, "a.b=c".
        environment: Environment with further overrides; that of the process if None.

    Raises:
        StudyError: Lists every problem.
    """
    sections = tuple(tree.values)
    problems = tree.override(settings, os.environ if environment is None else environment, here)
    known = (HEAD, PUBLISH, *graph.shared, *graph.names)
    problems += [unknown(name, known) for name in tree.values if name not in known]
    head = _validate(StudyHead, tree.values.get(HEAD, {}), HEAD, problems)
    shared = {name: _validate(model, tree.values.get(name, {}), name, problems) for name, model in graph.shared.items()}
    if (curation := shared.get("curation")) is not None:
        shared["curation"] = _with_choices(curation, tree, problems)
    parameters: dict[str, Parameters] = {}
    for stage in graph.stages:
        values = tree.values.get(stage.name, {})
        if head is not None and head.title and "title" in stage.parameters.model_fields and isinstance(values, dict):
            values = {"title": head.title, **values}
        for name, settings_of in shared.items():
            if settings_of is not None and isinstance(values, dict):
                taken = shared_keys(stage.parameters, [type(settings_of)])
                moved = sorted(taken.intersection(values))
                problems += [f"{stage.name}.{key}: one value serves every stage: say {name}.{key}" for key in moved]
                values = {**values, **settings_of.model_dump(include=taken)}
        section = _validate(stage.parameters, values, stage.name, problems)
        for name, swept in section.swept_values().items() if isinstance(section, SweptParameters) else ():
            _validate(stage.parameters, swept, f"{stage.name}.sweep.{name}", problems)
        if section is not None:
            parameters[stage.name] = _with_absolute_paths(section, (stage.name,), tree)
    if head is not None and head.stages is not None:
        problems.extend(
            unknown(f"{HEAD}.stages: '{name}'", graph.names, name) for name in head.stages if name not in graph.names
        )
    publish = _validate(PublishSettings, tree.values[PUBLISH], PUBLISH, problems) if PUBLISH in tree.values else None
    if not problems and head is not None:
        wanted = graph if head.stages is None else graph.only(head.stages)
        for number, name in enumerate((publish.required if publish is not None else None) or ()):
            if (judged := name.partition(":")[0]) not in wanted.names:
                problems.append(unknown(f"{PUBLISH}.required.{number}: '{name}'", wanted.names, judged))
    if problems or head is None:
        raise StudyError([f"study {tree.label}: {problem}" for problem in problems])
    asked = frozenset(wanted.names).intersection([*sections, *(head.stages or ())])
    return (
        Study(
            head=head,
            parameters={name: parameters[name] for name in wanted.names},
            shared={
                name: said for name, said in shared.items() if said is not None and name in {*wanted.shared, *sections}
            },
            asked=asked,
            publish=publish,
        ),
        wanted,
    )


def study_from_record(sections: Mapping[str, Any], stages: Sequence[str], graph: Graph) -> tuple[Study, Graph]:
    """Restore the study of a record for these stages; the environment is ignored, and nothing is published.

    Args:
        sections: The result of `Study.resolved`.
        stages: The stages to build.
        graph: All stages.

    Raises:
        StudyError: This version of the program does not accept the record; lists every problem.
    """
    head = {**sections[HEAD], "stages": list(stages)}
    values = {name: section for name, section in {**sections, HEAD: head}.items() if name != PUBLISH}
    if "curation" in values:  # the recorded choices stay
        values["curation"] = {**values["curation"], "file": None}
    tree = StudyTree(f"{head['name']} (as it is on record)", values, {(): Path.cwd()})
    study, wanted = study_from_tree(tree, graph, here=Path.cwd(), environment={})
    return study.model_copy(update={"asked": frozenset()}), wanted


def _with_choices(curation: Settings, tree: StudyTree, problems: list[str]) -> Settings:
    """Return the section of choices with the current content of its file."""
    assert isinstance(curation, CurationSettings)
    if curation.file is None:
        return curation
    path = tree.folder_of(("curation", "file")) / curation.file.expanduser()
    try:
        return curation.model_copy(update={"file": path, "choices": choices_in(path)})
    except InputError as error:
        problems.append(f"curation.file: {error}")
        return curation


def shared_keys(parameters: type[BaseModel], shared: Iterable[type[BaseModel]]) -> set[str]:
    """Return the keys of a stage's parameters that are in shared sections."""
    return {name for model in shared if issubclass(parameters, model) for name in model.model_fields}


def _validate(model: type[M], values: Any, section: str, problems: list[str]) -> M | None:
    """Build a section's model, or add its errors to `problems`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        for item in error.errors():
            problems.append(_in_words(model, section, item))
        return None


def _in_words(model: type[BaseModel], section: str, item: Any) -> str:
    """Return a validation error as a sentence with the full path of the key."""
    location = [str(step) for step in item["loc"]]
    path = ".".join([section, *location])
    if item["type"] == "extra_forbidden":
        return unknown(path, _known_names(model, item["loc"][:-1]), location[-1])
    if item["type"] == "missing" and path == f"{HEAD}.name":
        return f"{path}: missing; a study without a name is not run, it is there for others to extend"
    if item["type"] == "missing":
        return f"{path}: missing, a value is needed"
    message = str(item["msg"]).removeprefix("Value error, ")
    if message.startswith(f"{section}."):
        return message
    if message.startswith("Input should"):
        message = message.replace("Input should", "should", 1)
    if item["type"] in ("model_type", "dict_type"):
        message = "should be a table"
    given = item["input"]
    if item["type"] in ("tuple_type", "list_type"):
        message = "should be a list" + (
            f", such as {json.dumps([given])}" if isinstance(given, str | int | float) else ""
        )
    message = message.replace("Tuple should", "the list should").replace(" item after validation,", " item,")
    return f"{path}: {message}" + ("" if isinstance(given, dict | BaseModel) else f"; found {given!r}")


def _known_names(model: type[BaseModel], location: Sequence[str | int]) -> tuple[str, ...]:
    """Return the field names allowed at a place inside a model, through lists, tables and unions."""
    models = [model]
    for step in location:
        inner = [m for m in models if str(step) in m.model_fields]
        if inner:
            models = [inner_model for m in inner for _, inner_model in models_in(m.model_fields[str(step)].annotation)]
    return tuple(dict.fromkeys(name for m in models for name in m.model_fields))


def models_in(annotation: Any, path: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield the models inside a type, each with the path of its keys."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield path, annotation
        return
    origin, arguments = get_origin(annotation), get_args(annotation)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        yield from models_in(arguments[1], f"{path}.NAME")
    elif isinstance(origin, type) and issubclass(origin, Sequence):
        for argument in arguments:
            yield from models_in(argument, f"{path}.N")
    else:
        for argument in arguments:
            yield from models_in(argument, path)


def _with_absolute_paths(value: V, path: tuple[str, ...], tree: StudyTree) -> V:
    """Return a validated value with every relative path in it made absolute."""
    if isinstance(value, Path):
        return tree.folder_of(path) / value.expanduser()
    if isinstance(value, BaseModel):
        changed = {
            name: _with_absolute_paths(getattr(value, name), (*path, name), tree) for name in type(value).model_fields
        }
        return value.model_copy(update={k: v for k, v in changed.items() if v is not getattr(value, k)})
    if isinstance(value, Mapping):
        return {k: _with_absolute_paths(v, (*path, str(k)), tree) for k, v in value.items()}  # type: ignore[return-value]
    if isinstance(value, list | tuple):
        return type(value)([_with_absolute_paths(v, (*path, str(i)), tree) for i, v in enumerate(value)])
    return value
