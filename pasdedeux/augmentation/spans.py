"""Spans: contacts between bodies that keep their distance and not their direction.

When bodies of other sizes touch, joint pairs can stay as far apart as they were though their vectors must turn: a hug
of a smaller body has the same distances in other directions.  With z the vector of a pair and D its source length,

    (|z| - D)^2 = min over unit vectors u of |z - D u|^2,

so the bulk solver takes u from where the pair points now, and the matrix is that of a contact that keeps its vector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.source import Source
from pasdedeux.fitting import Term
from pasdedeux.fitting.terms import Normal
from pasdedeux.skeletons import BODY22

__all__ = ["SpanTerm", "Spans", "aim_spans", "find_spans", "packer", "span_vectors"]

Array = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]
Indices = npt.NDArray[np.int64]

_SHORTEST_M = 1e-6


@dataclass(frozen=True)
class Spans:
    """Pairs of joints of A and B in each frame, up to M of them, filled up with pairs of no weight.

    Args:
        points: Joint of A and joint of B (T, M, 2), as points 0 to 43.
        vectors_m: The source's vector from B's to A's, with what girth adds (T, M, 3).
        lengths_m: Its length (T, M).
        weights: (T, M).
    """

    points: Indices
    vectors_m: Array
    lengths_m: Array
    weights: Array

    @property
    def shares(self) -> Array:
        """What both joints contribute to a pair's vector (T, M, 2): 1 and -1."""
        return np.broadcast_to(np.array([1.0, -1.0]), self.points.shape)


def find_spans(source: Source, weights: Array, added_m: Array) -> Spans:
    """Pack the pairs that weigh anything.

    Args:
        source: The template.
        weights: Weight of each pair's distance (T, 22 of A, 22 of B).
        added_m: What is added to each pair's distance (22, 22), metres.
    """
    frame, first, second = np.nonzero(weights > 0)
    vectors = source.positions_m[frame, 0, first] - source.positions_m[frame, 1, second]
    lengths = np.linalg.norm(vectors, axis=-1)
    wanted = np.maximum(lengths + added_m[first, second], 0.0)
    packed = packer(frame, len(weights))
    return Spans(
        points=packed(np.stack([first, second + BODY22.num_joints], axis=-1)),
        vectors_m=packed(vectors * (wanted / np.maximum(lengths, _SHORTEST_M))[:, None]),
        lengths_m=packed(wanted),
        weights=packed(weights[frame, first, second]),
    )


def packer(frame: npt.NDArray[np.intp], num_frames: int) -> Callable[[npt.NDArray[Any]], npt.NDArray[Any]]:
    """Return what lays values (n, ...) of these frames (n,), which rise, out by frame (num_frames, M, ...).

    M is the greatest number in a frame; the others are filled up with zeros.
    """
    counts = np.bincount(frame, minlength=num_frames)
    place = np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame]

    def packed(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        laid = np.zeros((num_frames, int(counts.max(initial=0)), *values.shape[1:]), values.dtype)
        laid[frame, place] = values
        return laid

    return packed


def span_vectors(spans: Spans, points_m: Array) -> Array:
    """Return the vectors of the pairs (*batch, T, M, 3) of points (*batch, T, 44, 3)."""
    frames = np.arange(len(spans.weights))[:, None]
    return np.asarray(points_m[..., frames, spans.points[..., 0], :] - points_m[..., frames, spans.points[..., 1], :])


@dataclass(frozen=True)
class SpanTerm(Term):
    """sum w (|p_i - p_j| - D)^2 over the pairs of each frame."""

    spans: Spans

    is_quadratic = False

    def _units(self, positions_m: Array) -> tuple[Array, Array]:
        vectors = span_vectors(self.spans, positions_m)
        lengths = np.sqrt((vectors**2).sum(axis=-1))
        return vectors / np.maximum(lengths, _SHORTEST_M)[..., None], lengths

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        _, lengths = self._units(positions_m)
        return float((self.spans.weights * (lengths - self.spans.lengths_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        units, lengths = self._units(positions_m)
        pull = (self.spans.weights * (lengths - self.spans.lengths_m))[..., None] * units
        frames = np.arange(len(positions_m))[:, None]
        for end, sign in enumerate((1.0, -1.0)):
            np.add.at(normal.gradient, (frames, self.spans.points[..., end]), sign * pull)

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the Gauss-Newton curvature, which leaves out the distance's own bending."""
        units, _ = self._units(positions_m)
        normal.stencils.append((self.spans.points, np.array(self.spans.shares), self.spans.weights, units))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def aim_spans(
    offsets: AnyFloat, reference: AnyFloat, points: Indices, lengths: AnyFloat, weights: AnyFloat, aim: AnyFloat
) -> None:
    """Leave D u less r's vector in `aim` (3, T, M, variant), u where each pair points now."""
    frames, num_pairs, count = aim.shape[1:]
    scale = np.empty(count, aim.dtype)
    smallest = aim.dtype.type(_SHORTEST_M)
    for t in range(frames):
        for e in range(num_pairs):
            if weights[t, e] <= 0:
                continue
            i, j, length = points[t, e, 0], points[t, e, 1], lengths[t, e]
            scale[:] = 0
            for axis in range(3):
                one, other = offsets[axis, t, i], offsets[axis, t, j]
                given, aims = reference[axis, t, e], aim[axis, t, e]
                for v in range(count):
                    aims[v] = (one[v] - other[v]) + given[v]
                for v in range(count):
                    scale[v] += aims[v] * aims[v]
            for v in range(count):
                scale[v] = length / max(np.sqrt(scale[v]), smallest)
            for axis in range(3):
                given, aims = reference[axis, t, e], aim[axis, t, e]
                for v in range(count):
                    aims[v] = aims[v] * scale[v] - given[v]
