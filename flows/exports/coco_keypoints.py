"""2D annotations as COCO keypoints: a file for each layout of keypoints."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.casts import groups
from flows.exports.export_format import Export, ExportFormat, FileNames, write_text
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import TABLES, TableData
from storage_schema.table_data import concatenate

_VISIBLE = 2
_FILE_NAME = "{sequence}/{frame:06d}.png"


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write image names (no images), people (`track_id`), names of keypoints, licences and credits."""
    rows, names = concatenate(TABLES["annotations"], export.batches()), FileNames(out)
    info = {
        "description": f"{export.text}, exported by pasdedeux; pixels, x right, y down; images are not among the files",
        "contributor": export.credit,
    }
    licences = [{"id": at, "name": source.licence, "url": ""} for at, source in enumerate(export.sources, start=1)]
    return [
        write_text(
            names.path("annotations", layout, suffix=".json"),
            json.dumps({"info": info, "licenses": licences, **_content(rows, part, layout)}, allow_nan=False),
        )
        for (layout,), part in groups(rows, "layout")
    ]


FORMAT = ExportFormat(_write, lambda reference: reference.table == "annotations", "annotations")


def _content(rows: TableData, part: np.ndarray, layout: str) -> dict[str, list[dict[str, Any]]]:
    """Return images, annotations and the category of the rows of one layout."""
    images: dict[tuple[str, int], dict[str, Any]] = {}
    annotations = list[dict[str, Any]]()
    is_sized = ~(rows.is_null("image_width_px") | rows.is_null("image_height_px"))
    for row in part.tolist():
        sequence, frame = str(rows["sequence_id"][row]), int(rows["frame"][row])
        name = _FILE_NAME.format(sequence=sequence, frame=frame)
        place = {"id": len(images), "file_name": name, "video_id": sequence, "frame_id": frame}
        image = images.setdefault((sequence, frame), place)
        if is_sized[row]:
            image |= {"width": int(rows["image_width_px"][row]), "height": int(rows["image_height_px"][row])}
        points = np.asarray(rows["keypoints_px"][row], dtype=np.float64).reshape(-1, 2)
        scores = np.asarray(rows["keypoint_confidence"][row], dtype=np.float64)
        is_seen = (scores > 0) & np.isfinite(points).all(axis=-1)
        table = np.where(is_seen[:, None], np.c_[points, np.full(len(points), _VISIBLE)], 0.0)
        low, high = (end(points[is_seen], axis=0) if is_seen.any() else np.zeros(2) for end in (np.min, np.max))
        annotations.append(
            {
                "id": len(annotations) + 1,
                "image_id": image["id"],
                "category_id": 1,
                "track_id": int(rows["person_id"][row]),
                "keypoints": [
                    int(value) if at % 3 == 2 else round(value, 3) for at, value in enumerate(table.ravel().tolist())
                ],
                "keypoint_scores": np.where(is_seen, scores, 0.0).round(4).tolist(),
                "num_keypoints": int(is_seen.sum()),
                "bbox": [*low.round(3).tolist(), *(high - low).round(3).tolist()],
                "area": round(float(np.prod(high - low)), 3),
                "iscrowd": 0,
            }
        )
    category = {"id": 1, "name": "person", "supercategory": "person"}
    kept = KEYPOINT_LAYOUTS[layout]
    return {
        "images": list(images.values()),
        "annotations": annotations,
        "categories": [category | {"keypoints": list(kept.keypoint_names), "skeleton": kept.links(first=1)}],
    }
