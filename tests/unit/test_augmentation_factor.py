"""The shared factor solves what LAPACK's banded Cholesky solves."""

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from pasdedeux.augmentation.factor import factorise, solve
from pasdedeux.augmentation.problem import Problem
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import build_problem
from pasdedeux.choreography.duets import make_duet


def banded_matrix(problem: Problem) -> np.ndarray:
    """Return the horizontal matrix in LAPACK's lower banded form (2 n + 1, T n)."""
    frames, n = problem.num_frames, problem.source.num_points
    banded = np.zeros((2 * n + 1, frames * n))
    for shift in range(n):
        rows = np.arange(n - shift)
        banded[shift].reshape(frames, n)[:, : n - shift] = problem.matrix[0][:, rows + shift, rows]
    banded[n].reshape(frames, n)[:-1] += problem.lag1[0]
    banded[2 * n].reshape(frames, n)[:-2] += problem.lag2[0]
    return banded


def test_the_shared_factor_solves_the_same_system() -> None:
    problem = build_problem(Source(make_duet("waltz", duration_s=1.0, rate_hz=10.0).positions_m(), 10.0))
    factor = factorise(problem.matrix[0], problem.lag1[0], problem.lag2[0])
    rhs = np.random.default_rng(1).normal(size=(5, 88, 1, 3))
    plain = cho_solve_banded((cholesky_banded(banded_matrix(problem), lower=True), True), rhs.reshape(-1, 3))
    solve(factor, rhs, np.array([0]))
    np.testing.assert_allclose(rhs.reshape(-1, 3), plain, atol=1e-8)
