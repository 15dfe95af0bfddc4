"""A dataset's folder: other people's readers open it, nothing that stays here is in it, and it comes back whole."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from datasets import Features
from huggingface_hub import DatasetCard

from flows.console.app import run_command_line
from flows.dataset_folder import read_folder, write_folder
from flows.dataset_folder.contents import RowGroup, _without
from flows.dataset_folder.layout import read_manifest
from flows.dataset_folder.writing import plan_files
from flows.planning import PlanError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22
from storage_schema import TABLES, ArtifactRef, CorruptArtifact, SourceCredit, Store, open_table, verify
from storage_schema.arrow import arrow_schema
from storage_schema.datasets import open_dataset
from storage_schema.keys import file_sha256
from tasks.data import Data
from tasks.files.curation import content_of
from tests.builders.stored_datasets import VARIANTS, put_dataset

TAKES = {"alone": False, "hug": False, "judo": False, "waltz": True}
SECRET = SourceCredit("secret", "Internal use only; no redistribution", "nobody")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    store = Store(tmp_path_factory.mktemp("made") / "store")
    put_dataset(store, TAKES)
    return store


@pytest.fixture(scope="module")
def folder(store: Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("written") / "made-1"
    write_folder(store, open_dataset(store, "made@1"), out)
    return out


def digests(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): file_sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def splits_of(folder: Path, table: str) -> dict[str, int]:
    found = sorted((folder / "data" / table).glob("*.parquet"))
    return {path.name.split("-")[0]: pq.read_metadata(path).num_rows for path in found}


def run_script(script: str, path: Path, **environment: str) -> Any:
    """Run a script on a path in a process of its own, and return what it prints last, as JSON."""
    command, surroundings = [sys.executable, "-c", script, str(path)], os.environ | environment
    ended = subprocess.run(command, env=surroundings, capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


def test_mlcroissant_reads_every_record_set(folder: Path) -> None:
    script = """
import json, sys, warnings
warnings.simplefilter("ignore")
import mlcroissant as mlc
dataset = mlc.Dataset(sys.argv[1])
assert not dataset.metadata.issues.errors, dataset.metadata.issues.report()
assert dataset.metadata.ctx.is_v1_1() and dataset.metadata.data_limitations
counts = {record.id: sum(1 for _ in dataset.records(record.id)) for record in dataset.metadata.record_sets}
fields = [field for record in dataset.metadata.record_sets for field in record.fields]
shapes = {field.id: field.array_shape_tuple for field in fields if field.is_array}
print(json.dumps([counts, shapes]))
"""
    found, shapes = run_script(script, folder / "croissant.json")
    tables = [path.name for path in (folder / "data").iterdir()]
    assert found == {f"{table}-rows": sum(splits_of(folder, table).values()) for table in tables}
    assert shapes["variants-rows/body22_m"] == [22, 3]
    assert shapes["takes-rows/rest_offset_m"] == [-1]


def test_the_library_datasets_streams_each_split_of_each_table(folder: Path, tmp_path: Path) -> None:
    script = """
import json, sys, datasets
counts = {}
for table in [*datasets.get_dataset_config_names(sys.argv[1]), None]:
    streams = datasets.load_dataset(sys.argv[1], table, streaming=True)
    counts[table or "default"] = {split: sum(1 for _ in rows) for split, rows in streams.items()}
print(json.dumps(counts))
"""
    offline = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache")}
    found = run_script(script, folder, **offline)
    assert found.pop("default") == splits_of(folder, "variants")
    assert found == {path.name: splits_of(folder, path.name) for path in (folder / "data").iterdir()}


def test_the_card_is_one_of_the_hub_and_has_the_features_of_the_files(folder: Path) -> None:
    card = DatasetCard.load(folder / "README.md")
    assert (card.data.license, card.data.pretty_name) == ("other", "made@1")
    infos = {info["config_name"]: info for info in card.data.to_dict()["dataset_info"]}
    assert {path.name for path in (folder / "data").iterdir()} == set(infos)
    for table, info in infos.items():
        assert Features._from_yaml_list(info["features"]) == Features.from_arrow_schema(arrow_schema(TABLES[table]))
        assert {split["name"]: split["num_examples"] for split in info["splits"]} == splits_of(folder, table)
    assert (folder / "CREDITS.txt").is_file()
    assert [path.name for path in (folder / "LICENSES").iterdir()] == ["CC0.txt"]


def test_a_clip_is_one_row_group_with_the_take_s_split_and_the_rows_of_the_store(folder: Path, store: Store) -> None:
    clips = pd.read_parquet(folder / "data" / "clips")
    assert set(clips["clip_id"]) == {*TAKES, *(f"{take}/{name}" for take in TAKES for name in VARIANTS)}
    sides = json.loads((folder / "splits.json").read_text())["takes"]
    assert sides["waltz"]["split"] == "test"
    assert all(side["reason"] for side in sides.values())
    assert {clip.split for clip in clips.itertuples()} == {"train", "validation", "test"}
    for clip in clips.itertuples():
        assert clip.split == sides[clip.take_id]["split"] == Path(clip.file).name.split("-")[0]
        rows = pq.ParquetFile(folder / clip.file).read_row_group(clip.row_group)
        assert rows.num_rows == clip.num_frames * clip.num_people == 24
        table = "poses" if pd.isna(clip.variant_id) else "variants"
        stored = open_table(f"{table}:made@1", store)
        is_mine = stored["take_id"] == clip.take_id
        is_mine &= True if table == "poses" else stored["variant_id"] == clip.variant_id
        positions = np.stack(rows["body22_m"].to_numpy(zero_copy_only=False)).reshape(-1, 22, 3)
        np.testing.assert_array_equal(positions, stored["body22_m"][is_mine])
        rest = np.reshape(clip.rest_m, (2, 22, 3))
        take = clips[clips["clip_id"] == clip.take_id].iloc[0]
        scale = np.reshape(clip.bone_scale, (2, 22))
        lengths = bone_lengths(BODY22, np.reshape(take["rest_m"], (2, 22, 3))) * scale
        np.testing.assert_allclose(bone_lengths(BODY22, rest), lengths, atol=1e-6)
        assert clip.contact_rate == 0.0 if clip.take_id == "alone" else 0.0 < clip.contact_rate <= 1.0


def test_a_variant_has_the_contacts_of_its_take_where_it_holds_them(folder: Path) -> None:
    """The variants are their takes, larger by 0 and by 2 %, and so are the distances of their contacts."""
    rows = pq.read_table(folder / "data" / "contacts").to_pandas()
    held = dict(list(rows.fillna({"variant_id": ""}).groupby(["take_id", "variant_id"])))
    assert {take for take, _ in held} == {"waltz", "hug", "judo"}
    clips = pd.read_parquet(folder / "data" / "clips")
    assert set(clips.fillna({"variant_id": ""}).groupby(["take_id", "variant_id"]).groups) >= set(held)
    for (take, variant), contacts in held.items():
        of_take = held[take, ""]
        assert set(contacts["origin"]) == {"variants" if variant else "poses"}
        same = ["frame", "time_s", "person", "bone", "share", "partner", "partner_bone", "weight", "is_held"]
        assert contacts[same].reset_index(drop=True).equals(of_take[same].reset_index(drop=True))
        factor = 1.0 + VARIANTS.index(variant) / 50 if variant else 1.0
        for name in ("point_m", "partner_point_m"):
            expected = factor * np.stack(of_take[name].to_list())
            np.testing.assert_allclose(np.stack(contacts[name].to_list()), expected, atol=1e-6)
        np.testing.assert_allclose(contacts["gap_m"], factor * of_take["gap_m"].to_numpy(), atol=1e-6)


def test_figures_are_those_of_the_rows(folder: Path) -> None:
    stats = json.loads((folder / "stats.json").read_text())
    rows = pd.read_parquet(sorted(folder.glob("data/variants/train-*"))[0])
    positions = np.stack(rows["body22_m"]).reshape(-1, 22, 3).astype(np.float64)
    clips = positions.reshape(-1, 12, 2, 22, 3)
    wanted = {
        "body22_m": positions,
        "body22_velocity_m_s": (np.diff(clips, axis=1) * 30.0).reshape(-1, 22, 3),
        "bone_length_m": bone_lengths(BODY22, positions),
    }
    for name, values in wanted.items():
        found = stats["train"]["variants"][name]
        assert found["count"] == len(values)
        quantiles = np.quantile(values, (0.01, 0.5, 0.99), axis=0)
        mine = [values.mean(0), values.std(0), values.min(0), values.max(0), *quantiles]
        for key, figure in zip(("mean", "std", "min", "max", "q01", "q50", "q99"), mine, strict=True):
            np.testing.assert_allclose(found[key], figure, atol=2e-6, err_msg=f"{name} {key}")
    rates = stats["train"]["poses"]["contact_rate"]
    assert rates["count"] == 24
    assert 0 < max(rates["mean"]) <= 1


def test_a_folder_comes_into_another_store_as_what_it_was(folder: Path, store: Store, tmp_path: Path) -> None:
    reader = Store(tmp_path / "other")
    dataset, num_new = read_folder(folder, reader)
    assert dataset.digest == open_dataset(store, "made@1").digest
    assert num_new == 9
    assert verify(reader).is_ok
    names = [[clip.name for clip in Data(place).variants("made@1")] for place in (store, reader)]
    assert names[0] == names[1]
    assert read_folder(folder, reader)[1] == 0
    again = tmp_path / "again"
    write_folder(reader, dataset, again)
    assert digests(again) == digests(folder)


def test_a_damaged_folder_is_refused(folder: Path, tmp_path: Path) -> None:
    damaged = shutil.copytree(folder, tmp_path / "damaged")
    path = next((damaged / "data" / "poses").iterdir())
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    with pytest.raises(CorruptArtifact, match=path.name):
        read_folder(damaged, Store(tmp_path / "store"))
    assert not (tmp_path / "store" / "datasets").exists()


def rejecting(store: Store) -> dict[str, str]:
    """Return the choice that rejects a variant of a take."""
    rows = open_table("variants:made@1", store)
    is_rejected = (rows["take_id"] == "judo") & (rows["variant_id"] == VARIANTS[1])
    return {f"variants judo/{VARIANTS[1]}": f"reject {content_of(rows['body22_m'][is_rejected])}"}


def texts(folder: Path) -> str:
    """Return all that a folder says, in rows and in files."""
    said = [path.read_text() for path in folder.rglob("*") if path.is_file() and path.suffix != ".parquet"]
    said += [str(pd.read_parquet(path).astype(str).to_dict()) for path in folder.rglob("*.parquet")]
    return "\n".join(said)


def test_rejected_rows_are_nowhere_and_what_is_left_comes_back(store: Store, tmp_path: Path) -> None:
    choices = rejecting(store)
    dataset = put_dataset(store, TAKES, version="chosen", choices=choices)
    written = write_folder(store, dataset, tmp_path / "out")
    (tmp_path / "out" / "record" / "study.json").unlink()  # it says what was rejected, and why
    said = texts(tmp_path / "out")
    clips = pd.read_parquet(tmp_path / "out" / "data" / "clips")
    assert set(clips["clip_id"]) == {*TAKES, *(f"{t}/{v}" for t in TAKES for v in VARIANTS)} - {f"judo/{VARIANTS[1]}"}
    for table in ("variants", "variant_quality", "variant_frames"):
        rows = pd.read_parquet(tmp_path / "out" / "data" / table)
        assert not ((rows["take_id"] == "judo") & (rows["variant_id"] == VARIANTS[1])).any()
    assert not (tmp_path / "out" / "data" / "scores").exists()
    assert "Rejected by a person, of variants: 1." in written.left_out
    assert f"judo/{VARIANTS[1]}" not in said
    write_folder(store, dataset, tmp_path / "whole")
    reader = Store(tmp_path / "other")
    dataset, _ = read_folder(tmp_path / "whole", reader)
    assert verify(reader).is_ok
    assert len(Data(reader).variants(dataset.label)) == 11
    (judo,) = [clip for clip in Data(reader).variants(dataset.label) if clip.name == f"judo, {VARIANTS[2]}"]
    (same,) = [clip for clip in Data(store).variants("made@1") if clip.name == f"judo, {VARIANTS[2]}"]
    np.testing.assert_array_equal(judo.positions_m, same.positions_m)


@pytest.mark.parametrize(
    ("takes", "source", "withheld"),
    [(("hug", "spy"), SECRET, ()), (("open", "zebra"), SourceCredit("open", "CC0", "open"), ("made up",))],
    ids=["licence", "named"],
)
def test_a_source_that_may_not_leave_is_nowhere(
    store: Store, tmp_path: Path, takes: tuple[str, str], source: SourceCredit, withheld: tuple[str, ...]
) -> None:
    stays = takes[1]
    sources = {"spy": source, "open": source}
    dataset = put_dataset(store, dict.fromkeys(takes, False), version=f"of-{stays}", sources=sources)
    written = write_folder(store, dataset, tmp_path / "out", withheld=withheld)
    said = texts(tmp_path / "out").replace("made up for tests", "")
    assert any("stays, its licence" in words for words in written.left_out)
    assert stays not in said.replace(f"of-{stays}", "")
    assert SECRET.credit not in json.dumps(json.loads((tmp_path / "out" / "croissant.json").read_text())["creator"])
    reader = Store(tmp_path / "other")
    read_folder(tmp_path / "out", reader)
    assert verify(reader).is_ok


def test_nothing_at_all_may_leave_is_said(store: Store, tmp_path: Path) -> None:
    dataset = put_dataset(store, {"spy": False}, version="spy", sources={"spy": SECRET})
    with pytest.raises(PlanError, match=r"nothing of made@spy may leave: secret \(licence: Internal use only"):
        write_folder(store, dataset, tmp_path / "out")
    with pytest.raises(PlanError, match="no source 'nobody'"):
        write_folder(store, dataset, tmp_path / "out", withheld=["nobody"])
    assert list(tmp_path.iterdir()) == []


def test_an_update_writes_only_what_is_new_and_keeps_sides(store: Store, tmp_path: Path) -> None:
    more = put_dataset(store, {**TAKES, "lift": False, "push": False}, version="more")
    out = tmp_path / "out"
    write_folder(store, open_dataset(store, "made@1"), out)
    before = {path: path.stat().st_ino for path in out.rglob("*.parquet")}
    sides = json.loads((out / "splits.json").read_text())["takes"]
    (out / ".git").mkdir()
    with pytest.raises(PlanError, match=r"has made@1; `--since made@1` updates it"):
        write_folder(store, more, out)
    written = write_folder(store, more, out, since="made@1")
    assert read_manifest(out) == written.manifest
    assert written.manifest.label == "made@more"
    tables = ("variants", "variant_quality", "variant_frames", "poses", "takes", "contacts")
    assert {Path(name).parent.name for name in written.new} == {*tables, "scores"}
    kept = {path.stat().st_ino for path in out.rglob("*.parquet")} & set(before.values())
    assert len(kept) == len([path for path in before if path.parent.name in tables])
    now = json.loads((out / "splits.json").read_text())["takes"]
    assert {name: now[name] for name in sides} == sides
    assert set(pd.read_parquet(out / "data" / "clips")["take_id"]) == {*TAKES, "lift", "push"}
    assert (out / ".git").is_dir()
    clips = pd.read_parquet(out / "data" / "clips")
    for clip in clips.itertuples():
        rows = pq.ParquetFile(out / clip.file).read_row_group(clip.row_group, columns=["take_id"])
        assert set(rows["take_id"].to_pylist()) == {clip.take_id}
    reader = Store(tmp_path / "other")
    read_folder(out, reader)
    assert verify(reader).is_ok
    assert write_folder(store, more, out, since="made@1").new == ()
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["other", "out"]


def test_the_page_plays_clips_without_a_network(folder: Path) -> None:
    page = (folder / "index.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert page.count("<canvas") == 12
    assert "made@1" in page


def test_commands_write_read_and_refuse(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, place = str(tmp_path / "out"), str(store)
    assert run_command_line(["dataset", "write", "made@1", "--out", out, "--store", place]) == 0
    assert "made@1 is in" in capsys.readouterr().out
    assert run_command_line(["dataset", "read", out, "--store", str(tmp_path / "other"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_new"] == 9
    assert run_command_line(["dataset", "read", str(tmp_path), "--store", place]) == 2
    assert "is no folder of a dataset" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    assert run_command_line(["dataset", "write", "made@1", "--out", str(tmp_path / "full"), "--store", place]) == 2
    assert "is not empty" in capsys.readouterr().err


def test_what_stays_here_is_in_no_list_and_under_no_key_of_what_leaves() -> None:
    left = {"variants": ["v0", "v1", {"v0": 1, "kept": ["v1", "v0"]}], "v1": 3, "told": ("v1", 4, None)}
    assert _without(left, {"v1"}) == {"variants": ["v0", {"v0": 1, "kept": ["v0"]}], "told": [4, None]}


def test_a_data_file_is_full_at_a_hundred_megabytes() -> None:
    ref = ArtifactRef("chains", "a" * 64, "b" * 64)
    sizes = [60e6, 39_999_999, 1, 2, 100e6, 1]
    groups = [RowGroup("draws", "train", ref, ((at, at + 1),), int(size), "") for at, size in enumerate(sizes)]
    files = plan_files(SimpleNamespace(groups=groups), None)  # type: ignore[arg-type]
    assert [[group.num_bytes for group in file.groups] for file in files] == [
        [60_000_000, 39_999_999, 1],
        [2, 100_000_000],
        [1],
    ]
    assert [file.name for file in files] == [f"data/draws/train-{at:05}-of-00003.parquet" for at in range(3)]


@pytest.mark.parametrize(
    ("table", "name", "description", "shape"),
    [
        ("poses", "time_s", "Time from the start of the take or sequence, s", None),
        ("poses", "take_id", "Take: one capture, by a name unique in a study", None),
        ("poses", "body22_m", "World positions, m (22 x 3: joint, xyz)", "22,3"),
        ("takes", "joint_names", "Joints of the source's own skeleton", "-1"),
    ],
)
def test_a_field_is_described_with_its_unit_and_its_axes(
    folder: Path, table: str, name: str, description: str, shape: str | None
) -> None:
    sets = json.loads((folder / "croissant.json").read_text())["recordSet"]
    (field,) = [
        entry for record in sets for entry in record.get("field", ()) if entry["name"] == f"{table}-rows/{name}"
    ]
    assert (field["description"], field.get("arrayShape")) == (description, shape)
    assert field.get("isArray", False) is (shape is not None)
