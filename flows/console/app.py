"""The command line's commands under one name, and what an error becomes: one sentence and an exit code."""

from __future__ import annotations

import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Any

import typer
import typer.core
from typer import Option

from flows.console import (  # noqa: F401 - a module adds its commands when it is imported
    annotate,
    compare,
    curate,
    datasets,
    deploy,
    draws,
    fetch,
    generate,
    reconstruct,
    retarget,
    run,
    show,
    stores,
    studies,
    this_machine,
    view,
)
from flows.console.context import Context, app
from flows.planning import PlanError
from flows.study_files import StudyError
from pasdedeux.errors import InputError, PasdedeuxError
from storage_schema import StorageError
from storage_schema.provenance import code_version
from tasks.graph import Graph, GraphError
from tasks.shards import ClusterError, ShardError

_DONE, _FAILED, _BAD_INPUT, _INTERRUPTED = 0, 1, 2, 130

# The class that typer's own usage errors share; typer carries its own click, so it cannot be imported by name.
_UsageError: Any = typer.BadParameter.__mro__[typer.BadParameter.__mro__.index(Exception) - 1]


def run_command_line(arguments: Sequence[str] | None = None, *, graph: Graph | None = None) -> int:
    """Run one command; gives the exit code and never lets an error out as a traceback unless asked to (`--debug`)."""
    context = Context(given_graph=graph)
    try:
        code = app(args=None if arguments is None else list(arguments), obj=context, standalone_mode=False)
    except _UsageError as error:
        error.show()
        return _BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        code = _INTERRUPTED
    except Exception as error:  # noqa: BLE001 - the outermost place: every error becomes a sentence
        if context.is_debug:
            traceback.print_exception(error, file=sys.stderr)
            if isinstance(error, ShardError):
                typer.echo(error.trace, err=True)
        else:
            typer.echo(f"error: {_sentence(error)}", err=True)
        return exit_code_of(error)
    if code == _INTERRUPTED:
        # Python warns of Prefect's calls that were cut off when it collects them, after this.
        warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)
        typer.echo("interrupted; the same command continues the work", err=True)
    return code if isinstance(code, int) else _DONE  # a command that raised `typer.Exit` gives its code


def exit_code_of(error: BaseException) -> int:
    """Return 2 for what the user can put right in what was given, 1 for work that failed."""
    if isinstance(error, StudyError | PlanError | GraphError | InputError | FileNotFoundError | PermissionError):
        return _BAD_INPUT
    if isinstance(error, StorageError) and error.is_input:
        return _BAD_INPUT
    return _FAILED


def _sentence(error: BaseException) -> str:
    if isinstance(error, StudyError):
        return "\n       ".join(error.problems)
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, PlanError | GraphError | PasdedeuxError | StorageError | ShardError | ClusterError):
        return str(error)
    if type(error).__module__.startswith("flows."):
        return str(error)
    return f"{type(error).__name__}: {error} (run `pasdedeux --debug ...` for the traceback)"


def _say_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"pasdedeux {code_version()}")
        raise typer.Exit


@app.callback()
def options(
    context: typer.Context,
    debug: bool = Option(False, "--debug", help="Show the traceback of an error."),
    version: bool = Option(False, "--version", help="Print the version.", callback=_say_version, is_eager=True),
) -> None:
    """Build large, checked datasets of two people in close contact.

    A study (a TOML file) says what is built; a store (a folder) keeps what was built.  Run the same command again after
    a change, a crash or an interruption: only what is not there yet is computed.

    \b
      pasdedeux run                              build the built-in duets into ./store
      pasdedeux run --set chains.num_draws=2000  the same with one parameter changed
      pasdedeux plan                             what a run would compute, and why; starts nothing
      pasdedeux study new my.toml --from a.bvh --from b.bvh
      pasdedeux run my.toml
    """
    context.obj.is_debug = debug
