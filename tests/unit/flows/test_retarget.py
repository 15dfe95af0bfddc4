"""`pasdedeux retarget`: a take of a store or of files, for the bodies of other people."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flows.console import retarget
from flows.console.app import run_command_line
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
from tests.builders.own_sources import write_walk
from tests.builders.pages import Page
from tests.builders.source_samples import bvh_text, figure_motion
from tests.builders.stored_models import put_model

ELBOWS, KNEES = BODY22.indices(["left_elbow", "right_elbow"]), BODY22.indices(["left_ankle", "right_ankle"])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, str]:
    """Return a store with half a second of waltz, and a reference to it."""
    store = Store(tmp_path_factory.mktemp("retarget") / "store")
    section = IngestParameters.model_validate({"duets": [{"name": "waltz", "duration_s": 0.5}]})
    ref = STAGE.run_shard(STAGE.plan(StageInputs(manifests={}, seed=1), section)[0], store)
    return store, f"poses@{ref.key[:12]}"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two people a metre apart, somebody with long arms, an ASF file, a table, and a dog."""
    folder = tmp_path_factory.mktemp("bodies")
    (folder / "a.bvh").write_text(bvh_text(num_frames=12, rate_hz=30.0))
    there = figure_motion(num_frames=12, seed=1)
    moved = Motion(BODY22, there.rest_offsets_m, there.root_translation_m + np.eye(3)[2], there.local_unitquat, 30.0)
    (folder / "b.bvh").write_text(write_bvh(moved))
    offsets = there.rest_offsets_m.copy()
    offsets[ELBOWS] *= 1.3
    long = Motion(BODY22, offsets, there.root_translation_m, there.local_unitquat, 30.0)
    (folder / "long.bvh").write_text(write_bvh(long))
    (folder / "dog.bvh").write_text(write_bvh(there).replace("left_knee", "left_paw"))
    (folder / "legs.csv").write_text("from,to,distance_m\nleft_hip,left_ankle,0.7\nright_hip,right_ankle,0.7\n")
    (folder / "torn.csv").write_text(
        "from,to,distance_m\nleft_hip,left_knee,0.4\nleft_knee,left_ankle,0.4\nleft_hip,left_ankle,0.3\n"
    )
    (folder / "tiny.csv").write_text("from,to,distance_m\nleft_hip,left_ankle,0.1\n")
    write_walk(folder)
    return folder


def lengths_m(path: Path, joints: list[int]) -> np.ndarray:
    motion = read_bvh(path.read_bytes()).to_motion(metres_per_unit=0.01, rate_hz=30.0)
    at = [motion.skeleton.index(BODY22.joint_names[joint]) for joint in joints]
    return np.asarray(np.linalg.norm(motion.rest_offsets_m[at], axis=-1))


def test_files_become_the_same_people_with_the_bones_of_others(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = [str(files / "a.bvh"), str(files / "b.bvh")]
    assert (
        run_command_line(["retarget", *take, "--to", "source", "--to", str(files / "long.bvh"), "--out", str(tmp_path)])
        == 0
    )
    said = capsys.readouterr().out
    assert "long.bvh" in said
    first, second = tmp_path / "a_retarget.A.bvh", tmp_path / "a_retarget.B.bvh"
    np.testing.assert_allclose(lengths_m(first, ELBOWS), lengths_m(files / "a.bvh", ELBOWS), atol=1e-5)
    np.testing.assert_allclose(lengths_m(second, ELBOWS), lengths_m(files / "long.bvh", ELBOWS), atol=1e-4)
    np.testing.assert_allclose(lengths_m(second, KNEES), lengths_m(files / "b.bvh", KNEES), atol=1e-4)
    assert {path.name for path in tmp_path.iterdir()} >= {"UNITS.txt", "CREDITS.txt", "a_retarget.A.npz", LOOK}
    (scene,) = Page((tmp_path / LOOK).read_text()).scenes
    assert [panel["title"] for panel in scene["panels"]] == ["source", "retarget"]
    assert LOOK in said
    assert read_bvh(first.read_bytes()).num_frames == 12


def test_three_files_and_one_take_as_many_bodies(files: Path, tmp_path: Path) -> None:
    third = figure_motion(num_frames=12, seed=2)
    there = third.root_translation_m + 2.0 * np.eye(3)[2]
    moved = Motion(BODY22, third.rest_offsets_m, there, third.local_unitquat, 30.0)
    (tmp_path / "c.bvh").write_text(write_bvh(moved))
    three, long = [str(files / "a.bvh"), str(files / "b.bvh"), str(tmp_path / "c.bvh")], str(files / "long.bvh")
    bodies = ["--to", "source", "--to", "source", "--to", long]
    assert run_command_line(["retarget", *three, *bodies, "--out", str(tmp_path / "3")]) == 0
    assert run_command_line(["retarget", three[0], "--to", long, "--out", str(tmp_path / "1")]) == 0
    for path, wanted in (
        ("3/a_retarget.B", files / "b.bvh"),
        ("3/a_retarget.C", Path(long)),
        ("1/a_retarget.A", Path(long)),
    ):
        np.testing.assert_allclose(lengths_m(tmp_path / f"{path}.bvh", ELBOWS), lengths_m(wanted, ELBOWS), atol=1e-4)


def test_a_take_of_a_store_takes_a_table_and_an_asf(
    store: tuple[Store, str], files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bodies = ["--to", str(files / "legs.csv"), "--to", str(files / "90.asf")]
    words = [
        "retarget",
        store[1],
        *bodies,
        "--store",
        str(store[0].root),
        "--out",
        str(tmp_path),
        "--rest-pose",
        "standing",
    ]
    assert run_command_line(words) == 0
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("A "))
    assert "legs.csv" in row
    leg = BODY22.indices(["left_knee", "left_ankle"])
    assert lengths_m(tmp_path / "waltz_retarget.A.bvh", leg).sum() == pytest.approx(0.7, abs=2e-3)
    # As the ASF file was written: 0.42 m from knee to ankle.
    np.testing.assert_allclose(lengths_m(tmp_path / "waltz_retarget.B.bvh", KNEES), 0.42, atol=5e-3)


def test_a_body_that_contradicts_itself_is_warned_of(
    store: tuple[Store, str], files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["retarget", store[1], "--store", str(store[0].root), "--out", str(tmp_path)]
    assert run_command_line([*words, "--to", str(files / "torn.csv")]) == 0
    assert "the body for person A is missed by" in capsys.readouterr().err
    assert run_command_line([*words, "--to", str(files / "legs.csv")]) == 0
    assert "is missed by" not in capsys.readouterr().err


def test_what_is_known_of_a_take_is_kept_and_said(
    store: tuple[Store, str],
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stated: list[UserContact] = []

    class Watched(Augmenter):
        def __init__(self, source: Source, *, user_contacts: Sequence[UserContact] = ()) -> None:
            stated.extend(user_contacts)
            super().__init__(source, user_contacts=user_contacts)

    monkeypatch.setattr(retarget, "Augmenter", Watched)
    rest = ["--to", str(files / "legs.csv"), "--store", str(store[0].root), "--out", str(tmp_path)]
    assert run_command_line(["retarget", store[1], *rest]) == 0
    assert stated
    stated.clear()
    shutil.copy(files / "a.bvh", tmp_path / "copy.bvh")
    assert run_command_line(["retarget", str(files / "a.bvh"), str(tmp_path / "copy.bvh"), *rest]) == 0
    assert not stated
    assert "the same motion twice" in capsys.readouterr().err


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
    store: tuple[Store, str],
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    bodies: list[str],
    sentence: str,
) -> None:
    to = [word for body in bodies for word in ("--to", str(files / body))]
    assert (
        run_command_line(["retarget", store[1], *to, "--store", str(store[0].root), "--out", str(tmp_path / "o")]) == 2
    )
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_take_has_as_many_people_as_there_are_files(files: Path, tmp_path: Path) -> None:
    many = [str(shutil.copy(files / "a.bvh", tmp_path / f"{number}.bvh")) for number in range(28)]
    with find_take(many, tmp_path, [], 30.0) as (store, ref):
        assert read_take(store, ref).source.num_people == 28


def test_takes_that_are_none_end_with_a_sentence(
    store: tuple[Store, str], files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rest = ["--to", str(files / "long.bvh"), "--store", str(store[0].root), "--out", str(tmp_path / "o")]
    for words, sentence in (
        ([str(files / "a.bvh"), str(files / "dog.bvh")], "dog.bvh: its joints fit none of the known layouts"),
        (["nowhere/waltz"], "nowhere"),
        ([store[1].replace("poses", "takes")], "one take is needed: STUDY/TAKE"),
    ):
        assert run_command_line(["retarget", *words, *rest]) == 2
        assert sentence in capsys.readouterr().err


def test_a_trained_model_of_a_store_or_a_file_gives_the_motion_and_what_it_learned_holds_for_its_own_takes(
    store: tuple[Store, str], files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, take = store[0], store[0].manifest(resolve(store[1], store[0])[0])
    source = read_take(root, take.ref).source
    still = RidgeScaleModel(coefficients={"waltz": np.zeros((5, *source.positions_m.shape))})
    put_model(root, still, "random", [take])
    of_scales = put_model(root, still, "cross_scale", [take])
    put_model(root, NaiveFkModel(), "random", [])
    (tmp_path / "w.safetensors").write_bytes(write_weights(Weights(still, {"waltz": "another take"})))
    words = ["retarget", store[1], "--to", str(files / "long.bvh"), "--store", str(root.root)]

    def written_by(model: str) -> tuple[bytes, str]:
        assert run_command_line([*words, "--model", model, "--out", str(tmp_path / "o")]) == 0
        return (tmp_path / "o" / "waltz_retarget.B.bvh").read_bytes(), capsys.readouterr().err

    known, said = written_by(f"ridge_scale@models@{of_scales.ref.key[:12]}")
    assert "ridge_scale was trained on take waltz" in said
    unknown, said = written_by(str(tmp_path / "w.safetensors"))
    assert "ridge_scale was not trained on take waltz" in said
    plain, _ = written_by("naive_fk")
    assert known != unknown
    assert unknown == plain
    for model, sentence in (
        ("ridge_scale", "2 models of the store have this name; say which: ridge_scale@models@"),
        ("oracle", "0 models of the store have this name"),
        (str(tmp_path / "none.safetensors"), "does not exist"),
        (str(files / "legs.csv"), "0 models of the store have this name"),
    ):
        assert run_command_line([*words, "--model", model, "--out", str(tmp_path / "no")]) == 2
        assert sentence in capsys.readouterr().err
        assert not (tmp_path / "no").exists()
    alone = ["retarget", str(files / "a.bvh"), *words[2:], "--model", "naive_fk", "--out", str(tmp_path / "no")]
    assert run_command_line(alone) == 2
    assert "models are of takes of two people, this one has 1" in capsys.readouterr().err


def test_a_fitted_body_is_described_by_its_scales_without_the_root_and_by_its_worst_bone() -> None:
    scale = np.array([9.0, *[0.9] * 10, 1.0, *[1.3] * 10])
    misfit = {(BODY22.index("left_knee"), BODY22.index("left_ankle")): 0.002, (0, BODY22.index("spine1")): -0.008}
    fit = SimpleNamespace(bone_scale=scale, num_guessed=2, misfit_m=misfit)
    said = _said(SimpleNamespace(letter="B"), SimpleNamespace(name="robot"), fit)  # type: ignore[arg-type]
    assert said == ("B", "robot", "1.000", "0.90-1.30, 2 guessed", "5.0 mm", "8.0 mm", "pelvis and spine1")
    fit.num_guessed = 0
    assert _said(SimpleNamespace(letter="B"), SimpleNamespace(name="robot"), fit)[3] == "0.90-1.30"  # type: ignore[arg-type]
