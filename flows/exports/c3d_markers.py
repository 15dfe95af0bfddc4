"""Poses as C3D: the joints of all people of a cast as labelled points."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, Cast, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat
from pasdedeux.formats.c3d import write_c3d


def labels_of(cast: Cast) -> list[str]:
    """Return the names of the points of a cast, person by person: `A:pelvis`, ..."""
    return [f"{letter}:{joint}" for letter in cast.letters for joint in cast.skeleton.joint_names]


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each cast: millimetres, the points `A:pelvis`, ..., the credit in the group PASDEDEUX."""
    files = CastFiles(export, out, ("C3D files are in millimetres; their points are joints, `A:pelvis` and so on.",))
    for cast in casts(export):
        points = cast.positions_m.reshape(len(cast.positions_m), -1, 3)
        facts = {"AXES": cast.axes, "CREDIT": export.credit}
        data = write_c3d(points, labels_of(cast), rate_hz=cast.rate_hz, facts=facts)
        files.path(cast, suffix=".c3d").write_bytes(data)
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, options=POSED_OPTIONS)
