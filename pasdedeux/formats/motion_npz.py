"""Motions as npz archives that say themselves what is in them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from pasdedeux.kinematics import Motion


def write_motion_npz(motion: Motion, *, axes: str, **facts: Any) -> bytes:
    """Return a motion as an npz archive, lengths in metres.

    `joint_names`, `parents` (-1 for the root), `rest_offset_m` (joint, 3), `root_translation_m` (frame, 3),
    `local_unitquat` (frame, joint, 4) as x, y, z, w from the rest pose, `positions_m` (frame, joint, 3), `rate_hz`,
    `unit` and `axes`, a sentence; and further facts by their names.
    """
    arrays: dict[str, Any] = {
        "joint_names": np.array(motion.skeleton.joint_names),
        "parents": np.array(motion.skeleton.parents),
        "rest_offset_m": motion.rest_offsets_m,
        "root_translation_m": motion.root_translation_m,
        "local_unitquat": motion.local_unitquat,
        "positions_m": motion.world()[0],
        "rate_hz": motion.rate_hz,
        "unit": np.array("m"),
        "axes": np.array(axes),
    }
    file = io.BytesIO()
    np.savez_compressed(file, **arrays, **facts)
    return file.getvalue()
