"""Compare the kernels of rotations with the functions over arrays."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.compiled import compiled
from pasdedeux.kinematics import rotation_kernels, rotations


@compiled()
def run_kit(quaternions, vectors):
    out = np.empty((quaternions.shape[0], 26))
    for at in range(quaternions.shape[0]):
        p = (quaternions[at, 0, 0], quaternions[at, 0, 1], quaternions[at, 0, 2], quaternions[at, 0, 3])
        q = (quaternions[at, 1, 0], quaternions[at, 1, 1], quaternions[at, 1, 2], quaternions[at, 1, 3])
        a, b = rotation_kernels.row_of(vectors[at], 0), rotation_kernels.row_of(vectors[at], 1)
        x = rotation_kernels.rotate(p, (1.0, 0.0, 0.0))
        y, z = rotation_kernels.rotate(p, (0.0, 1.0, 0.0)), rotation_kernels.rotate(p, (0.0, 0.0, 1.0))
        unit_a, unit_b = rotation_kernels.normalise(a), rotation_kernels.normalise(b)
        row = (
            *rotation_kernels.multiply(p, rotation_kernels.conjugate(q)),
            *rotation_kernels.rotate(p, a),
            *rotation_kernels.unitquat_from_rotvec(a),
            *rotation_kernels.rotvec_from_unitquat(p),
            *rotation_kernels.swing_between(a, b),
            *rotation_kernels.unitquat_from_axes(x, y, z),
            *rotation_kernels.carry(unit_a, unit_b, unit_a),
            rotation_kernels.length(rotation_kernels.subtract(a, b)),
        )
        for part in range(26):
            out[at, part] = row[part]
    return out


def run_arrays(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    (p, q), (a, b) = np.moveaxis(quaternions, 1, 0), np.moveaxis(vectors, 1, 0)
    return np.concatenate(
        [
            rotations.multiply(p, rotations.conjugate(q)),
            rotations.rotate(p, a),
            rotations.unitquat_from_rotvec(a),
            rotations.rotvec_from_unitquat(p),
            rotations.swing_between(a, b),
            rotations.unitquat_from_rotmat(rotations.rotmat_from_unitquat(p)),
            rotations.normalise(b),
            np.linalg.norm(a - b, axis=-1, keepdims=True),
        ],
        axis=-1,
    )


@pytest.mark.parametrize("case", ["any", "opposite", "same"])
def test_the_compiled_kit_of_rotations_agrees_with_the_one_over_arrays(case: str) -> None:
    rng = np.random.default_rng(5)
    quaternions, vectors = rotations.normalise(rng.normal(size=(200, 2, 4))), rng.normal(size=(200, 2, 3))
    if case == "same":
        vectors[:, 1] = 2.0 * vectors[:, 0]
    if case == "opposite":
        # Exact in floating point, so that both kits see a half turn; carrying is not defined there.
        vectors[:, 1] = -vectors[:, 0]
    ours, theirs = run_kit(quaternions, vectors), run_arrays(quaternions, vectors)
    defined = np.r_[0:22, 25:26] if case == "opposite" else np.arange(26)
    np.testing.assert_allclose(ours[:, defined], theirs[:, defined], atol=1e-12)


def test_an_empty_direction_turns_nothing() -> None:
    quaternions, vectors = np.zeros((1, 2, 4)), np.zeros((1, 2, 3))
    quaternions[..., 3] = 1.0
    np.testing.assert_allclose(run_kit(quaternions, vectors)[0, [14, 15, 16, 17]], [0.0, 0.0, 0.0, 1.0])
