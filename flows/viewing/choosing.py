"""Accepting and rejecting: the file of choices as the viewer and `curate` change it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tasks.curation import Choice, read_choices, write_choices

UNDECIDED = "undecided"


class Choosing:
    """A file of choices, read again before each change: two people, or a person and an editor, lose nothing.

    Raises:
        InputError: The file holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        read_choices(self.path)

    def about(self, table: str, name: str) -> Choice | None:
        """Return what was chosen, whatever the content was."""
        return read_choices(self.path).get(f"{table} {name}")

    def words(self, table: str, name: str, content: str) -> str:
        """Return what was chosen in words, and whether it was of this content."""
        choice = self.about(table, name)
        if choice is None:
            return UNDECIDED
        said = f"{choice.decision}ed{f': {choice.reason}' if choice.reason else ''}"
        return said if choice.content == content else f"{said} (it had other content then: choose again)"

    def decide(
        self, decision: Literal["accept", "reject", "undo"], table: str, name: str, content: str, reason: str = ""
    ) -> str:
        """Write a choice, or forget it, and say so."""
        choices = read_choices(self.path)
        if decision == "undo":
            choices.pop(f"{table} {name}", None)
        else:
            choice = Choice(decision, table, name, content, reason)
            choices[choice.about] = choice
        write_choices(self.path, choices.values())
        return f"{table} {name}: {UNDECIDED if decision == 'undo' else f'{decision}ed'}; {len(choices)} in {self.path}"
