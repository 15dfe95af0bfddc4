"""Poses as binary glTF: all people of a cast as skinned, animated figures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from flows.exports.cast_files import CastFiles
from flows.exports.casts import POSED, Rig, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat
from pasdedeux.bodies import body_of, standing_motion
from pasdedeux.formats.glb import GlbPerson, Skin, write_glb
from pasdedeux.kinematics.rotations import identity_unitquat
from pasdedeux.plausibility.capsules import radius_per_height
from pasdedeux.skeletons import BODY22

_SAID = (
    "GLB files are in metres, seconds and unit quaternions (x, y, z, w). In Blender, set the frame rate of the scene "
    "to theirs before you import them: the import counts frames at the rate of the scene.",
)


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each cast: metres, Y up, the people called A, B, ..., each a skinned body."""
    files = CastFiles(export, out, _SAID)
    for cast in casts(export):
        rigs = zip(cast.letters, cast.rigs(export.rest_pose), strict=True)
        people = [glb_person(letter, rig) for letter, rig in rigs]
        facts = {"unit": "m", "axes": cast.axes, "rate_hz": cast.rate_hz, "frames": cast.in_words()}
        data = write_glb(people, copyright_text=export.credit, facts=facts)
        files.path(cast, suffix=".glb").write_bytes(data)
    return files.close()


def glb_person(name: str, rig: Rig) -> GlbPerson:
    """Return a person with a body; the rest pose is a T-pose if only positions are known."""
    motion = rig.motion
    if rig.positions_m is not None:
        motion = standing_motion(motion.skeleton, rig.positions_m, motion.rate_hz)
    rest, skeleton, moved_by = motion.rest_positions_m(), motion.skeleton, np.arange(motion.skeleton.num_joints)
    if rig.body_map is not None:
        upright, skeleton = identity_unitquat(len(rest)), BODY22
        rest, moved_by = rig.body_map.positions(rest, upright), rig.body_map.weight.argmax(axis=1)
    body = body_of(skeleton, rest, rig.height_m * radius_per_height(skeleton))
    joints, weights = body.strongest()
    skin = Skin(body.vertices_m, body.normals, body.faces, moved_by[joints], weights)
    return GlbPerson(name, motion, skin, rig.positions_m)


FORMAT = ExportFormat(_write, holds_poses, POSED, has_rest_pose=True, options=POSED_OPTIONS)
