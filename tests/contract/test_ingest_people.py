"""Who is who, resolved at ingest: simulated detectors, partners, and tables that overrule what was decided."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from storage_schema import Manifest, Store, TableData
from tests.builders.ingest_runs import planned, run
from tests.builders.own_sources import film_duet, write_coco

DUET = {"duets": [{"name": "waltz", "duration_s": 3.0}]}


def ingested(store: Store, **section: Any) -> dict[str, Manifest]:
    """Return the artifacts of all shards by name."""
    return {name: made for (_, name), made in run(store, planned(**section)).items()}


def annotations(store: Store, manifest: Manifest) -> TableData:
    return store.read(manifest.ref, "annotations")


def test_a_detector_sees_the_same_video_worse_and_everybody_is_found_again(store: Store) -> None:
    video = {"num_random_views": 0, "noise_px": 5.0, "has_detector": True}
    made = ingested(store, **DUET, virtual_video=video)
    plain, seen = (annotations(store, made[name]) for name in ("video", "detector"))
    (facts,) = made["detector"].facts["detected"]
    assert facts["sequence_id"] == "waltz.video00.detector"
    assert facts["num_identity_switches"] == 0
    assert facts["couples"] == [[0, 1]]
    assert facts["num_people"] == facts["num_true_people"] == 3
    for person in (0, 1):
        true_rows, rows = (np.flatnonzero(table["person_id"] == person) for table in (plain, seen))
        assert set(seen["partner_id"][rows].tolist()) == {1 - person}
        at = np.searchsorted(plain["frame"][true_rows], seen["frame"][rows])
        px, truth = seen["pair17_px"][rows], plain["pair17_px"][true_rows][at]
        is_seen = seen["pair17_confidence"][rows] > 0
        same = np.isclose(px, truth, atol=1e-3).all(axis=-1)
        assert 0.7 < is_seen.mean() < 0.8, "10 % are missing and 3 of 19 are junk, which is masked"
        assert same[is_seen].mean() > 0.99
    third = seen["person_id"] == 2
    assert seen.is_null("partner_id")[third].all()
    assert third.sum() <= 0.25 * 90 + 1
    assert plain.num_rows == 180


def test_a_video_without_a_detector_is_as_it_was(store: Store) -> None:
    made = ingested(store, **DUET, virtual_video={"num_random_views": 3})
    table = annotations(store, made["random_views"])
    np.testing.assert_array_equal(table["partner_id"], 1 - table["person_id"])
    np.testing.assert_array_equal(table["source_person_id"], table["person_id"])
    assert "detector" not in made


def test_shuffled_results_without_track_ids_are_as_good_as_people_given(store: Store, tmp_path: Path) -> None:
    duet = film_duet("waltz", duration_s=2.0, rate_hz=30.0)
    write_coco(tmp_path / "tracks.json", duet)
    tracks = json.loads((tmp_path / "tracks.json").read_text())["annotations"]
    rng = np.random.default_rng(0)
    results = [
        {"image_id": track["image_id"], "category_id": 1, "score": 0.9, "keypoints": track["keypoints"]}
        for track in (tracks[row] for row in rng.permutation(len(tracks)))
    ]
    (tmp_path / "results.json").write_text(json.dumps(results))
    people = []
    for name in ("results.json", "tracks.json"):
        (made,) = ingested(store, annotations=[{"id": "clip", "path": tmp_path / name, "rate_hz": 30.0}]).values()
        assert made.facts["couples"][0]["person_ids"] == [0, 1]
        table = annotations(store, made)
        assert table.num_rows == 120
        people.append({table["op14_px"][table["person_id"] == person].tobytes() for person in (0, 1)})
    assert people[0] == people[1]


def test_what_was_decided_is_written_and_a_changed_copy_overrules_it(store: Store, tmp_path: Path) -> None:
    write_coco(tmp_path / "duet.json", film_duet("waltz", duration_s=1.0, rate_hz=30.0))
    source = {"id": "clip", "path": tmp_path / "duet.json", "rate_hz": 30.0}
    (made,) = ingested(store, annotations=[source]).values()
    written = store.attachment(made.ref, "people.csv").decode()
    assert written == "sequence,first_frame,last_frame,person,is\nclip,0,29,0,0\nclip,0,29,1,1\n"
    people = tmp_path / "people.csv"
    people.write_text(written.replace("clip,0,29,1,1", "clip,0,29,1,nobody"))
    (alone,) = ingested(store, annotations=[source | {"people_file": people}]).values()
    table = annotations(store, alone)
    assert set(table["person_id"].tolist()) == {0}
    assert table.is_null("partner_id").all()
    assert alone.ref.key != made.ref.key
    assert store.attachment(alone.ref, "people.csv").decode() == people.read_text()
    for text, message in (
        ("clip,0,29,7,1", r"annotations clip: people of 'clip', row 'clip,0,29,7,1': there is no person 7"),
        ("other,0,29,1,1", "there is no such sequence; sequences: clip"),
        ("clip,0,29", r"annotations clip: people\.csv: line 3"),
    ):
        people.write_text(written.replace("clip,0,29,1,1", text))
        with pytest.raises(InputError, match=message):
            ingested(store, annotations=[source | {"people_file": people}])
