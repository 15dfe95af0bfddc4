"""Databases of any size are measured when a size is given, and only then."""

from __future__ import annotations

from flows.console.this_machine import find_benchmarks


def test_a_size_adds_the_benchmarks_that_take_one() -> None:
    assert "large" not in find_benchmarks()["projections"]
    result = find_benchmarks(large=3_000)["projections"]["large"]()
    assert "3,000 projections" in result.note
    assert result.fast_per_s > 0
