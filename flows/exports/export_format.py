"""What a format is in which the store gives out what it holds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from storage_schema import ArtifactRef, Reference, Store

__all__ = ["Export", "ExportFormat", "FileNames", "RestPose", "Units", "names_pairs", "write_text"]

RestPose = Literal["source", "standing"]
Units = Literal["cm", "m", "source"]


@dataclass(frozen=True)
class Export:
    """What is to be given out.

    Args:
        store: Store that holds it.
        text: The reference as it was given.
        reference: The reference.
        refs: The artifacts that it names.
        rest_pose: Rest pose of the skeletons of takes and variants: the source's, or a standing T-pose.
        units: Lengths of their BVH files: centimetres, metres, or the units of each source's file.
    """

    store: Store
    text: str
    reference: Reference
    refs: tuple[ArtifactRef, ...]
    rest_pose: RestPose = "source"
    units: Units = "cm"


class ExportFormat(ABC):
    """One format of files that go out.  Licence and credits are written beside the files for all of them.

    Attributes:
        writes: What it can write, in words, after "allowed are".
        has_rest_pose: Whether it writes skeletons, so that their rest pose and units can be chosen.
    """

    writes: ClassVar[str] = "all tables"
    has_rest_pose: ClassVar[bool] = False

    def can_write(self, reference: Reference) -> bool:
        """Tell whether it can hold what a reference names; everything unless a format says otherwise."""
        return True

    @abstractmethod
    def write(self, export: Export, out: Path) -> Iterable[Path]:
        """Write the files into a folder that is there, and return them.

        Lengths, axes, rate and joint names are in the files or their format fixes them: nothing leaves without units.
        """


class FileNames:
    """Names of the files of a folder, none twice."""

    def __init__(self) -> None:
        self._times = Counter[str]()

    def free(self, name: str) -> str:
        """Return a name, with a number where it was given before: take a_b, variant c and take a, variant b_c."""
        self._times[name] += 1
        return f"{name}.{self._times[name]}" if self._times[name] > 1 else name


def names_pairs(reference: Reference) -> bool:
    """Tell whether a reference names pairs of one moment: seeds, or one draw."""
    return reference.table == "seeds" or (reference.table == "draws" and reference.row is not None)


def write_text(path: Path, text: str) -> Path:
    """Write a text file and return its path."""
    path.write_text(text, encoding="utf-8")
    return path
