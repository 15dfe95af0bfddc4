"""`study` and `fetch`: where a study of one's own begins."""

from __future__ import annotations

import tomllib

import typer

from flows.console.context import JsonOption, print_json
from flows.study import shipped_studies

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Studies: those that ship, and new ones.", no_args_is_help=True, rich_markup_mode=None)
    group.command("list", help="List the studies that ship.")(show_all)
    group.command("show", help="Print a study that ships, to start your own from.")(show)
    app.add_typer(group, name="study")


def show_all(as_json: JsonOption = False) -> None:
    """List the studies that ship."""
    heads = {name: tomllib.loads(text).get("study", {}) for name, text in shipped_studies().items()}
    if as_json:
        print_json(heads)
        return
    for name, head in heads.items():
        typer.echo(f"{name:<16}{head.get('title', '')}")


def show(name: str) -> None:
    """Print a study that ships."""
    studies = shipped_studies()
    if name not in studies:
        raise typer.BadParameter(f"'{name}' does not ship; studies that do: {', '.join(studies)}")
    typer.echo(studies[name], nl=False)
