"""The factor that all variants of a take share: a block form of the banded Cholesky, made for many right-hand sides.

Frames are interleaved with joints (half-bandwidth 88).  Two frames form a block of 88, in which the matrix is block
tridiagonal; its Schur complements are inverted once, and a solve is two matrix products a block, over all variants at
once.  LAPACK's banded solve takes one right-hand side at a time and is several times slower for a hundred variants.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt
import scipy.linalg

from pasdedeux.augmentation.source import NUM_POINTS

__all__ = ["Factor", "factorise", "solve"]

Array = npt.NDArray[np.floating]

BLOCK = 2 * NUM_POINTS
"""Unknowns of two frames."""
_COLUMNS = 16
"""Right-hand sides of one matrix product; a multiple of every BLAS kernel's width."""


@dataclass(frozen=True)
class Factor:
    """A factored matrix: inverse Schur complements (block, 88, 88) and the diagonals that couple neighbouring blocks.

    Args:
        inverse: Inverse of each block's Schur complement (K, 88, 88).
        lag1: Coupling of the second frame of a block with the first of the next (K, 44); the last entry is 0.
        lag2: Coupling of each frame with the same place of the next block (K, 88); the last entry is 0.
    """

    inverse: Array
    lag1: Array
    lag2: Array

    @property
    def num_blocks(self) -> int:
        """Number of blocks of two frames."""
        return len(self.inverse)

    def astype(self, dtype: npt.DTypeLike) -> Factor:
        """Give the factor in another precision."""
        return Factor(*(np.ascontiguousarray(part, dtype=dtype) for part in (self.inverse, self.lag1, self.lag2)))


def factorise(matrix: Array, lag1: Array, lag2: Array) -> Factor:
    """Factor the symmetric positive definite matrix given by its frame blocks and temporal couplings.

    Args:
        matrix: Blocks within a frame (T, 44, 44).
        lag1: Coupling of each point at frames t and t+1 (T-1, 44).
        lag2: Coupling of each point at frames t and t+2 (T-2, 44).

    Raises:
        numpy.linalg.LinAlgError: The matrix is not positive definite.
    """
    frames, n = len(matrix), NUM_POINTS
    blocks = (frames + 1) // 2
    inner, outer, halves = np.zeros((blocks, n)), np.zeros((blocks, n)), np.zeros((blocks, 2, n))
    inner[: len(lag1[0::2])] = lag1[0::2]
    outer[: len(lag1[1::2])] = lag1[1::2]
    halves[: len(lag2[0::2]), 0] = lag2[0::2]
    halves[: len(lag2[1::2]), 1] = lag2[1::2]
    same = halves.reshape(blocks, BLOCK)
    inverse = np.empty((blocks, BLOCK, BLOCK))
    diagonal = np.arange(n)
    for k in range(blocks):
        schur = np.zeros((BLOCK, BLOCK))
        schur[:n, :n] = matrix[2 * k]
        schur[n:, n:] = matrix[2 * k + 1] if 2 * k + 1 < frames else np.eye(n)
        schur[diagonal + n, diagonal] = inner[k]
        if k > 0:
            half = same[k - 1][:, None] * inverse[k - 1]
            half[:n] += outer[k - 1][:, None] * inverse[k - 1][n:]
            update = half * same[k - 1][None]
            update[:, :n] += half[:, n:] * outer[k - 1][None]
            schur -= update
        lower, info = scipy.linalg.lapack.dpotrf(schur, lower=1)
        if info == 0:
            lower, info = scipy.linalg.lapack.dpotri(lower, lower=1)
        if info != 0:
            raise np.linalg.LinAlgError(f"the matrix is not positive definite at frame {2 * k}")
        inverse[k] = np.tril(lower) + np.tril(lower, -1).T
    return Factor(inverse=inverse, lag1=outer, lag2=same)


@numba.njit(cache=True, nogil=True)
def _solve(inverse: Array, lag1: Array, lag2: Array, rhs: Array) -> None:
    blocks, size, count = rhs.shape
    half = size // 2
    work = np.zeros((size, _COLUMNS), rhs.dtype)
    product = np.zeros((size, _COLUMNS), rhs.dtype)
    for start in range(0, count, _COLUMNS):
        stop = min(start + _COLUMNS, count)
        for k in range(blocks):
            for i in range(size):
                for v in range(start, stop):
                    work[i, v - start] = rhs[k, i, v]
            if k > 0:
                for i in range(size):
                    c = lag2[k - 1, i]
                    if c != 0.0:
                        for v in range(start, stop):
                            work[i, v - start] -= c * rhs[k - 1, i, v]
                for i in range(half):
                    c = lag1[k - 1, i]
                    if c != 0.0:
                        for v in range(start, stop):
                            work[i, v - start] -= c * rhs[k - 1, i + half, v]
            if count == _COLUMNS:
                np.dot(inverse[k], work, rhs[k])
            else:
                np.dot(inverse[k], work, product)
                for i in range(size):
                    for v in range(start, stop):
                        rhs[k, i, v] = product[i, v - start]
        for k in range(blocks - 2, -1, -1):
            for i in range(size):
                c = lag2[k, i]
                for v in range(start, stop):
                    work[i, v - start] = c * rhs[k + 1, i, v]
            for i in range(half):
                c = lag1[k, i]
                if c != 0.0:
                    for v in range(start, stop):
                        work[i + half, v - start] += c * rhs[k + 1, i, v]
            np.dot(inverse[k], work, product)
            for i in range(size):
                for v in range(start, stop):
                    rhs[k, i, v] -= product[i, v - start]


def solve(factor: Factor, rhs: Array) -> None:
    """Solve in place for right-hand sides (block, 88, count), contiguous, of the factor's precision.

    The matrix products always see 16 columns, filled up where fewer are left: BLAS picks its kernels, and with them the
    order of its sums, by the number of columns, so a column's bits would depend on how many others came along.
    """
    _solve(factor.inverse, factor.lag1, factor.lag2, rhs)
