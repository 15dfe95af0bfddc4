"""`study`: lists and shows studies, explains their keys, writes new ones."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from flows.console import options
from flows.console.annotate import DetectionsOption, DetectOption, KeysOption, film_source
from flows.console.context import answer, app, echo, graph_of, say
from flows.console.display import format_table
from flows.console.study_new import write_new_study
from flows.staleness import shorten_text
from flows.study import load_study
from flows.study_files import HEAD, PUBLISH, StudyError, read_study_tree, shipped_studies, study_text
from flows.study_keys import study_keys
from pasdedeux.errors import InputError
from tasks.graph import Graph
from tasks.ingest.film.detector_files import fetched_detectors
from tasks.ingest.film.readers import is_film

_group = typer.Typer(
    help="List, show and write studies; explain their keys.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(_group, name="study")


@_group.command("list")
def show_all(context: typer.Context, as_json: options.Json = False) -> None:
    """List the studies that ship, and what motion each needs."""
    graph = graph_of(context)
    studies = [_describe(name, graph) for name in shipped_studies()]
    header = ("name", "what it is", "stages", "data it needs")
    rows = [(d["name"], d["title"], _stage_words(d["stages"], graph), d["data"]) for d in studies]
    answer(studies, format_table(header, rows, text_columns=range(4)), as_json=as_json)


@_group.command()
def show(
    context: typer.Context,
    name: Annotated[str, Argument(help="Name of a study that ships, or path of a .toml file.")],
    is_resolved: Annotated[bool, Option("--resolved", help="With inherited values and defaults.")] = False,
    settings: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Print the file of a study, or with --resolved every key with inherited values and defaults.

    \b
      pasdedeux study show duets
      pasdedeux study show sampling_paper --resolved
    """
    if not is_resolved and not as_json and not settings:
        echo(study_text(name, Path.cwd()).removesuffix("\n"))
        return
    study, _ = load_study(name, graph_of(context), settings=settings or ())
    if as_json:
        answer(study.resolved(), (), as_json=True)
    else:
        echo("\n".join(_toml_lines("", study.resolved())))


@_group.command()
def keys(
    context: typer.Context,
    section: Annotated[str | None, Argument(metavar="[SECTION]", help="One section; default: all.")] = None,
    as_json: options.Json = False,
) -> None:
    """Print every key that a study may have, with type, default, unit and meaning.

    \b
      pasdedeux study keys chains
      pasdedeux run --set chains.num_chains=4      a key on the command line

    In a key, N is a position in a list, counted from 0, and NAME a name of your own.
    """
    graph = graph_of(context)
    known_keys = study_keys(graph, section)
    if not known_keys:
        raise StudyError(
            [f"there is no section '{section}'; sections: {', '.join((HEAD, PUBLISH, *graph.shared, *graph.names))}"]
        )
    defaults = ["" if key.default is None else json.dumps(key.default, ensure_ascii=False) for key in known_keys]
    rows = [
        (key.name, key.type, "needed" if key.is_needed else shorten_text(default), key.unit, key.meaning)
        for key, default in zip(known_keys, defaults, strict=True)
    ]
    header = ("key", "type", "default", "unit", "meaning")
    answer([asdict(key) for key in known_keys], format_table(header, rows, text_columns=range(5)), as_json=as_json)


@_group.command()
def new(
    file: Annotated[Path, Argument(metavar="FILE", help="The study to write, a new .toml file.")],
    sources: Annotated[
        list[Path] | None,
        Option("--from", metavar="PATH", help="Motion of a person, 2D poses, or a film; may be given again."),
    ] = None,
    keys: KeysOption = None,
    detections: DetectionsOption = None,
    detect: DetectOption = None,
) -> None:
    """Write a commented study for the motion files of one take, a person each, for 2D poses, or for a film.

    \b
      pasdedeux study new waltz.toml                      over the built-in duets
      pasdedeux study new mine.toml --from a.bvh --from b.bvh   people of one take
      pasdedeux study new mine.toml --from openpose_json_folder
      pasdedeux study new mine.toml --from dance.mp4 --keys keys.xml
    """
    is_given = bool(keys or detections or detect)
    films = [path for path in sources or () if path.exists() and is_film(path) and (is_given or fetched_detectors())]
    if is_given and len(films) != 1:
        raise InputError(f"--keys, --detections and --detect are of one film, found {len(films)}; name it by --from")
    files = [path for path in sources or () if path not in films]
    say(write_new_study(file, files, [film_source(path, (), keys, detections, detect) for path in films]))
    echo(f"{file} is written; look through it, then: pasdedeux plan {file}")


def _describe(name: str, graph: Graph) -> dict[str, Any]:
    """Describe a study that ships; `stages` is None for one that only serves as a base."""
    tree = read_study_tree(name, Path.cwd()).values
    head, ingest = tree[HEAD], tree.get("ingest", {})
    pairs = [pair for pair in ingest.get("pairs", {}).values() if pair.get("takes") != []]
    folders = {pair["folder"]: set[str]() for pair in pairs}
    for pair in pairs:
        folders[pair["folder"]].update(pair["subjects"])
    data = [f"{folder}/ (subjects {', '.join(sorted(subjects))})" for folder, subjects in folders.items()]
    return {
        "name": name,
        "title": head["title"],
        "stages": list(head.get("stages", graph.names)) if "name" in head else None,
        "data": "; ".join(data) if data else "none, built-in duets",
    }


def _stage_words(stages: list[str] | None, graph: Graph) -> str:
    if stages is None:
        return "(to extend)"
    missing = [name for name in graph.names if name not in stages]
    if not missing:
        return "all"
    return f"all but {', '.join(missing)}" if len(missing) <= 2 else ", ".join(stages)


def _toml_lines(path: str, value: Any) -> list[str]:
    """Return a value as lines of TOML, each with the whole path of a key; unset keys are left out."""
    if isinstance(value, dict) and value:
        return [line for name, item in value.items() for line in _toml_lines(f"{path}.{_key(name)}".lstrip("."), item)]
    return [] if value is None else [f"{path} = {_toml(value)}"]


def _toml(value: Any) -> str:
    """Return a value as inline TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)
