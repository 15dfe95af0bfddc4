"""Compare forward kinematics with its definition, joint by joint."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.arrays import Array
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.kinematics.rotations import multiply, normalise, rotate
from pasdedeux.skeletons import BODY22, PAIR17, Skeleton


def plain(skeleton: Skeleton, offsets_m: Array, roots_m: Array, local: Array) -> tuple[Array, Array]:
    """Return positions and rotations by the recursion from parents to children."""
    positions, world = np.empty((*local.shape[:-1], 3)), np.empty(local.shape)
    for joint in skeleton.order:
        if joint == skeleton.root:
            positions[..., joint, :], world[..., joint, :] = roots_m, local[..., joint, :]
            continue
        parent = skeleton.parents[joint]
        world[..., joint, :] = multiply(world[..., parent, :], local[..., joint, :])
        carried = rotate(world[..., parent, :], offsets_m[..., joint, :])
        positions[..., joint, :] = positions[..., parent, :] + carried
    return positions, world


@pytest.mark.parametrize(
    "skeleton", [BODY22, PAIR17, Skeleton("one", ("root",), (-1,))], ids=lambda skeleton: skeleton.name
)
@pytest.mark.parametrize("batch", [(), (0,), (1,), (7,), (3, 2)], ids=str)
@pytest.mark.parametrize("bodies", ["one body", "a body each", "a body a person"])
def test_forward_kinematics_is_exactly_the_recursion(skeleton: Skeleton, batch: tuple[int, ...], bodies: str) -> None:
    rng, joints = np.random.default_rng(3), skeleton.num_joints
    local = normalise(rng.normal(size=(*batch, joints, 4)))
    shape = {"one body": (), "a body each": batch, "a body a person": (1,) * (len(batch) - 1) + batch[-1:]}[bodies]
    offsets, roots = rng.normal(size=(*shape, joints, 3)), rng.normal(size=(*batch, 3))
    expected = plain(skeleton, offsets, roots, local)
    for got, wanted in zip(forward_kinematics(skeleton, offsets, roots, local), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)


def test_motions_in_single_precision_or_backwards_in_memory_are_posed_alike() -> None:
    rng = np.random.default_rng(4)
    local, roots = normalise(rng.normal(size=(5, 22, 4))), rng.normal(size=(5, 3))
    offsets = rng.normal(size=(22, 3))
    expected = plain(BODY22, offsets, roots[::-1], local[::-1])
    for got, wanted in zip(forward_kinematics(BODY22, offsets, roots[::-1], local[::-1]), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
    small = forward_kinematics(BODY22, *(part.astype(np.float32) for part in (offsets, roots, local)))[0]
    np.testing.assert_allclose(small[::-1], expected[0], atol=1e-5)
