"""Poses as BVH, a file for each person; a study reads those of a pair as seeds (`seeds.files`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat, write_text
from flows.exports.own_skeletons import RigFiles
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.own_skeleton import ended

_DECIMALS = 8


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each person, for takes and variants also an npz: degrees, Y up, true rate, centimetres."""
    rigs = RigFiles(out, rest_pose=export.rest_pose, units=export.units)
    files = CastFiles(export, out, ("BVH files are in centimetres and degrees.",))
    for cast in casts(export):
        for letter, rig in zip(cast.letters, cast.rigs(), strict=True):
            if rig.own is not None:
                rigs.write(cast.name_parts, *rig.own, is_apart=files.is_apart(cast))
                continue
            said = ""
            if rig.positions_m is not None and len(rig.positions_m) > 1:
                away_m = np.linalg.norm(rig.motion.world()[0] - rig.positions_m, axis=-1)
                said = (
                    f"bones have their median length, so that joints lie within {1e3 * np.percentile(away_m, 95):.1f} "
                    f"mm (95 %) of the pairs, at worst {1e3 * away_m.max():.1f} mm; GLB is exact"
                )
            path = files.path(cast, suffix=".bvh", who=letter, said=said)
            write_text(path, write_bvh(ended(rig.motion), decimals=_DECIMALS))
    return [*rigs.close(), *files.close()]


FORMAT = ExportFormat(_write, holds_poses, POSED, has_rest_pose=True, options=POSED_OPTIONS)
