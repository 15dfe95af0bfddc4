"""Detections of single images, as COCO results number them: they serve as annotations, and are no video."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pasdedeux.people.video import why_no_video
from storage_schema import Store, open_table
from tasks.evaluation.views import TOPIC as VIEWS
from tasks.stage import StageInputs
from tests.builders.own_sources import film_duet
from tests.builders.real_study import build_here
from tests.builders.storage_rows import having

STUDY = """
[study]
name = "images"
stages = ["ingest", "priors", "views", "projections", "reconstruction"]

[ingest]
rate_hz = 12.0
duets = [{ name = "waltz", duration_s = 1.0 }]
virtual_video = { num_videos = 0, num_random_views = 0 }
annotations = [{ id = "images", path = "results.json" }]
"""


@pytest.mark.parametrize("frames", [range(5000), range(0, 5000, 20), [0, 999], [7], [], [*range(40), 600]])
def test_a_video_may_have_gaps(frames: list[int]) -> None:
    assert why_no_video(np.array(frames, dtype=np.int64)) == ""


@pytest.mark.parametrize("frames", [[0, 1000], [139, 785, 872, 581781], range(0, 10**9, 10**6)])
def test_numbers_far_apart_are_single_images(frames: list[int]) -> None:
    assert "are single images, not a video" in why_no_video(np.array(frames, dtype=np.int64))


@pytest.mark.parametrize(
    ("step", "moved_px", "reason"),
    [
        (581781, 0.0, "images: 12 frames spread over 6,399,592 are single images, not a video"),
        (1, 900.0, "of their height apart: they are single images, not a video"),
    ],
    ids=["numbers far apart", "numbered one by one"],
)
def test_images_give_views_and_are_left_out_of_reconstruction_with_the_reason(
    tmp_path: Path, step: int, moved_px: float, reason: str
) -> None:
    duet = film_duet("hug", duration_s=1.0, rate_hz=12.0)
    results = [
        {"image_id": step * (frame + 1), "score": 0.9, "keypoints": keypoints_of(points + frame % 2 * moved_px)}
        for frame, people in enumerate(duet.keypoints_px("coco17"))
        for points in people
    ]
    (tmp_path / "results.json").write_text(json.dumps(results))
    (tmp_path / "images.toml").write_text(STUDY)
    build_here(tmp_path / "images.toml", tmp_path / "store")
    assert len(set(open_table("views:images", tmp_path / "store")["frame"])) == 12
    store = Store(tmp_path / "store")
    made = {name: having(name, store.artifacts()) for name in ("views", "annotations", "poses")}
    (shard,) = VIEWS.plan(StageInputs(made, seed=1), VIEWS.settings())
    scored = VIEWS.compute(shard, store)
    assert (list(scored.scores), list(scored.notes)) == (
        [],
        ["No true camera is known, so the error of views cannot be measured."],
    )
    (motions,) = store.artifacts("reconstruction")
    (skipped,) = motions.facts["skipped"]
    assert skipped.startswith("images: ")
    assert skipped.endswith(reason)
    assert motions.tables["motions"].rows == 0


def keypoints_of(points: np.ndarray) -> list[float]:
    rows = [[0.0, 0.0, 0.0] if np.isnan(point).any() else [*point.tolist(), 0.9] for point in points]
    return [number for row in rows for number in row]
