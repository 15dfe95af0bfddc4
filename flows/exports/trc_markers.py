"""Poses as TRC, for OpenSim: the joints of everybody of a cast as markers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.c3d_markers import labels_of
from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, Cast, casts, holds_poses
from flows.exports.export_format import VERDICT, Export, ExportFormat, write_text


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each cast: metres, the markers `A:pelvis`, ..."""
    files = CastFiles(export, out, ("TRC files are in metres; their markers are joints, `A:pelvis` and so on.",))
    for cast in casts(export):
        path = files.path(cast, suffix=".trc")
        write_text(path, _text(cast, path.name))
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, options=VERDICT)


def _text(cast: Cast, name: str) -> str:
    labels, (frames, *_) = labels_of(cast), cast.positions_m.shape
    rate = f"{cast.rate_hz:.9g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(labels)}\tm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, len(labels) + 1) for axis in "XYZ"),
        "",
    ]
    for frame, values in enumerate(cast.positions_m.reshape(frames, -1)):
        lines.append("\t".join([str(frame + 1), f"{frame / cast.rate_hz:.6f}", *(f"{one:.6f}" for one in values)]))
    return "\n".join(lines) + "\n"
