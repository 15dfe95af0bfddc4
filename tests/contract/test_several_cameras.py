"""A take that two sources of a study show, each from another camera: one motion, stored as that of one film is."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.errors import InputError
from pasdedeux.formats.npz import read_npz
from pasdedeux.skeletons import OP14
from storage_schema import Manifest, Store
from tasks import projections, reconstruction
from tasks.evaluation.reconstruction import TOPIC
from tasks.ingest.parameters import IngestParameters
from tasks.reconstruction import ReconstructionParameters
from tasks.stage import Parameters, StageInputs
from tests.builders.cameras_of_a_take import RATE_HZ, SIZE_PX, STEPS, FilmedCamera, calibrated, duet_m, see
from tests.builders.ingest_runs import planned, run
from tests.builders.rendered_film import write_film
from tests.builders.storage_rows import having


def write_camera(path: Path, seen: FilmedCamera) -> str:
    """Write what a camera sees as our CSV."""
    lines = [
        f"{frame},{track.person_id},{name},{x},{y}"
        for track in seen.tracks
        for frame, points in enumerate(track.keypoints_px)
        for name, (x, y) in zip(OP14.joint_names, points, strict=True)
    ]
    head = ("# layout: op14", f"# image_size: {SIZE_PX[0]}x{SIZE_PX[1]}", f"# rate_hz: {RATE_HZ}")
    path.write_text("\n".join([*head, "frame,person,joint,x,y", *lines]))
    return str(path)


def ingested(tmp_path: Path, seen: list[FilmedCamera], **first: str) -> tuple[Store, list[Manifest], list[Manifest]]:
    """Return the annotations of the cameras, whose first has these keys, too, and a database of other duets."""
    store = Store(tmp_path / "store")
    paths = [write_camera(tmp_path / f"{number}.csv", camera) for number, camera in enumerate(seen)]
    sources = [{"id": "front", "path": paths[0], **first}, {"id": "side", "path": paths[1], "camera_of": "front"}]
    duets = [{"name": name, "duration_s": 4.0} for name in ("push_hands", "hug", "judo")]
    made = list(run(store, planned(rate_hz=RATE_HZ, duets=duets, annotations=sources)).values())
    poses, annotations = (having(table, made) for table in ("poses", "annotations"))
    inputs = StageInputs({"poses": poses}, seed=0)
    shards = projections.plan(inputs, projections.ProjectionsParameters())
    return store, annotations, [store.manifest(projections.run_shard(shard, store)) for shard in shards]


def reconstructed(
    store: Store, annotations: list[Manifest], database: list[Manifest], methods: tuple[str, ...] = ("fit",)
) -> Manifest:
    inputs = StageInputs({"annotations": annotations, "projections": database}, seed=0)
    (shard,) = reconstruction.plan(inputs, ReconstructionParameters(methods=methods))
    assert (shard.partition, len(shard.refs("annotations"))) == ("front", 2)
    return store.manifest(reconstruction.run_shard(shard, store))


def test_two_sources_of_a_take_become_one_motion(tmp_path: Path) -> None:
    truth_m = duet_m("waltz")
    seen = see(truth_m, (20.0, 100.0))
    store, annotations, database = ingested(tmp_path, seen)
    manifest = reconstructed(store, annotations, database, ("nearest", "fit"))
    table = store.read(manifest.ref, "motions")
    assert set(table["method"]) == {"fit", "fit_clean"}
    assert manifest.facts["methods"] == ["fit"]
    first, side = manifest.facts["cameras"]
    assert first.startswith("camera front: ")
    assert "degrees from the first camera" in side
    assert manifest.facts["skipped"] == []
    places = []
    for person in (0, 1):
        rows = (table["method"] == "fit_clean") & (table["person_id"] == person)
        pose = table["op14_m"][rows].astype(float)
        true = truth_m[60 + STEPS * table["frame"][rows]] @ seen[0].camera.camera_from_world_rotmat.T
        errors = [np.abs((true[:, who] - true[:, who, :1]) - (pose - pose[:, :1])).mean() for who in (0, 1)]
        assert min(errors) < 0.03
        places.append((pose[:, 0], true[:, int(np.argmin(errors)), 0]))
    (a, true_a), (b, true_b) = places
    assert np.linalg.norm((a - b) - (true_a - true_b), axis=-1).mean() < 0.06
    assert sorted(manifest.attachments) == ["front_0.bvh", "front_0.npz", "front_1.bvh", "front_1.npz"]
    motion = read_npz(store.attachment(manifest.ref, "front_0.npz"), "motion")
    assert motion["cameras_name"].tolist() == ["front", "side"]
    # Evaluation reads the camera whose frames the motion has, whatever the order of the sources.
    shown = [replace(manifest, facts={**manifest.facts, "takes": ["waltz"]}) for manifest in annotations[::-1]]
    (scored,) = TOPIC.plan(StageInputs({"annotations": shown, "motions": [manifest]}, seed=0), Parameters())
    assert [store.manifest(ref).partition for ref in scored.refs("annotations")] == ["front"]
    assert list(TOPIC.compute(scored, store).notes)[:2] == [f"front: {first}.", f"front: {side}."], "on the page"


def test_a_calibration_places_the_cameras_of_a_study(tmp_path: Path) -> None:
    seen = see(duet_m("waltz"), (20.0, 100.0))
    path = tmp_path / "calib.toml"
    # In another order than the sources, with a camera that the study has not, and of images half as large again.
    tables = {"rear": (seen[0], 1.0), "side": (seen[1], 1.5), "front": (seen[0], 1.5)}
    path.write_text("".join(calibrated(filmed.camera, name, scale=scale) for name, (filmed, scale) in tables.items()))
    store, annotations, database = ingested(tmp_path, seen, calibration=str(path))
    manifest = reconstructed(store, annotations, database)
    motion = read_npz(store.attachment(manifest.ref, "front_0.npz"), "motion")
    focal = [filmed.camera.focal_px for filmed in seen]
    np.testing.assert_allclose(motion["cameras_focal_px"], focal, rtol=1e-6)
    between = np.linalg.norm(seen[0].camera.position_m - seen[1].camera.position_m)
    np.testing.assert_allclose(np.linalg.norm(np.subtract(*motion["cameras_position_m"])), between, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "keys", "said"),
    [
        ("[one", {}, "calibration of 'front', calib.toml: the calibration is no TOML"),
        ("rear", {}, "calibration of 'front', calib.toml: the cameras front, rear of the calibration fit only some"),
        ("", {"camera_of": "other"}, "calibration of 'front' is of several cameras, and no other source has camera_of"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused_before_work(
    tmp_path: Path, text: str, keys: dict[str, str], said: str
) -> None:
    seen = see(duet_m("waltz"), (20.0, 100.0))
    paths = [write_camera(tmp_path / f"{number}.csv", camera) for number, camera in enumerate(seen)]
    if text == "rear":
        text = calibrated(seen[0].camera, "front") + calibrated(seen[1].camera, "rear")
    (tmp_path / "calib.toml").write_text(text)
    sources = [
        {"id": "front", "path": paths[0], "calibration": str(tmp_path / "calib.toml"), "image_size_px": SIZE_PX},
        {"id": "side", "path": paths[1], "camera_of": "front", **keys},
        {"id": "other", "path": paths[1]},
    ]
    with pytest.raises((InputError, ValidationError), match=re.escape(said)):
        planned(duets=[], annotations=sources)


def test_a_camera_of_another_take_is_said_and_nothing_is_made(tmp_path: Path) -> None:
    seen = [see(duet_m("waltz"), (20.0,))[0], see(duet_m("judo"), (20.0, 100.0))[1]]
    store, annotations, database = ingested(tmp_path, seen)
    manifest = reconstructed(store, annotations, database)
    assert store.read(manifest.ref, "motions").num_rows == 0
    (reason,) = manifest.facts["skipped"]
    assert reason.startswith("front: cameras front")


def test_a_camera_of_no_source_is_refused() -> None:
    sources = [{"id": "front", "path": "front.csv"}, {"id": "side", "path": "side.csv", "camera_of": "frnt"}]
    with pytest.raises(
        ValidationError, match="camera_of of 'side' must name another source without camera_of, found 'frnt'"
    ):
        IngestParameters.model_validate({"annotations": sources})
    chained = [*sources[:1], {**sources[1], "camera_of": "front"}, {"id": "c", "path": "c.csv", "camera_of": "side"}]
    with pytest.raises(ValidationError, match="found 'side'; there are: front"):
        IngestParameters.model_validate({"annotations": chained})


def test_a_camera_is_one_video(tmp_path: Path) -> None:
    seen = see(duet_m("waltz"), (20.0, 100.0))
    paths = [write_camera(tmp_path / f"{number}.csv", camera) for number, camera in enumerate(seen)]
    cut = [np.full((540, 960, 3), grey, dtype=np.uint8) for grey in (20, 230) for _ in range(30)]
    film = {"path": str(write_film(tmp_path / "film.avi", cut)), "detections": paths[0]}
    for first, second in (("film", "poses"), ("poses", "film")):
        sources = {"poses": {"id": "poses", "path": paths[1]}, "film": {"id": "film", **film}}
        sources[second]["camera_of"] = first
        section = {"duets": [], "annotations": [sources["poses"]]}
        with pytest.raises(InputError, match=r"camera film: one video .* found film\.shot00, film\.shot01; .*has_cuts"):
            planned(**section, videos=[sources["film"]])
        shards = planned(**section, videos=[{**sources["film"], "has_cuts": False}])
        assert [shard.partition for shard in shards] == ["poses", "film"]
