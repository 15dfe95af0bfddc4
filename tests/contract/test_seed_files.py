"""Seeds from files: refused before any work when they are wrong, exact when they are right, with their lineage."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from flows.execution import begin, execute
from flows.exports import export_reference
from flows.outcomes import Run
from flows.planning import make_plan
from pasdedeux.errors import InputError
from pasdedeux.formats.pair_file import PairFile, PairSource, read_pair_json, write_pair_json
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.sampling.parameters import gauge_fix
from storage_schema import Manifest, Store, open_table
from tasks import seeds
from tasks.evaluation.chains import TOPIC as CHAINS
from tasks.rows.draw_sets import REPAIRED
from tasks.seeds import SeedsParameters
from tasks.seeds.files import SeedFile, pair_of_draw
from tasks.shards import HerePool
from tasks.stage import StageInputs
from tests.builders.made_poses import pair_bvh
from tests.builders.real_study import build_here, call_in_process, refused
from tests.builders.storage_rows import having

PAIR = gauge_fix(random_pairs(np.random.default_rng(4), 1, spread_rad=0.1)[0])

OLD_KEY = "0" * 64

STUDY = """
[study]
name = "edited"
stages = ["ingest", "priors", "views", "seeds", "chains"]

[ingest]
rate_hz = 12.0
duets = [{{ name = "waltz", duration_s = 1.0 }}, {{ name = "hug", duration_s = 1.0 }}]
held_out = ["hug"]
virtual_video = {{ num_random_views = 8 }}

[seeds]
num_seeds = 0
files = [{{ path = "seed.json"{more} }}]

[chains]
densities = ["ic"]
num_chains = 2
num_draws = 8
segment_draws = 4
thin = 2
num_views = 3
"""


OF_TAKES = ("seeds.files=[]", "seeds.num_seeds=2")


def write_study(folder: Path, *, more: str = "") -> Path:
    study = folder / "edited.toml"
    study.write_text(STUDY.format(more=more))
    return study


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Return a store with the study of two seeds of takes; nothing may be computed in it."""
    folder = tmp_path_factory.mktemp("edited")
    build_here(write_study(folder), folder / "store", *OF_TAKES)
    return Store(folder / "store")


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[Run]:
    """Let `restart` build in this process; return what was run."""
    begun: list[Run] = []

    def build(run: Run, *_: object, **__: object) -> None:
        plan = make_plan(run.study, run.graph, run.store, run.selection)
        execute(run, begin(run, plan), plan, HerePool(str(run.store.root)))
        begun.append(run)

    monkeypatch.setattr("flows.console.restart.build_and_report", build)
    return begun


def planned(store: Store, file: SeedFile) -> list[Manifest]:
    shards = seeds.plan(StageInputs({}, seed=1), SeedsParameters(num_seeds=0, files=[file]))
    return [store.manifest(seeds.run_shard(shard, store)) for shard in shards]


def test_a_seed_of_a_file_is_the_pair_in_it_with_its_lineage(store: Store, tmp_path: Path) -> None:
    source = PairSource("someone", "CC0", "made it")
    (tmp_path / "a.json").write_text(write_pair_json(PairFile(PAIR, "draws@abc#3", ("one",), (source,))))
    (made,) = planned(store, SeedFile(path=tmp_path / "a.json", takes=("two",)))
    table = store.read(made.ref, "seeds")
    np.testing.assert_allclose(table["pair17_m"][0], PAIR, atol=1e-12)
    assert (table["origin"][0], table["made_from"][0]) == ("draw", "draws@abc#3")
    assert made.facts["takes"] == ["one", "two"]
    assert [(source.name, source.licence, source.credit) for source in made.sources] == [("someone", "CC0", "made it")]


def test_a_seed_of_two_bvh_files_is_the_pair_in_them(store: Store, tmp_path: Path) -> None:
    for name, text in zip("ab", pair_bvh(PAIR), strict=True):
        (tmp_path / f"{name}.bvh").write_text(text)
    (made,) = planned(store, SeedFile(path=tmp_path / "a.bvh", other=tmp_path / "b.bvh"))
    table = store.read(made.ref, "seeds")
    np.testing.assert_allclose(table["pair17_m"][0], PAIR, atol=2e-6)
    assert table["origin"][0] == "file"
    assert made.sources[0].licence == "not stated"


def test_where_a_file_lies_does_not_matter_and_what_it_holds_does(tmp_path: Path) -> None:
    keys = []
    for name, pair in (("a", PAIR), ("b", PAIR), ("c", PAIR + 1e-9)):
        (tmp_path / f"{name}.json").write_text(write_pair_json(PairFile(pair)))
        parameters = SeedsParameters(num_seeds=0, files=[SeedFile(path=tmp_path / f"{name}.json")])
        keys.append(seeds.plan(StageInputs({}, seed=1), parameters)[0].key)
    assert keys[0] == keys[1] != keys[2]


def test_a_file_that_changes_between_plan_and_run_is_noticed(store: Store, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(write_pair_json(PairFile(PAIR)))
    (shard,) = seeds.plan(StageInputs({}, seed=1), SeedsParameters(num_seeds=0, files=[SeedFile(path=path)]))
    path.write_text(write_pair_json(PairFile(PAIR + 0.1)))
    with pytest.raises(InputError, match="changed since the run was planned"):
        seeds.run_shard(shard, store)


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        (None, "", "seed.json does not exist"),
        ("{", "", "seeds.files: seed.json: this pair is not valid JSON: line "),
        ("HIERARCHY", "", "seed.json is the BVH of one person; `other` must name that of person B"),
        (write_pair_json(PairFile(PAIR)), ', other = "b.bvh"', "b.bvh does not exist"),
        (write_pair_json(PairFile(PAIR)).replace("head", "hat"), "", "person A: joint 'head' is missing"),
    ],
)
def test_a_wrong_file_is_one_sentence_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, more: str, message: str
) -> None:
    if text is not None:
        (tmp_path / "seed.json").write_text(text)
    assert message in refused(capsys, write_study(tmp_path, more=more))


def test_a_seed_made_from_a_take_that_is_held_out_is_refused(
    edited: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "seed.json").write_text(write_pair_json(PairFile(PAIR, takes=("hug",))))
    study = write_study(tmp_path)
    found = call_in_process(capsys, "run", study, "--store", edited.root)
    assert found.code == 2
    assert "seed.json was made from take 'hug', which this study holds out" in found.err


@pytest.mark.usefixtures("runs")
def test_a_draw_becomes_the_seed_of_new_chains(
    edited: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`restart` itself, but for Prefect and the cluster: the file is the draw exactly, and the new chains know it."""
    store = Store(shutil.copytree(edited.root, tmp_path / "store"))
    row = 11
    chosen = pair_of_draw(store, f"draws:edited#{row}")
    shutil.copytree(store.folder("chains", chosen.ref.key), store.folder("chains", OLD_KEY))
    text = (store.folder("chains", OLD_KEY) / "manifest.json").read_text()
    (store.folder("chains", OLD_KEY) / "manifest.json").write_text(text.replace(chosen.ref.key, OLD_KEY))
    before = len(list(store.artifacts()))
    stored = np.asarray(open_table("draws:edited", store)["pair17_m"][row])
    np.testing.assert_allclose(chosen.pair.pair_m, stored, atol=1e-6)
    options = ("--store", store.root, "--out", tmp_path / "out")
    # What has the same content is of that study too, such as what an older version of the stage has made.
    answer = call_in_process(capsys, "restart", f"draws@{OLD_KEY}#{chosen.row}", *options, "--set", "chains.bad=1")
    assert answer.code == 2
    assert "chains.bad: unknown" in answer.err
    assert not (tmp_path / "out").exists()
    fewer = ("--set", "chains.num_draws=4", "--set", "chains.num_chains=1")
    answer = call_in_process(capsys, "restart", f"draws:edited#{row}", *options, *fewer)
    assert answer.code == 0, answer.err
    name = f"edited-restart-{chosen.ref.key[:12]}-{chosen.row}"
    assert f"pasdedeux show draws:{name}" in answer.out
    (written,) = (tmp_path / "out").glob("*.json")
    np.testing.assert_array_equal(read_pair_json(written.read_text()).pair_m, chosen.pair.pair_m)
    seed = open_table(f"seeds:{name}", store)
    assert (seed["origin"][0], seed["made_from"][0]) == ("draw", f"draws@{chosen.ref.key}#{chosen.row}")
    np.testing.assert_allclose(seed["pair17_m"][0], gauge_fix(chosen.pair.pair_m), atol=1e-12)
    draws = open_table(f"draws:{name}", store)
    assert (draws["density"].tolist(), draws["chain"].tolist()) == (["ic"] * 4, [0] * 4)
    # One seed, one segment and a summary; everything else was there.
    new = list(store.artifacts())
    assert len(new) == before + 3
    (made,) = (manifest for manifest in new if manifest.facts.get("made_from", "").startswith("draws@"))
    assert made.facts["takes"] == ["waltz"]
    assert {source.name for source in made.sources} == {source.name for source in chosen.pair.sources}


def test_draws_of_every_kind_start_chains_again_with_the_keys_of_their_sweep_alone(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str], runs: list[Run]
) -> None:
    """Of chains, repaired pairs and sweeps of both, in a study whose chains start at what its own seeds grow."""
    sweeps = "chains.sweep={repaired = {densities = ['ic']}, wide = {starts = 'grown', sigma_l = 0.1}}"
    more = ("seeds.num_grown=4", "seeds.num_filled=2", "seeds.num_starts=1")
    base = ("chains.starts=every", "chains.repair_steps=2", sweeps)
    build_here(write_study(tmp_path), store.root, "seeds.files=[]", "seeds.num_seeds=1", *more, *base)
    kinds = open_table("draws:edited", store)["density"].tolist()
    assert set(kinds) == {f"ic{REPAIRED}", "repaired", "wide"}
    fewer = ("--set", "chains.num_draws=4", "--set", "chains.num_chains=1")
    for kind in sorted(set(kinds)):
        draw = f"draws:edited#{kinds.index(kind)}"
        answer = call_in_process(capsys, "restart", draw, "--store", store.root, "--out", tmp_path / "out", *fewer)
        assert answer.code == 0, answer.err
        assert open_table(f"draws:{runs[-1].study.name}", store)["density"].tolist() == ["ic"] * 4
        chains = runs[-1].study.parameters["chains"]
        assert (chains.densities, chains.sweep) == (("ic",), {})
        assert (chains.sigma_l == 0.1) == (kind == "wide")


def test_draws_are_shown_by_the_row_that_restart_takes(edited: Store, capsys: pytest.CaptureFixture[str]) -> None:
    shown = call_in_process(capsys, "show", "draws:edited", "--rows", "20", "--store", edited.root).out
    places = re.findall(r"^  #(\d+) density=ic, seed_index=(\d+), chain=(\d+)", shown, re.MULTILINE)
    draws = open_table("draws:edited", edited)
    assert [tuple(map(int, place)) for place in places] == [
        (row, draws["seed_index"][row], draws["chain"][row]) for row in range(20)
    ]
    drawn = having("draws", edited.artifacts("chains"))
    (shard,) = CHAINS.plan(StageInputs({"draws": drawn[::-1]}, seed=1), CHAINS.settings())
    (picture,) = CHAINS.pictures(CHAINS.compute(shard, edited))
    assert picture.name == "draws-ic.player.json"
    scene = json.loads(picture.content)
    points = np.frombuffer(base64.b64decode(scene["data"]), dtype="<i2").reshape(scene["num_frames"], -1, 3)
    assert len(scene["labels"]) == 8
    for label, drawn in zip(scene["labels"], points[:, :34] * scene["unit_m"], strict=True):
        pair = pair_of_draw(edited, label.replace("STUDY", "edited")).pair.pair_m.reshape(34, 3)
        np.testing.assert_allclose(np.ptp(drawn - pair, axis=0), 0.0, atol=2.5 * scene["unit_m"])
        assert -0.3 < drawn[:, 1].min() < 0.3, "feet are about where the ground is drawn"


def test_what_is_no_draw_cannot_be_restarted_from(
    edited: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for text, message in (
        ("seeds:edited#0", "is not a draw"),
        ("draws:edited", "is not a draw"),
        ("draws:edited#32", "there is no row 32, the table has 32 rows here"),
        ("draws@ffffffff#0", "no artifact"),
        ("draws:other#0", "has not run"),
    ):
        answer = call_in_process(capsys, "restart", text, "--store", edited.root, "--out", tmp_path / "out")
        assert answer.code == 2, text
        assert message in answer.err
        assert not (tmp_path / "out").exists()


def test_exported_seeds_and_draws_come_in_again(edited: Store, store: Store, tmp_path: Path) -> None:
    seed_m = open_table("seeds:edited", edited)["pair17_m"][1]
    out = tmp_path / "out"
    as_json = export_reference(edited, "seeds:edited", "json", out)
    assert [path.name for path in as_json] == ["seed0.json", "seed1.json", "CREDITS.txt"]
    as_bvh = export_reference(edited, "seeds:edited#1", "bvh", out)
    assert [path.name for path in as_bvh] == ["seed1.A.bvh", "seed1.B.bvh", "UNITS.txt", "CREDITS.txt"]
    (exact,) = planned(store, SeedFile(path=out / "seed1.json"))
    (close,) = planned(store, SeedFile(path=out / "seed1.A.bvh", other=out / "seed1.B.bvh"))
    np.testing.assert_allclose(store.read(exact.ref, "seeds")["pair17_m"][0], seed_m, atol=1e-12)
    np.testing.assert_allclose(store.read(close.ref, "seeds")["pair17_m"][0], seed_m, atol=2e-6)
    assert exact.facts["takes"] == ["waltz"]
    (draw, _) = export_reference(edited, "draws:edited#3", "json", out)
    assert json.loads(draw.read_text())["made_from"].endswith("#3")
    with pytest.raises(InputError, match="allowed are seeds and single draws"):
        export_reference(edited, "draws:edited", "json", out)


def test_a_pair_that_lacks_joints_is_completed_by_draws(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = PairSource("someone", "CC0", "made it")
    (tmp_path / "a.json").write_text(write_pair_json(PairFile(PAIR, "draws@abc#3", ("one",), (source,))))
    (made,) = planned(store, SeedFile(path=tmp_path / "a.json"))
    turn = yaw_rotmat(0.8)
    tree = json.loads(write_pair_json(PairFile(PAIR @ turn.T + 1.0, takes=("two",))))
    del tree["persons"]["A"]["left_wrist"]
    tree["persons"]["B"] = dict.fromkeys(tree["persons"]["B"])
    (tmp_path / "part.json").write_text(json.dumps(tree))
    options = ("--draws", f"seeds@{made.ref.key}", "--store", store.root)
    answer = call_in_process(capsys, "complete", tmp_path / "part.json", *options)
    assert answer.code == 0, answer.err
    assert "person A: 1 joint completed" in answer.out
    assert "person B: 17 joints completed, 0.0 cm uncertain" in answer.out
    whole = read_pair_json((tmp_path / "part_completed.json").read_text())
    np.testing.assert_allclose(whole.pair_m, PAIR @ turn.T + 1.0, atol=0.01)
    assert (whole.takes, [source.name for source in whole.sources]) == (("one", "two"), ["someone"])
    for text, reference, message in (
        (write_pair_json(PairFile(PAIR)), options[1], "part.json: no joint is missing"),
        (json.dumps(tree | {"persons": {"A": {}, "B": {}}}), options[1], "0 joints of the two people are known"),
        (json.dumps(tree), "views:edited", "names no draws"),
        (json.dumps(tree | {"unit": "cm"}), options[1], "part.json: this is no pair: unit: Input should be 'm'"),
    ):
        (tmp_path / "part.json").write_text(text)
        answer = call_in_process(capsys, "complete", tmp_path / "part.json", "--draws", reference, *options[2:])
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert message in answer.err
