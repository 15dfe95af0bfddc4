"""Choices of a person: a text file that outlives rebuilds, and what obeys it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flows.console.app import run_command_line
from flows.exports import Export, export_reference
from flows.exports.casts import _kept_parts
from flows.staleness import changed_leaves
from flows.study import load_study, study_from_record
from flows.study_files import StudyError
from flows.viewing.curating import thing_of
from flows.viewing.shelf import Shelf
from pasdedeux.errors import InputError
from storage_schema import ShardRecord, Store, open_table, parse_reference, record_latest, resolve
from tasks.augmentation import AugmentationParameters
from tasks.augmentation import plan as plan_variants
from tasks.augmentation import run_shard as solve
from tasks.data import LOOK, Data
from tasks.files.curation import (
    Choice,
    Choosing,
    as_settings,
    content_of,
    read_choices,
    rejected_names,
    rejections,
    write_choices,
)
from tasks.graph import load_graph
from tasks.stage import StageInputs
from tasks.training.items import StoredVariants
from tasks.training.parameters import TrainingParameters
from tasks.training.plan import plan as plan_training
from tasks.windows import PairDataset
from tests.builders.command_line import CommandLine
from tests.builders.ingest_runs import duet_store
from tests.builders.storage_rows import put, random_columns

pytestmark = pytest.mark.usefixtures("own_cache")

NAME = "waltz/A-uniform-0.80"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, StageInputs]:
    """Return a store with a duet of a second and four variants of it, as a study on record."""
    store, takes = duet_store(tmp_path_factory.mktemp("curated") / "store")
    parameters = AugmentationParameters(scales=(0.8, 0.95, 1.05, 1.2), persons=("A",))
    inputs = StageInputs({"poses": takes, "takes": takes}, seed=1)
    variants = [store.manifest(solve(shard, store)) for shard in plan_variants(inputs, parameters)]
    records = {"ingest": takes, "augmentation": variants}
    run = {stage: [ShardRecord.of(manifest, store) for manifest in manifests] for stage, manifests in records.items()}
    record_latest(store, "short", "20260101T000000-short", run)
    return store, StageInputs({**inputs.manifests, "variants": variants}, seed=1)


def rejected(store: Store, file: Path, *, row: int = 0, reason: str = "feet slide") -> Choice:
    words = ["curate", "reject", f"variants:short/waltz#{row}", "--reason", reason, "--curation", str(file)]
    assert run_command_line([*words, "--store", str(store)]) == 0
    (choice,) = read_choices(file).values()
    return choice


@pytest.fixture
def export(built: tuple[Store, StageInputs], tmp_path: Path, invoke: CommandLine) -> CommandLine:
    """Return the command that exports the variants to the folder `out`."""
    return invoke.of("export", "variants:short", "--out", tmp_path / "out").at(built[0])


def test_the_file_is_read_back_and_equal_choices_are_equal_files(tmp_path: Path) -> None:
    choices = [Choice("reject", "variants", "b/x", "0" * 12, "slides  a lot"), Choice("accept", "draws", "a", "1" * 12)]
    first, second = tmp_path / "one.txt", tmp_path / "deep" / "other.txt"
    write_choices(first, choices)
    write_choices(second, reversed(choices))
    assert first.read_bytes() == second.read_bytes()
    assert list(read_choices(first).values()) == [choices[1], replace(choices[0], reason="slides a lot")]
    assert read_choices(tmp_path / "none.txt") == {}


@pytest.mark.parametrize("name", ["my dance 1/fit@1-5", "two  spaces/A", "100%/A", "50%20/A", "舞 踏/A", "a\u2028b/A"])
def test_any_name_is_read_back(tmp_path: Path, name: str) -> None:
    file = tmp_path / "choices.txt"
    Choosing(file).decide("reject", "variants", name, "0" * 12, "feet slide")
    assert read_choices(file) == {f"variants {name}": Choice("reject", "variants", name, "0" * 12, "feet slide")}
    assert rejections(as_settings(read_choices(file)), "variants") == {name: "0" * 12}


def test_a_choice_keeps_the_comments_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "choices.txt"
    file.write_text("# looked at on the large screen\naccept draws a 111111111111\n")
    Choosing(file).decide("reject", "variants", "b/x", "0" * 12)
    Choosing(file).decide("undo", "variants", "b/x", "0" * 12)
    comment, *_, last = file.read_text().splitlines()[1:]
    assert (comment, last) == ("# looked at on the large screen", "accept draws a 111111111111")


@pytest.mark.parametrize(
    "line", ["refuse variants a/b 000000000000", "reject cakes a 000000000000", "reject variants a"]
)
def test_a_line_that_is_no_choice_is_named(tmp_path: Path, line: str) -> None:
    file = tmp_path / "choices.txt"
    file.write_text(f"# mine\n\n{line}\n")
    with pytest.raises(InputError, match=r"choices.txt, line 3: a choice is"):
        Choosing(file)


def test_a_choice_can_be_taken_back(built: tuple[Store, StageInputs], tmp_path: Path, invoke: CommandLine) -> None:
    store, _ = built
    file = tmp_path / "choices.txt"
    choice = rejected(store, file, row=3)
    rows = open_table("variants:short", store)
    first = rows["body22_m"][rows["variant_id"] == "A-uniform-0.80"]
    assert choice == Choice("reject", "variants", NAME, content_of(first), "feet slide")
    assert Choosing(file).words("variants", NAME, "f" * 12).startswith("rejected: feet slide (it had other content")
    invoke("curate", "undo", "variants:short#3", "--curation", file, "--store", store)
    assert read_choices(file) == {}


def test_exports_leave_out_rejected(built: tuple[Store, StageInputs], tmp_path: Path, export: CommandLine) -> None:
    store, _ = built
    file, out = tmp_path / "choices.txt", tmp_path / "out"

    def variants() -> set[str]:
        return set(np.load(out / "variants.npz")["variant_id"].tolist())

    export("--format", "npz")
    everything = variants()
    choice = rejected(store, file)
    said = export("--format", "npz", "--curation", file).out
    assert everything - variants() == {"A-uniform-0.80"}
    assert "left out, as somebody rejected it: 1 of variants" in said
    page = (out / LOOK).read_text(encoding="utf-8")
    assert ("A-uniform-0.95" in page, "A-uniform-0.80" in page) == (True, False)
    export_reference(store, "variants:short", "bvh", tmp_path / "bvh", curation=file)
    assert len(list((tmp_path / "bvh").glob("*0.80*.bvh"))) == 0
    assert len(list((tmp_path / "bvh").glob("*0.95*.bvh"))) == 2
    write_choices(file, [replace(choice, content="f" * 12)])
    export("--format", "npz", "--curation", file)
    assert variants() == everything


@pytest.mark.parametrize("file_format", ["npz", "bvh"])
def test_an_export_of_which_everything_is_rejected_is_refused_and_writes_nothing(
    built: tuple[Store, StageInputs], tmp_path: Path, export: CommandLine, file_format: str
) -> None:
    store, _ = built
    file, rows = tmp_path / "choices.txt", open_table("variants:short", store)
    contents = {name: content_of(rows["body22_m"][rows["variant_id"] == name]) for name in set(rows["variant_id"])}
    write_choices(file, [Choice("reject", "variants", f"waltz/{name}", content) for name, content in contents.items()])
    said = export.refusal("--format", file_format, "--curation", file)
    assert "'variants:short': all of it is rejected" in said
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="'variants:short': every variant failed, or is left out by the choices"):
        PairDataset("variants:short", 5, store=store, curation=file)


def test_an_export_by_a_file_of_choices_that_is_not_there_is_refused(tmp_path: Path, export: CommandLine) -> None:
    absent = tmp_path / "misspelt.txt"
    assert f"there is no file {absent}" in export.refusal("--format", "npz", "--curation", absent)


def test_a_single_image_is_decided_by_itself_and_what_reads_it_knows(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    columns = random_columns("annotations", 4) | {"sequence_id": ["a", "a", "b", "b"], "frame": [0] * 4}
    ref = put(store, "ingest", "images", {"annotations": columns | {"person_id": [0, 1, 0, 1]}}, {}).ref
    shelf = Shelf(store, [ref])
    (part,) = shelf.parts
    (item,) = shelf.items(part)
    name, content = thing_of(shelf, part, item, 2)
    choice = Choice("reject", "annotations", name, content)
    settings = as_settings({choice.about: choice})
    assert rejected_names(rejections(settings, "annotations"), [store.read(ref, "annotations")]) == {"b"}


@pytest.fixture
def video(tmp_path: Path) -> tuple[Store, str]:
    """Return a store with a reconstruction of six frames of two people, and its reference."""
    store = Store(tmp_path / "store")
    columns = random_columns("motions", 12) | {"sequence_id": ["video"] * 12, "method": ["fit"] * 12}
    columns |= {"person_id": [0, 1] * 6, "frame": np.repeat(np.arange(3, 9), 2), "time_s": np.repeat(np.arange(6), 2)}
    ref = put(store, "reconstruction", "video", {"motions": columns}, {}).ref
    return store, f"motions@{ref.key}"


@pytest.fixture
def reject_clip(video: tuple[Store, str], tmp_path: Path, invoke: CommandLine) -> CommandLine:
    """Return the command that rejects frames of the reconstruction."""
    store, reference = video
    words = ("--reason", "foot lost", "--curation", tmp_path / "choices.txt", "--frames")
    return invoke.at(store).of("curate", "reject", f"{reference}#0", *words)


def test_clips_are_rejected_by_frames(video: tuple[Store, str], tmp_path: Path, reject_clip: CommandLine) -> None:
    (store, reference), file = video, tmp_path / "choices.txt"
    reject_clip("5-6")
    (choice,) = read_choices(file).values()
    whole = open_table(reference, store)
    inside = np.isin(whole["frame"], [5, 6])
    assert choice == Choice("reject", "motions", "video/fit@5-6", content_of(whole["body22_m"][inside]), "foot lost")
    assert Choosing(file).clips("motions", "video/fit") == {(5, 6): choice}
    assert Choosing(file).about("motions", "video/fit") is None, "the rest is undecided"
    chosen = Data(store, file).table(reference, ["frame", "person_id"])
    assert chosen["frame"].tolist() == [3, 3, 4, 4, 7, 7, 8, 8]
    assert len(chosen.table.columns) == len(whole.table.columns)
    export_reference(store, reference, "npz", tmp_path / "out", curation=file)
    with np.load(tmp_path / "out" / "motions.npz") as exported:
        np.testing.assert_array_equal(exported["body22_m"], whole["body22_m"][~inside])
    write_choices(file, [replace(choice, content="0" * 12)])
    assert Data(store, file).table(reference).num_rows == 12, "it had other content then"


def test_rejected_clips_split_a_motion(video: tuple[Store, str], tmp_path: Path, reject_clip: CommandLine) -> None:
    (store, reference), file = video, tmp_path / "choices.txt"
    for frames in ("5-5", "8-8"):
        reject_clip(frames)
    parsed = parse_reference(reference)
    export = Export(store, reference, parsed, tuple(resolve(parsed, store)), choices=as_settings(read_choices(file)))
    rows = store.read(export.refs[0], "motions")
    parts = [(*key, *clip, sorted(set(rows["frame"][at]))) for key, at, *clip in _kept_parts(rows, export.left_out)]
    assert parts == [("video", "fit", "3-4", [3, 4]), ("video", "fit", "6-7", [6, 7])]


def test_a_reconstruction_of_which_nothing_is_rejected_is_one_motion_also_where_nobody_is_there(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    columns = random_columns("motions", 6) | {"sequence_id": ["video"] * 6, "method": ["fit"] * 6}
    columns |= {"person_id": [0, 0, 0, 1, 1, 1], "frame": [0, 1, 2, 7, 8, 9]}
    ref = put(store, "reconstruction", "video", {"motions": columns}, {}).ref
    ((key, own, *clip),) = _kept_parts(store.read(ref, "motions"), ())
    assert (key, own.tolist(), clip) == (("video", "fit"), [0, 1, 2, 3, 4, 5], [])


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ("7-5", "video/fit has the frames 3 to 8; there is no clip 7-5"),
        ("0-5", "video/fit has the frames 3 to 8; there is no clip 0-5"),
        ("5", "--frames 5: a clip is FIRST-LAST"),
    ],
)
def test_a_clip_that_is_not_there_is_refused(tmp_path: Path, reject_clip: CommandLine, frames: str, said: str) -> None:
    assert said in reject_clip.refusal(frames)
    assert not (tmp_path / "choices.txt").exists()


def test_windows_and_objects_leave_out_what_is_rejected(built: tuple[Store, StageInputs], tmp_path: Path) -> None:
    store, _ = built
    file = tmp_path / "choices.txt"
    rejected(store, file)
    all_items, items = (PairDataset("variants:short", 5, store=store, curation=choices) for choices in (None, file))
    assert {item["name"] for item in all_items} - {item["name"] for item in items} == {"waltz, A-uniform-0.80"}
    everything, chosen = Data(store), Data(store, file)
    left_out = {variant.name for variant in everything.variants("short")}
    assert left_out - {variant.name for variant in chosen.variants("short")} == {"waltz, A-uniform-0.80"}
    rows = chosen.table("variants:short", ["frame"])
    assert rows.num_rows == 0.75 * open_table("variants:short", store).num_rows
    assert [column.name for column in rows.rows.schema] == ["frame"]
    assert chosen.table("takes:short").num_rows == 2, "of a table without things every row is there"
    with pytest.raises(InputError, match="there is no file"):
        Data(store, tmp_path / "misspelt.txt")


def test_rejected_variants_are_not_trained_on(built: tuple[Store, StageInputs], tmp_path: Path) -> None:
    store, inputs = built
    choice = rejected(store, tmp_path / "choices.txt")

    def keys(*choices: Choice) -> list[str]:
        settings = as_settings({choice.about: choice for choice in choices})
        return [shard.key for shard in plan_training(inputs, TrainingParameters(choices=settings))]

    assert keys(Choice("reject", "variants", "other_take/A-uniform-0.80", "0" * 12)) == keys()
    assert not {*keys()} & {*keys(choice)}
    takes, variants = ([manifest.ref for manifest in inputs.of(table)] for table in ("poses", "variants"))
    names = {name for _, name in StoredVariants(store, takes, variants).sound_names("waltz")}
    kept = StoredVariants(store, takes, variants, rejected=rejections(as_settings({choice.about: choice}), "variants"))
    assert names - {name for _, name in kept.sound_names("waltz")} == {"A-uniform-0.80"}


def test_a_choice_is_of_one_thing(built: tuple[Store, StageInputs], tmp_path: Path, invoke: CommandLine) -> None:
    file = tmp_path / "choices.txt"
    reject = invoke.of("curate", "reject", "--curation", file).at(built[0])
    said = reject.refusal("variants:short/waltz")
    assert "names several things, waltz/A-uniform-0.80 (row 0) to waltz/A-uniform-1.20" in said
    assert not file.exists()
    assert f"--curation {file}" in reject("poses:short/waltz").out, "one take"
    assert [choice.about for choice in read_choices(file).values()] == ["poses waltz"]


def test_a_study_says_what_its_file_said_and_is_built_again_without_the_file(tmp_path: Path) -> None:
    choice = Choice("reject", "variants", NAME, "0" * 12, "feet slide")
    file, study = tmp_path / "choices.txt", tmp_path / "mine.toml"
    study.write_text('[study]\nname = "mine"\nextends = "duets"\n[curation]\nfile = "choices.txt"\n')
    with pytest.raises(StudyError, match=r"curation.file: there is no file"):
        load_study(str(study), load_graph())
    write_choices(file, [choice])
    resolved = load_study(str(study), load_graph())[0].resolved()
    said = "reject 000000000000 feet slide"
    assert resolved["curation"]["choices"] == {f"variants {NAME}": said}
    assert "choices" not in resolved["training"]
    bare = load_study("duets", load_graph())[0].resolved()
    leaves = changed_leaves(bare["curation"], resolved["curation"])
    assert leaves[f"choices.variants {NAME}"] == ("", f'"{said}"'), "what `diff` shows"
    file.unlink()
    again, _ = study_from_record(resolved, [], load_graph())
    assert again.resolved()["curation"]["choices"] == resolved["curation"]["choices"]
    file.write_text("nonsense\n")
    with pytest.raises(StudyError, match=r"choices.txt, line 1"):
        load_study(str(study), load_graph())
