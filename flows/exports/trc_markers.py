"""Poses as TRC, for OpenSim: the joints of everybody of a scene as markers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.c3d_markers import labels_of
from flows.exports.export_format import VERDICT, Export, ExportFormat, write_text
from flows.exports.scene_files import SceneFiles
from flows.exports.scenes import POSED, Scene, holds_poses, scenes


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each scene: metres, the markers `A:pelvis`, ..."""
    files = SceneFiles(export, out, ("TRC files are in metres; their markers are joints, `A:pelvis` and so on.",))
    for scene in scenes(export):
        path = files.path(scene, suffix=".trc")
        write_text(path, _text(scene, path.name))
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, options=VERDICT)


def _text(scene: Scene, name: str) -> str:
    labels, (frames, *_) = labels_of(scene), scene.positions_m.shape
    rate = f"{scene.rate_hz:.9g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(labels)}\tm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, len(labels) + 1) for axis in "XYZ"),
        "",
    ]
    for frame, values in enumerate(scene.positions_m.reshape(frames, -1)):
        lines.append("\t".join([str(frame + 1), f"{frame / scene.rate_hz:.6f}", *(f"{one:.6f}" for one in values)]))
    return "\n".join(lines) + "\n"
