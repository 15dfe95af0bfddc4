"""On which side of a split takes stand."""

from __future__ import annotations

from collections import Counter

import pytest

from tasks.rows.sides import Side, take_sides


@pytest.mark.parametrize(
    ("num_takes", "num_held", "wanted"),
    [
        (1, 0, {"train": 1}),
        (2, 0, {"train": 1, "validation": 1}),
        (10, 0, {"train": 7, "validation": 1, "test": 2}),
        (20, 3, {"train": 15, "validation": 2, "test": 3}),
        (2, 2, {"test": 2}),
    ],
)
def test_held_out_takes_test_and_a_tenth_validates(num_takes: int, num_held: int, wanted: dict[str, int]) -> None:
    takes = {f"take{number}": number < num_held for number in range(num_takes)}
    sides = take_sides(takes)
    assert Counter(side.split for side in sides.values()) == wanted
    assert list(sides) == list(takes)
    assert {name for name, is_held in takes.items() if is_held} <= {n for n, s in sides.items() if s.split == "test"}
    assert all(side.reason for side in sides.values())
    assert take_sides(dict(reversed(takes.items()))) == sides, "order does not matter"


def test_a_take_keeps_its_side_when_others_come() -> None:
    first = take_sides({f"take{number}": False for number in range(10)})
    more = {f"take{number}": False for number in range(40)}
    sides = take_sides(more, known=first)
    assert {name: sides[name] for name in first} == first
    assert Counter(side.split for side in sides.values()) == {"test": 8, "validation": 4, "train": 28}
    known = {"take1": Side("test", "it was so")}
    assert take_sides({"take2": False}, known=known).keys() == {"take2"}
