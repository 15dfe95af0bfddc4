"""The table of camera motions: how the camera of film turns and zooms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from storage_schema import ArtifactRef, Store
from tasks.stage.committing import join_columns


def motion_table(motions: Mapping[str, CameraMotion]) -> dict[str, dict[str, Any]]:
    """Return the table of camera motions, none where no camera moves."""
    rows = [
        {
            "sequence_id": [name] * len(motion.frames),
            "frame": motion.frames,
            "steady_from_image": motion.steady_from_image,
            "displacement_px": motion.displacement_px,
            "roll_rad": motion.roll_rad,
            "zoom": motion.zoom,
            "image_width_px": [motion.image_size_px[0]] * len(motion.frames),
            "image_height_px": [motion.image_size_px[1]] * len(motion.frames),
        }
        for name, motion in sorted(motions.items())
    ]
    return {"camera_motions": join_columns(rows)} if rows else {}


def read_camera_motion(store: Store, ref: ArtifactRef, sequence_id: str) -> CameraMotion | None:
    """Return the motion of a sequence's camera; None if it is still or its motion is unknown."""
    if "camera_motions" not in store.manifest(ref).tables:
        return None
    table = store.read(ref, "camera_motions")
    rows = np.flatnonzero(np.asarray(table["sequence_id"]) == sequence_id)
    if not len(rows):
        return None
    size = int(table["image_width_px"][rows[0]]), int(table["image_height_px"][rows[0]])
    return CameraMotion(int(table["frame"][rows[0]]), table["steady_from_image"][rows], size)
