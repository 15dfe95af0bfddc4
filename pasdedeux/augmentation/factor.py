"""The factor shared by all variants of a take: a block form of the banded Cholesky for many right-hand sides.

Frames are interleaved with the n joints (half-bandwidth 2 n).  Two frames form a block of 2 n, in which the matrix is
block tridiagonal; its Schur complements are inverted once, and a solve is two matrix products a block, over all
variants at once.  LAPACK's banded solve takes one right-hand side at a time and is several times slower for a hundred
variants.

The products are written here, in LLVM's vectors, instead of BLAS: its kernels for AVX2 round a column by its place
among the others, even if their number is fixed, and the iteration amplifies that to a tenth of a millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Integers
from pasdedeux.compiled import compiled, inner_kernel, intrinsic

Array = npt.NDArray[np.floating]

_COLUMNS, _ROWS = 16, 4
"""Right-hand sides and rows of one tile of the product: it stays in registers, and its sums hide the delay of one."""


@dataclass(frozen=True)
class Factor:
    """A factored matrix: inverse Schur complements (block, 2 n, 2 n) and the diagonals that couple neighbouring blocks.

    Args:
        inverse: Inverse of each block's Schur complement (K, 2 n, 2 n).
        lag1: Coupling of the second frame of a block with the first of the next (K, n); the last entry is 0.
        lag2: Coupling of each frame with the same place of the next block (K, 2 n); the last entry is 0.
    """

    inverse: Array
    lag1: Array
    lag2: Array

    @property
    def num_blocks(self) -> int:
        """Number of blocks of two frames."""
        return len(self.inverse)

    def astype(self, dtype: npt.DTypeLike) -> Factor:
        """Return the factor in another precision."""
        return Factor(*(np.ascontiguousarray(part, dtype=dtype) for part in (self.inverse, self.lag1, self.lag2)))


def factorise(matrix: Array, lag1: Array, lag2: Array) -> Factor:
    """Factor the symmetric positive definite matrix given by its frame blocks and temporal couplings.

    Args:
        matrix: Blocks within a frame (T, n, n).
        lag1: Coupling of each point at frames t and t+1 (T-1, n).
        lag2: Coupling of each point at frames t and t+2 (T-2, n).

    Raises:
        numpy.linalg.LinAlgError: The matrix is not positive definite.
    """
    from scipy.linalg.lapack import dpotrf, dpotri  # here: planning need not wait for it

    frames, n = matrix.shape[:2]
    blocks, size = (frames + 1) // 2, 2 * n
    inner, outer, halves = np.zeros((blocks, n)), np.zeros((blocks, n)), np.zeros((blocks, 2, n))
    inner[: len(lag1[0::2])] = lag1[0::2]
    outer[: len(lag1[1::2])] = lag1[1::2]
    halves[: len(lag2[0::2]), 0] = lag2[0::2]
    halves[: len(lag2[1::2]), 1] = lag2[1::2]
    same = halves.reshape(blocks, size)
    inverse = np.empty((blocks, size, size))
    is_lower = np.tri(size, dtype=bool)
    for k in range(blocks):
        # A - B S^-1 B^T: A has two frames coupled by `inner`, B the diagonals `outer` and `same`.
        schur = np.diag(inner[k], n) + np.diag(inner[k], -n)
        schur[:n, :n] = matrix[2 * k]
        schur[n:, n:] = matrix[2 * k + 1] if 2 * k + 1 < frames else np.eye(n)
        if k > 0:
            half = same[k - 1, :, None] * inverse[k - 1]
            half[:n] += outer[k - 1, :, None] * inverse[k - 1, n:]
            schur -= half * same[k - 1]
            schur[:, :n] -= half[:, n:] * outer[k - 1]
        lower, info = dpotrf(schur.T, lower=1, clean=0, overwrite_a=1)
        if info == 0:
            lower, info = dpotri(lower, lower=1, overwrite_c=1)
        if info != 0:
            raise np.linalg.LinAlgError(f"the matrix is not positive definite at frame {2 * k}")
        inverse[k] = np.where(is_lower, lower, lower.T)
    return Factor(inverse=inverse, lag1=outer, lag2=same)


@inner_kernel()
def _couple_before(work: Array, before: Array, lag1: Array, lag2: Array) -> None:
    """Subtract from the right-hand sides of a block (2 n, column) the contribution of the block before."""
    size, width = work.shape
    for i in range(size):
        rows, same, c = work[i], before[i], lag2[i]
        if i < size // 2:
            other, d = before[i + size // 2], lag1[i]
            for v in range(width):
                rows[v] = (rows[v] - c * same[v]) - d * other[v]
        else:
            for v in range(width):
                rows[v] -= c * same[v]


@inner_kernel()
def _couple_after(work: Array, after: Array, lag1: Array, lag2: Array) -> None:
    """Write the contribution of the next block's solution (2 n, column) to a block into `work`."""
    size, width = work.shape
    for i in range(size):
        rows, same, c = work[i], after[i], lag2[i]
        if i < size // 2:
            for v in range(width):
                rows[v] = c * same[v]
        else:
            other, d = after[i - size // 2], lag1[i - size // 2]
            for v in range(width):
                rows[v] = c * same[v] + d * other[v]


@intrinsic
def _multiply_tile(_: Any, matrix: Any, row: Any, right: Any, column: Any, product: Any) -> Any:
    """Set a tile of a product: each entry sums over k in order, and each step rounds twice, without FMA.

    So an entry has the same bits in every place and on every processor.
    """
    from llvmlite import ir
    from numba.core import cgutils, types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        of, over, to = (context.make_array(signature.args[at])(context, builder, arguments[at]) for at in (0, 2, 4))
        lanes = ir.VectorType(context.get_value_type(matrix.dtype), _COLUMNS)
        nothing, index = ir.Constant(lanes, ir.Undefined), ir.IntType(32)

        def entry(array: Any, i: Any, j: Any) -> Any:
            return builder.gep(array.data, [builder.add(builder.mul(i, builder.extract_value(array.shape, 1)), j)])

        def entries(array: Any, i: Any) -> Any:
            return builder.bitcast(entry(array, i, arguments[3]), lanes.as_pointer())

        align = context.get_abi_sizeof(lanes.element)
        rows = [builder.add(arguments[1], arguments[1].type(number)) for number in range(_ROWS)]
        sums = [cgutils.alloca_once_value(builder, ir.Constant(lanes, None)) for _ in rows]
        for total in sums:  # the places are shared by all tiles of a call
            builder.store(ir.Constant(lanes, None), total)
        with cgutils.for_range(builder, builder.extract_value(of.shape, 1)) as loop:
            known = builder.load(entries(over, loop.index), align=align)
            for i, total in zip(rows, sums, strict=True):
                single = builder.insert_element(nothing, builder.load(entry(of, i, loop.index)), index(0))
                same = builder.shuffle_vector(single, nothing, ir.Constant(ir.VectorType(index, _COLUMNS), None))
                builder.store(builder.fadd(builder.load(total), builder.fmul(same, known)), total)
        for i, total in zip(rows, sums, strict=True):
            builder.store(builder.load(total), entries(to, i), align=align)
        return context.get_dummy_value()

    return types.none(matrix, row, right, column, product), generate


@inner_kernel()
def _multiply(matrix: Array, right: Array, product: Array) -> None:
    """Set a product of contiguous matrices (m, k) and (k, n): m is a multiple of 4, as 44 a person is, n one of 16."""
    for column in range(0, right.shape[1], _COLUMNS):
        for row in range(0, matrix.shape[0], _ROWS):
            _multiply_tile(matrix, row, right, column, product)


@compiled()
def _solve(inverse: Array, lag1: Array, lag2: Array, rhs: Array, axes: Integers) -> None:
    """Do `solve_factored`; columns of all axes are concatenated and padded to whole tiles, for vectorised loops."""
    blocks, size, _, count = rhs.shape
    width = -(-len(axes) * count // _COLUMNS) * _COLUMNS
    work, solved = np.zeros((size, width), rhs.dtype), np.zeros((size, width), rhs.dtype)
    for k in range(blocks):
        for i in range(size):
            for place in range(len(axes)):
                given, column = rhs[k, i, axes[place]], work[i, place * count : place * count + count]
                for v in range(count):
                    column[v] = given[v]
        if k > 0:
            _couple_before(work, solved, lag1[k - 1], lag2[k - 1])
        _multiply(inverse[k], work, solved)
        for i in range(size):
            for place in range(len(axes)):
                given, column = rhs[k, i, axes[place]], solved[i, place * count : place * count + count]
                for v in range(count):
                    given[v] = column[v]
    for k in range(blocks - 2, -1, -1):
        _couple_after(work, solved, lag1[k], lag2[k])
        _multiply(inverse[k], work, solved)
        for i in range(size):
            for place in range(len(axes)):
                given, column = rhs[k, i, axes[place]], solved[i, place * count : place * count + count]
                for v in range(count):
                    given[v] -= column[v]
                    column[v] = given[v]


def solve_factored(factor: Factor, rhs: Array, axes: Integers) -> None:
    """Solve in place for some of the axes of right-hand sides (block, 88, axis, count), of the factor's precision.

    A column depends on no other column and not on its place, to the last bit.
    """
    _solve(factor.inverse, factor.lag1, factor.lag2, rhs, axes)
