"""Depth from candidates, a person's own proportions, and the fit to the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from pasdedeux.fitting.observed_pose import image_noise
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip, retarget_proportions
from pasdedeux.reconstruction.depth import bone_vectors, decode_depths, place_depths
from pasdedeux.reconstruction.errors import jitter_m, root_centred_error_m
from pasdedeux.reconstruction.matching import Method, ReconstructionOptions, Searcher, match_track
from pasdedeux.reconstruction.proportions import estimate_proportions, retarget_image
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14
from tests.builders.walkers import database_of, random_poses, walk


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    return Searcher.of(database_of([walk(150, seed=seed) for seed in range(6)]))


def parallel_track(world: np.ndarray, *, noise_m: float = 0.0, seed: int = 0) -> tuple[Track, np.ndarray]:
    """Return the track of a walker seen from far away, 300 pixels a metre, and the truth."""
    points = world[..., :2] + np.random.default_rng(seed).normal(0.0, noise_m, (*world.shape[:2], 2))
    px = points * np.array([300.0, -300.0]) + 1000.0
    return Track(px, np.ones(px.shape[:2]), 24.0, Lens(1e7, (1000.0, 1000.0))), world


def errors(found: np.ndarray, truth: np.ndarray) -> float:
    return float(root_centred_error_m(found, truth).mean())


def test_the_fit_is_nearer_than_retrieval_and_as_smooth_as_the_truth(searcher: Searcher) -> None:
    track, truth = parallel_track(walk(80, seed=11))
    matches = match_track(searcher, track)
    found = {method: reconstruct_track(searcher, track, method, matches=matches) for method in searcher.methods}
    error = {method: errors(person.positions_m, truth) for method, person in found.items()}
    # The database holds walks of the same kind, so retrieval alone is within a centimetre.
    assert error[Method.FIT] < 0.75 * error[Method.VITERBI]
    assert error[Method.FIT] < 0.01
    fitted = found[Method.FIT].positions_m
    centred = fitted - mid_hip(fitted)[:, None]
    assert jitter_m(centred) < jitter_m(truth - mid_hip(truth)[:, None]) + 0.002
    lengths = bone_lengths(OP14, fitted)
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), atol=1e-9)


@pytest.mark.parametrize("noise_m", [0.015, 0.03])
def test_the_fit_is_no_worse_than_retrieval_when_the_image_is_poor(searcher: Searcher, noise_m: float) -> None:
    track, truth = parallel_track(walk(80, seed=11), noise_m=noise_m)
    matches = match_track(searcher, track)
    fitted = reconstruct_track(searcher, track, Method.FIT, matches=matches)
    retrieved = reconstruct_track(searcher, track, Method.VITERBI, matches=matches)
    assert errors(fitted.positions_m, truth) < errors(retrieved.positions_m, truth) + 0.001


def test_the_less_a_retrieval_is_trusted_the_nearer_is_the_fit_to_a_clear_image(searcher: Searcher) -> None:
    track, truth = parallel_track(walk(80, seed=11))
    image = (truth - mid_hip(truth)[:, None])[..., :2]
    off = []
    for trust in (0.2, 4.0):
        options = ReconstructionOptions(has_own_proportions=False, metres_per_pixel=1.0 / 300.0, trust_per_misfit=trust)
        fitted = reconstruct_track(searcher, track, Method.FIT, options).positions_m
        off.append(np.linalg.norm((fitted - mid_hip(fitted)[:, None])[..., :2] - image, axis=-1).mean())
    assert off[1] < off[0]


def test_outliers_of_a_joint_now_and_then_do_not_bend_the_fit(searcher: Searcher) -> None:
    track, truth = parallel_track(walk(80, seed=11))
    px = track.keypoints_px.copy()
    px[20:60:8, OP14.index("left_wrist")] += 150.0  # half a metre
    wrong = Track(px, track.confidence, 24.0, track.lens)
    fitted = reconstruct_track(searcher, wrong, Method.FIT)
    clean = reconstruct_track(searcher, track, Method.FIT)
    assert errors(fitted.positions_m, truth) < errors(clean.positions_m, truth) + 0.01


@pytest.mark.parametrize("num_frames", [1, 2, 3, 5])
def test_tracks_of_few_frames_are_fitted(searcher: Searcher, num_frames: int) -> None:
    track, _ = parallel_track(walk(num_frames, seed=11))
    fitted = reconstruct_track(searcher, track, Method.FIT)
    assert np.isfinite(fitted.positions_m).all()


def test_signs_of_depth_are_those_of_the_candidates() -> None:
    truth = retarget_proportions(walk(40, seed=3))
    truth -= truth[:, [OP14.root]]
    rng = np.random.default_rng(0)
    candidates = truth[:, None] + rng.normal(0, 0.03, (40, 10, 14, 3))
    _, depths = decode_depths(truth[..., :2], candidates, np.zeros((40, 10)), noise_m=1e-4, rate_hz=24.0)
    np.testing.assert_allclose(depths, bone_vectors(truth)[..., 2], atol=0.03)
    assert errors(place_depths(truth[..., :2], depths), truth) < 0.005


def test_bones_that_are_not_seen_take_the_depth_of_the_candidates() -> None:
    pose, elbow = random_poses(np.random.default_rng(1), 1), OP14.index("left_elbow")
    images = np.repeat(pose[..., :2], 6, axis=0)
    images[:, elbow] = np.nan
    candidates = np.repeat(pose[:, None], 6, axis=0)
    vectors, depths = decode_depths(images, candidates, np.zeros((6, 1)), noise_m=1e-3, rate_hz=24.0)
    expected = bone_vectors(pose)[0, elbow]
    np.testing.assert_allclose(vectors[:, elbow], np.tile(expected, (6, 1)), atol=1e-9)
    np.testing.assert_allclose(depths[:, elbow], expected[2], atol=1e-9)
    assert np.isfinite(depths).all()


def ratios(**of_joints: float) -> np.ndarray:
    """Return ratios of bones (14,) of which those that end in these joints, left and right, are not 1."""
    ratio = np.ones(14)
    for name, value in of_joints.items():
        ratio[OP14.indices([f"left_{name}", f"right_{name}"])] = value
    return ratio


def test_proportions_are_found_up_to_size_and_images_move_back_and_forth() -> None:
    poses = np.concatenate([random_poses(np.random.default_rng(0), 200), walk(100)])
    poses -= mid_hip(poses)[:, None]
    ratio = ratios(knee=1.2, ankle=1.1, elbow=0.85, hip=0.95)
    ratio *= REFERENCE_LENGTHS_M.sum() / (ratio * REFERENCE_LENGTHS_M).sum()
    image = retarget_proportions(poses, REFERENCE_LENGTHS_M * ratio)
    image -= mid_hip(image)[:, None]
    found = estimate_proportions(image[..., :2], np.ones((300, 14)), poses[..., :2])
    np.testing.assert_allclose(found[1:], ratio[1:], rtol=0.06)
    np.testing.assert_allclose(retarget_image(image[..., :2], ratio), poses[..., :2], atol=1e-9)
    nothing = estimate_proportions(image[..., :2], np.zeros((300, 14)), poses[..., :2])
    np.testing.assert_allclose(nothing, 1.0)


@given(st.lists(st.integers(0, 13), max_size=14, unique=True), st.floats(0.7, 1.4))
def test_retargeting_by_one_ratio_is_a_scale_whatever_is_missing(missing: list[int], ratio: float) -> None:
    pose = random_poses(np.random.default_rng(0), 1)[0]
    pose = (pose - mid_hip(pose))[:, :2]
    pose[missing] = np.nan
    np.testing.assert_allclose(retarget_image(pose, np.full(14, ratio)), pose / ratio, atol=1e-12)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_joints_that_are_missing_move_the_others_of_an_image_little(share: float) -> None:
    ratio = ratios(knee=1.2, ankle=1.1, elbow=0.85, hip=0.95, shoulder=0.8)
    poses = retarget_proportions(walk(100), REFERENCE_LENGTHS_M * ratio)
    image = (poses - mid_hip(poses)[:, None])[..., :2]
    whole = retarget_image(image, ratio)
    image[np.random.default_rng(0).random(image.shape[:2]) < share] = np.nan
    moved = np.linalg.norm(retarget_image(image, ratio) - whole, axis=-1)
    assert np.array_equal(np.isnan(moved), np.isnan(image[..., 0]))
    assert np.nanmax(moved) < 0.06
    assert np.nanmean(moved) < 0.012


def test_a_person_of_other_proportions_seen_by_a_pinhole_is_fitted_up_to_size(searcher: Searcher) -> None:
    world = retarget_proportions(walk(80, seed=11), REFERENCE_LENGTHS_M * ratios(knee=1.15, ankle=1.15))
    truth = world @ yaw_rotmat(0.4).T + np.array([0.3, 0.0, -5.0])
    px = truth[..., :2] / -truth[..., 2:] * np.array([1400.0, -1400.0]) + np.array([960.0, 540.0])
    track = Track(px, np.ones(px.shape[:2]), 24.0, Lens(1400.0, (960.0, 540.0)))
    fitted = reconstruct_track(searcher, track, Method.FIT)
    reference = reconstruct_track(searcher, track, Method.FIT, ReconstructionOptions(has_own_proportions=False))
    assert errors(fitted.positions_m, truth) < 0.9 * errors(reference.positions_m, truth)


def test_noise_is_measured_through_motion_and_outliers() -> None:
    world = walk(200)[..., :2]
    rng = np.random.default_rng(0)
    noisy = world + rng.normal(0, 0.01, world.shape)
    noisy[::20, 3] += 0.5
    seen = np.ones(world.shape[:2], dtype=bool)
    assert image_noise(noisy, seen) == pytest.approx(0.01, rel=0.1)
    assert image_noise(world, seen) < 0.002
    assert image_noise(world[:3], seen[:3]) == 0.0
    assert image_noise(world, np.zeros_like(seen)) == 0.0


def test_a_known_scale_is_kept_and_brings_the_fit_nearer(searcher: Searcher) -> None:
    track, truth = parallel_track(walk(80, seed=11))
    known = ReconstructionOptions(has_own_proportions=False, metres_per_pixel=1.0 / 300.0)
    matches = match_track(searcher, track, known)
    np.testing.assert_allclose(matches.placement.metres_per_pixel, 1.0 / 300.0)
    fitted = reconstruct_track(searcher, track, Method.FIT, known, matches=matches)
    assert errors(fitted.positions_m, truth) < 0.03
    with pytest.raises(ValidationError, match="metres_per_pixel"):
        ReconstructionOptions(metres_per_pixel=0.0)
    for trust in (0.0, np.nan):
        with pytest.raises(ValidationError, match="trust_per_misfit"):
            ReconstructionOptions(trust_per_misfit=trust)
