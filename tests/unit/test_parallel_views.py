"""The paper's own tables: held-out motion by parallel rays."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.evaluation.parallel_views import Condition, best_candidates, parallel_track, parallel_view_scores
from pasdedeux.evaluation.reconstruction_metrics import root_centred_error_m
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import PublishedSettings, build_codebook
from pasdedeux.projections.reconstruct import Searcher, match_track
from pasdedeux.projections.retarget import centre_and_face, mid_hip
from tests.walkers import walk


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    motions = [walk(100, seed=seed) for seed in range(4)]
    poses = np.concatenate([centre_and_face(motion).poses_m for motion in motions]).astype(np.float32)
    return Searcher.of(Database(poses, np.tile(np.arange(100) == 0, 4)))


def test_every_method_is_scored_from_every_view_and_the_fit_beats_the_nearest(searcher: Searcher) -> None:
    scores = parallel_view_scores(
        searcher,
        walk(40, seed=11),
        rate_hz=24.0,
        item="walk",
        yaws_deg=(0.0, 75.0),
        stream=lambda condition, view: np.random.default_rng([condition, view]),
        conditions=(Condition("clean"), Condition("noisy", noise=0.03)),
        codebook=build_codebook(
            searcher.database, np.random.default_rng(0), PublishedSettings(num_clusters=40, num_landmarks=80)
        ),
    )
    assert all(np.isfinite(score.value) for score in scores)
    found = {(s.split, s.metric, s.method, s.item): s.value for s in scores}
    assert len(found) == len(scores)
    for split in ("clean", "noisy"):
        for view in ("walk at 0 degrees", "walk at 75 degrees"):
            fit, nearest = (found[split, "error_root_kept", method, view] for method in ("fit", "nearest"))
            assert fit < nearest
            assert found[split, "error_root_kept", "best_of_50", view] < nearest
            assert 0.0 < found[split, "recall_at_1", "as_published", view] <= 1.0
            assert found[split, "error_root_kept", "as_published", view] > fit
        assert found[split, "two_views_differ", "fit", "walk, views 75 degrees apart"] > 0.0


def test_the_best_candidate_is_no_farther_than_any_other(searcher: Searcher) -> None:
    truth = walk(30, seed=11)
    truth = truth - mid_hip(truth)[:, None]
    track = parallel_track(truth, 24.0, Condition("clean"), np.random.default_rng(0))
    found = match_track(searcher, track)
    best = root_centred_error_m(best_candidates(searcher, found, truth), truth)
    for rank in range(0, 50, 7):
        other = searcher.database.turned(found.neighbours.row[:, rank], found.neighbours.yaw_index[:, rank])
        assert (best <= root_centred_error_m(other, truth) + 1e-9).all()


def test_conditions_hide_and_shake_as_much_as_they_say() -> None:
    truth = walk(200, seed=1)
    track = parallel_track(truth, 24.0, Condition("hidden", missing=0.3), np.random.default_rng(0))
    assert np.isnan(track.keypoints_px[..., 0]).mean() == pytest.approx(0.3, abs=0.03)
    noisy = parallel_track(truth, 24.0, Condition("noisy", noise=0.03), np.random.default_rng(0))
    exact = parallel_track(truth, 24.0, Condition("clean"), np.random.default_rng(0))
    torso_px = 1000.0 * np.median(np.linalg.norm(truth[:, 1] - mid_hip(truth), axis=-1))
    assert np.std(noisy.keypoints_px - exact.keypoints_px) == pytest.approx(0.03 * torso_px, rel=0.05)
