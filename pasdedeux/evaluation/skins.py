"""Coarse bodies for the player of the page: one for each skeleton, which the page fits to everybody's bones."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from functools import cache

import numpy as np

from pasdedeux.bodies import body_of
from pasdedeux.evaluation.pictures import shade_of
from pasdedeux.plausibility.capsules import body_height_m, capsule_model, standing_m
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton

SKINNED = {skeleton.name: skeleton for skeleton in (BODY22, PAIR17, OP14)}
_NUM_VERTICES, _STATURE_M = 1600, 1.7
_UNIT_M = 1e-4
_TURNED_BY = {
    BODY22.name: {"pelvis": ("left_hip", "right_hip", "spine1"), "spine3": ("left_collar", "right_collar", "neck")},
    PAIR17.name: {"pelvis": ("left_hip", "right_hip", "spine"), "chest": ("left_shoulder", "right_shoulder", "neck")},
    OP14.name: {"neck": ("left_shoulder", "right_shoulder", "right_hip")},
}
"""Joints with several children follow the line between two of them and a third; others follow their bone."""


def skins_json(names: Iterable[str]) -> str:
    """Return the coarse bodies of these skeletons as JSON, for the script of the page."""
    return json.dumps({name: _packed(SKINNED[name]) for name in sorted(set(names))}, separators=(",", ":"))


@cache
def _packed(skeleton: Skeleton) -> dict[str, object]:
    """Return a body: vertices (n, 3), joints (n, 4) and weights (n, 4) in bytes, faces (m, 3), one after another."""
    rest_m = _STATURE_M * standing_m(skeleton)
    parents = [max(parent, 0) for parent in skeleton.parents]
    height_m = body_height_m(skeleton, np.linalg.norm(rest_m - rest_m[parents], axis=-1))
    radii_m = capsule_model(skeleton).radii_m(np.atleast_1d(height_m))[0]
    body = body_of(skeleton, rest_m, radii_m, num_vertices=_NUM_VERTICES)
    joints, weights = body.strongest()
    data = (
        np.round(body.vertices_m / _UNIT_M).astype("<i2").tobytes(),
        joints.astype(np.uint8).tobytes(),
        np.round(255.0 * weights).astype(np.uint8).tobytes(),
        body.faces.astype("<u2").tobytes(),
    )
    return {
        "parents": list(skeleton.parents),
        "rest_m": np.round(rest_m, 4).tolist(),
        "shades": [shade_of(name) for name in skeleton.joint_names],
        "turned_by": {
            skeleton.index(name): list(map(skeleton.index, others))
            for name, others in _TURNED_BY[skeleton.name].items()
        },
        "unit_m": _UNIT_M,
        "num_vertices": len(body.vertices_m),
        "data": base64.b64encode(b"".join(data)).decode(),
    }
