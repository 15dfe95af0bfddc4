"""The fast forms of the sampling room beat their plain baselines by a wide margin, measured in the same run."""

from __future__ import annotations

import pytest

from pasdedeux.sampling.benchmarks import BENCHMARKS

# A tenth or less of what an idle core shows, so that a busy machine does not fail the test.
LEAST_RATIO = {
    "likelihood": 25.0,
    "exact": 3.0,
    "density": 20.0,
    "cartesian": 3.0,
    "shape_context": 90.0,
    "agreement": 1.1,
    "chain": 20.0,
    "triangulation": 3.0,
    "coverage": 10.0,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BENCHMARKS))
def test_fast_form_beats_its_plain_baseline(name: str) -> None:
    assert BENCHMARKS[name]().ratio > LEAST_RATIO[name]
