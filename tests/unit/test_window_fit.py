"""The live fit gives what the fit of whole tracks gives on its frames, and leaves what was given out alone."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import BoneVectorTerm, image_noise
from pasdedeux.fitting.terms import DifferenceTerm, PointTerm
from pasdedeux.kinematics.rotations import multiply, unitquat_from_rotvec
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.reconstruction.depth import DepthSettings, bone_vectors, decode_depths
from pasdedeux.reconstruction.live.vote_kernels import extend_signs, noise_of, prior_of_frame, trace_signs, vote_signs
from pasdedeux.reconstruction.live.window_fit import WindowFit, WindowFitOptions
from pasdedeux.reconstruction.live.window_kernels import fit_window
from pasdedeux.skeletons import OP14
from tests.builders.walkers import walk

RATE_HZ = 24.0
ONES = np.ones(14)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def turned(rng: np.random.Generator, poses: np.ndarray, spread: float) -> np.ndarray:
    """The same poses with every bone turned at random."""
    turns = unitquat_from_rotvec(rng.normal(0, spread, (*poses.shape[:-2], 14, 3)))
    unitquat = multiply(bone_rotations(poses), turns)
    return place_bone_rotations(unitquat, REFERENCE_LENGTHS_M, np.zeros((*poses.shape[:-2], 3)))


def seen_walk(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A walk, noisy candidates (frame, 12, 14, 3) for it, and how well they match."""
    truth = centre_and_face(walk(frames, seed=4)).poses_m
    candidates = turned(rng, np.repeat(truth[:, None], 12, axis=1), 0.25)
    match = np.linalg.norm((candidates - truth[:, None])[..., :2], axis=-1).mean(axis=-1)
    order = np.argsort(match, axis=1)
    return (
        truth,
        np.take_along_axis(candidates, order[..., None, None], axis=1),
        np.take_along_axis(match, order, axis=1),
    )


def test_signs_and_depths_of_frames_are_those_of_the_track(rng: np.random.Generator) -> None:
    truth, candidates, match = seen_walk(rng, 30)
    image = truth[..., :2] + rng.normal(0, 0.01, (30, 14, 2))
    image[rng.uniform(size=(30, 14)) < 0.1] = np.nan
    misfit = match - match[:, :1]
    options = DepthSettings()
    expected = decode_depths(
        image, np.isfinite(image[..., 0]), candidates, misfit, REFERENCE_LENGTHS_M, noise_m=0.01, rate_hz=RATE_HZ
    )
    size, deviation = np.zeros((30, 14)), np.zeros((30, 14))
    cost, back = np.zeros((30, 64)), np.zeros((30, 64), dtype=np.int64)
    log_weight, vectors = -misfit / options.misfit_m, bone_vectors(candidates)
    for at in range(30):
        size[at], deviation[at], score = vote_signs(
            image[at], REFERENCE_LENGTHS_M, vectors[at], log_weight[at], 0.01, options.kernel_m, options.floor
        )
        cost[at] = -score
        if at:
            before = cost[at - 1], size[at - 1], deviation[at - 1]
            way = options.speed_m_s / RATE_HZ
            cost[at], back[at] = extend_signs(*before, size[at], deviation[at], score, REFERENCE_LENGTHS_M, way)
    sign = trace_signs(cost, back, np.arange(30))
    for at in range(30):
        mean, depth = prior_of_frame(
            size[at], deviation[at], sign[at], vectors[at], log_weight[at], options.kernel_m, REFERENCE_LENGTHS_M
        )
        np.testing.assert_allclose(depth, expected.depth_m[at], atol=1e-9)
        np.testing.assert_allclose(mean, expected.vector_m[at], atol=1e-9)


def test_a_window_has_the_least_energy_that_the_plain_fit_finds(rng: np.random.Generator) -> None:
    frames = 9
    truth, candidates, _ = seen_walk(rng, frames)
    image = truth[..., :2] + rng.normal(0, 0.02, (frames, 14, 2))
    bones = bone_vectors(candidates[:, 0])
    start = candidates[:, 0].copy()
    weight, bone_weight = rng.uniform(0.2, 1.0, (frames, 14)) / 0.02**2, rng.uniform(50.0, 400.0, frames)
    per_time = (RATE_HZ**2 / 8.0) ** 2
    time_weight = np.where(np.arange(frames) >= 2, per_time, 0.0)
    found = fit_window(
        start,
        0,
        REFERENCE_LENGTHS_M,
        image,
        weight,
        bones,
        bone_weight,
        time_weight,
        np.full(frames, 1e9),
        0.0,
        40,
    )
    depth_hold = np.where(np.arange(3) < 2, weight[..., None], 1e-2)
    terms = [
        PointTerm(np.concatenate([image, start[..., 2:]], axis=-1), depth_hold),
        DifferenceTerm(np.zeros(start.shape), np.array(per_time), 2),
        BoneVectorTerm(OP14, bones, np.broadcast_to(bone_weight[:, None, None], bones.shape)),
    ]
    forest = BoneForest((OP14,), REFERENCE_LENGTHS_M)
    expected = fit_bones(forest, forest.state_of(start), terms, FitSettings(60, 0.0)).positions_m
    energy, best = (sum(term.energy(one) for term in terms) for one in (found, expected))
    assert energy < best * (1.0 + 1e-3)
    np.testing.assert_allclose(bone_vectors(found), bone_vectors(expected), atol=3e-3)


def test_poses_that_were_given_out_stay_and_the_others_go_on_from_them(rng: np.random.Generator) -> None:
    truth, candidates, _ = seen_walk(rng, 7)
    start = candidates[:, 0].copy()
    time_weight = np.where(np.arange(7) >= 2, 1e9, 0.0)
    no_image = np.zeros((7, 14))
    found = fit_window(
        start,
        2,
        REFERENCE_LENGTHS_M,
        np.ascontiguousarray(truth[..., :2]),
        no_image,
        bone_vectors(start),
        np.full(7, 1e-3),
        time_weight,
        np.full(7, 1e9),
        1e-9,
        30,
    )
    np.testing.assert_allclose(found[:2], start[:2], atol=1e-12)
    after, before = (np.linalg.norm(np.diff(one[:4], n=2, axis=0), axis=-1).mean() for one in (found, start))
    assert after < 0.2 * before


def test_the_noise_of_recent_frames_is_that_of_a_track(rng: np.random.Generator) -> None:
    image = centre_and_face(walk(24, seed=1)).poses_m[..., :2] + rng.normal(0, 0.015, (24, 14, 2))
    assert noise_of(image, np.arange(24)) == pytest.approx(image_noise(image, np.ones((24, 14), dtype=bool)), rel=1e-9)
    assert noise_of(image[:3], np.arange(3)) == 0.0
    gaps = np.arange(24) * 2
    assert noise_of(image, gaps) == 0.0


def test_fitted_poses_are_nearer_than_the_matches_and_keep_their_lengths(rng: np.random.Generator) -> None:
    truth, candidates, match = seen_walk(rng, 40)
    distance = 4.0
    image = truth[..., :2] / (1.0 - truth[..., 2:] / distance) + rng.normal(0, 0.01, (40, 14, 2))
    hidden = rng.uniform(size=(40, 14)) < 0.1
    lag = 5
    fit = WindowFit(RATE_HZ, lag + 1, 12)
    found = []
    for frame in range(40 + lag):
        if frame < 40:
            weights = np.where(hidden[frame], 0.0, 1.0)
            fit.see(frame, image[frame], weights, candidates[frame], match[frame], distance, ONES)
        if frame >= lag:
            found.append(fit.fit(np.zeros(lag + 1, dtype=np.int64), ONES))
    poses = np.stack(found)
    lengths = np.linalg.norm(bone_vectors(poses), axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(REFERENCE_LENGTHS_M, lengths.shape), atol=1e-9)
    error = [np.linalg.norm(one - truth, axis=-1).mean() for one in (poses, candidates[:, 0])]
    assert error[0] < 0.55 * error[1]


def test_with_joints_missing_more_steps_come_nearer(rng: np.random.Generator) -> None:
    truth, candidates, match = seen_walk(rng, 60)
    image = truth[..., :2] + rng.normal(0, 0.003, (60, 14, 2))
    image[rng.uniform(size=(60, 14)) < 0.3] = np.nan
    errors = {}
    for steps in (1, 4):
        live = WindowFit(RATE_HZ, 7, 12, WindowFitOptions(most_solves_missing=steps))
        found = []
        for frame in range(60):
            weights = np.isfinite(image[frame, :, 0]).astype(float)
            live.see(frame, image[frame], weights, candidates[frame], match[frame], 1e9, ONES)
            if frame >= 6:
                found.append(live.fit(np.zeros(7, dtype=np.int64), ONES))
        errors[steps] = np.linalg.norm(np.array(found) - truth[: len(found)], axis=-1).mean()
    assert errors[4] < 0.9 * errors[1]
    assert errors[4] < 0.5 * np.linalg.norm(candidates[:54, 0] - truth[:54], axis=-1).mean()


def test_a_frame_without_any_joint_in_common_keeps_the_match() -> None:
    pose = centre_and_face(walk(1)).poses_m
    fit = WindowFit(RATE_HZ, 1, 4)
    fit.see(0, np.full((14, 2), np.nan), np.zeros(14), pose, np.array([0.05]), 4.0, ONES)
    np.testing.assert_allclose(fit.fit(np.zeros(1, dtype=np.int64), ONES), pose[0], atol=1e-6)


def test_beliefs_without_meaning_are_named() -> None:
    with pytest.raises(InputError, match="ahead"):
        WindowFitOptions(most_ahead=-1)
    with pytest.raises(InputError, match="positive"):
        WindowFitOptions(least_noise_m=0.0)
