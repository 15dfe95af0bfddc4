"""The main job on a small study: one command, two workers, every stage; what it leaves and what can be done with it."""

from __future__ import annotations

import base64
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flows.planning import make_plan, stage_inputs
from flows.study import load_study
from pasdedeux.skeletons import BODY22
from storage_schema import TABLES, Store, open_table, read_latest
from tasks import evaluation
from tests.builders.pages import Page
from tests.builders.real_study import BuiltStudy, RealRun, build_here, call_in_process, graph

pytestmark = pytest.mark.slow

STAGES = {*graph().names} - {"generation"}
"""Stages that leave something; the study generates nothing."""
TOPICS = {"takes", "views", "chains", "sets", "coverage", "leave_one_out", "lifting", "reconstruction", "augmentation"}
TOPICS |= {"models"}
"""Topics that have scores."""
HEADINGS = {topic.heading for topic in evaluation.TOPICS if topic.name in TOPICS | {"clips"}}
HEADINGS |= {"What was built", "Is it good?", "Skipped, and why", "Sources and licences"}
FILLED = set(TABLES) - {"camera_motions", "objects", "model_states", "torso_basis", "joint_limits"}
FILLED -= {"selected_pairs", "contacts", "clips"}
"""The study has no object, no model that is trained in several segments, and no take that priors are learned from;
selected pairs, contacts and clips are in exported files alone."""
RATE_HZ = 12.0


def report_folder(small: BuiltStudy) -> Path:
    (folder,) = (small.store / "runs").glob("*/report")
    return folder


def test_every_stage_and_every_table_is_there(small: BuiltStudy) -> None:
    latest = read_latest(Store(small.store), "small")
    assert latest is not None
    assert {stage for stage in latest.stages if latest.refs(stage)} == STAGES
    tables = {
        name for stage in STAGES for ref in latest.refs(stage) for name in Store(small.store).manifest(ref).tables
    }
    assert tables >= FILLED
    for name in tables:
        assert open_table(f"{name}:small", small.store).num_rows > 0, name


def test_the_command_says_how_it_went_and_where_the_report_is(small: BuiltStudy) -> None:
    page = small.store / "runs" / "latest" / "small.html"
    assert f"report: {page}\n" in small.answer.out
    assert page.read_bytes() == (report_folder(small) / "report.html").read_bytes()
    assert "shards computed" in small.answer.out
    assert "\x1b" not in small.answer.out + small.answer.err, "plain lines where nobody sits at a terminal"


def test_the_report_needs_no_other_file_and_has_a_section_for_everything(small: BuiltStudy) -> None:
    text = (report_folder(small) / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert {heading for level, heading in page.headings if level == 2} == HEADINGS
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    assert "url(" not in text
    assert "@import" not in text
    assert len(page.figures) >= 8
    for figure in page.figures:
        assert b"<image" in figure or figure.count(b"<path") + figure.count(b"<use") > 10, "an empty figure"
    assert len(page.scenes) >= 8
    assert {path.name for path in report_folder(small).glob("*.svg")}


def test_the_card_names_licence_and_credit_of_each_source_and_the_held_out_take(small: BuiltStudy) -> None:
    card = (report_folder(small) / "card.md").read_text(encoding="utf-8")
    sources = {source for manifest in Store(small.store).artifacts() for source in manifest.sources}
    assert sources
    for source in sources:
        assert source.name in card
        assert source.licence in card
        assert source.credit in card
    assert "- hug (held out for evaluation)" in card
    assert "- waltz\n" in card
    for table in FILLED - {"scores", "verdicts"}:
        assert f"| {table} | {open_table(f'{table}:small', small.store).num_rows:,} |" in card


def test_every_topic_has_scores_beside_a_baseline_and_each_only_once(small: BuiltStudy) -> None:
    scores = open_table("scores:small", small.store)
    is_baseline: dict[str, set[bool]] = {}
    for topic, value in zip(scores["topic"], scores["is_baseline"], strict=True):
        is_baseline.setdefault(topic, set()).add(bool(value))
    assert set(is_baseline) == TOPICS
    assert {topic for topic, values in is_baseline.items() if values == {True, False}} == TOPICS - {"takes"}
    columns = ("topic", "metric", "method", "split", "item", "at")
    rows = Counter(zip(*(map(str, scores[name]) for name in columns), strict=True))
    assert [row for row, count in rows.items() if count > 1] == []
    assert not np.isinf(scores["value"]).any()


def test_what_is_held_out_was_learned_from_by_nothing(small: BuiltStudy) -> None:
    learned = ("torso_basis", "joint_limits", "seeds", "draws", "projections", "models")
    for manifest in Store(small.store).artifacts():
        if set(learned) & set(manifest.tables):
            assert "hug" not in manifest.facts["takes"], (manifest.ref.stage, manifest.partition, manifest.name)
    assert "hug" not in set(open_table("projections:small", small.store)["take_id"])
    assert set(open_table("motions:small", small.store)["sequence_id"]) == {"hug.video00"}


def test_every_video_has_a_moving_clip(small: BuiltStudy) -> None:
    videos = {name for name in open_table("cameras:small", small.store)["sequence_id"] if ".video" in name}
    clips = {
        path.name.removeprefix("clip-").removesuffix(".player.json"): json.loads(path.read_text())
        for path in report_folder(small).glob("clip-*")
    }
    assert set(clips) == videos == {"waltz.video00", "hug.video00"}
    for scene in clips.values():
        moving = np.frombuffer(base64.b64decode(scene["data"]), "<i2").reshape(scene["num_frames"], -1)
        assert np.ptp(moving, axis=0).max() > 5


@pytest.mark.parametrize("table", sorted(FILLED))
def test_every_table_can_be_shown(small: BuiltStudy, capsys: pytest.CaptureFixture[str], table: str) -> None:
    answer = call_in_process(capsys, "show", f"{table}:small", "--store", small.store, "--json")
    assert answer.code == 0, answer.err
    shown = answer.json
    assert [column["name"] for column in shown["columns"]] == [column.name for column in TABLES[table].columns]
    assert shown["num_rows"] == open_table(f"{table}:small", small.store).num_rows
    assert {step["stage"] for step in shown["lineage"]} <= STAGES
    assert shown["sources"] or table == "models"
    assert call_in_process(capsys, "show", f"{table}:small#0", "--store", small.store).code == 0


def test_the_lineage_of_scores_reaches_every_take(small: BuiltStudy, capsys: pytest.CaptureFixture[str]) -> None:
    shown = call_in_process(capsys, "show", "scores:small", "--store", small.store, "--json").json
    steps = {(step["stage"], step["partition"], step["name"]) for step in shown["lineage"]}
    assert {("ingest", "waltz", "take"), ("ingest", "hug", "take")} <= steps
    assert {stage for stage, _, _ in steps} == STAGES


def test_status_and_verify_find_everything_in_place(small: BuiltStudy, capsys: pytest.CaptureFixture[str]) -> None:
    status = call_in_process(capsys, "status", "--store", small.store, "--json").json
    (study,) = [study for study in status["studies"] if study["study"] == "small"]
    assert {stage["stage"] for stage in study["stages"]} == STAGES | {"generation"}
    assert all(stage["num_shards"] == stage["num_there"] for stage in study["stages"])
    assert [run["status"] for run in status["runs"]] == ["finished"]
    verified = call_in_process(capsys, "verify", "--store", small.store, "--json")
    assert verified.code == 0
    assert verified.json["num_artifacts"] == len(list(Store(small.store).artifacts()))


@pytest.mark.parametrize(
    ("reference", "names"),
    [
        ("poses:small/waltz", ("waltz.A", "waltz.B")),
        ("variants:small/waltz", ("waltz_A-0.95.A", "waltz_A-0.95.B")),
    ],
)
def test_what_goes_out_as_bvh_can_come_in_again(
    small: BuiltStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str], reference: str, names: tuple[str, str]
) -> None:
    export(small, capsys, reference, "bvh", tmp_path)
    study = tmp_path / "again.toml"
    files = [tmp_path / f"{name}.bvh" for name in names]
    assert call_in_process(capsys, "study", "new", study, "--from", files[0], "--from", files[1]).code == 0
    text = study.read_text().replace("[study]", '[study]\nstages = ["ingest"]', 1)
    study.write_text(text)
    build_here(study, tmp_path / "store", f"ingest.rate_hz={RATE_HZ}", "ingest.virtual_video.num_random_views=1")
    again_m = open_table("poses:again", tmp_path / "store")["body22_m"]
    if reference.startswith("poses"):
        np.testing.assert_allclose(again_m, open_table(reference, small.store)["body22_m"], atol=2e-4)
        return
    variants = open_table(reference, small.store)
    rows = [(variants["variant_id"] == "A-uniform-0.95") & (variants["person"] == person) for person in (0, 1)]
    off_m = np.linalg.norm(again_m - np.concatenate([variants["body22_m"][chosen] for chosen in rows]), axis=-1)
    ends = BODY22.indices(["left_wrist", "right_wrist", "left_ankle", "right_ankle"])
    # A source's hips and spine are stiffer than body22's; hands and feet are met first.
    assert off_m[:, ends].max() < 0.01
    assert np.percentile(off_m, 95) < 0.015


def export(small: BuiltStudy, capsys: pytest.CaptureFixture[str], reference: str, file_format: str, out: Path) -> None:
    answer = call_in_process(capsys, "export", reference, "--format", file_format, "--out", out, "--store", small.store)
    assert answer.code == 0, answer.err
    assert all(Path(line.removeprefix("look at it: ")).is_file() for line in answer.out.splitlines())
    assert "Apache-2.0" in (out / "CREDITS.txt").read_text(encoding="utf-8")


MODULES = """
import json, sys
from flows.console import main
try:
    main(sys.argv[1:])
finally:
    print(json.dumps(sorted(sys.modules)), file=sys.stderr)
"""
HEAVY = {"prefect", "distributed", "dask", "uvicorn", "fastapi"}
HEAVY |= {"cv2", "matplotlib.pyplot", "scipy.signal", "arviz_stats", "pandas"}


def test_a_second_run_computes_nothing_and_loads_neither_prefect_nor_dask(small: BuiltStudy, tmp_path: Path) -> None:
    before = sorted(path for path in small.store.rglob("*"))
    arguments = ("run", small.study, "--store", small.store, "--json")
    answer = RealRun(*arguments, prefect_home=tmp_path / "prefect", program=("-c", MODULES)).finish()
    assert answer.code == 0, answer.err
    assert answer.json["num_computed"] == 0
    assert answer.json["report"] == str(report_folder(small))
    assert HEAVY & set(json.loads(answer.err.splitlines()[-1])) == set()
    assert not (tmp_path / "prefect").exists(), "Prefect was started"
    assert sorted(path for path in small.store.rglob("*")) == before


def test_what_a_stage_begins_with_before_all_is_there_is_what_it_consists_of(small: BuiltStudy) -> None:
    study, stages = load_study(str(small.study), graph())
    plan = make_plan(study, stages, Store(small.store))
    late: dict[str, set[str]] = {}
    for stage in stages.stages:
        parameters = study.parameters[stage.name]
        needed = {name: plan.stage(name).manifests for name in stages.needed(stage.name, parameters)}
        inputs = stage_inputs(stage, study.head.seed, needed)
        planned = {item.shard.key: item.shard.partition for item in plan.stage(stage.name).shards}
        begun: set[str] = set()
        for early in stage.early:
            whole = {table: inputs.of(table) for table in early.reads}
            for new in [manifest for table in early.each for manifest in inputs.of(table)] or [None]:
                news = {table: (new,) if new and table in new.tables else () for table in early.each}
                begun.update(shard.key for shard in early.plan(replace(inputs, manifests=whole | news), parameters))
        assert begun <= planned.keys(), stage.name
        if stage.early:
            late[stage.name] = {partition for key, partition in planned.items() if key not in begun}
    assert late.pop("projections"), "whether draws enter depends on whether there are takes"
    assert late == {"augmentation": set(), "views": set(), "evaluation": {"report"}}
