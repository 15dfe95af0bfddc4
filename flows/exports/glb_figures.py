"""Poses as binary glTF: everybody of a cast as a skinned, animated figure."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, casts, holds_poses
from flows.exports.export_format import VERDICT, Export, ExportFormat
from pasdedeux.formats.glb import GlbPerson, write_glb

_SAID = (
    "GLB files are in metres, seconds and unit quaternions (x, y, z, w); set the scene of Blender to their rate before "
    "they are imported, which counts frames at the rate of the scene.",
)


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each cast: metres, Y up, the people called A, B, ..., each a skin of capsules."""
    files = CastFiles(export, out, _SAID)
    for cast in casts(export):
        people = [
            GlbPerson(letter, rig.motion, rig.radii_m, rig.positions_m)
            for letter, rig in zip(cast.letters, cast.rigs(export.rest_pose), strict=True)
        ]
        facts = {"unit": "m", "axes": cast.axes, "rate_hz": cast.rate_hz, "frames": cast.in_words()}
        data = write_glb(people, copyright_text=export.credit, facts=facts)
        files.path(cast, suffix=".glb").write_bytes(data)
    return files.close()


FORMAT = ExportFormat(_write, holds_poses, POSED, has_rest_pose=True, options=VERDICT)
