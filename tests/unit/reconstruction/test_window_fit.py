"""The live fit is nearer than the matches, keeps bone lengths, and works where joints are missing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings, fit_bones
from pasdedeux.fitting.observed_pose import BoneVectorTerm, image_noise, image_term
from pasdedeux.fitting.terms import AccelerationTerm
from pasdedeux.kinematics.rotations import multiply, unitquat_from_rotvec
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face, mid_hip
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.reconstruction.depth import bone_vectors
from pasdedeux.reconstruction.live import window_fit
from pasdedeux.reconstruction.live.window_fit import TRUST_PER_MISFIT, LiveFrame, WindowFit
from pasdedeux.reconstruction.live.window_kernels import fit_window
from pasdedeux.reconstruction.reconstruct import bone_deviation_m
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


def seen(
    frame: int, image: np.ndarray, weights: np.ndarray, candidates: np.ndarray, match: np.ndarray, distance: float
) -> LiveFrame:
    """A frame of a person this far from the camera."""
    row = np.arange(len(match))
    return LiveFrame(frame, row, row * 1.0, match, candidates, np.array([0.0, 0.0, -distance]), image, weights)


def posed(unknowns: np.ndarray) -> np.ndarray:
    """Poses of unknowns (frame, 14, 3): the root's place, and for every other joint a vector along its bone."""
    poses = np.zeros(unknowns.shape)
    for joint in OP14.order:
        parent, vector = OP14.parents[joint], unknowns[:, joint]
        if parent < 0:
            poses[:, joint] = vector
        else:
            length = np.linalg.norm(vector, axis=-1, keepdims=True)
            poses[:, joint] = poses[:, parent] + REFERENCE_LENGTHS_M[joint] * vector / length
    return poses


def plain_fit(
    held: np.ndarray, image: np.ndarray, weight: np.ndarray, bones: np.ndarray, trust: float, even: np.ndarray
) -> tuple[np.ndarray, Callable[[np.ndarray], float]]:
    """Poses of least energy behind held ones, image weights (frame, 14), and the energy of poses.

    Second differences count where `even`; their standard deviation is that of 8 m/s2.
    """

    def residuals(poses: np.ndarray) -> np.ndarray:
        seen = np.sqrt(weight)[..., None] * (poses[..., :2] - image)
        off = (bone_vectors(poses) - bones) / trust
        bent = np.diff(np.concatenate([held, poses]), n=2, axis=0)[even] * RATE_HZ**2 / 8.0
        adrift = 0.01 * poses[:, OP14.root, 2]
        return np.concatenate([seen.ravel(), off.ravel(), bent.ravel(), adrift])

    start = bones.copy()
    start[:, OP14.root] = 0.0
    found = least_squares(lambda unknowns: residuals(posed(unknowns.reshape(bones.shape))), start.ravel(), ftol=1e-7)
    return posed(found.x.reshape(bones.shape)), lambda poses: float((residuals(poses) ** 2).sum())


def test_windows_have_the_least_energy_of_a_plain_fit(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, candidates, _ = seen_walk(rng, 7)
    frames = np.array([0, 1, 2, 3, 4, 6])
    truth, candidates = truth[frames], candidates[frames, :1]
    image = truth[..., :2] + rng.normal(0, 0.03, (6, 14, 2))
    confidence = rng.uniform(0.2, 1.0, (6, 14)) * (rng.uniform(size=(6, 14)) > 0.1)
    for name in ("STOP", "STOP_MISSING"):
        monkeypatch.setattr(window_fit, name, FitSettings(max_iterations=100, tolerance=0.0))
    live = WindowFit(RATE_HZ, min_noise_m=1e-3)
    far_off = np.array([1.0])
    for at, frame in enumerate(frames):
        live.see(seen(int(frame), image[at], confidence[at], candidates[at], far_off, 1e9), ONES)
    track = np.full((7, 14, 2), np.nan)
    track[frames] = np.where(confidence[..., None] > 0, image, np.nan)
    noise = image_noise(track, np.isfinite(track[..., 0]))
    assert 0.015 < noise < 0.06
    trust = float(bone_deviation_m(1.0, noise, TRUST_PER_MISFIT))
    bones, robust, given = bone_vectors(candidates[:, 0]), np.ones((6, 14)), np.zeros((0, 14, 3))
    for due in range(3):
        held = given[-2:]
        whole = frames[due - len(held) :]
        even = whole[2:] == whole[:-2] + 2
        weight = confidence[due:] * robust / noise**2
        plain, energy = plain_fit(held, image[due:], weight, bones[due:], trust, even)
        found = live.fit(np.zeros(6 - due, dtype=np.int64), ONES)
        np.testing.assert_allclose(found, plain[0] - mid_hip(plain[:1])[0], atol=2e-3)
        placed = np.concatenate([found[None] + mid_hip(plain[:1]), plain[1:]])
        assert energy(placed) < energy(plain) * (1.0 + 1e-3)
        given = np.concatenate([given, placed[:1]])
        off = np.where(confidence[due:] > 0, np.linalg.norm(plain[..., :2] - image[due:], axis=-1), 0.0)
        robust = (1.0 / (1.0 + (off / (3.0 * noise)) ** 2))[1:]


@pytest.mark.parametrize("frames", [1, 2, 7])
def test_steps_of_a_window_are_those_of_the_fit_of_whole_tracks(rng: np.random.Generator, frames: int) -> None:
    truth, candidates, _ = seen_walk(rng, frames)
    image, weights = truth[..., :2] + rng.normal(0, 0.03, (frames, 14, 2)), rng.uniform(0.2, 1.0, (frames, 14))
    bones, start = bone_vectors(candidates[:, 0]), candidates[:, 1].copy()
    noise, firmness, smoothness = (
        np.full(14, 0.03),
        rng.uniform(10.0, 100.0, frames),
        np.full(max(frames - 2, 0), 500.0),
    )
    forest, far = BoneForest((OP14,), REFERENCE_LENGTHS_M), np.full(frames, 1e9)
    terms = [
        image_term(image, weights / noise**2, start, far),
        AccelerationTerm(smoothness[:, None, None]),
        BoneVectorTerm(OP14, bones, firmness[:, None, None]),
    ]
    is_kept, held = np.zeros(frames, dtype=bool), np.zeros((0, 14, 3))
    for steps in (1, 3):  # arrays as `WindowFit` gives them: of others, the kernel would be compiled once more
        whole = fit_bones(forest, forest.state_of(start), terms, FitSettings(steps, 0.0)).positions_m
        guess = (held, start, image, far, weights, noise, is_kept, bones, firmness, smoothness)
        found = fit_window(*guess, REFERENCE_LENGTHS_M.copy(), steps, 0.0)
        assert np.abs(found - start).max() > 0.05
        np.testing.assert_allclose(found, whole, atol=1e-8)


def fitted_live(
    image: np.ndarray, candidates: np.ndarray, match: np.ndarray, *, distance: float, lag: int
) -> np.ndarray:
    """Return poses (frame - lag, 14, 3) of a live fit; joints that are NaN in the image have no weight."""
    live, poses = WindowFit(RATE_HZ), []
    for frame, points in enumerate(image):
        weights = np.isfinite(points[:, 0]).astype(float)
        live.see(seen(frame, points, weights, candidates[frame], match[frame], distance), ONES)
        if frame >= lag:
            poses.append(live.fit(np.zeros(lag + 1, dtype=np.int64), ONES))
    return np.stack(poses)


def error_m(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(poses - truth[: len(poses)], axis=-1).mean())


def test_fitted_poses_are_nearer_than_the_matches_and_keep_their_lengths(rng: np.random.Generator) -> None:
    truth, candidates, match = seen_walk(rng, 40)
    image = truth[..., :2] / (1.0 - truth[..., 2:] / 4.0) + rng.normal(0, 0.01, (40, 14, 2))
    image[rng.uniform(size=(40, 14)) < 0.1] = np.nan
    poses = fitted_live(image, candidates, match, distance=4.0, lag=5)
    lengths = np.linalg.norm(bone_vectors(poses), axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(REFERENCE_LENGTHS_M, lengths.shape), atol=1e-9)
    assert error_m(poses, truth) < 0.55 * error_m(candidates[:, 0], truth)


def test_with_joints_missing_more_steps_come_nearer(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, candidates, match = seen_walk(rng, 60)
    image = truth[..., :2] + rng.normal(0, 0.003, (60, 14, 2))
    image[rng.uniform(size=(60, 14)) < 0.3] = np.nan
    errors = []
    for steps in (1, 4):
        monkeypatch.setattr(window_fit, "STOP_MISSING", FitSettings(max_iterations=steps, tolerance=3e-3))
        errors.append(error_m(fitted_live(image, candidates, match, distance=1e9, lag=6), truth))
    assert errors[1] < 0.9 * errors[0]
    assert errors[1] < 0.5 * error_m(candidates[:54, 0], truth)


def test_a_frame_without_any_joint_in_common_keeps_the_match() -> None:
    pose = centre_and_face(walk(1)).poses_m
    fit = WindowFit(RATE_HZ)
    fit.see(seen(0, np.full((14, 2), np.nan), np.zeros(14), pose, np.array([0.05]), 4.0), ONES)
    np.testing.assert_allclose(fit.fit(np.zeros(1, dtype=np.int64), ONES), pose[0], atol=1e-6)
