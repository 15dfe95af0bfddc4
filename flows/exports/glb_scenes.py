"""Poses as binary glTF: everybody of a scene as a skinned, animated figure."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.export_format import VERDICT, Export, ExportFormat
from flows.exports.scene_files import SceneFiles
from flows.exports.scenes import POSED, holds_poses, scenes
from pasdedeux.formats.glb import GlbPerson, write_glb


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each scene: metres, Y up, the people called A, B, ..., each a skin of capsules."""
    files = SceneFiles(export, out, ("GLB files are in metres, seconds and unit quaternions (x, y, z, w).",))
    for scene in scenes(export):
        people = [
            GlbPerson(letter, rig.motion, rig.radii_m, rig.positions_m)
            for letter, rig in zip(scene.letters, scene.rigs(export.rest_pose), strict=True)
        ]
        facts = {"unit": "m", "axes": scene.axes, "rate_hz": scene.rate_hz, "frames": scene.in_words()}
        data = write_glb(people, copyright_text=export.credit, facts=facts)
        files.path(scene, suffix=".glb").write_bytes(data)
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, has_rest_pose=True, options=VERDICT)
