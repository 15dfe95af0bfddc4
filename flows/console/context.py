"""What every command needs: the program, the graph of stages, the store, and output."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer import Option

from pasdedeux.plain_text import visible

if TYPE_CHECKING:
    from pydantic import BaseModel

    from storage_schema import Store
    from tasks.graph import Graph

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
"""The program. Modules of this package add their commands when they are imported, which is when one is called."""

_BUSY_S = 2.0
"""Work that takes longer prints that it continues."""


def key_option(model: type[BaseModel], key: str, *names: str, metavar: str | None = None) -> Any:
    """Return an option for a key of a study, with the description and the limits of its model."""
    field = model.model_fields[key]
    bounds = {
        name: getattr(bound, name) for bound in field.metadata for name in ("ge", "gt", "le") if hasattr(bound, name)
    }
    least = bounds.get("ge", 1e-6 if bounds.get("gt") == 0 else None)
    return Option(*names, metavar=metavar, min=least, max=bounds.get("le"), help=f"{field.description}.")


@dataclass
class Context:
    """State of one call of the command line."""

    given_graph: Graph | None = None
    is_debug: bool = False

    @cached_property
    def graph(self) -> Graph:
        """Return the graph of all stages."""
        from tasks.graph import load_graph

        return self.given_graph if self.given_graph is not None else load_graph()


def graph_of(context: typer.Context) -> Graph:
    """Return the graph of all stages of this call."""
    given = context.find_object(Context)
    assert given is not None
    return given.graph


def open_store(folder: Path) -> Store:
    """Return the store in a folder or bucket, which need not exist yet.

    Raises:
        NewerSchema, NotAStore: It cannot be one.
        RemoteError: The bucket does not answer.
    """
    from storage_schema import Store

    store = Store(folder)
    store.refresh()
    store.check_version()
    return store


def existing_store(folder: Path) -> Store:
    """Return the store in a folder or bucket, which must exist.

    Raises:
        UnknownReference: There is no store.
    """
    from storage_schema import UnknownReference

    store = open_store(folder)
    if not store.root.is_dir():
        raise UnknownReference(f"there is no store in {store}; name the folder of a store with --store")
    return store


def next_command(*words: str, store: Path, settings: Sequence[str] | None = None) -> str:
    """Return a command to paste, with the store and the settings of this one.

    >>> next_command("run", "duets", store=Path("my store"), settings=["chains.num_chains=4"])
    "pasdedeux run duets --store 'my store' --set chains.num_chains=4"
    """
    options = [part for setting in settings or () for part in ("--set", setting)]
    at = [] if store == Path("store") else ["--store", re.sub("^s3:/(?=[^/])", "s3://", str(store))]
    return shlex.join(["pasdedeux", *words, *at, *options])


def wrapped(line: str, width: int) -> list[str]:
    """Wrap a line at words to this width; continuation lines are indented by four more.

    >>> wrapped("  waltz: hands drift", 14)
    ['  waltz: hands', '      drift']
    """
    line = visible(line)
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    whole = textwrap.TextWrapper(width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return whole.wrap(line) or [""]


def echo(text: str, *, err: bool = False) -> None:
    """Print text on standard output or standard error; all commands print through this function.

    Control characters are escaped, so that names, notes and credits from others cannot control the terminal.
    """
    typer.echo(visible(text), err=err)


@contextmanager
def busy(words: str) -> Iterator[None]:
    """Print the work in progress and its duration on standard error, after 2 s, 4 s, 8 s and so on."""
    ended, started = threading.Event(), time.monotonic()

    def tell() -> None:
        wait_s = _BUSY_S
        while not ended.wait(wait_s):
            echo(f"{words}: {time.monotonic() - started:.0f} s", err=True)
            wait_s *= 2

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


def say(lines: Iterable[str], *, err: bool = False) -> None:
    """Print lines on standard output or standard error, wrapped at words for a terminal."""
    stream: Any = sys.stderr if err else sys.stdout
    stream = getattr(stream, "rich_proxied_file", stream)  # a progress display wraps the terminal and hides it
    width = shutil.get_terminal_size().columns if stream.isatty() else None
    for line in lines:
        echo(line if width is None else "\n".join(wrapped(line, width)), err=err)


def answer(value: Any, lines: Iterable[str], *, as_json: bool) -> None:
    """Print a result as JSON or as lines of text."""
    if as_json:
        echo(json.dumps(value, indent=1, ensure_ascii=False))
    else:
        say(lines)
