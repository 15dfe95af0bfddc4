"""What a format is in which the store gives out what it holds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from storage_schema import ArtifactRef, Reference, Store

__all__ = ["Export", "ExportFormat", "names_pairs", "write_text"]


@dataclass(frozen=True)
class Export:
    """What is to be given out.

    Args:
        store: Store that holds it.
        text: The reference as it was given.
        reference: The reference.
        refs: The artifacts that it names.
    """

    store: Store
    text: str
    reference: Reference
    refs: tuple[ArtifactRef, ...]


class ExportFormat(ABC):
    """One format of files that go out.  Licence and credits are written beside the files for all of them.

    Attributes:
        writes: What it can write, in words, after "allowed are".
    """

    writes: ClassVar[str] = "all tables"

    def can_write(self, reference: Reference) -> bool:
        """Tell whether it can hold what a reference names; everything unless a format says otherwise."""
        return True

    @abstractmethod
    def write(self, export: Export, out: Path) -> Iterable[Path]:
        """Write the files into a folder that is there, and return them.

        Lengths, axes, rate and joint names are in the files or their format fixes them: nothing leaves without units.
        """


def names_pairs(reference: Reference) -> bool:
    """Tell whether a reference names pairs of one moment: seeds, or one draw."""
    return reference.table == "seeds" or (reference.table == "draws" and reference.row is not None)


def write_text(path: Path, text: str) -> Path:
    """Write a text file and return its path."""
    path.write_text(text, encoding="utf-8")
    return path
