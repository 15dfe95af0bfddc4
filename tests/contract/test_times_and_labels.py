"""When and who, in all that leaves: the first frame is at 0, the second one step of the rate later, A is not B."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pybvh
import pygltflib
import pytest

from flows.exports import export_reference
from storage_schema import ArtifactRef, Store
from tasks.stage.facts import TakeFacts
from tests.builders.ingest_runs import planned, run

RATE_HZ = 12.5
NUM_FRAMES = 10
TIMES_S = np.arange(NUM_FRAMES) / RATE_HZ

Read = tuple[Any, dict[str, Any]]
"""Times of the frames, and the pelvis of each person (frame, 3) by name, metres or in the unit of the file."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    store = Store(tmp_path_factory.mktemp("store"))
    duet = {"name": "waltz", "duration_s": NUM_FRAMES / RATE_HZ}
    run(store, [shard for shard in planned(rate_hz=RATE_HZ, duets=[duet]) if shard.name == "take"])
    return store


@pytest.fixture
def take(store: Store) -> ArtifactRef:
    (manifest,) = store.artifacts()
    return manifest.ref


def read_trc(folder: Path) -> Read:
    (path,) = folder.glob("*.trc")
    lines = path.read_text().split("\n")
    rows, labels = np.loadtxt(lines[6:], delimiter="\t"), lines[3].split("\t")
    assert float(lines[2].split("\t")[0]) == RATE_HZ
    return rows[:, 1], {who: rows[:, labels.index(f"{who}:pelvis") :][:, :3] for who in "AB"}


def read_c3d(folder: Path) -> Read:
    (path,) = folder.glob("*.c3d")
    file = ezc3d.c3d(str(path))
    points, labels = file["header"]["points"], file["parameters"]["POINT"]["LABELS"]["value"]
    frames = np.arange(points["first_frame"], points["last_frame"] + 1)
    places = {who: file["data"]["points"][:3, labels.index(f"{who}:pelvis")].T / 1e3 for who in "AB"}
    return frames / points["frame_rate"], places


def read_bvh(folder: Path) -> Read:
    motions = {path.stem[-1]: pybvh.read_bvh_file(path) for path in folder.glob("*.bvh")}
    (step_s,) = {motion.frame_time for motion in motions.values()}
    return np.arange(motions["A"].frame_count) * step_s, {who: one.root_pos / 100 for who, one in motions.items()}


def read_glb(folder: Path) -> Read:
    (path,) = folder.glob("*.glb")
    file = pygltflib.GLTF2.load(str(path))

    def values(number: int) -> Any:
        accessor = file.accessors[number]
        start = file.bufferViews[accessor.bufferView].byteOffset
        width = {"SCALAR": 1, "VEC3": 3}[accessor.type]
        return np.frombuffer(file.binary_blob(), "<f4", accessor.count * width, start).reshape(-1, width)

    (moving,) = file.animations
    tracks = {
        one.target.node: moving.samplers[one.sampler] for one in moving.channels if one.target.path == "translation"
    }
    places = {skin.name: values(tracks[skin.skeleton].output) for skin in file.skins}
    return values(moving.samplers[0].input)[:, 0], places


def read_csv(folder: Path) -> Read:
    with (folder / "poses.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    times = {int(row["frame"]): float(row["time_s"]) for row in rows}
    places = {
        who: np.array(
            [[float(row[f"root_translation_m.{axis}"]) for axis in "xyz"] for row in rows if row["person"] == code]
        )
        for who, code in (("A", "0"), ("B", "1"))
    }
    return [times[frame] for frame in range(NUM_FRAMES)], places


READERS: dict[str, Callable[[Path], Read]] = {
    "trc": read_trc,
    "c3d": read_c3d,
    "bvh": read_bvh,
    "glb": read_glb,
    "csv": read_csv,
}


@pytest.mark.parametrize("name", READERS)
def test_a_file_says_when_each_frame_was_and_whose_joints_are_whose(
    store: Store, take: ArtifactRef, tmp_path: Path, name: str
) -> None:
    export_reference(store, f"poses@{take.key}", name, tmp_path)
    times_s, places = READERS[name](tmp_path)
    np.testing.assert_allclose(times_s, TIMES_S, atol=1e-6)
    rows = store.read(take, "poses", columns=["person", "frame", "body22_m"])
    for person, who in enumerate("AB"):
        mine = rows["person"] == person
        wanted = rows["body22_m"][mine][np.argsort(rows["frame"][mine]), 0]
        np.testing.assert_allclose(places[who], wanted, atol=2e-5)
    assert np.linalg.norm(places["A"] - places["B"], axis=1).min() > 0.1


def test_tables_and_clips_say_when_each_frame_was(store: Store, take: ArtifactRef, tmp_path: Path) -> None:
    rows = store.read(take, "poses", columns=["frame", "time_s"])
    np.testing.assert_allclose(rows["time_s"], TIMES_S[rows["frame"]], atol=1e-12)
    assert TakeFacts.of(store.manifest(take)).rate_hz == RATE_HZ
    path, _ = export_reference(store, f"contacts@{take.key}", "npz", tmp_path)
    with np.load(path) as contacts:
        assert set(contacts["frame"]) > {0, 1}
        np.testing.assert_allclose(contacts["time_s"], TIMES_S[contacts["frame"]], atol=1e-12)
