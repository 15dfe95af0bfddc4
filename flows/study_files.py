"""Files of studies, shipped or the user's: reads them with the studies that they extend, and applies overrides."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from pasdedeux.errors import InputError
from tasks.files.user_files import read_text_file

ENVIRONMENT_PREFIX = "PASDEDEUX_SET__"
HEAD = "study"
"""Section of a study with its name, the study that it extends, and its stages."""
PUBLISH = "publish"
"""Section of a study with the dataset that a finished run becomes, and the verdicts required."""

_NOT_INHERITED = ("name", "title")


class StudyError(Exception):
    """A study cannot be used; `problems` has one clear sentence for each thing that is wrong."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__(list(problems))
        self.problems = list(problems)

    def __str__(self) -> str:
        """Return the problems, one a line."""
        return "\n".join(self.problems)


@dataclass
class StudyTree:
    """The merged, unchecked values of a study: its file, the studies that it extends, and overrides.

    Args:
        label: Name of the study in messages.
        values: Its tables.
        folders: Folders for relative paths, by key; the longest key at or above a path counts.
    """

    label: str
    values: dict[str, Any] = field(default_factory=dict)
    folders: dict[tuple[str, ...], Path] = field(default_factory=dict)

    def folder_of(self, path: Sequence[str]) -> Path:
        """Return the folder that a relative path at this key starts from."""
        return next(self.folders[key] for i in range(len(path), -1, -1) if (key := tuple(path[:i])) in self.folders)

    def merge(self, values: Mapping[str, Any], folder: Path, path: tuple[str, ...] = ()) -> None:
        """Merge tables into this one key by key; lists and single values are replaced."""
        node: Any = self.values
        for step in path:
            node = node[step]
        for name, value in values.items():
            if isinstance(value, dict) and isinstance(node.get(name), dict):
                self.merge(value, folder, (*path, name))
            else:
                node[name] = deepcopy(value)
                self._say_folder((*path, name), folder)

    def override(self, settings: Sequence[str], environment: Mapping[str, str], here: Path) -> list[str]:
        """Apply overrides, those of the environment first, and return their errors."""
        problems: list[str] = []
        for path, value, origin in _overrides(settings, environment, problems):
            problem = _put(self.values, path, value)
            if problem:
                problems.append(f"{origin}: {problem}")
            self._say_folder(path, here)
        head = self.values.get(HEAD)
        if isinstance(head, dict) and "extends" in head:
            problems.append(f"{HEAD}.extends: can be said in a study's file only")
        return problems

    def _say_folder(self, path: tuple[str, ...], folder: Path) -> None:
        self.folders = {key: old for key, old in self.folders.items() if key[: len(path)] != path}
        self.folders[path] = folder


def shipped_studies() -> dict[str, str]:
    """Return the text of every study that ships, by name."""
    folder = resources.files("flows").joinpath("studies")
    files = sorted((item for item in folder.iterdir() if item.name.endswith(".toml")), key=lambda item: item.name)
    return {item.name.removesuffix(".toml"): item.read_text(encoding="utf-8") for item in files}


def study_text(name_or_path: str, here: Path) -> str:
    """Return the text of a study that ships, or of a file; StudyError where there is none."""
    return _find(name_or_path, here, here, "")[0]


def read_study_tree(name_or_path: str, here: Path) -> StudyTree:
    """Read a study that ships (by name) or a file (by path), with all studies that it extends.

    Relative paths start at the file that states them, those of a shipped study at `here`. Name, title and `[publish]`
    are not inherited.

    Raises:
        StudyError: There is no such study, it is not TOML, or it extends itself or a missing study.
    """
    tree = StudyTree(name_or_path, folders={(): here})
    _merge_study(tree, name_or_path, here, here, ())
    return tree


def unknown(path: str, known: Sequence[str], name: str | None = None) -> str:
    """Return the message for an unknown name, with the nearest known name or all of them."""
    near = difflib.get_close_matches(name or path, known, n=1, cutoff=0.5)
    if near:
        return f"{path}: unknown; did you mean {near[0]}?"
    return f"{path}: unknown; known: {', '.join(known) or 'none'}"


def _merge_study(tree: StudyTree, said: str, here: Path, folder: Path, children: tuple[str, ...]) -> None:
    """Merge a study into a tree, after the studies that it extends.

    Args:
        tree: The tree.
        said: Name or path of the study, as stated.
        here: Start of the relative paths of shipped studies.
        folder: Start of `said`, if that is a relative path.
        children: The studies that extend this one, from the first.
    """
    context = f"study {children[-1]}: {HEAD}.extends: " if children else ""
    text, folder, label = _find(said, here, folder, context)
    if label in children:
        raise StudyError([f"study {children[0]} extends itself: {' -> '.join([*children, label])}"])
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise StudyError([f"{context}study {said} is not valid TOML: {error}"]) from None
    head = values.get(HEAD)
    if isinstance(head, dict):
        parent = head.pop("extends", None)
        for name in _NOT_INHERITED if children else ():
            head.pop(name, None)
        if children:
            values.pop(PUBLISH, None)
        if isinstance(parent, str):
            _merge_study(tree, parent, here, folder, (*children, label))
        elif parent is not None:
            raise StudyError([f"study {said}: {HEAD}.extends: should be the name or the path of one study"])
    tree.merge(values, folder)


def _find(said: str, here: Path, folder: Path, context: str) -> tuple[str, Path, str]:
    """Return a study's text, the folder of its relative paths, and its name in messages."""
    shipped = shipped_studies()
    if said in shipped:
        return shipped[said], here, said
    path = folder / Path(said).expanduser()
    looks_like_path = said.endswith(".toml") or "/" in said or os.sep in said
    if not looks_like_path and not path.is_file():
        raise StudyError([unknown(f"{context}study '{said}'", tuple(shipped), said) + " (or name a .toml file)"])
    try:
        return read_text_file(path), path.resolve().parent, str(path.resolve())
    except InputError as error:
        raise StudyError([f"{context}study {str(error).replace(str(path), said)}"]) from None


def _overrides(
    settings: Sequence[str], environment: Mapping[str, str], problems: list[str]
) -> Iterator[tuple[tuple[str, ...], Any, str]]:
    """Yield the overrides, weakest first, as (path, value, origin)."""
    for variable in sorted(environment):
        if variable.startswith(ENVIRONMENT_PREFIX):
            path = tuple(variable.removeprefix(ENVIRONMENT_PREFIX).lower().split("__"))
            yield path, toml_value(environment[variable]), variable
    for setting in settings:
        name, equals, text = setting.partition("=")
        path = tuple(name.strip().split("."))
        if not equals or not all(path) or len(path) < 2:
            problems.append(f"--set {setting}: expected section.name=value, for example chains.num_chains=4")
            continue
        yield path, toml_value(text), f"--set {setting}"


def toml_value(text: str) -> Any:
    """Parse a value as TOML (4, 0.5, true, [1, 2], "text"); anything else is text."""
    try:
        return tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _put(tree: dict[str, Any], path: tuple[str, ...], value: Any) -> str:
    """Set a value at a path of tables and list positions; return the problem, or an empty text."""
    node: Any = tree
    for depth, step in enumerate(path, start=1):
        key: str | int = step
        if isinstance(node, list):
            if not step.isdigit() or int(step) >= len(node):
                return f"{'.'.join(path[:depth])}: expected a position from 0 to {len(node) - 1}"
            key = int(step)
        elif not isinstance(node, dict):
            return f"{'.'.join(path[: depth - 1])} is a single value, so {'.'.join(path[:depth])} cannot be set"
        if depth == len(path):
            node[key] = value
        else:
            node = node.setdefault(key, {}) if isinstance(node, dict) else node[key]
    return ""
