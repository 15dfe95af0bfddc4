"""Terms of a fit: squares of the positions of all points over time, with their gradient and curvature.

A term gives E, half its gradient g (frame, point, 3) and half its Gauss-Newton curvature.  Curvature has a structure
that makes it cheap: for each axis a matrix over points within a frame, diagonals between frames one and two apart, and
rank-one parts of several points.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pasdedeux.arrays import Array, Integers

AXES = 3


@dataclass
class Normal:
    """Half gradient and half Gauss-Newton curvature of all terms at one motion of T frames and N points.

    Args:
        gradient: (T, N, 3).
        matrix: Curvature within a frame (axis=3, T, N, N).
        lag1: Between frames t and t+1 at the same point (axis=3, T-1, N).
        lag2: Between frames t and t+2 (axis=3, T-2, N).
        stencils: Rank-one parts of several points each: points (T, m, k), their shares (T, m, k), weights (T, m) and
            unit vectors (T, m, 3).
    """

    gradient: Array
    matrix: Array
    lag1: Array
    lag2: Array
    stencils: list[tuple[Integers, Array, Array, Array]] = field(default_factory=list)

    @classmethod
    def zeros(cls, num_frames: int, num_points: int) -> Normal:
        """Return gradient and curvature of zero."""
        return cls(
            gradient=np.zeros((num_frames, num_points, AXES)),
            matrix=np.zeros((AXES, num_frames, num_points, num_points)),
            lag1=np.zeros((AXES, max(num_frames - 1, 0), num_points)),
            lag2=np.zeros((AXES, max(num_frames - 2, 0), num_points)),
        )

    @property
    def diagonal(self) -> Array:
        """Curvature of each point with itself (axis=3, T, N), a view to write to."""
        return np.asarray(np.einsum("atii->ati", self.matrix))


def total_energy(terms: Sequence[Term], positions_m: Array) -> float:
    """Return the energy of all terms at positions (T, N, 3), metres."""
    return sum(term.energy(positions_m) for term in terms)


class Term(ABC):
    """One sum of weighted squares."""

    is_quadratic = True
    """Whether the curvature is independent of the positions, so that it is added up once."""

    @abstractmethod
    def energy(self, positions_m: Array) -> float:
        """Return E for positions (T, N, 3), metres."""

    @abstractmethod
    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""

    @abstractmethod
    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the Gauss-Newton curvature."""


@dataclass(frozen=True)
class PointTerm(Term):
    """sum w |p - target|^2 per axis: points drawn to targets; a target that is NaN has no weight.

    Args:
        targets_m: (T, N, 3), metres.
        weights: (T, N, 3) or broadcasts to it; 0 leaves an axis free.
    """

    targets_m: Array
    weights: Array

    def __post_init__(self) -> None:
        """Clear weights of targets that are NaN."""
        is_seen = np.isfinite(self.targets_m)
        object.__setattr__(self, "weights", np.where(is_seen, self.weights, 0.0))
        object.__setattr__(self, "targets_m", np.where(is_seen, self.targets_m, 0.0))

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        return float((self.weights * (positions_m - self.targets_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        normal.gradient += self.weights * (positions_m - self.targets_m)

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the curvature."""
        normal.diagonal[...] += self.weights.transpose(2, 0, 1)


@dataclass(frozen=True)
class AccelerationTerm(Term):
    """sum w |p_t - 2 p_t+1 + p_t+2|^2: smoothness over time.

    Args:
        weights: Broadcasts to (T - 2, N, 3).
    """

    weights: Array

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        return float((self.weights * np.diff(positions_m, n=2, axis=0) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        pull = self.weights * np.diff(positions_m, n=2, axis=0)
        for shift, factor in enumerate(_SECOND_DIFFERENCE):
            normal.gradient[shift : shift + len(pull)] += factor * pull

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the curvature."""
        diagonal, count = normal.diagonal, normal.lag2.shape[1]
        weights = np.broadcast_to(self.weights, (count, *positions_m.shape[1:])).transpose(2, 0, 1)
        for i, left in enumerate(_SECOND_DIFFERENCE):
            diagonal[:, i : i + count] += left * left * weights
            for lag, right in zip((normal.lag1, normal.lag2), _SECOND_DIFFERENCE[i + 1 :], strict=False):
                lag[:, i : i + count] += left * right * weights


_SECOND_DIFFERENCE = (1.0, -2.0, 1.0)


@dataclass(frozen=True)
class QuadraticTerm(Term):
    """x' K x - 2 b' x + c with x = p - origin: a sum of squares that is already added up.

    Args:
        origin_m: (T, N, 3), metres.
        matrix: (axis=3, T, N, N), including the diagonals of temporal terms.
        lag1: (axis=3, T-1, N).
        lag2: (axis=3, T-2, N).
        linear: b (T, N, 3).
        constant: c.
    """

    origin_m: Array
    matrix: Array
    lag1: Array
    lag2: Array
    linear: Array
    constant: float = 0.0

    def _apply(self, x: Array) -> Array:
        product = np.moveaxis(np.matmul(self.matrix, np.moveaxis(x, -1, 0)[..., None])[..., 0], 0, -1)
        for shift, lag in ((1, self.lag1), (2, self.lag2)):
            if len(x) > shift:
                coupling = np.moveaxis(lag, 0, -1)
                product[:-shift] += coupling * x[shift:]
                product[shift:] += coupling * x[:-shift]
        return np.asarray(product)

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        x = positions_m - self.origin_m
        if not x.any():
            return self.constant
        return float((x * (self._apply(x) - 2.0 * self.linear)).sum() + self.constant)

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        normal.gradient += self._apply(positions_m - self.origin_m) - self.linear

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the curvature."""
        normal.matrix += self.matrix
        normal.lag1 += self.lag1
        normal.lag2 += self.lag2


@dataclass(frozen=True)
class DistanceTerm(Term):
    """sum w (|p_i - p_j| - length)^2: distances between pairs of points.

    Args:
        pairs: Points (m, 2).
        lengths_m: (T, m), metres.
        weights: (T, m) or broadcasts to it.
    """

    pairs: Integers
    lengths_m: Array
    weights: Array

    is_quadratic = False

    def __post_init__(self) -> None:
        """Broadcast the weights."""
        object.__setattr__(self, "weights", np.array(np.broadcast_to(self.weights, self.lengths_m.shape)))

    def _vectors(self, positions_m: Array) -> tuple[Array, Array]:
        vector = positions_m[:, self.pairs[:, 1]] - positions_m[:, self.pairs[:, 0]]
        distance = np.sqrt((vector**2).sum(axis=-1))
        return vector / np.maximum(distance, 1e-12)[..., None], distance

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        _, distance = self._vectors(positions_m)
        return float((self.weights * (distance - self.lengths_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        unit, distance = self._vectors(positions_m)
        pull = (self.weights * (distance - self.lengths_m))[..., None] * unit
        for column, sign in ((1, 1.0), (0, -1.0)):
            incidence = np.eye(positions_m.shape[1])[self.pairs[:, column]]
            normal.gradient += sign * np.einsum("mi,tma->tia", incidence, pull)

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the Gauss-Newton curvature, without the second derivative of the distance."""
        unit, _ = self._vectors(positions_m)
        points = np.broadcast_to(self.pairs, (len(unit), *self.pairs.shape))
        normal.stencils.append((points, np.broadcast_to(np.array([-1.0, 1.0]), points.shape), self.weights, unit))


@dataclass(frozen=True)
class HalfSpaceTerm(Term):
    """sum w max(0, limit - n . sum_k share_k x_k)^2 with x = p - origin: combinations of points kept on one side.

    Args:
        origin_m: (T, N, 3), metres.
        points: Points of each combination (T, m, k).
        shares: Share of each (T, m, k).
        normals: Unit vectors n (T, m, 3).
        limits_m: (T, m).
        weights: (T, m); 0 for unused places.
    """

    origin_m: Array
    points: Integers
    shares: Array
    normals: Array
    limits_m: Array
    weights: Array

    is_quadratic = False

    def _shortfall(self, positions_m: Array) -> Array:
        x = positions_m - self.origin_m
        rows = self.points + x.shape[1] * np.arange(len(x))[:, None, None]
        reach = np.einsum("tmka,tma->tmk", x.reshape(-1, AXES).take(rows, axis=0), self.normals)
        return np.asarray(np.maximum(self.limits_m - (self.shares * reach).sum(axis=-1), 0.0))

    def energy(self, positions_m: Array) -> float:
        """Return E."""
        return float((self.weights * self._shortfall(positions_m) ** 2).sum())

    def add_gradient(self, positions_m: Array, normal: Normal) -> None:
        """Add half the gradient."""
        pull = -(self.weights * self._shortfall(positions_m))[..., None] * self.normals
        frames = np.broadcast_to(np.arange(len(positions_m))[:, None, None], self.points.shape)
        np.add.at(normal.gradient, (frames, self.points), self.shares[..., None] * pull[:, :, None])

    def add_curvature(self, positions_m: Array, normal: Normal) -> None:
        """Add half the curvature of the combinations on the wrong side."""
        is_short = (self._shortfall(positions_m) > 0) & (self.weights > 0)
        most = int(is_short.sum(axis=1).max(initial=0))
        if most == 0:
            return
        frame, column = np.nonzero(is_short)
        at = frame, (np.cumsum(is_short, axis=1) - 1)[frame, column]
        shape = (len(positions_m), most)
        points, shares = np.zeros((*shape, self.points.shape[2]), np.int64), np.zeros((*shape, self.points.shape[2]))
        weights, units = np.zeros(shape), np.zeros((*shape, AXES))
        points[at], shares[at] = self.points[frame, column], self.shares[frame, column]
        weights[at], units[at] = self.weights[frame, column], self.normals[frame, column]
        normal.stencils.append((points, shares, weights, units))
