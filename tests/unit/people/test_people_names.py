"""Name people A to Z, then AA, AB, ..."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from flows.console.show import joint_lines
from pasdedeux.augmentation.variations import persons_of
from pasdedeux.people.names import person_index, person_name, person_names

ROOT = Path(__file__).parents[3]


def test_names_are_letters_each_once_and_sort_by_length_then_letter() -> None:
    names = person_names(1000)
    assert (names[0], names[25], names[26], names[51], names[52], names[701], names[702]) == (
        "A", "Z", "AA", "AZ", "BA", "ZZ", "AAA",
    )  # fmt: skip
    assert sorted(set(names), key=lambda name: (len(name), name)) == names
    assert [person_name(index) for index in range(1000)] == names
    assert [person_index(name) for name in names] == list(range(1000))


def test_a_crowd_of_thirty_has_a_column_each() -> None:
    people = np.arange(30 * 14 * 2, dtype=np.float64).reshape(30, 14, 2)
    header, first, *_ = (re.split(r"\s{2,}", line.strip()) for line in joint_lines(people, "op14", unit="px"))
    assert [word for word in header if word.endswith(" x")] == [f"{name} x" for name in person_names(30)]
    assert len(first) == 1 + 30 * 2


def test_letters_name_one_person_each_also_in_a_crowd() -> None:
    assert persons_of("AB", 30) == [0, 1]
    assert persons_of("all", 30) == list(range(30))


def test_no_other_module_makes_names_of_people_from_letters() -> None:
    packages = ("pasdedeux", "storage_schema", "tasks", "flows")
    modules = [path for package in packages for path in (ROOT / package).rglob("*.py")]
    makers = [path for path in modules if re.search(r"ascii_uppercase|[\"']ABCD", path.read_text(encoding="utf-8"))]
    assert makers == [ROOT / "pasdedeux/people/names.py"]
