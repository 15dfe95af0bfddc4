"""`study` and `fetch`: where a study of one's own begins."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated

import typer

from flows.console import fetch
from flows.console.context import JsonOption, print_json
from flows.study_files import shipped_studies

__all__ = ["register"]

_NEW = """Write a commented study to start from, with what the given files tell of themselves.

\b
  pasdedeux study new waltz.toml                               over the built-in duets
  pasdedeux study new mine.toml --from a.bvh --from b.bvh      two people of one take
  pasdedeux study new mine.toml --from openpose_json_folder
"""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Studies: those that ship, and new ones.", no_args_is_help=True, rich_markup_mode=None)
    group.command("list", help="List the studies that ship.")(show_all)
    group.command("show", help="Print a study that ships, to start your own from.")(show)
    group.command("new", help=_NEW)(new)
    app.add_typer(group, name="study")
    app.add_typer(fetch.app, name="fetch")


def show_all(as_json: JsonOption = False) -> None:
    """List the studies that ship."""
    heads = {name: tomllib.loads(text).get("study", {}) for name, text in shipped_studies().items()}
    if as_json:
        print_json(heads)
        return
    for name, head in heads.items():
        typer.echo(f"{name:<16}{head.get('title', '')}")


def new(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The study to write, a .toml file that is not there yet.")
    ],
    sources: Annotated[
        list[Path] | None,
        typer.Option(
            "--from", metavar="PATH", help="A motion file, a file of 2D poses, or a folder; may be given again."
        ),
    ] = None,
) -> None:
    """Write a commented study to start from."""
    from flows.console.study_new import write_new_study

    write_new_study(file, sources or [])
    typer.echo(f"{file} is written; look through it, then: pasdedeux plan {file}")


def show(name: str) -> None:
    """Print a study that ships."""
    studies = shipped_studies()
    if name not in studies:
        raise typer.BadParameter(f"'{name}' does not ship; studies that do: {', '.join(studies)}")
    typer.echo(studies[name], nl=False)
