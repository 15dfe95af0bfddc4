"""The keys of a study, told from the models of its sections."""

from __future__ import annotations

from flows.study_keys import study_keys
from tasks.graph import load_graph

KEYS = {key.name: key for key in study_keys(load_graph())}


def test_every_key_says_what_it_means() -> None:
    assert [name for name, key in KEYS.items() if not key.meaning] == []


def test_keys_of_lists_and_of_named_tables_have_the_path_that_an_override_takes() -> None:
    assert KEYS["ingest.duets.N.duration_s"].unit == "s"
    assert KEYS["ingest.pairs.NAME.folder"].is_needed
    assert KEYS["ingest.pairs.NAME.persons.N.yaw_deg"].unit == "deg"
    assert KEYS["ingest.virtual_video.noise_px"].type == "number >= 0, <= 200"


def test_only_the_keys_of_one_section_are_told_when_it_is_named() -> None:
    assert {key.name.split(".")[0] for key in study_keys(load_graph(), "chains")} == {"chains"}
    assert study_keys(load_graph(), "chain") == []
