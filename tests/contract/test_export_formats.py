"""What every format of files that go out must do: be read back, carry the credits, refuse what it cannot hold."""

from __future__ import annotations

import csv
import errno
import re
from collections.abc import Callable
from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from flows.exports import EXPORT_FORMATS, export_format, export_reference
from flows.exports.credits import add_notice
from pasdedeux.benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.evaluation.scores import Score, columns_of
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.pair_file import read_pair_json
from pasdedeux.learning.baselines import CopyModel
from pasdedeux.learning.registry import read_weights
from storage_schema import (
    TABLES,
    ArtifactRef,
    ShardRecord,
    SourceCredit,
    Store,
    open_table,
    parse_reference,
    record_latest,
    source_credits,
)
from tasks.ingest import STAGE, IngestParameters
from tasks.stage import StageInputs
from tests.builders.storage_rows import put, random_columns
from tests.builders.stored_models import put_model

NUM_SEEDS = 2
CREDIT = SourceCredit(name="a studio", licence="CC0", credit="Made by a studio")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Return a store with a short duet, its virtual video, and two seeds; its artifacts are named by table."""
    store = Store(tmp_path_factory.mktemp("exports"))
    section = {"duets": [{"name": "waltz", "duration_s": 0.5}], "virtual_video": {"num_random_views": 2}}
    for shard in STAGE.plan(StageInputs(manifests={}, seed=1), IngestParameters.model_validate(section)):
        STAGE.run_shard(shard, store)
    columns = random_columns("seeds", NUM_SEEDS) | {
        "seed_index": np.arange(NUM_SEEDS),
        "pair17_m": random_pairs(np.random.default_rng(0), NUM_SEEDS, spread_rad=0.1),
    }
    store.commit(
        stage="seeds",
        key="5" * 64,
        partition="seed0",
        name="seeds",
        version=1,
        parameters={},
        seed=0,
        inputs=[],
        files=[],
        tables={"seeds": columns},
        facts={},
        sources=[CREDIT],
    )
    put_model(store, CopyModel(), "random", [one for one in store.artifacts("ingest") if "poses" in one.tables])
    return store


def references(store: Store) -> dict[str, str]:
    """Return a reference to one artifact of each table that the store has."""
    return {table: f"{table}@{manifest.ref.key}" for manifest in store.artifacts() for table in manifest.tables}


def check_npz(paths: list[Path], text: str, store: Store) -> None:
    rows = open_table(text, store)
    (path,) = paths
    with np.load(path) as arrays:
        assert set(rows.column_names) <= set(arrays)
        assert all(len(arrays[name]) == rows.num_rows for name in rows.column_names if f"{name}_offsets" not in arrays)
        for name in arrays:
            if name.endswith("_m") and f"{name}_offsets" not in arrays:
                np.testing.assert_array_equal(arrays[name], rows[name])


def check_csv(paths: list[Path], text: str, store: Store) -> None:
    rows = open_table(text, store)
    (path,) = paths
    with path.open(newline="", encoding="utf-8") as file:
        header, *lines = csv.reader(file)
    assert len(set(header)) == len(header)
    assert list(dict.fromkeys(name.partition(".")[0] for name in header)) == list(rows.column_names)
    assert [len(line) for line in lines] == [len(header)] * rows.num_rows


def check_bvh(paths: list[Path], text: str, store: Store) -> None:
    motions = [path for path in paths if path.suffix == ".bvh"]
    assert len(motions) == 2 * (NUM_SEEDS if text.startswith("seeds") else 1)
    for path in motions:
        source = read_bvh(path.read_bytes())
        assert source.num_frames == (1 if text.startswith("seeds") else 15)
        stature = np.ptp(source.to_motion(metres_per_unit=0.01, rate_hz=30.0).world()[0][0], axis=0).max()
        assert 1.0 < stature < 2.5


def check_json(paths: list[Path], text: str, store: Store) -> None:
    pairs = [read_pair_json(path.read_bytes()) for path in paths]
    np.testing.assert_array_equal([pair.pair_m for pair in pairs], open_table(text, store)["pair17_m"])
    assert all(pair.sources[0].credit == CREDIT.credit for pair in pairs)


def check_safetensors(paths: list[Path], text: str, store: Store) -> None:
    weights, card = paths
    assert [path.name for path in paths] == ["random_copy.safetensors", "random_copy.md"]
    assert read_weights(weights.read_bytes(), weights.name).model.name == "copy"
    (source,) = next(store.artifacts("training")).inputs
    for wanted in (source.key, source.content_digest, "`random`, seed 0", '"reach": 0.15', "1.25 cm", "naive_fk 2 cm"):
        assert wanted in card.read_text()


READ_BACK: dict[str, Callable[[list[Path], str, Store], None]] = {
    "npz": check_npz,
    "csv": check_csv,
    "bvh": check_bvh,
    "json": check_json,
    "safetensors": check_safetensors,
}
"""How a program of others reads each format."""


def test_every_format_is_read_back_here() -> None:
    assert set(READ_BACK) == set(EXPORT_FORMATS)


def test_a_model_has_the_figures_of_the_last_run_alone(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    put_model(store, CopyModel(), "random", [])
    (model,) = store.artifacts("training")
    scores = [Score("E_r", model.facts["model"], value, "m", split="test") for value in (0.1, 0.2, 0.1)]
    tables = [{"scores": columns_of("models", [score])} for score in scores]
    made = [put(store, "evaluation", str(at), one, {"takes": []}, (model,)) for at, one in enumerate(tables)]
    for shown in (made[:1], made[1:2], made[::2]):
        record_latest(store, "study", "run", {"evaluation": [ShardRecord.of(one, store) for one in shown]})
        _, card, _ = export_reference(store, f"models@{model.ref.key}", "safetensors", tmp_path / "out")
        figures = [line for line in card.read_text().splitlines() if line.startswith("| E_r")]
        assert figures == [f"| E_r, test | {0.2 if shown == made[1:2] else 0.1:g} m | |"]


@pytest.mark.parametrize("name", EXPORT_FORMATS)
def test_what_a_format_writes_is_read_back_and_credited_and_the_rest_refused_in_a_sentence(
    store: Store, tmp_path: Path, name: str
) -> None:
    kind = export_format(name)
    num_written = 0
    for table, text in references(store).items():
        out = tmp_path / table
        if not kind.can_write(parse_reference(text)):
            with pytest.raises(InputError) as found:
                export_reference(store, text, name, out)
            sentence = str(found.value)
            assert sentence == f"'{text}' cannot be written as {name.upper()}; allowed are {kind.writes}"
            assert not out.exists()
            continue
        *written, notice = export_reference(store, text, name, out)
        READ_BACK[name](written, text, store)
        (source,) = {
            one
            for manifest in store.artifacts()
            if manifest.ref.key in text
            for one in source_credits(store, manifest.ref)
        }
        assert notice.name == "CREDITS.txt"
        assert all(part in notice.read_text() for part in (source.name, source.licence, source.credit))
        num_written += 1
    assert num_written > 0


def named(store: Store, name: str, into: Store) -> None:
    """Copy artifacts whose takes, sequences, variants and splits somebody else has called so."""
    copies: dict[ArtifactRef, ArtifactRef] = {}
    for one in sorted(store.artifacts(), key=lambda one: (one.ref.stage != "ingest", len(one.inputs))):
        tables = {}
        for table in one.tables:
            rows = store.read(one.ref, table)
            ids = {column: [name] * rows.num_rows for column in TABLES[table].id_columns}
            tables[table] = {column: rows[column] for column in rows} | ids
        copies[one.ref] = into.commit(
            stage=one.ref.stage,
            key=one.ref.key,
            partition=one.partition,
            name=one.name,
            version=1,
            parameters=one.parameters,
            seed=0,
            inputs=[copies.get(ref, ref) for ref in one.inputs],
            files=[],
            tables=tables,
            facts={key: name if key in ("take_id", "sequence_id", "split") else one.facts[key] for key in one.facts},
            sources=one.sources,
        )


NASTY = ("../ESCAPED", "/etc/passwd", "..", "a/b", "a\\b", "a\0b", "", "~", "con:", "x" * 300, "take\n1", "-rf", "ä")


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(NASTY) | st.text(st.characters(exclude_categories=["Cs"]), max_size=40))
@example(name="../ESCAPED")
@example(name="60_03.b-1")
def test_no_name_in_rows_leads_out_of_the_folder_whatever_the_format(
    store: Store, tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    folder = tmp_path_factory.mktemp("named")
    copy = Store(folder / "store")
    named(store, name, copy)
    before = {path for path in folder.rglob("*") if path.is_file()}
    for number, (file_format, (table, text)) in enumerate(product(EXPORT_FORMATS, references(copy).items())):
        out = folder / "out" / str(number) / "here"
        if export_format(file_format).can_write(parse_reference(text)):
            with suppress(InputError):
                export_reference(copy, text, file_format, out)
            assert (out / "CREDITS.txt").is_file()
            assert all(path.parent == out and path.is_file() for path in out.rglob("*")), (file_format, table)
        there = {path for path in folder.rglob("*") if path.is_file() and out not in path.parents}
        assert there == before, (file_format, table)
        before |= {path for path in folder.rglob("*") if path.is_file()}


def test_an_export_beside_another_keeps_its_credits(store: Store, tmp_path: Path) -> None:
    (tmp_path / "CREDITS.txt").write_text("Something of somebody else.\n")
    texts = references(store)
    for table in ("poses", "seeds"):
        *_, notice = export_reference(store, texts[table], "bvh", tmp_path)
    add_notice(notice, "Motions of a studio.\n")
    said = notice.read_text()
    assert said.startswith("Motions of a studio.\n\nSomething of somebody else.\n\nExported from ")
    for table in ("poses", "seeds"):
        (manifest,) = [one for one in store.artifacts() if table in one.tables]
        assert f"Exported from {texts[table]} by pasdedeux." in said
        assert manifest.ref.content_digest in said
        assert all(source.credit in said and source.name in said for source in manifest.sources)
    names = re.findall(r"(.*)\n  licence:", said)
    assert names == ["a studio", "pasdedeux built-in duets"]
    export_reference(store, texts["poses"], "npz", tmp_path)
    add_notice(notice, "Motions of a studio.\n")
    assert notice.read_text() == said
    assert "waltz_A: 15 frames" in (tmp_path / "UNITS.txt").read_text()


def test_credits_stay_where_there_is_no_room_for_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notice = tmp_path / "CREDITS.txt"
    add_notice(notice, "Motions of a studio.\n")

    def full(path: Path, *_: object, **__: object) -> int:
        path.open("w").close()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        add_notice(notice, "Motions of another one.\n")
    assert notice.read_text() == "Motions of a studio.\n"


def test_credits_of_folders_that_somebody_has_joined_are_kept(store: Store, tmp_path: Path) -> None:
    texts = references(store)
    said = [
        export_reference(store, texts[table], "bvh", tmp_path / table)[-1].read_text() for table in ("poses", "seeds")
    ]
    notice = tmp_path / "CREDITS.txt"
    notice.write_text("".join(said))
    export_reference(store, texts["poses"], "npz", tmp_path)
    lines = notice.read_text().splitlines()
    assert {line for one in said for line in one.splitlines()} <= {*lines}
    assert lines.count("Sources, their licences and credits:") == 1


def test_a_rest_pose_and_units_are_refused_where_there_are_none(store: Store, tmp_path: Path) -> None:
    text = references(store)["poses"]
    with pytest.raises(InputError, match=r"chosen for BVH files of poses and variants, not for 'poses@.*' as CSV"):
        export_reference(store, text, "csv", tmp_path, rest_pose="standing")
    with pytest.raises(InputError, match=r"not for 'seeds@.*' as BVH"):
        export_reference(store, references(store)["seeds"], "bvh", tmp_path, units="m")


def test_an_unknown_format_is_answered_with_the_known_ones(store: Store, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'fbx' is not known; known formats: " + ", ".join(EXPORT_FORMATS)):
        export_reference(store, references(store)["poses"], "fbx", tmp_path)
