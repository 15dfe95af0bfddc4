"""Write and read files of pairs; refuse other content in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.pair_file import PairFile, PairSource, pair_from_bvh, read_pair_json, write_pair_json
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.skeletons import PAIR17
from tests.builders.made_poses import pair_bvh

PAIRS = random_pairs(np.random.default_rng(1), 30, spread_rad=0.5)
WHOLE = PairFile(PAIRS[0], "draws@abc#3", ("one", "two"), (PairSource("someone", "CC0", "made it"),))


def test_json_gives_back_every_digit_and_all_that_is_said_of_the_pair() -> None:
    for pair in (*PAIRS, gauge_fix(PAIRS[3]), 1e-9 * np.ones((2, 17, 3)) + PAIRS[4]):
        np.testing.assert_array_equal(read_pair_json(write_pair_json(PairFile(pair))).pair_m, pair)
    read = read_pair_json(write_pair_json(WHOLE).encode())
    assert (read.made_from, read.takes, read.sources) == (WHOLE.made_from, WHOLE.takes, WHOLE.sources)


def test_a_joint_stands_on_a_line_of_its_own_under_its_name() -> None:
    line = next(line for line in write_pair_json(WHOLE).splitlines() if '"left_knee"' in line)
    numbers = line.strip().removeprefix('"left_knee": [').rstrip(",").rstrip("]").split(", ")
    assert [float(number) for number in numbers] == PAIRS[0, 0, PAIR17.index("left_knee")].tolist()


def test_bvh_gives_positions_back_to_a_micrometre() -> None:
    for pair in PAIRS:
        np.testing.assert_allclose(pair_from_bvh(*pair_bvh(pair)).pair_m, pair, atol=1e-6)
    with pytest.raises(InputError, match="frame 0: the position of 'pelvis' is not finite"):
        pair_bvh(np.where(np.arange(17)[:, None] == PAIR17.root, np.inf, PAIRS[0]))


def without(tree: dict[str, Any]) -> None:
    del tree["persons"]["A"]["left_hip"]


def wrong(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda tree: tree.update(changes)


def joint(value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda tree: tree["persons"]["B"].update(head=value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without, "person A: joint 'left_hip' is missing"),
        (lambda tree: tree["persons"]["A"].update(tail=[0, 0, 0]), "joint 'tail' is not in pair17"),
        (lambda tree: tree["persons"].pop("B"), "this is no pair: persons.B: Field required"),
        (joint([0.0, 1.0]), "this is no pair: persons.B.head.2: Field required"),
        (joint([0.0, 1.0, float("nan")]), "persons.B.head.2: Input should be a finite number"),
        (joint([0.0, True, 1.0]), "persons.B.head.1: Input should be a valid number"),
        (joint([0.0, 170.0, 0.0]), "person B: the length of the bone to 'head' in metres is .*; allowed: 0.001 to 2"),
        (wrong(format="other"), "this is no pair: format: Input should be '"),
        (wrong(unit="cm"), "unit: Input should be 'm'"),
        (wrong(skeleton="op14"), "skeleton: Input should be 'pair17'"),
        (wrong(version=2), "version: Input should be 1"),
        (wrong(colour="red"), "colour: Extra inputs are not permitted"),
        (wrong(takes="one"), "takes: Input should be a valid tuple"),
        (wrong(sources=[{"name": "x"}]), "sources.0.licence: Field required"),
    ],
)
def test_what_is_no_pair_is_refused_by_name(spoil: Callable[[dict[str, Any]], None], message: str) -> None:
    tree = json.loads(write_pair_json(WHOLE))
    spoil(tree)
    with pytest.raises(FormatError, match=message):
        read_pair_json(json.dumps(tree))


def test_bvh_that_cannot_be_a_pair_is_refused() -> None:
    first, second = pair_bvh(PAIRS[0])
    with pytest.raises(FormatError, match="person A: there is no frame 1, the file has 1"):
        pair_from_bvh(first, second, frame=1)
    with pytest.raises(FormatError, match="person B: its joints fit no known layout"):
        pair_from_bvh(first, second.replace("left_knee", "knee_of_the_left"))
    with pytest.raises(FormatError, match=r"in metres is .*; allowed"):
        pair_from_bvh(first, second, metres_per_unit=1.0)
