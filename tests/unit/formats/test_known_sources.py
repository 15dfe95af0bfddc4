"""Correct what CMU's files state wrongly."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.study_files import read_study_tree, shipped_studies
from pasdedeux.errors import InputError
from pasdedeux.formats.rigs.resolution import KnownSource
from tasks.ingest.takes.known_sources import CMU_CREDIT, known_source, note_fetched
from tasks.ingest.takes.parameters import PersonOptions
from tasks.ingest.takes.resolution import NOT_STATED, credit_of, find_person
from tests.builders.own_sources import write_walk

NOTHING = KnownSource()


@pytest.mark.parametrize(
    ("name", "layout", "stated_hz", "is_fetched", "expected"),
    [
        ("60_01.bvh", "cmu_daz", 120.0, False, KnownSource(60.0, 1.263)),
        ("61_12.BVH", "cmu_daz", 120.0, False, KnownSource(60.0, 1.191)),
        ("60_01.bvh", "cmu_daz", 30.0, False, NOTHING),
        ("60_01.bvh", "cmu_cgspeed", 120.0, False, NOTHING),
        ("02_01.bvh", "cmu_daz", 120.0, False, NOTHING),
        ("60_01.amc", "cmu_asf", None, True, KnownSource(60.0, None)),
        ("01_13.amc", "cmu_asf", None, True, KnownSource(120.0, None)),
        ("01_13.amc", "cmu_asf", None, False, NOTHING),
    ],
)
def test_only_files_known_to_state_wrong_values_are_corrected(
    name: str, layout: str, stated_hz: float | None, is_fetched: bool, expected: KnownSource
) -> None:
    assert known_source(name, layout, stated_hz=stated_hz, is_fetched=is_fetched) == expected


def test_rate_and_licence_of_cmu_are_those_of_files_that_fetch_brought_and_of_no_other(tmp_path: Path) -> None:
    path = write_walk(tmp_path)
    with pytest.raises(InputError, match=r"set rate_hz .* \(CMU's file of this name has 120 Hz\)"):
        find_person(path, PersonOptions(), {})
    assert credit_of([find_person(path, PersonOptions(rate_hz=60), {})], None, None).licence == NOT_STATED
    note_fetched(path, path.read_bytes())
    brought = find_person(path, PersonOptions(), {})
    assert brought.parameters.rate_hz == 120
    assert credit_of([brought], None, None) == CMU_CREDIT
    assert credit_of([brought], "CC0-1.0", None).licence == "CC0-1.0"
    path.write_bytes(path.read_bytes() + b"\n")
    changed = find_person(path, PersonOptions(rate_hz=60), {})
    assert credit_of([changed], None, None).credit == NOT_STATED
    assert credit_of([brought, changed], None, None).credit == NOT_STATED
    assert credit_of([changed], CMU_CREDIT.licence, CMU_CREDIT.credit) == CMU_CREDIT, "a study may state it"


@pytest.mark.parametrize("study", [name for name, text in shipped_studies().items() if 'extends = "salsa' in text])
def test_every_study_on_salsa_states_licence_and_rate(study: str) -> None:
    for family in read_study_tree(study, Path()).values["ingest"]["pairs"].values():
        assert (family["licence"], family["credit"]) == (CMU_CREDIT.licence, CMU_CREDIT.credit)
        assert family["rate_hz"] == (60 if "60" in family["subjects"] else 120)
