"""Graphs over joints, the planar triangulation kernel and contacts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from pasdedeux.errors import InputError
from pasdedeux.interaction import closest_joint_pairs, gap_m
from pasdedeux.interaction.graph import (
    Graph,
    delaunay_edges,
    gabriel_edges,
    graph_edges,
    minimum_weight_edges,
    nearest_edges,
)
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
    edges, counts = delaunay_edges_fast(points)
    for one, own, count in zip(points, edges, counts, strict=True):
        assert as_set(own[:count]) == scipy_edges(one + jitter(34))


@pytest.mark.parametrize("num_points", [1, 2, 3, 4, 5])
def test_triangulation_kernel_takes_few_points(num_points: int) -> None:
    points = np.random.default_rng(num_points).normal(size=(20, num_points, 2))
    edges, counts = delaunay_edges_fast(points)
    for one, own, count in zip(points, edges, counts, strict=True):
        assert as_set(own[:count]) == as_set(delaunay_edges(one))


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
    own = as_set(edges[0, : counts[0]])
    assert own == as_set(again[0, : counts[0]])
    # Euler: a triangulation of n points has between 2n - 3 and 3n - 6 edges, and joins every point.
    assert 2 * 34 - 3 <= len(own) <= max_edges(34)
    assert {joint for edge in own for joint in edge} == set(range(34))


@pytest.mark.parametrize("dimension", [2, 3])
def test_delaunay_edges_are_those_of_scipy(dimension: int) -> None:
    points = np.random.default_rng(7).normal(size=(34, dimension))
    assert as_set(delaunay_edges(points)) == scipy_edges(points)


def test_gabriel_graph_is_part_of_delaunay() -> None:
    points = np.random.default_rng(8).normal(size=(34, 2))
    gabriel = as_set(gabriel_edges(points))
    assert gabriel < as_set(delaunay_edges(points))
    for i, j in gabriel:
        centre, radius = (points[i] + points[j]) / 2, np.linalg.norm(points[i] - points[j]) / 2
        others = np.delete(points, [i, j], axis=0)
        assert np.linalg.norm(others - centre, axis=1).min() >= radius


def test_nearest_graph_holds_every_joints_nearest_neighbours() -> None:
    points = np.random.default_rng(9).normal(size=(20, 2))
    edges = as_set(nearest_edges(points, num_nearest=3))
    for joint in range(20):
        order = np.argsort(np.linalg.norm(points - points[joint], axis=1))[1:4]
        assert all(tuple(sorted((joint, int(other)))) in edges for other in order)


def test_minimum_weight_graph_is_a_triangulation_no_longer_than_delaunay_on_a_known_case() -> None:
    points = np.random.default_rng(10).normal(size=(34, 2))
    edges, delaunay = minimum_weight_edges(points), delaunay_edges(points)
    assert len(edges) == len(delaunay)
    # A quadrilateral whose Delaunay diagonal is the longer one.
    kite = np.array([[0.0, 0.0], [3.0, -0.9], [3.0, 0.9], [4.0, 0.0]])
    length = np.linalg.norm(kite[minimum_weight_edges(kite)[:, 0]] - kite[minimum_weight_edges(kite)[:, 1]], axis=1)
    other = np.linalg.norm(kite[delaunay_edges(kite)[:, 0]] - kite[delaunay_edges(kite)[:, 1]], axis=1)
    assert length.sum() <= other.sum()


@pytest.mark.parametrize("graph", list(Graph))
def test_every_graph_refuses_a_missing_joint(graph: Graph) -> None:
    points = np.zeros((5, 2))
    points[3, 0] = np.nan
    with pytest.raises(InputError, match="point 3 is not finite"):
        graph_edges(points, graph)


def test_minimum_weight_graph_refuses_space() -> None:
    with pytest.raises(InputError, match="planar"):
        graph_edges(np.zeros((5, 3)), Graph.MINIMUM_WEIGHT)


def test_closest_joint_pairs_are_found_nearest_first() -> None:
    pair = np.random.default_rng(11).normal(size=(4, 2, 17, 3))
    pair[:, 1, 3] = pair[:, 0, 7] + [0.001, 0.0, 0.0]
    contacts = closest_joint_pairs(pair, num_pairs=4)
    np.testing.assert_array_equal(contacts.joint_a[:, 0], 7)
    np.testing.assert_array_equal(contacts.joint_b[:, 0], 3)
    assert (np.diff(contacts.distance_m, axis=-1) >= 0).all()
    np.testing.assert_allclose(gap_m(pair), 0.001, atol=1e-12)
