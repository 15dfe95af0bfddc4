"""Intervals of expected errors hold for families that nothing was fitted to."""

from __future__ import annotations

import numpy as np

from benchmarks.families import INTERVAL, fitted, outside, parts

NUM_FAMILIES, NUM_ROWS = 9, 20


def simulated(rng: np.random.Generator, between: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return evidence, errors and families of rows, whose logarithms scatter by 0.25 within a family."""
    family = np.repeat(np.arange(NUM_FAMILIES), NUM_ROWS)
    evidence = np.column_stack([np.ones(len(family)), rng.normal(size=(len(family), 2))])
    left = rng.normal(0, 0.25, len(family)) + rng.normal(0, between, NUM_FAMILIES)[family]
    return evidence, np.exp(evidence @ [-2.5, 0.3, -0.2] + left), family


def test_intervals_cover_left_out_families_and_intervals_of_one_common_scatter_do_not() -> None:
    rng = np.random.default_rng(5)
    for between in (0.0, 0.25):
        held, of_one = [], []
        for _ in range(150):
            evidence, true, family = simulated(rng, between)
            known = family > 0
            middle = np.exp(evidence[~known] @ fitted(evidence[known], true[known]))
            low, high = parts(evidence[known], true[known], family[known])
            held.append(np.mean((low * middle <= true[~known]) & (true[~known] <= high * middle)))
            rest = np.log(true[known]) - evidence[known] @ fitted(evidence[known], true[known])
            low, high = np.exp(rest.std() * np.array([-1.2816, 1.2816]))
            of_one.append(np.mean((low * middle <= true[~known]) & (true[~known] <= high * middle)))
        # Student's t is wider than needed where families do not differ; 0.03 is twice the deviation of the mean.
        assert 0.77 < np.mean(held) < 0.88
        assert between == 0.0 or np.mean(of_one) < np.mean(held) - 0.03


def test_expected_errors_of_a_family_depend_on_the_errors_of_other_families_alone() -> None:
    evidence, true, family = simulated(np.random.default_rng(6), 0.2)
    halves = [family < 4, family >= 4]
    before = outside(evidence, true, family, halves)
    assert np.isfinite(before).all()
    assert (before[1] < before[0]).all()
    assert (before[0] < before[2]).all()
    after = outside(evidence, np.where(family < 4, 2.0 * true, true), family, halves)
    np.testing.assert_array_equal(after[:, family < 4], before[:, family < 4])
    # Doubled errors double the expected errors, with the same interval.
    np.testing.assert_allclose(after[:, family >= 4], 2.0 * before[:, family >= 4])
    assert INTERVAL[1] - INTERVAL[0] == 0.8
