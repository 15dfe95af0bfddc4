"""Cholesky solver for symmetric matrices of frame blocks, in which each frame couples to the next two."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array


class NotPositiveDefinite(ArithmeticError):  # noqa: N818 - describes the matrix; callers increase the damping
    """The matrix is not positive definite."""


def solve_blocks(diagonal: Array, below: Array, rhs: Array) -> Array:
    """Solve a symmetric system by its lower half; 6 n^3 operations a frame, all of them in matrix products.

    Args:
        diagonal: Blocks of each frame (T, n, n); the factor takes their place.
        below: Rows of frames t+1 and t+2 in the columns of frame t (T, 2, n, n); those past the end are ignored.
        rhs: Right-hand side (T, n).

    Raises:
        NotPositiveDefinite: No Cholesky factor exists.
    """
    from scipy.linalg.blas import dtrsm  # here: planning need not wait for it
    from scipy.linalg.lapack import dpotrf

    frames, n = rhs.shape
    panels = np.zeros((frames, 2 * n, n))
    pending = np.zeros((2 * n, 2 * n))
    solution = np.array(rhs)
    carry = np.zeros(2 * n)
    for t in range(frames):
        factor, info = dpotrf((diagonal[t] - pending[:n, :n]).T, lower=1, overwrite_a=1)
        if info != 0:
            raise NotPositiveDefinite(f"frame {t}: pivot {info} is not positive")
        solved = dtrsm(1.0, factor, (solution[t] - carry[:n])[:, None], side=0, lower=1)[:, 0]
        solution[t] = solved
        diagonal[t] = factor
        if t + 1 == frames:
            break  # nothing comes after
        panel = below[t].reshape(2 * n, n).copy()
        panel[:n] -= pending[n:, :n]
        panel = dtrsm(1.0, factor, panel.T, side=0, lower=1, overwrite_b=1).T
        update = panel @ panel.T
        update[:n, :n] += pending[n:, n:]
        pending = update
        carry[:n] = carry[n:]
        carry[n:] = 0.0
        carry += panel @ solved
        panels[t] = panel
    padded = np.zeros((frames + 2, n))
    for t in range(frames - 1, -1, -1):
        known = solution[t] - panels[t].T @ padded[t + 1 : t + 3].reshape(-1)
        padded[t] = dtrsm(1.0, diagonal[t].T, known[:, None], side=0, lower=0)[:, 0]
    return padded[:frames]
