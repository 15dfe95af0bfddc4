import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from pasdedeux.augmentation.factor import factorise, solve
from pasdedeux.augmentation.terms import build_problem
from pasdedeux.benchmarks.augmentation import banded_matrix, benchmark_source


def test_the_baseline_solves_the_same_system() -> None:
    problem = build_problem(benchmark_source(10))
    factor = factorise(problem.matrix[0], problem.lag1[0], problem.lag2[0])
    rhs = np.random.default_rng(1).normal(size=(5, 88, 1, 3))
    plain = cho_solve_banded((cholesky_banded(banded_matrix(problem), lower=True), True), rhs.reshape(-1, 3))
    solve(factor, rhs, np.array([0]))
    np.testing.assert_allclose(rhs.reshape(-1, 3), plain, atol=1e-8)
