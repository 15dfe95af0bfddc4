"""Every planted fault applies to today's sources, and the test named with it is there; they are planted on demand."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.planted_faults.faults import FAULTS, Fault

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_planted_fault_applies_and_its_test_is_there(fault: Fault) -> None:
    compile(fault.planted_in((ROOT / fault.file).read_text()), fault.file, "exec")
    file, *_, name = fault.test.split("::")
    assert f"def {name}" in (ROOT / "tests" / file).read_text()
