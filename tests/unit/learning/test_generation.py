"""Stage `generation` and `pasdedeux generate`: sampled variants beside the solver's, in a store and as files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.learning.networks.interaction_cvae import InteractionCvae
from pasdedeux.learning.registry import Weights, write_weights
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.settings import PaperCvaeConfig
from pasdedeux.learning.window_vae import PaperCvaeModel
from pasdedeux.skeletons import BODY22, EXPI18, Skeleton
from storage_schema import Manifest, Store
from tasks.generation import STAGE, GenerationParameters, check_study
from tasks.graph import load_graph
from tasks.ingest import STAGE as INGEST
from tasks.ingest import IngestParameters
from tasks.rows.takes import read_take
from tasks.stage import StageInputs
from tasks.training.parameters import TrainingParameters
from tests.builders.stored_models import put_model

SMALL = PaperCvaeConfig(window_s=1.0, width=6, hidden=5, latent_size=3, num_blocks=1, kernel=1)


def make_model(skeleton: Skeleton = BODY22) -> PaperCvaeModel:
    """Return a model with weights that somebody might have learned in a moment."""
    network, generator = InteractionCvae(SMALL, skeleton), torch.Generator().manual_seed(5)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.02, generator)
    known = np.stack([np.ones(skeleton.num_joints), np.full(skeleton.num_joints, 0.05)])
    return PaperCvaeModel(SMALL, known.astype(np.float32), network)


class Here:
    """A store with half a second of waltz and two trained models."""

    def __init__(self, root: Path) -> None:
        self.store = Store(root)
        section = IngestParameters.model_validate({"duets": [{"name": "waltz", "duration_s": 0.5}]})
        ref = INGEST.run_shard(INGEST.plan(StageInputs(manifests={}, seed=1), section)[0], self.store)
        self.take = self.store.manifest(ref)
        self.model = put_model(self.store, make_model(), "random", [self.take])
        put_model(self.store, RidgeScaleModel(coefficients={}), "random", [self.take])

    @property
    def inputs(self) -> StageInputs:
        models = [manifest for manifest in self.store.artifacts("training") if "models" in manifest.tables]
        return StageInputs(manifests={"models": models, "poses": [self.take]}, seed=1)

    def made(self, store: Store | None = None, **keys: object) -> list[Manifest]:
        shards = STAGE.plan(self.inputs, GenerationParameters.model_validate({"model": "paper_cvae", **keys}))
        store = store or self.store
        return [store.manifest(STAGE.run_shard(shard, store)) for shard in shards]


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Here:
    return Here(tmp_path_factory.mktemp("generation") / "store")


def test_what_is_sampled_depends_on_neither_blocks_nor_how_many_there_are(here: Here, tmp_path: Path) -> None:
    few, many = here.made(num_variants=1)[0], here.made(num_variants=9)
    assert [len(manifest.facts["variants"]) for manifest in many] == [8, 1]
    first = many[0]
    rows = few.tables["variants"].rows
    np.testing.assert_array_equal(
        here.store.read(few.ref, "variants")["body22_m"], here.store.read(first.ref, "variants")["body22_m"][:rows]
    )
    there = Here(tmp_path / "again")
    assert [manifest.ref.content_digest for manifest in there.made(num_variants=1)] == [few.ref.content_digest]


def test_training_reads_what_the_solver_made_alone_and_the_evaluation_both() -> None:
    graph = load_graph()
    assert "generation" not in graph.above("training")
    assert {"augmentation", "training"} <= graph.above("generation")
    assert "generation" in graph.upstream["evaluation"]
    assert "generation" not in graph.needed("projections", graph.stage("projections").parameters())


def write_keys(path: Path, frames: list[int], pose_m: np.ndarray) -> Path:
    path.write_text(json.dumps({"frames": frames, "body22_m": pose_m.tolist()}))
    return path


def test_key_frames_that_b_can_take_are_met(here: Here, tmp_path: Path) -> None:
    source = read_take(here.store, here.take.ref).source
    keys = write_keys(tmp_path / "keys.json", [4], source.positions_m[[4], 1] + [0.02, 0.0, 0.0])
    (generated,) = here.made(num_variants=1, key_frames={"waltz": keys})
    motion = here.store.read(generated.ref, "variants")["body22_m"].reshape(-1, 2, 22, 3)
    assert np.linalg.norm(motion[4, 1] - source.positions_m[4, 1] - [0.02, 0.0, 0.0], axis=-1).max() < 0.005


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"model": "oracle"}, "'oracle' names 0 trained models, not one; there are: paper_cvae@random, ridge"),
        ({"model": "paper_cvae@cross_scale"}, "names 0 trained models"),
        ({"key_frames": {"tango": "near.json"}}, "'tango' is no take of two people; takes: waltz"),
        (
            {"key_frames": {"waltz": "far.json"}},
            r"key frames: frame 99 is outside the motion of take waltz, which has 15",
        ),
        ({"key_frames": {"waltz": "none.json"}}, r"none\.json does not exist"),
    ],
)
def test_impossible_sampling_is_refused(here: Here, tmp_path: Path, keys: dict[str, object], sentence: str) -> None:
    for name, frame in (("near", 4), ("far", 99)):
        write_keys(tmp_path / f"{name}.json", [frame], np.zeros((1, 22, 3)))
    files = keys.get("key_frames")
    if isinstance(files, dict):
        keys = {"key_frames": {take: tmp_path / name for take, name in files.items()}}
    with pytest.raises(InputError, match=sentence):
        here.made(**keys)


def test_a_study_is_refused_whose_model_cannot_do_what_is_asked(tmp_path: Path) -> None:
    keys = write_keys(tmp_path / "keys.json", [0], np.zeros((1, 22, 3)))

    def check(**values: object) -> None:
        check_study({"generation": GenerationParameters.model_validate(values), "training": TrainingParameters()})

    check()
    check(model="ridge_scale", scales=[0.9])
    check(key_frames={"waltz": keys})
    empty = tmp_path / "empty.json"
    empty.write_text("{}")
    for values, sentence in (
        ({"model": "paper_cvae"}, "'paper_cvae' is not trained here; trained are copy, naive_fk, ridge_scale"),
        ({"model": "ridge_scale"}, "'ridge_scale' draws no bodies, so scales must be given"),
        ({"model": "naive_fk", "key_frames": {"waltz": keys}}, "'naive_fk' takes no key frames"),
        ({"key_frames": {"hug": keys, "waltz": empty}}, r"^generation\.key_frames\.waltz: "),
        ({"sweep": {"more": {"key_frames": {"waltz": empty}}}}, r"^generation\.key_frames\.waltz: "),
    ):
        with pytest.raises(InputError, match=sentence):
            check(**values)


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_the_command_writes_the_same_again(here: Here, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "w.safetensors"
    weights.write_bytes(write_weights(Weights(make_model())))
    words = [f"poses@{here.take.ref.key[:12]}", "--store", str(here.store.root), "--num", "2", "--scales", "0.9,1.1"]
    for model, out in (("paper_cvae", "o"), ("paper_cvae", "o"), (str(weights), "p")):
        assert run_command_line(["generate", model, *words, "--out", str(tmp_path / out)]) == 0
        said = capsys.readouterr().out
        assert "1 of 2: B-paper_cvae-0000 " in said
        assert "bones of B 0.90-0.90" in said
        if out == "o":
            before = digests(tmp_path / "o")
    assert digests(tmp_path / "o") == before
    assert {"UNITS.txt", "CREDITS.txt", "waltz_B-paper_cvae-0001.A.bvh"} <= set(before)
    motion = read_bvh((tmp_path / "p" / "waltz_B-paper_cvae-0001.B.bvh").read_bytes())
    assert motion.num_frames == 15


def test_the_command_refuses_with_a_sentence(here: Here, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    take = [f"poses@{here.take.ref.key[:12]}", "--store", str(here.store.root), "--out", str(tmp_path / "no")]
    far = write_keys(tmp_path / "far.json", [99], np.zeros((1, 22, 3)))
    for name, data in (("bad", b"no weights"), ("narrow", write_weights(Weights(make_model(EXPI18))))):
        (tmp_path / f"{name}.safetensors").write_bytes(data)
    Store(tmp_path / "empty")
    for words, sentence in (
        (["oracle", *take], "0 models of the store have this name"),
        ([str(tmp_path / "bad.safetensors"), *take], "these are no weights of a model"),
        ([str(tmp_path / "narrow.safetensors"), *take], "weights of another topology: it is of expi18, 18 joints"),
        (["paper_cvae", *take, "--store", str(tmp_path / "empty")], "the store has none"),
        (["ridge_scale", *take], "ridge_scale draws no bodies: say --scales"),
        (["paper_cvae", *take, "--scales", "0.9;1"], "numbers separated by commas"),
        (["paper_cvae", *take, "--scales", "99"], "allowed are 0.05 to 20"),
        (["paper_cvae", *take, "--key-frames", str(far)], "frame 99 is outside the motion of take waltz"),
    ):
        assert run_command_line(["generate", *words]) == 2
        assert sentence in capsys.readouterr().err
        assert not (tmp_path / "no").exists()


def test_the_command_reports_nothing_usable(here: Here, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [f"poses@{here.take.ref.key[:12]}", "--store", str(here.store.root), "--out", str(tmp_path / "no")]
    source = read_take(here.store, here.take.ref).source
    # The key frame puts B ten metres away, so no contact can be kept.
    away = write_keys(tmp_path / "away.json", [7], source.positions_m[[7], 1] + [10.0, 0.0, 0.0])
    assert run_command_line(["generate", "paper_cvae", *words, "--key-frames", str(away)]) == 1
    assert "none of 1 motions is usable" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
