"""Test that the result of an item does not depend on its batch, with any kernels that OpenBLAS may choose."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import astuple

import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features

from pasdedeux.augmentation.factor import Factor, solve_factored
from pasdedeux.cameras.torso import lift_torsos
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.kinematics import align_rigid
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.skeletons import PAIR17
from tests.builders.toy_runs import ROOT

Array = np.ndarray

KERNELS = {
    "Prescott": "sse3",
    "Nehalem": "sse4.2",
    "Sandybridge": "avx",
    "Haswell": "avx2",
    "Zen": "avx2",
    "SkylakeX": "avx512vl",
}
"""Families of OpenBLAS's kernels, and what a processor needs to run them."""
TESTS = (
    "tests/property/test_batches.py::test_an_item_is_the_same_to_the_last_bit_in_any_batch",
    "tests/unit/augmentation/test_augmentation_solvers.py::test_a_variant_has_the_same_bits_alone_and_in_any_batch",
)


def _solved(rhs: Array) -> Array:
    rng = np.random.default_rng(1)
    parts = [rng.normal(size=(3, *shape)).astype(np.float32) for shape in ((88, 88), (44,), (88,))]
    solved = np.ascontiguousarray(np.moveaxis(rhs, 0, -1), dtype=np.float32)
    for axes in ([0, 2], [1]):
        solve_factored(Factor(*parts), solved, np.array(axes))
    return np.moveaxis(solved, -1, 0)


def _lifted(torso_px: Array) -> Array:
    parts = astuple(lift_torsos(torso_px, proportions_torso_basis()))
    return np.concatenate([np.asarray(part, dtype=float).reshape(len(torso_px), -1) for part in parts], axis=1)


def _aligned(pairs_m: Array) -> Array:
    points = pairs_m.reshape(len(pairs_m), -1, 3)
    return align_rigid(points, points[:, ::-1]).apply(points)


def _mapped(pairs_m: Array) -> Array:
    return op14_from_working(pairs_m, PAIR17)


@pytest.mark.parametrize(
    ("compute", "shape"), [(_solved, (3, 88, 3)), (_lifted, (6, 2)), (_aligned, (2, 17, 3)), (_mapped, (2, 17, 3))]
)
def test_an_item_is_the_same_to_the_last_bit_in_any_batch(
    compute: Callable[[Array], Array], shape: tuple[int, ...]
) -> None:
    items = np.random.default_rng(0).normal(size=(67, *shape))
    together = compute(items)
    for size in (1, 3, 16, 40):
        for first in (0, 5, 67 - size):
            part = slice(first, first + size)
            assert compute(items[part]).tobytes() == together[part].tobytes()


@pytest.mark.parametrize("kernel", [name for name, needed in KERNELS.items() if get_host_cpu_features().get(needed)])
def test_batches_do_not_matter_under_any_kernels_of_openblas_that_this_processor_can_run(kernel: str) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *TESTS],
        cwd=ROOT,
        env={**os.environ, "OPENBLAS_CORETYPE": kernel, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert said.returncode == 0, said.stdout
    assert " passed" in said.stdout
