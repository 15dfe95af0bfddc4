"""Benchmarks of commands and of growth: found by their names, and small ones measured."""

from __future__ import annotations

from functools import partial

import pytest

from flows.console import command_benchmarks
from flows.console.this_machine import find_benchmarks
from pasdedeux.benchmarks.scale import grown


def test_commands_and_scale_have_benchmarks_beside_the_stages() -> None:
    found = find_benchmarks()
    assert list(found["commands"]) == ["status", "demo"]
    assert {"chains", "projections", "scale"} <= set(found)


def test_status_is_measured_on_a_store_of_that_many_artifacts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command_benchmarks, "_NUM_ARTIFACTS", 50)
    monkeypatch.setattr(command_benchmarks, "measure", lambda name, work, count: (name, count / len(list(work()))))
    found = command_benchmarks.BENCHMARKS["status"]()
    assert found.plain_per_s == 1.0, "the plain form reads one manifest for each artifact"


def test_growth_is_measured_as_an_exponent() -> None:
    found = grown("a square", "rows", (200, 400, 800), lambda size: partial(spin, size**2))
    exponent = float(found.note.partition("time ")[2].partition(",")[0])
    assert 1.5 < exponent < 2.5
    assert found.ratio == pytest.approx(1 / 4, rel=0.5)


def spin(count: int) -> int:
    return sum(number % 7 for number in range(count))
