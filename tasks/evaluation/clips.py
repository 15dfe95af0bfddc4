"""Topic `clips`: each annotated sequence as its camera saw it."""

from __future__ import annotations

import numpy as np

from pasdedeux.skeletons import OP14
from storage_schema import Store, TableData
from tasks.evaluation.topic import TopicResult, make_shard
from tasks.evaluation.truth import read_cameras
from tasks.stage import Shard, StageInputs

__all__ = ["TOPIC", "run", "shards"]

TOPIC = "clips"
_UNKNOWN_IMAGE_MARGIN_PX = 20


def shards(inputs: StageInputs, *, seconds: float, rate_hz: float) -> list[Shard]:
    """One shard per sequence that is a video; sequences of single annotated pairs have no clip."""
    return [
        make_shard(
            topic=TOPIC,
            name=sequence_id,
            inputs=[manifest],
            parameters={"sequence_id": sequence_id, "seconds": seconds, "rate_hz": rate_hz},
            seed=inputs.seed,
        )
        for manifest in inputs.of("annotations")
        if manifest.facts["purpose"] != "random_views"
        for sequence_id in manifest.facts["sequence_ids"]
    ]


def run(shard: Shard, store: Store) -> TopicResult:
    """Draw the first seconds of one sequence."""
    from pasdedeux.evaluation.overlay import floor_grid, overlay_clip  # here: planning does not need OpenCV

    sequence_id = shard.parameters["sequence_id"]
    columns = ["sequence_id", "frame", "person_id", "time_s", "op14_px", "image_width_px", "image_height_px"]
    data = store.read(shard.inputs[0], "annotations", columns=columns)
    is_here = data["sequence_id"] == sequence_id
    is_here &= data["time_s"] < shard.parameters["seconds"] + data["time_s"][is_here].min()
    keypoints, times = _by_frame(data, is_here)
    step = _step(times, shard.parameters["rate_hz"])
    keypoints, size = _image(keypoints[::step], data["image_width_px"][is_here][0], data["image_height_px"][is_here][0])
    camera = read_cameras(store, shard.inputs).get(sequence_id)
    name = f"clip-{sequence_id.replace('/', '-')}.webp"
    clip = overlay_clip(
        OP14,
        keypoints,
        image_size_px=size,
        rate_hz=min(shard.parameters["rate_hz"], _rate(times)),
        floor_px=None if camera is None else floor_grid(camera),
        labels=[f"{time:.1f} s" for time in times[::step]],
    )
    return TopicResult(pictures={name: clip}, captions={name: f"Sequence {sequence_id}: the 2D poses that were given."})


def _by_frame(data: TableData, is_here: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints (frame, person, 14, 2), NaN where a person is absent, and the frames' times."""
    frames, rows = np.unique(data["frame"][is_here], return_inverse=True)
    people, columns = np.unique(data["person_id"][is_here], return_inverse=True)
    keypoints = np.full((len(frames), len(people), 14, 2), np.nan)
    keypoints[rows, columns] = data["op14_px"][is_here]
    times = np.zeros(len(frames))
    times[rows] = data["time_s"][is_here]
    return keypoints, times


def _rate(times: np.ndarray) -> float:
    return 1.0 / float(np.median(np.diff(times))) if len(times) > 1 else 25.0


def _step(times: np.ndarray, rate_hz: float) -> int:
    return max(1, round(_rate(times) / rate_hz))


def _image(keypoints: np.ndarray, width: float, height: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Return keypoints and an image size; an unknown size is made to hold every keypoint."""
    if np.isfinite(width) and np.isfinite(height):
        return keypoints, (int(width), int(height))
    finite = keypoints[np.isfinite(keypoints).all(axis=-1)]
    if not len(finite):
        return keypoints, (480, 270)
    low = finite.min(axis=0) - _UNKNOWN_IMAGE_MARGIN_PX
    extent = finite.max(axis=0) + _UNKNOWN_IMAGE_MARGIN_PX - low
    return keypoints - low, (int(extent[0]), int(extent[1]))
