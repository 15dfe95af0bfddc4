"""The command line `pasdedeux`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from pasdedeux.threads import use_one_thread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tasks.graph import Graph

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None, *, graph: Graph | None = None) -> None:
    """Run the command line and exit with its code: 0 done, 1 failed work, 2 bad input, 130 interrupted.

    Imports happen only in this call, because Dask workers import this package by its entry point.
    """
    use_one_thread()
    try:
        from flows.console.app import run_command_line
    except KeyboardInterrupt:  # imports take the first second
        sys.stderr.write("interrupted; the same command continues the work\n")
        raise SystemExit(130) from None
    raise SystemExit(run_command_line(arguments, graph=graph))
