"""Callers of kernels hand them plain arrays: each kernel compiles once, whatever arrays the callers were given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from pasdedeux.fitting import bones, levenberg
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.terms import DistanceTerm, PointTerm
from pasdedeux.interaction import contacts, shape_context
from pasdedeux.interaction.shape_context import ShapeCoverage, shape_bins
from pasdedeux.kinematics import forward, forward_kinematics
from pasdedeux.plausibility import capsules
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.reconstruction import depth
from pasdedeux.skeletons import OP14, PAIR17

RNG = np.random.default_rng(5)
POSES = RNG.normal(size=(4, 14, 3))
PAIRS = RNG.normal(size=(3, 2, 17, 3))
POINTS, SHARES = RNG.integers(0, 14, (4, 5, 2)), RNG.normal(size=(4, 5, 2))
OFFSETS, ROOTS = RNG.normal(size=(14, 3)), RNG.normal(size=(4, 3))
TURNS = RNG.normal(size=(4, 14, 4))
IMAGE, CANDIDATES = RNG.normal(size=(14, 2)), RNG.normal(size=(3, 14, 3))
BARS, LENGTHS, WEIGHTS = np.array([[3, 4], [6, 7], [2, 10]]), np.full((4, 3), 0.5), np.ones((4, 3))
RADII = np.full((2, 17), 0.05)


def read_only(values: np.ndarray) -> np.ndarray:
    copy = values.copy()
    copy.flags.writeable = False
    return copy


def strided(values: np.ndarray) -> np.ndarray:
    return np.repeat(values, 2, axis=-1)[..., ::2]


def moved(positions: np.ndarray) -> np.ndarray:
    """Return positions after steps of a fit, whose curvature sums the stencils of bars between points."""
    forest = BoneForest((OP14,), np.ones(14))
    terms = [DistanceTerm(BARS, LENGTHS, WEIGHTS), PointTerm(positions, np.ones(positions.shape))]
    return levenberg.fit_bones(forest, forest.state_of(positions), terms).positions_m


def cover(bins: np.ndarray) -> np.ndarray:
    coverage = ShapeCoverage(PAIRS)
    coverage.add(bins)
    return coverage.shape


@pytest.mark.parametrize("change", [read_only, strided, np.asfortranarray])
@pytest.mark.parametrize(
    ("kernels", "call", "arrays"),
    [
        ([(contacts, "_sum_up")], contacts.stencil_vectors, [POINTS, SHARES, POSES]),
        ([(contacts, "_sum_up")], contacts.stencil_vectors, [POINTS, SHARES, POSES.astype(np.float32)]),
        (
            [
                (bones, "directions_of"),
                (bones, "place_along_bones"),
                (bones, "turn_bones"),
                (levenberg, "_add_stencils"),
            ],
            moved,
            [POSES],
        ),
        (
            [(forward, "carry_out")],
            lambda *arrays: np.concatenate(forward_kinematics(OP14, *arrays), axis=-1),
            [OFFSETS, ROOTS, TURNS],
        ),
        ([(capsules, "_penetrations")], capsule_model(PAIR17).penetration, [PAIRS, RADII]),
        ([(shape_context, "lower_shape_minima")], cover, [shape_bins(PAIRS)]),
        (
            [(depth, "_vote_signs")],
            lambda *arrays: depth.vote_on_signs(None, *arrays, np.zeros(3), noise_m=0.01, passed_s=0.1).cost,
            [IMAGE, CANDIDATES],
        ),
    ],
)
def test_a_kernel_does_not_compile_again_for_another_layout(
    kernels: Sequence[tuple[Any, str]],
    call: Callable[..., np.ndarray],
    arrays: Sequence[np.ndarray],
    change: Callable[[np.ndarray], np.ndarray],
) -> None:
    plain = call(*(np.array(array) for array in arrays))
    before = [signatures(*kernel) for kernel in kernels]
    assert np.array_equal(call(*(change(array) for array in arrays)), plain)
    assert [signatures(*kernel) for kernel in kernels] == before


def signatures(module: Any, name: str) -> set[Any]:
    kernel = getattr(module, name)
    found = set(getattr(kernel, "_made", kernel).overloads)
    assert found, f"{name} was not called"
    return found
