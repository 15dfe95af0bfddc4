"""A watched folder: what is dropped into it extends the dataset, only that is computed, what is not whole waits."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flows.outcomes import Outcome
from pasdedeux.errors import InputError
from storage_schema import Store, open_table, read_latest
from tasks.stage.judgements import verdict_of
from tests.builders.ingest_runs import planned, write_figure_pair
from tests.builders.real_study import graph
from tests.builders.source_samples import csv_text
from tests.builders.toy_runs import run_toys, write_study

STUDY = """
[study]
name = "nightly"
stages = ["ingest", "augmentation"]

[ingest]
rate_hz = 15.0
virtual_video = { num_videos = 0, num_random_views = 0 }
annotations = [{ id = "films", path = "films", is_watched = true }]

[ingest.pairs.inbox]
folder = "inbox"
pattern = "{take}/{subject}.bvh"
subjects = ["A", "B"]
id = "{take}"

[augmentation]
scales = [0.9]
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    (tmp_path / "films").mkdir()
    return write_study(tmp_path, STUDY)


def drop_take(study: Path, name: str, subjects: str = "AB") -> None:
    folder = study.parent / "inbox" / name
    folder.mkdir(parents=True, exist_ok=True)
    for source, subject in zip(write_figure_pair(study.parent), "AB", strict=True):
        if subject in subjects:
            shutil.move(source, folder / f"{subject}.bvh")


def drop_film(study: Path, name: str, text: str | None = None) -> None:
    (study.parent / "films" / f"{name}.csv").write_text(csv_text() if text is None else text)


def build(study: Path) -> Outcome:
    return run_toys(study, study.parent / "store", graph=graph())


def computed(outcome: Outcome) -> dict[str, tuple[int, int]]:
    """Return for each stage how many shards there are, and how many of them were computed."""
    return {stage.name: (stage.num_shards, stage.num_computed) for stage in outcome.stages}


def test_what_is_dropped_into_a_folder_is_all_that_is_computed(study: Path) -> None:
    drop_take(study, "waltz")
    drop_film(study, "monday")
    assert computed(build(study)) == {"ingest": (2, 2), "augmentation": (1, 1)}
    drop_take(study, "tango")
    drop_take(study, "late", "A")
    drop_film(study, "tuesday")
    drop_film(study, "half", "sequence_id,frame")
    outcome = build(study)
    assert computed(outcome) == {"ingest": (6, 4), "augmentation": (2, 1)}
    store = Store(study.parent / "store")
    assert set(open_table("variants:nightly", store, columns=["take_id"])["take_id"]) == {"waltz", "tango"}
    latest = read_latest(store, "nightly")
    assert latest is not None
    assert {"films.monday", "films.tuesday"} <= {shard.partition for shard in latest.stages["ingest"]}
    skipped = {
        manifest.partition: verdict.reason
        for ref in latest.refs("ingest")
        if (manifest := store.manifest(ref)).name == "skipped" and (verdict := verdict_of(manifest)) is not None
    }
    assert "late skipped: file B.bvh does not exist" in skipped["inbox"].replace("late/", "")
    assert "half skipped: " in skipped["films"]

    drop_take(study, "late", "B")
    (study.parent / "films" / "half.csv").unlink()
    assert computed(build(study)) == {"ingest": (5, 1), "augmentation": (3, 1)}
    assert build(study).num_computed == 0


def test_a_take_that_is_to_be_held_out_is_waited_for_where_its_folder_is_watched(tmp_path: Path) -> None:
    first, second = write_figure_pair(tmp_path)
    family = {"folder": tmp_path, "subjects": ["60", "61"], "is_watched": True}
    held_out = ["60_01", "60_02"]
    with pytest.raises(InputError, match=r"'06_02' is not a take of this study; did you mean '60_01'\?"):
        planned(pairs={"all": family}, held_out=["06_02"])
    before = planned(pairs={"all": family}, held_out=held_out)
    (skipped,) = [shard.parameters for shard in before if shard.name == "skipped"]
    assert "'60_02': 'the study names it, and it has not come yet'" in str(skipped)
    for file in (first, second):
        shutil.copy(file, file.with_name(file.name.replace("_01", "_02")))
    after = planned(pairs={"all": family}, held_out=held_out)
    come = [shard for shard in after if shard.partition == "60_02"]
    assert come[0].values["is_held_out"]
    assert {shard.key for shard in after} - {shard.key for shard in before} == {shard.key for shard in come}
    assert not [shard for shard in after if shard.name == "skipped"]


def test_files_and_folders_are_watched_alike_and_no_two_are_taken_for_one(tmp_path: Path) -> None:
    films = tmp_path / "films"
    (films / "tuesday").mkdir(parents=True)
    for name in ("monday.csv", "tuesday/cam1.csv", "a b.csv", "a_b.csv"):
        (films / name).write_text(csv_text())
    options = {"id": "films", "path": films, "is_watched": True}
    shards = planned(annotations=[options])
    assert [shard.partition for shard in shards if shard.name == "annotations"] == [
        *("films.a_b", "films.monday", "films.tuesday_cam1")
    ]
    (skipped,) = (shard.parameters for shard in shards if shard.name == "skipped")
    assert "a_b.csv: another file is 'films.a_b' already; rename one of them" in str(skipped)
    with pytest.raises(InputError, match=r"another file is 'films\.a_b' already"):
        planned(annotations=[{**options, "is_watched": False}])


def test_a_take_that_stands_twice_in_a_pattern_is_found(tmp_path: Path) -> None:
    first, second = write_figure_pair(tmp_path)
    (tmp_path / "waltz").mkdir()
    shutil.move(first, tmp_path / "waltz" / "waltz_A.bvh")
    shutil.move(second, tmp_path / "waltz" / "other_A.bvh")
    family = {"folder": tmp_path, "subjects": ["A"], "pattern": "{take}/{take}_{subject}.bvh", "id": "{take}"}
    assert {shard.partition for shard in planned(pairs={"all": family})} == {"waltz"}


def test_a_folder_in_which_nothing_fits_is_refused(tmp_path: Path) -> None:
    family = {"folder": tmp_path / "inbox", "subjects": ["60", "61"], "pattern": "{take}.bvh"}
    with pytest.raises(InputError, match=r"ingest.pairs.all: no file \{take\}.bvh is in "):
        planned(pairs={"all": family})
