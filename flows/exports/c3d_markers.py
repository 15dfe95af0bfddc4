"""Poses as C3D: the joints of everybody of a scene as labelled points."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.export_format import VERDICT, Export, ExportFormat
from flows.exports.scene_files import SceneFiles
from flows.exports.scenes import POSED, Scene, holds_poses, scenes
from pasdedeux.formats.c3d import write_c3d


def labels_of(scene: Scene) -> list[str]:
    """Return the names of the points of a scene, person by person: `A:pelvis`, ..."""
    return [f"{letter}:{joint}" for letter in scene.letters for joint in scene.skeleton.joint_names]


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each scene: millimetres, the points `A:pelvis`, ..., the credit in the group PASDEDEUX."""
    files = SceneFiles(export, out, ("C3D files are in millimetres; their points are joints, `A:pelvis` and so on.",))
    for scene in scenes(export):
        points = scene.positions_m.reshape(len(scene.positions_m), -1, 3)
        facts = {"AXES": scene.axes, "CREDIT": export.credit}
        data = write_c3d(points, labels_of(scene), rate_hz=scene.rate_hz, facts=facts)
        files.path(scene, suffix=".c3d").write_bytes(data)
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, options=VERDICT)
