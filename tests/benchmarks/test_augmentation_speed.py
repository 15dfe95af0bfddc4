import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from pasdedeux.augmentation.benchmarks import BENCHMARKS, _banded, benchmark_source
from pasdedeux.augmentation.factor import factorise, solve
from pasdedeux.augmentation.terms import build_problem


def test_the_baseline_solves_the_same_system() -> None:
    problem = build_problem(benchmark_source(10))
    factor = factorise(problem.matrix[0], problem.lag1[0], problem.lag2[0])
    rhs = np.random.default_rng(1).normal(size=(1, 5, 88, 3))
    plain = cho_solve_banded((cholesky_banded(_banded(problem), lower=True), True), rhs.reshape(-1, 3))
    solve(factor, rhs, np.array([0]))
    np.testing.assert_allclose(rhs.reshape(-1, 3), plain, atol=1e-8)


def test_batches_are_many_times_faster_than_solving_one_by_one() -> None:
    assert BENCHMARKS["bulk"]().ratio > 10.0
