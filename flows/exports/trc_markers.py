"""Poses as TRC, for OpenSim: the joints of all people of a cast as markers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.c3d_markers import labels_of
from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat, write_text
from pasdedeux.formats.trc import write_trc


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each cast: metres, the markers `A:pelvis`, ..."""
    files = CastFiles(export, out, ("TRC files are in metres; their markers are joints, `A:pelvis` and so on.",))
    for cast in casts(export):
        path = files.path(cast, suffix=".trc")
        points = cast.positions_m.reshape(len(cast.positions_m), -1, 3)
        write_text(path, write_trc(points, labels_of(cast), rate_hz=cast.rate_hz, name=path.name))
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, options=POSED_OPTIONS)
