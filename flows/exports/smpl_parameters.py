"""Motions as parameters of SMPL-like bodies for the user's own body model: an npz for each person, as in AMASS."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from flows.exports.cast_files import CastFiles
from flows.exports.casts import MOVING, Cast, Rig, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat
from pasdedeux.errors import InputError, named
from pasdedeux.formats.rigs.own_skeleton import standing
from pasdedeux.formats.smpl import BODY, BodyModel, SmplMotion, read_body_model, smpl_of_body22, smpl_of_motion
from pasdedeux.skeletons import BODY22
from tasks.ingest.files import load_file


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write poses, trans, betas and rate of each person; betas are fitted, and their misfit is stated."""
    if export.body_model is None:
        raise InputError("parameters are written for a body model: name it with --body-model; docs/body-models.md")
    with named(export.body_model.name):
        model = read_body_model(load_file(export.body_model).data)
    files = CastFiles(export, out, (f"NPZ files: parameters of {model.kind} as AMASS, metres, rotation vectors.",))
    for cast in casts(export):
        people = zip(cast.letters, cast.rigs(), np.moveaxis(cast.positions_m, 1, 0), strict=True)
        for letter, rig, positions_m in people:
            fitted, axis = _fitted(model, rig, positions_m)
            turned = replace(cast, axes=f"right-handed, {axis.upper()} up")
            path = files.path(turned, suffix=".npz", who=letter, said=_misfit_in_words(fitted))
            path.write_bytes(_npz(export, cast, fitted, model, axis))
    return files.close()


FORMAT = ExportFormat(
    _write,
    lambda reference: reference.table in MOVING and holds_poses(reference),
    f"whole {', '.join(MOVING)}",
    options=POSED_OPTIONS | {"body_model"},
)


def _fitted(model: BodyModel, rig: Rig, positions_m: np.ndarray) -> tuple[SmplMotion, str]:
    """Return the parameters of a person and their up axis: that of the source if it was SMPL."""
    if rig.own is None:
        return smpl_of_body22(model, positions_m, rig.motion.world()[1][:, : BODY22.num_joints]), "y"
    person, own_skeleton, _ = rig.own
    if own_skeleton.motion.skeleton.joint_names == model.skeleton.joint_names:
        return smpl_of_motion(model, own_skeleton.motion, positions_m, up_axis=person.up_axis), person.up_axis
    stood = standing(own_skeleton)
    carriers = stood.body.weight.argmax(axis=1)
    return smpl_of_body22(model, positions_m, stood.motion.world()[1][:, carriers]), "y"


def _misfit_in_words(fitted: SmplMotion) -> str:
    """Return the misfit of betas and rotations in words."""
    bone, worst_m = max(fitted.misfit_m.items(), key=lambda misfit: abs(misfit[1]))
    mean_m = np.mean(np.abs([*fitted.misfit_m.values()]))
    return (
        f"joints lie within {1e3 * np.percentile(fitted.away_m, 95):.1f} mm (95 %), at worst "
        f"{1e3 * fitted.away_m.max():.1f} mm; bones of the fitted betas differ by {1e3 * mean_m:.1f} mm in the mean, "
        f"{bone} by {1e3 * worst_m:+.1f} mm"
    )


def _npz(export: Export, cast: Cast, fitted: SmplMotion, model: BodyModel, axis: str) -> bytes:
    poses = fitted.rotvecs.reshape(len(fitted.rotvecs), -1)
    bones, misfits = zip(*fitted.misfit_m.items(), strict=True)
    out = io.BytesIO()
    np.savez_compressed(
        out,
        poses=poses,
        root_orient=poses[:, :3],
        pose_body=poses[:, 3 : 3 * len(BODY)],
        trans=fitted.trans_m,
        betas=fitted.betas,
        mocap_framerate=cast.rate_hz,
        surface_model_type=np.array(model.kind.replace("-", "").lower()),
        gender=np.array("neutral"),
        joint_names=np.array(model.skeleton.joint_names),
        unit=np.array("m"),
        axes=np.array(f"right-handed, {axis.upper()} up"),
        credit=np.array(export.credit),
        bone=np.array(bones),
        bone_misfit_m=np.array(misfits),
        joint_misfit_m=fitted.away_m,
    )
    return out.getvalue()
