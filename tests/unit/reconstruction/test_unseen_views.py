"""Reconstruction of held-out motion from unseen views, and sizes from a known height of the camera."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pasdedeux.cameras.virtual_video import PERSON_HEIGHT_M, PERSON_HEIGHT_PX, look_at_camera
from pasdedeux.evaluation.motion_players import reconstruction_player, turn_to_camera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction import unseen_views
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.matching import Method, Searcher, match_track
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.sizes import sized_by_height
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.reconstruction.unseen_views import Condition, UnseenMotion, ViewedMotion, best_candidates
from pasdedeux.skeletons import OP14
from tasks.evaluation.unseen_views import unseen_view_scores
from tests.builders.walkers import database_of, walk


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    return Searcher.of(database_of([walk(100, seed=seed) for seed in range(4)]))


def moved(world: np.ndarray, *yaws_deg: float) -> UnseenMotion:
    return UnseenMotion("walk", world, 24.0, yaws_deg)


def see(world: np.ndarray, condition: Condition, *, yaw_deg: float = 0.0) -> ViewedMotion:
    return unseen_views.see(moved(world), condition, yaw_deg, np.random.default_rng(0))


def before_a_pinhole(world: np.ndarray) -> ViewedMotion:
    """Return a motion as a level pinhole sees it, 4 m away and as high as the hips, 30 degrees round it."""
    middle = mid_hip(world).mean(axis=0)
    focal_px = 4.0 * PERSON_HEIGHT_PX / PERSON_HEIGHT_M
    camera = look_at_camera(
        middle, distance_m=4.0, yaw_rad=-np.pi / 6, pitch_rad=0.0, focal_px=focal_px, image_size_px=(1920, 1080)
    )
    truth = (world - camera.position_m) @ camera.camera_from_world_rotmat.T
    px = camera.project(world).px
    return ViewedMotion(Track(px, np.ones(px.shape[:2]), 24.0, Lens.assumed(1920, 1080, px)), truth)


def test_every_method_is_scored_from_every_view_and_the_fit_beats_the_nearest(searcher: Searcher) -> None:
    motion = moved(walk(40, seed=11), 0.0, 75.0)
    for condition in (Condition("clean"), Condition("noisy", noise=0.03)):
        scores, items = unseen_view_scores(searcher, motion, condition, np.random.default_rng)
        assert all(np.isfinite(score.value) for score in scores)
        found = {(s.metric, s.method, s.item): s.value for s in scores}
        assert len(found) == len(scores)
        mean = float(np.nanmean(items.values["fit"]))
        assert mean == pytest.approx(found["error_root_kept", "fit", "walk, mean of views"])
        for view in ("walk at 0 degrees", "walk at 75 degrees", "walk, mean of views"):
            fit, nearest = (found["error_root_kept", method, view] for method in ("fit", "nearest"))
            assert fit < nearest
            if condition.name == "clean":
                assert found["error_root_kept", "live", view] < 0.05
                assert ("error_root_kept", "live_clean", view) in found
            for method in searcher.methods:
                assert ("foot_slide", f"{method}_clean", view) in found
        assert found["two_views_differ", "fit", "walk, views 75 degrees apart"] > 0.0


def test_the_truth_is_the_motion_as_the_camera_has_it() -> None:
    seen = see(walk(30, seed=3), Condition("clean"), yaw_deg=40.0)
    np.testing.assert_allclose(seen.track.keypoints_px, seen.truth_m[..., :2] * [1000.0, -1000.0], atol=1e-9)
    opposite = see(walk(30, seed=3), Condition("clean"), yaw_deg=-40.0)
    assert root_centred_error_m(seen.truth_m, opposite.truth_m).mean() > 0.12


def test_the_best_candidate_is_no_farther_than_any_other(searcher: Searcher) -> None:
    seen = see(walk(30, seed=11), Condition("clean"))
    found = match_track(searcher, seen.track)
    best = root_centred_error_m(best_candidates(searcher, found, seen.truth_m), seen.truth_m)
    for rank in range(0, 50, 7):
        candidate_m = searcher.database.turned(found.neighbours.row[:, rank], found.yaw_steps[:, rank])
        assert (best <= root_centred_error_m(candidate_m, seen.truth_m) + 1e-9).all()


def test_conditions_have_the_stated_share_of_hidden_joints_and_noise() -> None:
    def seen(condition: Condition) -> np.ndarray:
        return see(world, condition).track.keypoints_px

    world = walk(200, seed=1)
    hidden = seen(Condition("hidden", missing=0.3))
    assert np.isnan(hidden[..., 0]).mean() == pytest.approx(0.3, abs=0.03)
    exact = seen(Condition("clean"))
    shaken = np.std(seen(Condition("noisy", noise=0.03)) - exact)
    torso_px = np.median(np.linalg.norm(exact[:, 1] - 0.5 * (exact[:, 8] + exact[:, 11]), axis=-1))
    assert shaken == pytest.approx(0.03 * torso_px, rel=0.1)


def test_a_reconstruction_is_shown_beside_its_image_and_over_the_truth_with_its_error() -> None:
    poses = walk(12, seed=1)
    px = poses[..., :2] * [300.0, -300.0]
    px[3] = np.nan
    people = np.stack([poses, poses + np.array([0.8, 0.0, 0.3])], axis=1)
    people[5, 1] = np.nan
    truth = people + np.array([0.0, 0.0, 5.0])
    shown = reconstruction_player(people, rate_hz=12.0, keypoints_px=np.stack([px, px + 90.0], axis=1), truth_m=truth)
    scene = json.loads(shown)
    assert [len(panel["figures"]) for panel in scene["panels"]] == [2, 4]
    assert [panel["is_flat"] for panel in scene["panels"]] == [True, False]
    assert scene["num_frames"] == len(scene["labels"]) == 12
    assert scene["labels"][6] == "0.5 s, 0.0 cm"


def test_a_camera_of_known_height_gives_people_their_size(searcher: Searcher) -> None:
    """The body is three quarters as large as the database's, which one camera cannot see."""
    world = 0.75 * walk(60, seed=9)
    world[..., 1] += 0.75 * 0.07 - world[:, OP14.indices(["left_ankle", "right_ankle"]), 1].min()
    seen = before_a_pinhole(world)
    found = reconstruct_track(searcher, seen.track, Method.FIT)
    height_m = float(mid_hip(world).mean(axis=0)[1])
    errors, distances = [], []
    for track in (found, sized_by_height(found, searcher.database.camera, height_m)):
        errors.append(root_centred_error_m(track.positions_m, seen.truth_m).mean())
        distances.append(np.abs(mid_hip(track.positions_m)[:, 2] - mid_hip(seen.truth_m)[:, 2]).mean())
    assert errors[0] > 0.1
    assert errors[1] < 0.5 * errors[0]
    assert distances[1] < 0.25 * distances[0]


def test_a_height_that_cannot_be_true_changes_no_size(searcher: Searcher) -> None:
    seen = before_a_pinhole(walk(24, seed=9))
    found = reconstruct_track(searcher, seen.track, Method.NEAREST)
    camera = searcher.database.camera
    assert sized_by_height(found, camera, 9.0) is found


def test_a_person_at_the_edge_of_the_image_is_shown_from_the_side_that_the_camera_sees() -> None:
    """A person 45 degrees off the axis has the shoulders along the ray, so that they coincide in the image."""
    person = np.zeros((3, 1, 14, 3))
    person[..., 1] = np.linspace(-0.1, 0.1, 14)
    person[..., 2, :] = np.array([0.15, 0.0, -0.15])
    person[..., 5, :] = np.array([-0.15, 0.0, 0.15])
    place = person - person.mean(axis=2, keepdims=True) + np.array([3.0, 0.0, -3.0])
    place[1] = np.nan
    place[2] -= np.array([3.0, 0.0, -3.0])
    turned = turn_to_camera(person, place)
    np.testing.assert_allclose(turned[0, 0, [2, 5], :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(turned[0, 0, [2, 5], 2]), 0.15 * np.sqrt(2.0))
    np.testing.assert_array_equal(turned[1:], person[1:])
