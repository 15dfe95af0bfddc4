"""`pasdedeux retarget`: a take of a store or of files, for the bodies of other people."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flows.console.inputs import find_take
from flows.console.retarget import _said
from pasdedeux.augmentation import Augmenter, Source
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.kinematics import Motion
from pasdedeux.learning.baselines import NaiveFkModel
from pasdedeux.learning.registry import Weights, write_weights
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.skeletons import BODY22
from storage_schema import Store, resolve
from tasks.data import LOOK
from tasks.ingest import STAGE, IngestParameters
from tasks.rows.takes import read_take
from tasks.stage import StageInputs
from tests.builders.command_line import CommandLine
from tests.builders.own_sources import write_walk
from tests.builders.pages import Page
from tests.builders.source_samples import bvh_text, figure_motion
from tests.builders.stored_models import put_model

ELBOWS, KNEES = BODY22.indices(["left_elbow", "right_elbow"]), BODY22.indices(["left_ankle", "right_ankle"])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Return a store with half a second of waltz."""
    store = Store(tmp_path_factory.mktemp("retarget") / "store")
    section = IngestParameters.model_validate({"duets": [{"name": "waltz", "duration_s": 0.5}]})
    STAGE.run_shard(STAGE.plan(StageInputs(manifests={}, seed=1), section)[0], store)
    return store


@pytest.fixture
def waltz(store: Store) -> str:
    """Return a reference to the take of the store."""
    return next(f"poses@{take.ref.key[:12]}" for take in store.artifacts("ingest"))


@pytest.fixture
def retarget(store: Store, tmp_path: Path, invoke: CommandLine) -> CommandLine:
    """Return the command on the store, which writes to the folder `out`."""
    return invoke.of("retarget", "--out", tmp_path / "out").at(store)


def displaced(motion: Motion, z_m: float, offsets_m: np.ndarray | None = None) -> str:
    """Return a BVH file of a motion that is moved in depth, perhaps with other bones."""
    offsets_m = motion.rest_offsets_m if offsets_m is None else offsets_m
    there_m = motion.root_translation_m + np.array([0.0, 0.0, z_m])
    return write_bvh(Motion(BODY22, offsets_m, there_m, motion.local_unitquat, motion.rate_hz))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with three people a metre apart, somebody with long arms, an ASF file, tables, and a dog."""
    folder = tmp_path_factory.mktemp("bodies")
    second, third = (figure_motion(num_frames=12, seed=seed) for seed in (1, 2))
    offsets_m = second.rest_offsets_m.copy()
    offsets_m[ELBOWS] *= 1.3
    header = "from,to,distance_m\n"
    for name, text in {
        "a.bvh": bvh_text(num_frames=12, rate_hz=30.0),
        "b.bvh": displaced(second, 1.0),
        "c.bvh": displaced(third, 2.0),
        "long.bvh": displaced(second, 0.0, offsets_m),
        "dog.bvh": write_bvh(second).replace("left_knee", "left_paw"),
        "legs.csv": f"{header}left_hip,left_ankle,0.7\nright_hip,right_ankle,0.7\n",
        "torn.csv": f"{header}left_hip,left_knee,0.4\nleft_knee,left_ankle,0.4\nleft_hip,left_ankle,0.3\n",
        "tiny.csv": f"{header}left_hip,left_ankle,0.1\n",
    }.items():
        (folder / name).write_text(text)
    write_walk(folder)
    return folder


def lengths_m(path: Path, joints: list[int]) -> np.ndarray:
    motion = read_bvh(path.read_bytes()).to_motion(metres_per_unit=0.01, rate_hz=30.0)
    at = [motion.skeleton.index(BODY22.joint_names[joint]) for joint in joints]
    return np.asarray(np.linalg.norm(motion.rest_offsets_m[at], axis=-1))


def test_files_get_the_bones_of_others(files: Path, tmp_path: Path, retarget: CommandLine) -> None:
    said = retarget(files / "a.bvh", files / "b.bvh", "--to", "source", "--to", files / "long.bvh").out
    assert "long.bvh" in said
    out = tmp_path / "out"
    first, second = out / "a_retarget.A.bvh", out / "a_retarget.B.bvh"
    np.testing.assert_allclose(lengths_m(first, ELBOWS), lengths_m(files / "a.bvh", ELBOWS), atol=1e-5)
    np.testing.assert_allclose(lengths_m(second, ELBOWS), lengths_m(files / "long.bvh", ELBOWS), atol=1e-4)
    np.testing.assert_allclose(lengths_m(second, KNEES), lengths_m(files / "b.bvh", KNEES), atol=1e-4)
    assert {path.name for path in out.iterdir()} >= {"UNITS.txt", "CREDITS.txt", "a_retarget.A.npz", LOOK}
    (scene,) = Page((out / LOOK).read_text()).scenes
    assert [panel["title"] for panel in scene["panels"]] == ["source", "retarget"]
    assert LOOK in said
    assert read_bvh(first.read_bytes()).num_frames == 12


@pytest.mark.parametrize(
    ("sources", "bodies"),
    [(("a.bvh", "b.bvh", "c.bvh"), ("source", "source", "long.bvh")), (("a.bvh",), ("long.bvh",))],
)
def test_three_files_and_one_take_as_many_bodies(
    files: Path, tmp_path: Path, retarget: CommandLine, sources: Sequence[str], bodies: Sequence[str]
) -> None:
    to = [word for body in bodies for word in ("--to", body if body == "source" else files / body)]
    retarget(*(files / name for name in sources), *to)
    for letter, source, body in zip("ABC", sources, bodies, strict=False):
        wanted = lengths_m(files / (source if body == "source" else body), ELBOWS)
        np.testing.assert_allclose(lengths_m(tmp_path / f"out/a_retarget.{letter}.bvh", ELBOWS), wanted, atol=1e-4)


def test_bodies_come_from_a_table_and_an_asf(waltz: str, files: Path, tmp_path: Path, retarget: CommandLine) -> None:
    said = retarget(waltz, "--to", files / "legs.csv", "--to", files / "90.asf", "--rest-pose", "standing").out
    (row,) = (line for line in said.splitlines() if line.startswith("A "))
    assert "legs.csv" in row
    leg = BODY22.indices(["left_knee", "left_ankle"])
    assert lengths_m(tmp_path / "out" / "waltz_retarget.A.bvh", leg).sum() == pytest.approx(0.7, abs=2e-3)
    # As the ASF file was written: 0.42 m from knee to ankle.
    np.testing.assert_allclose(lengths_m(tmp_path / "out" / "waltz_retarget.B.bvh", KNEES), 0.42, atol=5e-3)


@pytest.mark.parametrize(("body", "is_torn"), [("torn.csv", True), ("legs.csv", False)])
def test_a_torn_body_is_warned_of(waltz: str, files: Path, retarget: CommandLine, body: str, is_torn: bool) -> None:
    assert ("the body for person A is missed by" in retarget(waltz, "--to", files / body).err) is is_torn


def test_what_is_known_of_a_take_is_kept_and_said(
    waltz: str, files: Path, tmp_path: Path, retarget: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated: list[UserContact] = []

    class Watched(Augmenter):
        def __init__(self, source: Source, *, user_contacts: Sequence[UserContact] = ()) -> None:
            stated.extend(user_contacts)
            super().__init__(source, user_contacts=user_contacts)

    monkeypatch.setattr("flows.console.retarget.Augmenter", Watched)
    retarget(waltz, "--to", files / "legs.csv")
    assert stated
    stated.clear()
    copy = shutil.copy(files / "a.bvh", tmp_path / "copy.bvh")
    assert "the same motion twice" in retarget(files / "a.bvh", copy, "--to", files / "legs.csv").err
    assert not stated


@pytest.mark.parametrize(
    ("bodies", "sentence"),
    [
        (["dog.bvh"], "error: dog.bvh: its joints fit none of the known layouts"),
        (["90_01.amc"], "error: 90_01.amc: an AMC file holds no body; give its ASF file"),
        (["tiny.csv"], "error: tiny.csv: this body would be 0."),
        (["none.bvh"], "none.bvh does not exist"),
        (
            ["a.bvh", "b.bvh", "a.bvh"],
            "error: 3 bodies are given, but take waltz has 2 people: --to once for each, A first",
        ),
    ],
)
def test_bodies_that_are_none_end_with_a_sentence(
    waltz: str, files: Path, tmp_path: Path, retarget: CommandLine, bodies: list[str], sentence: str
) -> None:
    assert sentence in retarget.refusal(waltz, *(word for body in bodies for word in ("--to", files / body)))
    assert not (tmp_path / "out").exists()


def test_a_take_has_as_many_people_as_there_are_files(files: Path, tmp_path: Path) -> None:
    many = [str(shutil.copy(files / "a.bvh", tmp_path / f"{number}.bvh")) for number in range(28)]
    with find_take(many, tmp_path, [], 30.0) as (store, ref):
        assert read_take(store, ref).source.num_people == 28


def test_takes_that_are_none_end_with_a_sentence(waltz: str, files: Path, retarget: CommandLine) -> None:
    for words, sentence in (
        ([files / "a.bvh", files / "dog.bvh"], "dog.bvh: its joints fit none of the known layouts"),
        (["nowhere/waltz"], "nowhere"),
        ([waltz.replace("poses", "takes")], "one take is needed: STUDY/TAKE"),
    ):
        assert sentence in retarget.refusal(*words, "--to", files / "long.bvh")


def test_a_trained_model_of_a_store_or_a_file_gives_the_motion_and_what_it_learned_holds_for_its_own_takes(
    store: Store, waltz: str, files: Path, tmp_path: Path, retarget: CommandLine
) -> None:
    take = store.manifest(resolve(waltz, store)[0])
    source = read_take(store, take.ref).source
    still = RidgeScaleModel(coefficients={"waltz": np.zeros((5, *source.positions_m.shape))})
    put_model(store, still, "random", [take])
    of_scales = put_model(store, still, "cross_scale", [take])
    put_model(store, NaiveFkModel(), "random", [])
    (tmp_path / "w.safetensors").write_bytes(write_weights(Weights(still, {"waltz": "another take"})))
    longer = retarget.of("--to", files / "long.bvh")

    def written_by(model: str | Path) -> tuple[bytes, str]:
        said = longer(waltz, "--model", model).err
        return (tmp_path / "out" / "waltz_retarget.B.bvh").read_bytes(), said

    known, said = written_by(f"ridge_scale@models@{of_scales.ref.key[:12]}")
    assert "ridge_scale was trained on take waltz" in said
    unknown, said = written_by(tmp_path / "w.safetensors")
    assert "ridge_scale was not trained on take waltz" in said
    plain, _ = written_by("naive_fk")
    assert known != unknown
    assert unknown == plain
    shutil.rmtree(tmp_path / "out")
    for take_of, model, sentence in (
        (waltz, "ridge_scale", "2 models of the store have this name; say which: ridge_scale@models@"),
        (waltz, "oracle", "0 models of the store have this name"),
        (waltz, tmp_path / "none.safetensors", "does not exist"),
        (waltz, files / "legs.csv", "0 models of the store have this name"),
        (files / "a.bvh", "naive_fk", "models are of takes of two people, this one has 1"),
    ):
        assert sentence in longer.refusal(take_of, "--model", model)
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("num_guessed", "guessed"), [(2, ", 2 guessed"), (0, "")])
def test_a_fitted_body_is_described_by_its_scales_and_worst_bone(num_guessed: int, guessed: str) -> None:
    scale = np.array([9.0, *[0.9] * 10, 1.0, *[1.3] * 10])
    misfit = {(BODY22.index("left_knee"), BODY22.index("left_ankle")): 0.002, (0, BODY22.index("spine1")): -0.008}
    fit = SimpleNamespace(bone_scale=scale, num_guessed=num_guessed, misfit_m=misfit)
    said = _said(SimpleNamespace(letter="B"), SimpleNamespace(name="robot"), fit)  # type: ignore[arg-type]
    assert said == ("B", "robot", "1.000", f"0.90-1.30{guessed}", "5.0 mm", "8.0 mm", "pelvis and spine1")
