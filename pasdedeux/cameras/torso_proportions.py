"""A torso basis from body proportions alone, where there is no motion to learn from."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.torso import TorsoBasis, learn_torso_basis
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.skeletons import PAIR17

_STATURE_M = 1.7
# Shares of the stature after Drillis and Contini (1966): x to the left, y up from the pelvis.
_UPRIGHT = {
    "spine": (0.0, 0.08),
    "chest": (0.0, 0.18),
    "neck": (0.0, 0.28),
    "head": (0.0, 0.36),
    "shoulder": (0.112, 0.294),
    "hip": (0.049, 0.0),
}
_NUM_TORSOS = 2000
_DEVIATION_DEG = {"flexion": 15.0, "lateral": 8.0, "torsion": 14.0, "shrug": 8.0, "protraction": 12.0}
"""Standard deviations of the bends of trunks and the moves of shoulders in everyday and dance motion."""


def proportions_torso_basis() -> TorsoBasis:
    """Return a torso basis of an average body that bends, twists and moves its shoulders; no take is used.

    The torsos are drawn once from a fixed stream, so the basis is always the same.
    """
    rng = np.random.default_rng(20180501)
    angle = {name: np.deg2rad(width) * rng.normal(size=_NUM_TORSOS) for name, width in _DEVIATION_DEG.items()}
    angle["flexion"] = angle["flexion"] + np.deg2rad(10.0)
    pose = np.zeros((_NUM_TORSOS, PAIR17.num_joints, 3))
    for name, place in _UPRIGHT.items():
        for side, sign in (("left_", 1.0), ("right_", -1.0)) if name in ("shoulder", "hip") else (("", 1.0),):
            pose[:, PAIR17.index(side + name), :2] = np.array([sign * place[0], place[1]]) * _STATURE_M
    chest = pose[0, PAIR17.index("chest")]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        shoulder = PAIR17.index(f"{side}_shoulder")
        shrug = angle["shrug"] + np.deg2rad(4.0) * rng.normal(size=_NUM_TORSOS)
        turn = _turn(y=-sign * angle["protraction"], z=sign * shrug)
        pose[:, shoulder] = chest + np.einsum("nij,nj->ni", turn, pose[:, shoulder] - chest)
    # Half of each bend is at the spine joint, half at the chest.
    upper = PAIR17.indices(("chest", "neck", "head", "left_shoulder", "right_shoulder"))
    for joint in ("chest", "spine"):
        pivot = pose[:, [PAIR17.index(joint)]].copy()
        turn = _turn(x=0.5 * angle["flexion"], y=0.5 * angle["torsion"], z=0.5 * angle["lateral"])
        pose[:, upper] = pivot + np.einsum("nij,nkj->nki", turn, pose[:, upper] - pivot)
    return learn_torso_basis(pose)


def _turn(*, x: Array | float = 0.0, y: Array | float = 0.0, z: Array | float = 0.0) -> Array:
    rotvec = np.stack([np.broadcast_to(value, (_NUM_TORSOS,)) for value in (x, y, z)], axis=-1)
    return rotmat_from_unitquat(unitquat_from_rotvec(rotvec))
