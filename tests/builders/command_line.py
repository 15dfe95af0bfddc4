"""The command line, called in this process: its exit code, and what it printed."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import pytest

from flows.console.app import run_command_line
from tasks.graph import Graph


@dataclass(frozen=True)
class Answer:
    """What one call of the command line gave."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The answer of `--json`."""
        return json.loads(self.out)


@dataclass(frozen=True)
class CommandLine:
    """The command line with the stages of the program, or with those of a graph.

    Args:
        words: What each command begins with.
        options: What each command ends with.
    """

    capsys: pytest.CaptureFixture[str]
    graph: Graph | None = None
    words: tuple[object, ...] = ()
    options: tuple[object, ...] = ()

    def of(self, *words: object) -> CommandLine:
        """Return the command that begins with these words."""
        return replace(self, words=(*self.words, *words))

    def at(self, store: object) -> CommandLine:
        """Return the commands on a store."""
        return replace(self, options=("--store", store))

    def __call__(self, *words: object, code: int = 0) -> Answer:
        """Run a command that must end with this exit code; return what it printed, without anything before."""
        self.capsys.readouterr()
        found = run_command_line([str(word) for word in (*self.words, *words, *self.options)], graph=self.graph)
        printed = self.capsys.readouterr()
        assert found == code, printed.err
        return Answer(found, printed.out, printed.err)

    def refusal(self, *words: object) -> str:
        """Return the error of a command that must be refused, with exit code 2."""
        return self(*words, code=2).err
