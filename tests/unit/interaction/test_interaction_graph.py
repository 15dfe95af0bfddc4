"""Check graphs over joints and the kernel of planar triangulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from pasdedeux.errors import InputError
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.surfaces import closest_joint_distance
from pasdedeux.interaction.triangulation import delaunay_edges_fast, jitter, max_edges


def scipy_edges(points: np.ndarray) -> set[tuple[int, int]]:
    simplices = Delaunay(points).simplices
    size = simplices.shape[1]
    return {tuple(sorted((int(s[i]), int(s[j])))) for s in simplices for i in range(size) for j in range(i)}


def as_set(edges: np.ndarray) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in edges}


@pytest.mark.parametrize("shape", [(1.0, 1.0), (1.0, 0.02), (1e-3, 1e-3)])
def test_triangulation_kernel_agrees_with_scipy(shape: tuple[float, float]) -> None:
    points = np.random.default_rng(3).normal(size=(300, 34, 2)) * shape
    for figure, edges, count in zip(points, *delaunay_edges_fast(points), strict=True):
        assert as_set(edges[:count]) == scipy_edges(figure + jitter(34))


@pytest.mark.parametrize("num_points", [1, 2, 3, 4, 5])
def test_triangulation_kernel_takes_few_points(num_points: int) -> None:
    points = np.random.default_rng(num_points).normal(size=(20, num_points, 2))
    for figure, edges, count in zip(points, *delaunay_edges_fast(points), strict=True):
        assert as_set(edges[:count]) == as_set(delaunay_edges(figure))


@pytest.mark.parametrize("kind", ["duplicates", "line", "grid", "one_point"])
def test_degenerate_points_have_one_full_triangulation(kind: str) -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(34, 2))
    if kind == "duplicates":
        points[10:20] = points[0:10]
    elif kind == "line":
        points[:, 1] = 0.3 * points[:, 0]
    elif kind == "grid":
        points = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)[:34]
    else:
        points[:] = 0.7
    edges, counts = delaunay_edges_fast(points[None])
    again, _ = delaunay_edges_fast(points[None])
    found = as_set(edges[0, : counts[0]])
    assert found == as_set(again[0, : counts[0]])
    # Euler: a triangulation of n points has between 2n - 3 and 3n - 6 edges, and joins every point.
    assert 2 * 34 - 3 <= len(found) <= max_edges(34)
    assert {joint for edge in found for joint in edge} == set(range(34))


@pytest.mark.parametrize("dimension", [2, 3])
def test_delaunay_edges_are_those_of_scipy(dimension: int) -> None:
    points = np.random.default_rng(7).normal(size=(34, dimension))
    assert as_set(delaunay_edges(points)) == scipy_edges(points)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_missing_joint_is_refused(dimension: int) -> None:
    points = np.zeros((5, dimension))
    points[3, 0] = np.nan
    with pytest.raises(InputError, match="point 3 is not finite"):
        delaunay_edges(points)


def test_the_closest_joints_of_two_people_are_found() -> None:
    pair = np.random.default_rng(11).normal(size=(4, 2, 17, 3))
    pair[:, 1, 3] = pair[:, 0, 7] + [0.001, 0.0, 0.0]
    np.testing.assert_allclose(closest_joint_distance(pair), 0.001, atol=1e-12)
