"""Take body parameters through a study and back: a folder like InterHuman's to takes, variants and parameters."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.exports import export_reference
from pasdedeux.errors import InputError
from pasdedeux.formats.smpl import read_smpl
from pasdedeux.kinematics import Motion, bone_directions, bone_lengths, place_bones
from pasdedeux.skeletons import BODY22
from storage_schema import ArtifactRef, Store
from tests.builders.body_models import amass, body_model, npz
from tests.builders.ingest_runs import planned, run
from tests.builders.source_samples import bvh_text
from tests.builders.storage_rows import put, random_columns

KIND = "SMPL-H"
NUM_FRAMES = 12
Taken = tuple[Store, ArtifactRef, Path, dict[str, np.ndarray]]


def ingested(folder: Path, take: dict[str, Any]) -> tuple[Store, ArtifactRef]:
    store = Store(folder / "store")
    (made,) = run(store, planned(rate_hz=30.0, takes=[{"id": "hug", "floor": "keep", **take}])[:1]).values()
    return store, made.ref


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Taken:
    """Return a store with a take of a file of two people whose world is Z up, the body model, and its arrays."""
    folder = tmp_path_factory.mktemp("interhuman")
    arrays: dict[str, Any] = {"mocap_framerate": np.array(30.0)}
    for person, shift in ((1, 0.0), (2, 0.8)):
        motion = dict(np.load(io.BytesIO(amass(KIND, seed=person))))
        motion["trans"] += [shift, 0.0, 0.0]
        arrays |= {f"person{person}_{name}": motion[name] for name in ("poses", "trans", "betas")}
    (folder / "hug.npz").write_bytes(npz(**arrays))
    (folder / "body_model.npz").write_bytes(body_model(KIND))
    path = str(folder / "hug.npz")
    return (*ingested(folder, {"files": [path, path]}), folder / "body_model.npz", arrays)


def moved(path: Path, model: Path) -> Motion:
    source = read_smpl(path.read_bytes(), model.read_bytes())
    return source.to_motion(metres_per_unit=1.0, rate_hz=30.0, up_axis="z")


def body22_of(motion: Motion) -> np.ndarray:
    return motion.world()[0][:, motion.skeleton.indices(BODY22.joint_names)]


def test_a_take_gives_back_the_parameters_that_it_came_with(taken: Taken, tmp_path: Path) -> None:
    store, ref, model, arrays = taken
    takes = store.read(ref, "takes")
    assert takes["up_axis"].tolist() == ["z", "z"]
    assert takes["source_format"].tolist() == ["smpl", "smpl"]
    export_reference(store, f"poses@{ref.key}", "smpl", tmp_path, body_model=model)
    said = (tmp_path / "UNITS.txt").read_text()
    for person, letter in enumerate("AB", start=1):
        found = np.load(tmp_path / f"hug.{letter}.npz")
        np.testing.assert_allclose(found["betas"], arrays[f"person{person}_betas"], atol=2e-3)
        np.testing.assert_allclose(found["trans"], arrays[f"person{person}_trans"], atol=1e-3)
        np.testing.assert_allclose(found["poses"], arrays[f"person{person}_poses"], atol=1e-4)
        assert found["joint_misfit_m"].max() < 1e-3
        assert (str(found["axes"]), float(found["mocap_framerate"])) == ("right-handed, Z up", 30.0)
        assert f"hug.{letter}.npz: {NUM_FRAMES} frames at 30 Hz" in said
    assert "axes: right-handed, Z up; joints lie within 0.0 mm (95 %)" in said


def test_a_variant_leaves_as_parameters_with_the_misfit_of_its_betas(taken: Taken, tmp_path: Path) -> None:
    store, ref, model, _ = taken
    poses = store.read(ref, "poses")
    body = np.swapaxes(poses["body22_m"].astype(float).reshape(2, -1, 22, 3), 0, 1)
    scale = np.ones((2, 22))
    scale[0] = 0.9  # the model has betas for size, so this one is met; one arm alone is not
    scale[1, BODY22.index("left_elbow")] = 1.5
    lengths = scale * np.median(bone_lengths(BODY22, body), axis=0)
    wanted = place_bones(BODY22, body[:, :, 0], bone_directions(BODY22, body), lengths)
    rows = {
        "take_id": ["hug"] * 2 * NUM_FRAMES,
        "variant_id": ["v"] * 2 * NUM_FRAMES,
        "frame": np.repeat(np.arange(NUM_FRAMES), 2),
        "person": np.tile([0, 1], NUM_FRAMES),
        "body22_m": wanted.reshape(-1, 22, 3),
    }
    quality = {"take_id": ["hug"], "variant_id": ["v"], "bone_scale": [scale.ravel()], "verdict": ["pass"]}
    tables = {
        "variants": random_columns("variants", 2 * NUM_FRAMES) | rows,
        "variant_quality": random_columns("variant_quality", 1) | quality,
    }
    facts = {"kind": "variants", "take_id": "hug", "num_persons": 2, "num_frames": NUM_FRAMES}
    made = put(store, "augmentation", "v", tables, facts, (store.manifest(ref),))
    export_reference(store, f"variants@{made.ref.key}", "smpl", tmp_path, body_model=model)
    small, odd = (tmp_path / f"hug_v.{letter}.npz" for letter in "AB")
    np.testing.assert_allclose(body22_of(moved(small, model)), wanted[:, 0], atol=5e-3)
    found = np.load(odd)
    misfit = dict(zip(found["bone"].tolist(), found["bone_misfit_m"].tolist(), strict=True))
    assert misfit["left_elbow"] < -0.05
    away = np.linalg.norm(body22_of(moved(odd, model)) - wanted[:, 1], axis=-1)
    np.testing.assert_allclose(found["joint_misfit_m"], away, atol=1e-6)


def test_a_take_of_other_files_leaves_as_parameters_too(tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(bvh_text(num_frames=NUM_FRAMES, rate_hz=30.0))
    (tmp_path / "body_model.npz").write_bytes(body_model("SMPL-X"))
    take = {"files": [str(tmp_path / "a.bvh")], "metres_per_unit": 0.01, "up_axis": "y"}
    store, ref = ingested(tmp_path, take)
    model = tmp_path / "body_model.npz"
    export_reference(store, f"poses@{ref.key}", "smpl", tmp_path / "out", body_model=model)
    path = tmp_path / "out" / "hug.A.npz"
    source = read_smpl(path.read_bytes(), model.read_bytes())
    found = body22_of(source.to_motion(metres_per_unit=1.0, rate_hz=30.0))
    wanted = store.read(ref, "poses")["body22_m"]
    away = np.linalg.norm(found - wanted, axis=-1)
    np.testing.assert_allclose(np.load(path)["joint_misfit_m"], away, atol=1e-6)
    # Bones of the made-up model lie otherwise at rest, and its betas do not give every body; directions are met.
    bones = BODY22.indices(["left_elbow", "left_knee"])
    directions, expected = (bone_directions(BODY22, places)[:, bones] for places in (found, wanted))
    np.testing.assert_allclose(directions, expected, atol=1e-4)


def test_what_is_missing_is_said(taken: Taken, tmp_path: Path) -> None:
    store, ref, model, arrays = taken
    with pytest.raises(InputError, match="name it with --body-model"):
        export_reference(store, f"poses@{ref.key}", "smpl", tmp_path)
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"bad\.npz: this body model is a damaged npz archive"):
        export_reference(store, f"poses@{ref.key}", "smpl", tmp_path, body_model=bad)
    (tmp_path / "in").mkdir()
    alone = tmp_path / "in" / "alone.npz"
    alone.write_bytes(npz(**{name: value for name, value in arrays.items() if "rate" not in name}))
    take = {"files": [str(alone)] * 2}
    with pytest.raises(InputError, match=r"its body model body_model\.npz or .* is not beside it; set `skeleton`"):
        ingested(tmp_path, take)
    with pytest.raises(InputError, match="states no frame rate; set rate_hz"):
        ingested(tmp_path, take | {"persons": [{"skeleton": str(model)}] * 2})
