"""The torso basis and the lifting of 2D torsos."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.cameras import torso
from pasdedeux.cameras.torso import TORSO_JOINTS, TorsoBasis, learn_torso_basis, lift_torsos
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.errors import InputError
from pasdedeux.kinematics import align_rigid
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from tests.builders.poses import wild

BASIS = proportions_torso_basis()


def turned_torsos(seed: int, count: int, deviation: float = 0.0) -> np.ndarray:
    """Return torsos of the basis in any rotation that is not seen edge-on; `deviation` is in standard deviations."""
    rng = np.random.default_rng(seed)
    turns = rotmat_from_unitquat(normalise(rng.normal(size=(4 * count, 4))))
    turns = turns[np.abs(turns[:, 2, 2]) > 0.3][:count]
    coefficients = rng.normal(size=(len(turns), len(BASIS.components_m))) * BASIS.standard_deviation_m * deviation
    torsos = BASIS.mean_m + np.einsum("nk,kjd->njd", coefficients, BASIS.components_m)
    torsos = np.einsum("nij,nkj->nki", turns, torsos)
    return torsos - torsos[:, :1]


def picture(torsos: np.ndarray, metres_per_pixel: float = 0.004) -> np.ndarray:
    return torsos[..., :2] * [1, -1] / metres_per_pixel + [300.0, 200.0]


def nearest_twin(lifted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    error = np.linalg.norm(lifted - truth[:, None], axis=-1).max(axis=-1)
    return np.take_along_axis(error, error.argmin(axis=1)[:, None], axis=1)[:, 0]


def test_mean_torsos_are_recovered_exactly_up_to_the_twin() -> None:
    truth = turned_torsos(0, 200)
    lifted = lift_torsos(picture(truth), BASIS)
    assert lifted.is_lifted.all()
    np.testing.assert_allclose(nearest_twin(lifted.torso_m, truth), 0.0, atol=1e-4)
    np.testing.assert_allclose(lifted.metres_per_pixel.min(axis=1), 0.004, rtol=2e-3)
    np.testing.assert_allclose(lifted.root_px[:, 0], [[300.0, 200.0]] * 200, atol=1e-2)
    mirrored = truth * [1, 1, -1]
    # The mean torso is flat to a millimetre or two, so the twin is its mirror image.
    np.testing.assert_allclose(lifted.backbones[:, 0], lifted.backbones[:, 1] * [1, 1, -1], atol=5e-3)
    assert nearest_twin(lifted.torso_m, mirrored).max() < 0.01


def test_bent_torsos_are_recovered_to_a_few_centimetres_and_the_scale_to_a_few_percent() -> None:
    truth = turned_torsos(1, 300, deviation=1.0)
    lifted = lift_torsos(picture(truth), BASIS)
    assert np.median(nearest_twin(lifted.torso_m, truth)) < 0.05
    assert np.median(np.abs(np.log(lifted.metres_per_pixel / 0.004))) < 0.05


def test_the_first_twin_has_the_neck_nearer_to_the_camera() -> None:
    lifted = lift_torsos(picture(turned_torsos(2, 100, 0.5)), BASIS)
    assert (lifted.backbones[:, 0, 2] >= lifted.backbones[:, 1, 2]).all()


def test_lifting_does_not_change_with_the_place_and_size_of_the_picture() -> None:
    torsos = turned_torsos(3, 50, 0.5)
    lifted = lift_torsos(picture(torsos, 0.004), BASIS)
    moved = lift_torsos(picture(torsos, 0.001) + 77.0, BASIS)
    np.testing.assert_allclose(lifted.torso_m, moved.torso_m, atol=1e-6)
    np.testing.assert_allclose(lifted.metres_per_pixel, 4 * moved.metres_per_pixel, rtol=1e-6)


def test_missing_joints_are_left_out_and_too_few_are_refused() -> None:
    truth = turned_torsos(4, 60)
    px = picture(truth)
    px[:20, 0] = np.nan
    px[20:40, [1, 5]] = np.nan
    px[40:, [0, 1, 2]] = np.nan
    lifted = lift_torsos(px, BASIS)
    np.testing.assert_array_equal(lifted.is_lifted, [True] * 40 + [False] * 20)
    assert np.isnan(lifted.torso_m[40:]).all()
    assert np.isnan(lifted.metres_per_pixel[40:]).all()
    np.testing.assert_allclose(nearest_twin(lifted.torso_m[:20], truth[:20]), 0.0, atol=1e-3)
    np.testing.assert_allclose(lifted.root_px[:20, 0], [[300.0, 200.0]] * 20, atol=0.1)
    one_point = np.full((1, 6, 2), 100.0)
    assert not lift_torsos(one_point, BASIS).is_lifted[0]
    assert lift_torsos(np.zeros((0, 6, 2)), BASIS).torso_m.shape == (0, 2, 6, 3)


def test_a_torso_seen_edge_on_gives_finite_numbers() -> None:
    px = picture(BASIS.mean_m[None] * [0, 1, 1])
    lifted = lift_torsos(px, BASIS)
    for values in (lifted.torso_m, lifted.metres_per_pixel, lifted.log_scale_deviation):
        assert np.isfinite(values).all()


def test_a_basis_learned_from_moving_people_spans_their_torsos() -> None:
    poses = wild(5, 400)
    poses = poses * np.linspace(0.8, 1.2, 400)[:, None, None]
    learned = learn_torso_basis(poses)
    assert 0.6 < learned.explained_variance.sum() <= 1 + 1e-12
    assert (np.diff(learned.standard_deviation_m) <= 1e-12).all()
    flat = learned.components_m.reshape(4, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(4), atol=1e-9)
    up = learned.mean_m[1]
    assert up[1] > 0
    np.testing.assert_allclose(up[[0, 2]], 0.0, atol=1e-9)
    assert learned.mean_m[TORSO_JOINTS.index("left_shoulder"), 0] > 0
    moved = learn_torso_basis(poses @ rotmat_from_unitquat(normalise(np.array([1.0, 2, 3, 4]))).T + 5.0)
    aligned = align_rigid(moved.mean_m, learned.mean_m).apply(moved.mean_m)
    np.testing.assert_allclose(aligned, learned.mean_m, atol=1e-6)


def test_unusable_bases_are_refused() -> None:
    with pytest.raises(InputError, match="at least 10 poses"):
        learn_torso_basis(wild(0, 5))
    with pytest.raises(InputError, match="per component"):
        TorsoBasis(BASIS.mean_m, BASIS.components_m, np.ones(1), np.ones(1))


def test_many_torsos_are_lifted_in_blocks_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    px = picture(turned_torsos(6, 50, 1.0))
    whole = lift_torsos(px, BASIS)
    monkeypatch.setattr(torso, "BLOCK_SIZE", 7)
    for weights in (None, np.ones((50, 6))):
        blocks = lift_torsos(px, BASIS, weights=weights)
        np.testing.assert_allclose(blocks.torso_m, whole.torso_m, atol=1e-9)
        np.testing.assert_array_equal(blocks.is_lifted, whole.is_lifted)
