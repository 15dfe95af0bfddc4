"""Writers of our two formats of 2D annotations: what programs of users do, and the round trip of the readers."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS

__all__ = ["write_annotation_csv", "write_annotation_npz"]

COLUMNS = ("sequence", "frame", "person", "joint", "x", "y", "confidence")


def write_annotation_csv(frames: AnnotatedFrames) -> str:
    """Return annotations as our CSV; missing keypoints are left out, a person without any keeps one empty row."""
    names = KEYPOINT_LAYOUTS[frames.layout].keypoint_names
    out = io.StringIO()
    out.write(f"# layout: {frames.layout}\n")
    if frames.image_size_px:
        width, height = next(iter(frames.image_size_px.values()))
        out.write(f"# image_size: {width}x{height}\n")
    if frames.rate_hz:
        out.write(f"# rate_hz: {frames.rate_hz!r}\n")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in range(frames.num_rows):
        head = [frames.sequence_id[row], int(frames.frame[row]), int(frames.person_id[row])]
        seen = [column for column in range(len(names)) if frames.confidence[row, column] > 0]
        for column in seen:
            x, y = frames.keypoints_px[row, column]
            writer.writerow(
                [*head, names[column], repr(float(x)), repr(float(y)), repr(float(frames.confidence[row, column]))]
            )
        if not seen:
            writer.writerow([*head, names[0], "", "", 0])
    return out.getvalue()


def write_annotation_npz(frames: AnnotatedFrames) -> bytes:
    """Return annotations as our npz."""
    arrays: dict[str, Any] = {
        "layout": np.array(frames.layout),
        "sequence": np.array(frames.sequence_id),
        "frame": frames.frame,
        "person": frames.person_id,
        "keypoints_px": frames.keypoints_px,
        "confidence": frames.confidence,
    }
    if frames.image_size_px:
        arrays["image_size_px"] = np.array(next(iter(frames.image_size_px.values())))
    if frames.rate_hz:
        arrays["rate_hz"] = np.array(frames.rate_hz)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()
