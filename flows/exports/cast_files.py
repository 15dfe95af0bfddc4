"""Files of casts: their paths, and a text with their units, axes, rate, joints and frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flows.exports.casts import NAMES, Cast
from flows.exports.export_format import Export, FileNames, write_text, write_units
from pasdedeux.plain_text import csv_line


class CastFiles:
    """Files of an export.

    Args:
        export: The export.
        out: Folder, which exists.
        said: Sentences on all files of the format.
    """

    def __init__(self, export: Export, out: Path, said: Sequence[str]) -> None:
        self._export, self._out, self._said = export, out, said
        self._names = FileNames(out)
        self._lines: dict[str, str] = {}
        self._paths: list[Path] = []

    def is_apart(self, cast: Cast) -> bool:
        """Return whether the verdict on a cast is worse than requested."""
        return cast.level.rank > self._export.verdict.rank

    def path(self, cast: Cast, *, suffix: str, who: str = "", said: str = "") -> Path:
        """Return a path for a cast or for one person of it, and keep the sentences about the file."""
        path = self._names.path(*cast.name_parts, suffix=suffix, who=who, is_apart=self.is_apart(cast))
        self._lines[str(path.relative_to(self._out))] = f"{cast.in_words()}; {said}" if said else cast.in_words()
        self._paths.append(path)
        if len(cast.labels) > 1 and who in ("", "A"):
            index = self._names.path(*cast.name_parts, "frames", suffix=".csv", is_apart=self.is_apart(cast))
            rows = (f"{csv_line(frame, label)}\n" for frame, label in enumerate(cast.labels))
            self._paths.append(write_text(index, "frame,reference\n" + "".join(rows)))
        return path

    def close(self) -> list[Path]:
        """Write the text about all files, and return all paths."""
        said = [*self._said, NAMES[self._export.reference.table]]
        return [*self._paths, write_units(self._out, said, self._lines)] if self._paths else []
