"""Topic `clips`: each annotated sequence as its camera saw it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pasdedeux.evaluation.pictures import Picture, image_panel, pack_player
from pasdedeux.skeletons import OP14
from storage_schema import Store
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.takes import by_frame_and_person, rate_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import SequenceFacts

_UNKNOWN_IMAGE_MARGIN_PX = 20
_CLIP_S = 4.0
_RATE_HZ = 12.5
"""Frames per second of a clip at most: more are not seen and make the page larger."""


class ClipParameters(Parameters):
    """One sequence's clip."""

    sequence_id: str


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per sequence that is a video; sequences of single annotated pairs have no clip."""
    return [
        TOPIC.shard(inputs, sequence_id, ClipParameters(sequence_id=sequence_id), annotations=[manifest])
        for manifest in inputs.of("annotations")
        if (facts := SequenceFacts.of(manifest)).purpose != "random_views"
        for sequence_id in facts.sequence_ids
    ]


class _ShownClips(NamedTuple):
    """The first seconds of a sequence, thinned out: keypoints (frame, person, 14, 2), pixels, times, image size."""

    sequence_id: str
    keypoints_px: np.ndarray
    times_s: np.ndarray
    rate_hz: float
    size_px: tuple[int, int]


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownClips]:
    """Read the first seconds of one sequence."""
    sequence_id, annotations = shard.options(ClipParameters).sequence_id, shard.ref("annotations")
    columns = ["sequence_id", "frame", "person_id", "time_s", "op14_px", "image_width_px", "image_height_px"]
    data = store.read(annotations, "annotations", columns=columns)
    is_here = data["sequence_id"] == sequence_id
    is_here &= data["time_s"] < _CLIP_S + data["time_s"][is_here].min()
    rows = {name: data[name][is_here] for name in columns[1:]}
    keypoints, _, _ = by_frame_and_person(rows["frame"], rows["person_id"], rows["op14_px"])
    times = rows["time_s"][np.unique(rows["frame"], return_index=True)[1]]
    rate_hz = rate_of(times)
    step = max(1, round(rate_hz / _RATE_HZ))
    keypoints, size = _image(keypoints[::step], rows["image_width_px"][0], rows["image_height_px"][0])
    return TopicResult(shown=_ShownClips(sequence_id, keypoints, times[::step], rate_hz / step, size))


def _draw(shown: _ShownClips) -> Iterator[Picture]:
    """Show the clip."""
    panel = image_panel(shown.sequence_id, OP14, shown.keypoints_px, shown.size_px)
    labels = [f"{time:.1f} s" for time in shown.times_s]
    caption = (
        f"Sequence {shown.sequence_id}: the first seconds of its 2D poses. A limb that is missing or jumps "
        "is an error of the detector."
    )
    player = pack_player([panel], rate_hz=shown.rate_hz, labels=labels)
    yield Picture(f"clip-{shown.sequence_id.replace('/', '-')}.player.json", caption, player)


def _image(keypoints: np.ndarray, width: float, height: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Return keypoints and an image size; an unknown size is chosen to contain every keypoint."""
    if np.isfinite(width) and np.isfinite(height):
        return keypoints, (int(width), int(height))
    finite = keypoints[np.isfinite(keypoints).all(axis=-1)]
    if not len(finite):
        return keypoints, (480, 270)
    low = finite.min(axis=0) - _UNKNOWN_IMAGE_MARGIN_PX
    extent = finite.max(axis=0) + _UNKNOWN_IMAGE_MARGIN_PX - low
    return keypoints - low, (int(extent[0]), int(extent[1]))


TOPIC = Topic(
    name="clips",
    heading="Sequences",
    introduction="The 2D poses of each sequence as its camera saw them.",
    reads=("annotations", "cameras"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    cautions=(("cameras", "Virtual video is rendered from motion capture. Its 2D noise is simulated."),),
)
