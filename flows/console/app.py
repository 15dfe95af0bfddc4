"""The program `pasdedeux`: loads the command that is called, and turns an error into a sentence and an exit code.

Each command is imported when it is called, because most of them import half of the science.
"""

from __future__ import annotations

import importlib
import traceback
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import typer
import typer.core
from typer import Option

from flows.console.context import Context, app, echo, say
from flows.signals import ended_as_by_ctrl_c
from pasdedeux.plain_text import visible

if TYPE_CHECKING:
    from tasks.graph import Graph

_DONE, _FAILED, _BAD_INPUT, _INTERRUPTED = 0, 1, 2, 130

# The base class of typer's usage errors. typer bundles its own click, so it cannot be imported by name.
_UsageError: Any = typer.BadParameter.__mro__[typer.BadParameter.__mro__.index(Exception) - 1]


GROUPS: dict[str, dict[str, str]] = {
    "Build": {
        "run": "Build a study: compute missing and stale artifacts.",
        "plan": "List what a run would compute and why, by stage and partition; nothing is started.",
        "study": "List, show and write studies; explain their keys.",
        "rerun": "Rebuild a finished run or a version of a dataset in another store and compare artifact by artifact.",
        "restart": "Start new chains from a draw.",
        "deploy": "Deploy a study to a Prefect server, as a build that runs on a schedule or on request.",
    },
    "Look": {
        "status": "Show the contents of a store: its studies, their verdicts, its runs and its size.",
        "view": "Look at takes, draws, pairs, reconstructions and variants in a browser.",
        "show": "Print the columns, first rows and lineage of a reference.",
        "diff": "Compare two finished runs or two versions of datasets; only differences are shown, scores last.",
    },
    "Your own files": {
        "check": "Check motion of two people from any source, and show the worst.",
        "annotate": "Annotate every frame of a film.",
        "reconstruct": "Reconstruct 3D motion of people from film or 2D keypoints, with a study's projection database.",
        "retarget": "Retarget a take to other bodies, keep its contacts, and write it on its own skeletons.",
        "complete": "Fill in the unknown joints of a 3D pair, such as one from a depth camera.",
        "generate": "Sample new bodies for person B, and the motion of both, from a trained model.",
        "fetch": "Download freely available motion capture, and networks of detectors.",
    },
    "Datasets": {
        "curate": "Accept or reject a variant, draw, seed, lifted pair, take, sequence or reconstructed motion.",
        "export": "Export the rows of a reference to files, with units, licence and credits.",
        "dataset": "Name built artifacts as immutable versions, and move them.",
    },
    "Operate": {
        "verify": "Read every file of the store and compare it with its manifest; exit code 1 if anything is wrong.",
        "gc": "Delete unneeded artifacts of a store; without --yes, only list them.",
        "doctor": "Check the installation; exit code 1 if something is missing.",
        "bench": "Measure kernels or whole commands against a plain implementation; needs a checkout.",
    },
}
"""First line of each command's help. `--help` lists the commands in these groups without importing their modules."""

COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}


class Program(typer.core.TyperGroup):
    """A group of commands that knows only their names and summaries until one is called."""

    def __init__(self, *, commands: dict[str, Any], **attributes: Any) -> None:
        known = {name: typer.core.TyperCommand(name, help=summary) for name, summary in COMMANDS.items()}
        super().__init__(commands={**known, **commands}, **attributes)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the commands in their groups."""
        for heading, group in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl(list(group.items()))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Import the module of the command that is called."""
        if args[0] in COMMANDS:
            importlib.import_module(f"flows.console.{args[0]}")
            self.commands = typer.main.get_group(app).commands
        return super().resolve_command(ctx, args)


def run_command_line(arguments: Sequence[str] | None = None, *, graph: Graph | None = None) -> int:
    """Run one command and return the exit code; a traceback is printed only with `--debug`."""
    context = Context(given_graph=graph)
    try:
        with ended_as_by_ctrl_c():
            code = app(args=None if arguments is None else list(arguments), obj=context, standalone_mode=False)
    except _UsageError as error:
        error.message = visible(error.message)
        error.show()
        return _BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        code = _INTERRUPTED
    except Exception as error:  # noqa: BLE001 - the outermost place: every error becomes a sentence
        from tasks.shards import ShardError

        if context.is_debug:
            echo("".join(traceback.format_exception(error)), err=True)
            if isinstance(error, ShardError):
                echo(error.trace, err=True)
        else:
            say(f"error: {_sentence(error)}".split("\n"), err=True)
        return exit_code_of(error)
    if code == _INTERRUPTED:
        # Python warns later, when it collects calls of Prefect that were interrupted.
        warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)
        echo("interrupted; the same command continues the work", err=True)
    return code if isinstance(code, int) else _DONE  # `typer.Exit` returns its code


def exit_code_of(error: BaseException) -> int:
    """Return 2 for input that the user can correct, 1 for failed work."""
    from flows.planning import PlanError
    from flows.study_files import StudyError
    from pasdedeux.errors import InputError
    from storage_schema import StorageError
    from tasks.graph import GraphError

    if isinstance(error, StudyError | PlanError | GraphError | InputError | FileNotFoundError | PermissionError):
        return _BAD_INPUT
    if isinstance(error, StorageError) and error.is_input:
        return _BAD_INPUT
    return _FAILED


def _sentence(error: BaseException) -> str:
    from flows.planning import PlanError
    from flows.study_files import StudyError
    from pasdedeux.errors import PasdedeuxError
    from storage_schema import StorageError
    from tasks.graph import GraphError
    from tasks.shards import ClusterError, ShardError

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
        from storage_schema.provenance import code_version

        echo(f"pasdedeux {code_version()}")
        raise typer.Exit


@app.callback(cls=Program)
def options(
    context: typer.Context,
    debug: bool = Option(False, "--debug", help="Show the traceback of an error."),
    version: bool = Option(False, "--version", help="Print the version.", callback=_say_version, is_eager=True),
) -> None:
    """Build large, checked datasets of two people in close contact.

    A study (a TOML file) says what is built; a store (a folder) keeps what was built.  Run the same command again after
    a change, a crash or an interruption: only missing results are computed.

    \b
      pasdedeux run                              the built-in duets, into ./store
      pasdedeux run --set chains.num_draws=2000  the same with another parameter
      pasdedeux plan                             what a run would compute, and why
      pasdedeux study new my.toml --from a.bvh --from b.bvh
      pasdedeux run my.toml
    """
    context.obj.is_debug = debug
