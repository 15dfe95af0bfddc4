"""What is taken out of the store stands as a person expects it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.exports import export_reference
from flows.exports.export_format import FileNames
from pasdedeux.data import Data
from pasdedeux.errors import InputError
from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.kinematics import Motion, bone_directions, bone_lengths, place_bones
from pasdedeux.kinematics.rotations import angle_between
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.reconstruction.body import EmbodiedMotion, body_through, hold_hips, pose_body
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from storage_schema import TABLES, ArtifactRef, Store, TableData, open_table
from storage_schema.encoding import encode
from tasks.ingest import STAGE, IngestParameters
from tasks.rows.products import product_rows
from tasks.stage import StageInputs
from tests.builders.own_sources import first_frames, write_walk
from tests.builders.source_samples import bvh_text
from tests.builders.storage_rows import put, random_columns
from tests.builders.walkers import reconstruction, walk


def exported(tmp_path: Path, columns: dict[str, Any], facts: dict[str, Any]) -> dict[str, Motion]:
    """Return the motions of the BVH files that reconstructed ones become, by the name of their file."""
    store = Store(tmp_path / "store")
    ref = put(store, "reconstruction", "walk", {"motions": columns}, facts).ref
    export_reference(store, f"motions@{ref.key[:8]}", "bvh", tmp_path / "out")
    return {
        path.stem: read_bvh(path.read_bytes()).to_motion(metres_per_unit=0.01, rate_hz=30.0, up_axis="y")
        for path in (tmp_path / "out").glob("*.bvh")
    }


def body_of_walk(frames: int, size: float = 1.0) -> EmbodiedMotion:
    poses = size * hold_hips(reconstruction(walk(frames))).positions_m
    body = body_through(poses)
    return EmbodiedMotion(body, *pose_body(body, poses))


def rows_of(frame: np.ndarray, body: EmbodiedMotion, sequence_id: str, person_id: int, method: str) -> dict[str, Any]:
    count = len(frame)
    return random_columns("motions", count) | {
        "sequence_id": [sequence_id] * count,
        "method": [method] * count,
        "person_id": np.full(count, person_id),
        "frame": frame,
        "time_s": frame / 30.0,
        "body22_m": body.motion(30.0).world()[0],
        "body22_unitquat": body.unitquat,
    }


def joined(*parts: dict[str, Any]) -> dict[str, Any]:
    return {
        name: list(chain.from_iterable(part[name] for part in parts))
        if isinstance(parts[0][name], list)
        else np.concatenate([part[name] for part in parts])
        for name in parts[0]
    }


def test_people_of_a_video_have_the_same_frames_and_one_floor(tmp_path: Path) -> None:
    tall, small = body_of_walk(8, 1.1), body_of_walk(5, 0.8)
    columns = joined(
        rows_of(np.arange(3, 11), tall, "walk", 0, "fit"), rows_of(np.arange(6, 11), small, "walk", 1, "fit")
    )
    motions = exported(tmp_path, columns, {"pitch_deg": 0.0})
    first, second = motions["walk.A"], motions["walk.B"]
    assert (first.num_frames, second.num_frames) == (8, 8)
    rise = np.mean([tall.body.ankle_height_m, small.body.ankle_height_m])
    for motion, body, at in ((first, tall, 0), (second, small, 3)):
        rises = motion.root_translation_m[at:] - body.pelvis_m
        np.testing.assert_allclose(rises, np.broadcast_to([0.0, rise, 0.0], rises.shape), atol=1e-5)
    np.testing.assert_allclose(second.root_translation_m[:3], second.root_translation_m[[3, 3, 3]], atol=1e-9)


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, ArtifactRef, list[Motion]]:
    """Return a store with a take of a BVH file, z up, and an ASF, and both as they came in."""
    folder = tmp_path_factory.mktemp("sources")
    (folder / "a.bvh").write_text(bvh_text(num_frames=12, rate_hz=30.0))
    amc = write_walk(folder)
    first = {"rate_hz": 30.0, "metres_per_unit": 0.01, "up_axis": "z"}
    take = {"id": "mix", "files": [str(folder / "a.bvh"), str(amc)], "on_unequal": "trim", "floor": "keep"}
    section = {"rate_hz": 30.0, "takes": [take | {"persons": [first, {"rate_hz": 30.0}]}]}
    store = Store(folder / "store")
    plan = STAGE.plan(StageInputs(manifests={}, seed=1), IngestParameters.model_validate(section))
    ref = STAGE.run_shard(plan[0], store)
    bvh = read_bvh((folder / "a.bvh").read_bytes()).to_motion(metres_per_unit=0.01, rate_hz=30.0, up_axis="z")
    asf = read_amc(amc.read_bytes(), read_asf((folder / "90.asf").read_bytes()))
    return store, ref, [bvh, first_frames(asf.to_motion(metres_per_unit=0.0254 / 0.45, rate_hz=30.0), 12)]


def variants_of(store: Store, ref: ArtifactRef, variant: str, scale: float) -> str:
    """Commit a variant in which the bones of both have one scale and the directions that they have in the take."""
    poses = store.read(ref, "poses")
    body = np.swapaxes(poses["body22_m"].astype(float).reshape(2, -1, 22, 3), 0, 1)
    frames = len(body)
    lengths = scale * np.median(bone_lengths(BODY22, body), axis=0)
    scaled = place_bones(BODY22, body[:, :, 0], bone_directions(BODY22, body), lengths)
    rows = random_columns("variants", 2 * frames) | {
        "take_id": ["mix"] * 2 * frames,
        "variant_id": [variant] * 2 * frames,
        "frame": np.repeat(np.arange(frames), 2),
        "person": np.tile([0, 1], frames),
        "body22_m": scaled.reshape(-1, 22, 3),
    }
    quality = {"take_id": ["mix"], "variant_id": [variant], "bone_scale": np.full((1, 44), scale), "verdict": ["pass"]}
    tables = {"variants": rows, "variant_quality": random_columns("variant_quality", 1) | quality}
    facts = {"kind": "variants", "take_id": "mix", "num_persons": 2, "num_frames": frames}
    return f"variants@{put(store, 'augmentation', variant, tables, facts, (store.manifest(ref),)).ref.key}"


def read_motion(path: Path, metres_per_unit: float = 0.01) -> Motion:
    return read_bvh(path.read_bytes()).to_motion(metres_per_unit=metres_per_unit, rate_hz=30.0)


def assert_same(found: Motion, source: Motion) -> None:
    """What an export promises: the source's hierarchy and rest pose, 1e-4 m, 0.01 degrees."""
    names = [found.skeleton.index(name) for name in source.skeleton.joint_names]
    for joint, name in enumerate(source.skeleton.joint_names):
        above = source.skeleton.parents[joint]
        its = found.skeleton.parents[names[joint]]
        assert (source.skeleton.joint_names[above] if above >= 0 else "") == (
            found.skeleton.joint_names[its] if its >= 0 else ""
        ), name
    np.testing.assert_allclose(found.rest_offsets_m[names][1:], source.rest_offsets_m[1:], atol=1e-6)
    (places, turns), (its_places, its_turns) = found.world(), source.world()
    np.testing.assert_allclose(places[:, names], its_places, atol=1e-4)
    assert np.rad2deg(angle_between(turns[:, names], its_turns).max()) < 0.01


def test_scale_one_exports_the_source_itself(taken: tuple[Store, ArtifactRef, list[Motion]], tmp_path: Path) -> None:
    store, ref, sources = taken
    export_reference(store, f"poses@{ref.key}", "bvh", tmp_path / "take")
    export_reference(store, variants_of(store, ref, "same", 1.0), "bvh", tmp_path / "variant")
    for letter, source in zip("AB", sources, strict=True):
        for path in (tmp_path / "take" / f"mix.{letter}.bvh", tmp_path / "variant" / f"mix_same.{letter}.bvh"):
            assert_same(read_motion(path), source)


def test_a_standing_rest_pose_keeps_positions(taken: tuple[Store, ArtifactRef, list[Motion]], tmp_path: Path) -> None:
    store, ref, _ = taken
    small = variants_of(store, ref, "small", 0.8)
    export_reference(store, small, "bvh", tmp_path / "own", units="source")
    export_reference(store, small, "bvh", tmp_path / "tee", rest_pose="standing", units="m")
    for letter, metres in (("A", 0.01), ("B", 0.0254 / 0.45)):
        name = f"mix_small.{letter}"
        plain = read_motion(tmp_path / "own" / f"{name}.bvh", metres)
        tee = read_motion(tmp_path / "tee" / f"{name}.bvh", 1.0)
        assert plain.skeleton == tee.skeleton
        np.testing.assert_allclose(plain.world()[0], tee.world()[0], atol=1e-6)
        arrays = dict(np.load(tmp_path / "tee" / f"{name}.npz"))
        assert (str(arrays["rest_pose"]), float(arrays["bvh_metres_per_unit"])) == ("standing", 1.0)
        wrist, shoulder = (
            str(arrays["body22_joint"][BODY22.index(f"left_{joint}")]) for joint in ("wrist", "shoulder")
        )
        arm = np.subtract(*(tee.rest_positions_m()[tee.skeleton.index(joint)] for joint in (wrist, shoulder)))
        assert arm[0] > 0.3
        np.testing.assert_allclose(arm[1:], 0.0, atol=1e-5)
    said = (tmp_path / "tee" / "UNITS.txt").read_text()
    assert "mix_small.A: 12 frames at 30 Hz, one unit of the BVH is 1 m; joints lie within 0.0 mm" in said
    assert "a standing T-pose" in said


def test_variants_can_have_the_source_rate(taken: tuple[Store, ArtifactRef, list[Motion]], tmp_path: Path) -> None:
    store, ref, _ = taken
    read = [store.read(ref, table) for table in ("takes", "poses")]
    rows, poses = ({name: table[name] for name in table.column_names} for table in read)
    facts = dict(store.manifest(ref).facts)
    fast = put(store, "ingest", "fast", {"takes": rows | {"source_rate_hz": [60.0] * 2}, "poses": poses}, facts).ref
    same = variants_of(store, fast, "B-uniform-0.90", 0.9)
    export_reference(store, same, "bvh", tmp_path / "study")
    export_reference(store, same, "bvh", tmp_path / "source", rate="source")
    plain, doubled = (read_bvh((tmp_path / rate / "mix_B-0.90.B.bvh").read_bytes()) for rate in ("study", "source"))
    assert (plain.num_frames, doubled.num_frames) == (12, 23)
    assert "mix_B-0.90.B: 23 frames at 60 Hz, one unit" in (tmp_path / "source" / "UNITS.txt").read_text()
    assert "12 frames at 30 Hz (the source: 60 Hz)" in (tmp_path / "study" / "UNITS.txt").read_text()
    both = [
        file.to_motion(metres_per_unit=0.01, rate_hz=hz, up_axis="y") for file, hz in ((plain, 30.0), (doubled, 60.0))
    ]
    np.testing.assert_allclose(both[1].world()[0][::2], both[0].world()[0], atol=1e-5)
    with pytest.raises(InputError, match="the rate can be chosen for files of motion of poses and variants"):
        export_reference(store, same, "npz", tmp_path / "no", rate="source")


def test_a_motion_leaves_as_the_best_method_made_it_and_by_all_where_that_is_asked_for(tmp_path: Path) -> None:
    body = body_of_walk(4)
    methods = ("nearest", "viterbi", "fit", "fit_clean")
    columns = joined(*(rows_of(np.arange(4), body, "walk", 0, method) for method in methods))
    store = Store(tmp_path / "store")
    ref = put(store, "reconstruction", "walk", {"motions": columns}, {"pitch_deg": 0.0}).ref
    export_reference(store, f"motions@{ref.key}", "bvh", tmp_path / "best")
    assert [path.name for path in (tmp_path / "best").glob("*.bvh")] == ["walk.A.bvh"]
    assert "method: fit_clean" in (tmp_path / "best" / "UNITS.txt").read_text()
    export_reference(store, f"motions@{ref.key}", "bvh", tmp_path / "all", all_methods=True)
    assert sorted(path.name for path in (tmp_path / "all").glob("*.bvh")) == [
        f"walk_{method}.A.bvh" for method in ("fit", "fit_clean", "nearest-baseline", "viterbi")
    ]


LIFTED_PLACE = {"sequence_id": "s", "person_id": 0, "partner_id": 1}


def test_the_product_of_lifted_pairs_is_the_best_method_of_each_annotation() -> None:
    methods = ["fitted", "mean_pair", "over_time", "fitted", "completed", "fitted", "lifting"]
    columns = random_columns("lifted_pairs", 7) | {name: [value] * 7 for name, value in LIFTED_PLACE.items()}
    columns |= {"method": methods, "frame": np.array([0, 0, 0, 1, 1, 2, 3])}
    rows = TableData(TABLES["lifted_pairs"], encode(TABLES["lifted_pairs"], columns))
    assert [methods[row] for row in product_rows(rows)] == ["over_time", "completed", "fitted", "lifting"]


def test_products_are_chosen_over_the_whole_table(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 2_500
    one_row = random_columns("lifted_pairs", 1) | {name: [value] for name, value in LIFTED_PLACE.items()}
    columns = {name: list(values) * (4 * count) for name, values in one_row.items()} | {
        "method": [method for method in ("mean_pair", "fitted", "over_time", "lifting_ik") for _ in range(count)],
        "frame": np.tile(np.arange(count), 4),
    }
    reference = f"lifted_pairs@{put(store, 'lifting', 'lifted', {'lifted_pairs': columns}, {'takes': []}).ref.key}"
    monkeypatch.setattr("tasks.data.iter_rows", lambda *_, **__: _batches(open_table(reference, store), 3_000))
    pairs = Data(store).pairs(reference, all_methods=False)
    np.testing.assert_array_equal(pairs.rows, 2 * count + np.arange(count))
    some = Data(store).pairs(reference, count=5, all_methods=False)
    assert some.rows.tolist() == [2 * count + at for at in (0, 625, 1250, 1874, 2499)]


def _batches(rows: TableData, size: int) -> Iterator[TableData]:
    for first in range(0, rows.num_rows, size):
        yield TableData(rows.table, rows.rows.slice(first, size))


def test_names_that_join_to_the_same_give_files_of_their_own(tmp_path: Path) -> None:
    names = FileNames(tmp_path)
    paths = [names.path(*parts, suffix=".npz", who="A").name for parts in (("a", "b_c"), ("a_b", "c"))]
    assert paths == ["a_b_c.A.npz", "a_b_c.A.2.npz"]


def test_names_that_lead_elsewhere_are_refused(taken: tuple[Store, ArtifactRef, list[Motion]], tmp_path: Path) -> None:
    store, ref, _ = taken
    out = tmp_path / "deep" / "out"
    with pytest.raises(InputError, match=r'^"../ESCAPED" is to be part of a file\'s name'):
        export_reference(store, variants_of(store, ref, "../ESCAPED", 0.95), "bvh", out)
    rows = rows_of(np.arange(5), body_of_walk(5), "../ESCAPED", 0, "fit")
    with pytest.raises(InputError, match=r'^"../ESCAPED" is to be part of a file\'s name'):
        exported(tmp_path, rows, {"pitch_deg": 0.0})
    assert not list(tmp_path.rglob("*ESCAPED*"))


def test_another_export_keeps_earlier_units(taken: tuple[Store, ArtifactRef, list[Motion]], tmp_path: Path) -> None:
    store, ref, _ = taken
    export_reference(store, f"poses@{ref.key}", "bvh", tmp_path)
    small = variants_of(store, ref, "smaller", 0.85)
    for _ in range(2):
        export_reference(store, small, "bvh", tmp_path, rest_pose="standing", units="m")
    lines = (tmp_path / "UNITS.txt").read_text().splitlines()[5:]
    plain, standing = "that of the source's file", "a standing T-pose"
    assert [(line.partition(":")[0], line.rpartition(" is ")[2]) for line in lines] == [
        *(("mix.A", plain), ("mix.B", plain)),
        *(("mix_smaller.A", standing), ("mix_smaller.B", standing)),
    ]


def test_a_reconstructed_motion_stands_upright_though_its_camera_looked_down(tmp_path: Path) -> None:
    camera, whole = DatabaseCamera(float(np.deg2rad(30.0))), body_of_walk(3)
    columns = rows_of(np.arange(3), whole.turned(camera.camera_from_upright_rotmat), "walk", 0, "fit")
    motion = exported(tmp_path, columns, {"pitch_deg": 30.0})["walk.A"]
    at = [motion.skeleton.joint_names.index(HUMANOID_NAMES[joint]) for joint in BODY22.joint_names]
    soles = whole.motion(30.0).world()[0] + [0.0, whole.body.ankle_height_m, 0.0]
    np.testing.assert_allclose(motion.world()[0][:, at], soles, atol=1e-5)
