"""What every format of files that go out must do: be read back, carry the credits, refuse what it cannot hold."""

from __future__ import annotations

import csv
import errno
import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import ezc3d
import numpy as np
import pybvh
import pygltflib
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.synthetic import random_pairs
from flows.exports import EXPORT_FORMATS, Export, export_format, export_reference
from flows.exports.casts import casts
from flows.exports.credits import add_notice
from flows.exports.export_format import FileNames
from flows.exports.overlay_video import FilmImages, _laid_on
from pasdedeux.errors import InputError
from pasdedeux.evaluation.scores import Score, columns_of
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.pair_file import read_pair_json
from pasdedeux.formats.registry import ANNOTATION_FORMATS, MOTION_FORMATS, recognise_format
from pasdedeux.learning.baselines import CopyModel
from pasdedeux.learning.registry import read_weights
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from pasdedeux.skeletons.working import WORKING_SKELETONS
from pasdedeux.verdict import Level
from storage_schema import (
    TABLES,
    ArtifactRef,
    ShardRecord,
    SourceCredit,
    Store,
    TableData,
    open_table,
    parse_reference,
    record_latest,
    resolve,
    source_credits,
)
from storage_schema.encoding import encode
from tests.builders.body_models import body_model
from tests.builders.ingest_runs import planned, run
from tests.builders.made_poses import NUM_LIFTED, put_made_poses
from tests.builders.mp4_boxes import with_durations
from tests.builders.rendered_film import write_film
from tests.builders.storage_rows import having, put, random_columns
from tests.builders.stored_models import put_model

NUM_SEEDS = 2
NUM_FRAMES = 15
RATE_HZ = 12.5
CREDIT = SourceCredit(name="a studio", licence="CC0", credit="Made by a studio")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Return a store with a short duet, its virtual video, and two seeds; its artifacts are named by table."""
    store = Store(tmp_path_factory.mktemp("exports"))
    duet = {"name": "waltz", "duration_s": NUM_FRAMES / RATE_HZ}
    run(store, planned(rate_hz=RATE_HZ, duets=[duet], virtual_video={"num_random_views": 2}))
    columns = random_columns("seeds", NUM_SEEDS) | {
        "seed_index": np.arange(NUM_SEEDS),
        "pair17_m": random_pairs(np.random.default_rng(0), NUM_SEEDS, spread_rad=0.1),
    }
    put(store, "seeds", "seed0", {"seeds": columns}, {}, source=CREDIT)
    put_made_poses(store)
    put_model(store, CopyModel(), "random", having("poses", store.artifacts("ingest")))
    return store


def poses_of(text: str, store: Store) -> np.ndarray:
    """Return what a reference names (frame, person, J, 3), of variants one after another."""
    rows = open_table(text, store)
    if text.startswith(("poses", "variants")):
        order = np.lexsort((rows["person"], rows["frame"], *([rows["variant_id"]] if "variant_id" in rows else [])))
        return rows["body22_m"][order].reshape(-1, 2, 22, 3)
    return rows["pair17_m"]


def rate_of(text: str) -> float | None:
    """Return the frame rate of what a reference names; none where nothing moves."""
    rates_hz = {"poses": RATE_HZ, "variants": RATE_HZ, "motions": 30.0}
    return rates_hz.get(text.partition("@")[0])


def references(store: Store) -> dict[str, str]:
    """Return a reference to one artifact of each table that the store has."""
    return {table: f"{table}@{manifest.ref.key}" for manifest in store.artifacts() for table in manifest.tables}


def check_npz(paths: list[Path], text: str, store: Store) -> None:
    rows = open_table(text, store)
    (path,) = paths
    with np.load(path) as arrays:
        assert set(rows.column_names) <= set(arrays)
        assert all(len(arrays[name]) == rows.num_rows for name in rows.column_names if f"{name}_offsets" not in arrays)
        for name in arrays:
            if name.endswith("_m") and f"{name}_offsets" not in arrays:
                np.testing.assert_array_equal(arrays[name], rows[name])
        for column in rows.table.columns:
            assert not column.unit or str(arrays[f"{column.name}_unit"]) == column.unit
            if column.joints:
                skeleton = WORKING_SKELETONS[column.joints]
                assert tuple(arrays[f"{column.joints}_joint_names"]) == skeleton.joint_names
                assert tuple(arrays[f"{column.joints}_parents"]) == skeleton.parents


def check_csv(paths: list[Path], text: str, store: Store) -> None:
    rows = open_table(text, store)
    path, listed = paths
    with path.open(newline="", encoding="utf-8") as file:
        header, *lines = csv.reader(file)
    with listed.open(newline="", encoding="utf-8") as file:
        listed_columns = {row["column"]: row for row in csv.DictReader(file)}
    assert list(listed_columns) == list(rows.column_names)
    assert all(listed_columns[column.name]["unit"] == column.unit for column in rows.table.columns)
    assert len(set(header)) == len(header)
    assert list(dict.fromkeys(name.partition(".")[0] for name in header)) == list(rows.column_names)
    assert [len(line) for line in lines] == [len(header)] * rows.num_rows
    for name in {"person", "time_s", "body22_m", "pair17_m"}.intersection(listed_columns):
        cells = [[line[at] for at in range(len(header)) if header[at].partition(".")[0] == name] for line in lines]
        np.testing.assert_allclose(np.array(cells, dtype=float), np.reshape(rows[name], (len(lines), -1)), rtol=1e-6)


def options_of(name: str, folder: Path) -> dict[str, Any]:
    """Return what a format cannot do without."""
    if name != "smpl":
        return {}
    (folder / "body_model.npz").write_bytes(body_model("SMPL"))
    return {"body_model": folder / "body_model.npz"}


def names_in(paths: list[Path], suffix: str) -> list[Path]:
    """Return the files of a kind in the order of their names, the text on units beside them."""
    (units,) = [path for path in paths if path.name == "UNITS.txt"]
    found = sorted(path for path in paths if path.suffix == suffix)
    assert all(path.name.removesuffix(suffix) in units.read_text() for path in found)
    return found


def check_bvh(paths: list[Path], text: str, store: Store) -> None:
    motions = names_in(paths, ".bvh")
    counts = {"poses": NUM_FRAMES, "variants": NUM_FRAMES, "seeds": NUM_SEEDS}
    assert [path.stem[-2:] for path in motions] == [".A", ".B"] * (2 if text.startswith("variants") else 1)
    for path in motions:
        source, as_others_read = read_bvh(path.read_bytes()), pybvh.read_bvh_file(path)
        assert source.num_frames == as_others_read.frame_count == counts.get(text.partition("@")[0], NUM_LIFTED)
        stature = np.ptp(source.to_motion(metres_per_unit=0.01, rate_hz=30.0).world()[0][0], axis=0).max()
        assert 1.0 < stature < 2.5
        if rate_hz := rate_of(text):
            assert as_others_read.frame_time == pytest.approx(1.0 / rate_hz, abs=1e-6)
        if text.startswith("poses"):
            pelvis_m = poses_of(text, store)[:, "AB".index(path.stem[-1]), BODY22.root]
            np.testing.assert_allclose(as_others_read.root_pos / 100.0, pelvis_m, atol=2e-5)


def check_glb(paths: list[Path], text: str, store: Store) -> None:
    files = [pygltflib.GLTF2.load(str(path)) for path in names_in(paths, ".glb")]
    for file in files:
        assert [skin.name for skin in file.skins] == ["A", "B"]
        assert "licence:" in file.asset.copyright
        assert file.asset.extras["unit"] == "m"
        assert "y up" in file.asset.extras["axes"].lower()
        times_s, rate_hz = glb_values(file, file.animations[0].samplers[0].input)[:, 0], rate_of(text)
        np.testing.assert_allclose(times_s, np.arange(len(times_s)) / rate_hz if rate_hz else times_s, atol=1e-6)
    found = np.concatenate([joints_of(file) for file in files])
    if text.startswith("motions"):
        assert found.shape == (NUM_LIFTED, 2, 27, 3)
        np.testing.assert_allclose(found[:, 1] - found[:, 0] - [1.0, 0.0, 0.0], 0.0, atol=1e-5)
    else:
        wanted = poses_of(text, store)
        np.testing.assert_allclose(found[:, :, : wanted.shape[2]], wanted, atol=1e-4)


def glb_values(file: pygltflib.GLTF2, number: int, dtype: str = "<f4") -> np.ndarray:
    """Return what an accessor of a file gives, an element a row."""
    accessor = file.accessors[number]
    view = file.bufferViews[accessor.bufferView]
    data = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(data, dtype).reshape(accessor.count, -1)


def joints_of(file: pygltflib.GLTF2) -> np.ndarray:
    """Return the joints (frame, person, J, 3) of a file, by its matrices, and check that bodies lie round them."""
    values = partial(glb_values, file)
    (moving,) = file.animations
    tracks = {(c.target.node, c.target.path): values(moving.samplers[c.sampler].output) for c in moving.channels}
    num_frames = len(values(moving.samplers[0].input))
    people = []
    for skin, mesh in zip(file.skins, file.meshes, strict=True):
        world = {skin.skeleton: np.eye(4)[None]}
        for node in skin.joints:
            joint = file.nodes[node]
            matrix = np.tile(np.eye(4), (num_frames, 1, 1))
            matrix[:, :3, :3] = Rotation.from_quat(tracks[node, "rotation"]).as_matrix()
            matrix[:, :3, 3] = tracks.get((node, "translation"), np.array(joint.translation))
            world[node] = world[node] @ matrix
            world |= dict.fromkeys(joint.children or (), world[node])
        joints = np.stack([world[node] for node in skin.joints], axis=1)
        people.append(joints[..., :3, 3])
        bind = values(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
        shape = mesh.primitives[0].attributes
        bound, weights = values(shape.JOINTS_0, "<u2"), values(shape.WEIGHTS_0)
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
        points = np.c_[values(shape.POSITION), np.ones(len(bound))]
        posed = np.einsum("nk,nkij,nj->ni", weights, (joints[0] @ bind)[bound], points)[:, :3]
        near = np.linalg.norm(posed[:, None] - joints[0, None, :, :3, 3], axis=-1).min(axis=1)
        assert near.max() < 0.3
        faces = posed[values(mesh.primitives[0].indices, "<u4").reshape(-1, 3)]
        assert np.einsum("ni,ni->", faces[:, 0], np.cross(faces[:, 1], faces[:, 2])) > 0, "faces look inwards"
    return np.stack(people, axis=1)


def check_c3d(paths: list[Path], text: str, store: Store) -> None:
    files = [ezc3d.c3d(str(path)) for path in names_in(paths, ".c3d")]
    for file in files:
        point = file["parameters"]["POINT"]
        assert point["UNITS"]["value"] == ["mm"]
        assert point["LABELS"]["value"] == labels_of(len(point["LABELS"]["value"]))
        head = file["header"]["points"]
        assert (head["first_frame"], head["frame_rate"]) == (0, rate_of(text) or head["frame_rate"])
        assert "licence:" in "".join(file["parameters"]["PASDEDEUX"]["CREDIT"]["value"])
    found = np.concatenate([file["data"]["points"][:3].transpose(2, 1, 0) for file in files]) / 1e3
    check_points(found, text, store)


def labels_of(count: int) -> list[str]:
    """Return the labels of the joints of both people, so many in all."""
    joints = WORKING_SKELETONS["body22" if count == 44 else "pair17"].joint_names
    return [f"{who}:{joint}" for who in "AB" for joint in joints]


def check_trc(paths: list[Path], text: str, store: Store) -> None:
    tables = []
    for path in names_in(paths, ".trc"):
        lines = path.read_text().split("\n")
        head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
        labels = lines[3].split("\t")[2::3]
        assert labels == labels_of(len(labels))
        assert lines[4].split("\t")[2:] == [f"{axis}{at}" for at in range(1, len(labels) + 1) for axis in "XYZ"]
        rows = np.loadtxt(lines[6:], delimiter="\t", ndmin=2)
        rate, count = float(head["DataRate"]), len(rows)
        assert rate == (rate_of(text) or rate)
        assert (float(head["CameraRate"]), float(head["OrigDataRate"]), head["OrigDataStartFrame"]) == (rate, rate, "1")
        assert (head["Units"], head["NumMarkers"]) == ("m", str(len(labels)))
        assert (head["NumFrames"], head["OrigNumFrames"]) == (str(count), str(count))
        assert rows[:, 0].tolist() == list(range(1, count + 1))
        np.testing.assert_allclose(rows[:, 1], np.arange(count) / rate, atol=1e-6, err_msg="the first is at 0 s")
        tables.append(rows[:, 2:].reshape(len(rows), -1, 3))
    check_points(np.concatenate(tables), text, store)


def check_points(found: np.ndarray, text: str, store: Store) -> None:
    if text.startswith("motions"):
        assert found.shape == (NUM_LIFTED, 44, 3)
    else:
        wanted = poses_of(text, store)
        np.testing.assert_allclose(found.reshape(wanted.shape), wanted, atol=1e-5)


def check_smpl(paths: list[Path], text: str, store: Store) -> None:
    found = names_in(paths, ".npz")
    assert [path.stem[-2:] for path in found] == [".A", ".B"] * (2 if text.startswith("variants") else 1)
    for path in found:
        source = MOTION_FORMATS["smpl"].read(path.read_bytes(), body_model("SMPL"))
        assert source.num_frames == (NUM_LIFTED if text.startswith("motions") else NUM_FRAMES)
        assert "licence:" in str(np.load(path)["credit"])


def check_coco(paths: list[Path], text: str, store: Store) -> None:
    (path,) = paths
    rows, content = open_table(text, store), json.loads(path.read_text())
    assert "licence: Apache-2.0" in content["info"]["contributor"]
    assert content["licenses"][0]["name"] == "Apache-2.0"
    category, layout = content["categories"][0], KEYPOINT_LAYOUTS[rows["layout"][0]]
    assert category["keypoints"] == list(layout.keypoint_names)
    assert category["skeleton"] == [[first + 1, second + 1] for first, second in layout.links()]
    num_seen = (rows["pair17_confidence"] > 0).sum(axis=1).tolist()
    assert [person["num_keypoints"] for person in content["annotations"]] == num_seen
    kind = ANNOTATION_FORMATS["coco"]
    assert recognise_format(path.read_bytes()) is kind
    read = kind.read({path.name: path.read_bytes()}, sequence_id="s")
    assert (read.frame.tolist(), read.person_id.tolist()) == (rows["frame"].tolist(), rows["person_id"].tolist())
    np.testing.assert_allclose(read.keypoints_px.ravel(), np.concatenate(rows["keypoints_px"]), atol=1e-3)
    images = {image["id"]: image for image in content["images"]}
    assert len(images) == len({(name, frame) for name, frame in zip(rows["sequence_id"], rows["frame"], strict=True)})
    assert [person["id"] for person in content["annotations"]] == list(range(1, rows.num_rows + 1))
    for row, person in enumerate(content["annotations"]):
        image, points = images[person["image_id"]], np.reshape(rows["keypoints_px"][row], (-1, 2))
        place = (str(rows["sequence_id"][row]), int(rows["frame"][row]))
        assert (image["video_id"], image["frame_id"], image["file_name"]) == (*place, "{}/{:06d}.png".format(*place))
        assert (image["width"], image["height"]) == (rows["image_width_px"][row], rows["image_height_px"][row])
        assert (person["track_id"], person["category_id"]) == (rows["person_id"][row], 1)
        scores = np.asarray(rows["keypoint_confidence"][row])
        table = np.reshape(person["keypoints"], (-1, 3))
        np.testing.assert_array_equal(table[:, 2], np.where(scores > 0, 2, 0))
        np.testing.assert_allclose(table[scores > 0, :2], points[scores > 0], atol=1e-3)
        np.testing.assert_allclose(person["keypoint_scores"], scores, atol=1e-4)
        left, top, width, height = person["bbox"]
        x, y = points[scores > 0].T
        np.testing.assert_allclose([left, top, left + width, top + height], [min(x), min(y), max(x), max(y)], atol=2e-3)
        assert person["area"] == pytest.approx(width * height, rel=1e-3)
        assert person["iscrowd"] == 0


def check_mp4(paths: list[Path], text: str, store: Store) -> None:
    (path,) = names_in(paths, ".mp4")
    video = cv2.VideoCapture(str(path))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == NUM_LIFTED
    ref = parse_reference(text)
    (cast,) = casts(Export(store, text, ref, tuple(resolve(ref, store))))
    assert cast.seen is not None
    wanted, _ = drawn_px(store, cast.seen)
    for points in wanted:
        image = video.read()[1].astype(int)
        orange, blue = image[..., 2] - image[..., 0] > 40, image[..., 0] - image[..., 2] > 20
        for person, mask in enumerate((orange, blue)):
            middles = [points[person, list(bone)].mean(axis=0) for bone in cast.seen.skeleton.bones]
            near = [
                mask[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4].any()
                for x, y in np.round([middle for middle in middles if np.isfinite(middle).all()]).astype(int)
                if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]
            ]
            assert np.mean(near) > 0.7, f"person {person}: {np.mean(near):.0%} of the bones are where they belong"


def drawn_px(store: Store, seen: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return where people belong on their annotation, and that: by the least squares of scale and shift, y down."""
    manifests = having("annotations", store.artifacts())
    tables = (store.read(manifest.ref, "annotations") for manifest in manifests)
    rows = next(table for table in tables if seen.sequence_id in table["sequence_id"])
    given = np.full((*seen.positions_m.shape[:3], 2), np.nan)
    for row in range(rows.num_rows):
        frame, person_id = int(rows["frame"][row]), int(rows["person_id"][row])
        if str(rows["sequence_id"][row]) == seen.sequence_id and frame in seen.frames and person_id in seen.person_ids:
            place = seen.frames.index(frame), seen.person_ids.index(person_id)
            given[place] = rows[f"{seen.skeleton.name}_px"][row]
    drawn = np.full_like(given, np.nan)
    for at, people in enumerate(seen.positions_m):
        for who in [slice(None)] if seen.is_pair else [slice(0, 1), slice(1, 2)]:
            flat, to = people[who][..., :2] * [1, -1], given[at, who]
            known = np.isfinite(flat).all(axis=-1) & np.isfinite(to).all(axis=-1)
            x, y = flat[known].T
            ones, zeros = np.ones_like(x), np.zeros_like(x)
            system = np.concatenate([np.c_[x, ones, zeros], np.c_[y, zeros, ones]])
            scale, right, down = np.linalg.lstsq(system, to[known].T.ravel(), rcond=None)[0]
            drawn[at, who] = flat * scale + [right, down]
    return drawn, given


def check_json(paths: list[Path], text: str, store: Store) -> None:
    pairs = [read_pair_json(path.read_bytes()) for path in paths]
    np.testing.assert_array_equal([pair.pair_m for pair in pairs], open_table(text, store)["pair17_m"])
    assert all(pair.sources[0].credit == CREDIT.credit for pair in pairs)


def check_safetensors(paths: list[Path], text: str, store: Store) -> None:
    weights, card = paths
    assert [path.name for path in paths] == ["random_copy.safetensors", "random_copy.md"]
    assert read_weights(weights.read_bytes(), weights.name).model.name == "copy"
    (source,) = next(store.artifacts("training")).inputs
    for wanted in (source.key, source.content_digest, "`random`, seed 0", '"reach": 0.15', "1.25 cm", "naive_fk 2 cm"):
        assert wanted in card.read_text()


READ_BACK: dict[str, Callable[[list[Path], str, Store], None]] = {
    "npz": check_npz,
    "csv": check_csv,
    "bvh": check_bvh,
    "glb": check_glb,
    "c3d": check_c3d,
    "trc": check_trc,
    "smpl": check_smpl,
    "coco": check_coco,
    "mp4": check_mp4,
    "json": check_json,
    "safetensors": check_safetensors,
}
"""How a program of others reads each format."""


def test_every_format_is_read_back_here() -> None:
    assert set(READ_BACK) == set(EXPORT_FORMATS)


def test_a_model_has_the_figures_of_the_last_run_alone(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    put_model(store, CopyModel(), "random", [])
    (model,) = store.artifacts("training")
    scores = [Score("E_r", model.facts["model"], value, "m", split="test") for value in (0.1, 0.2, 0.1)]
    tables = [{"scores": columns_of("models", [score])} for score in scores]
    made = [put(store, "evaluation", str(at), columns, {"takes": []}, (model,)) for at, columns in enumerate(tables)]
    for shown in (made[:1], made[1:2], made[::2]):
        record_latest(store, "study", "run", {"evaluation": [ShardRecord.of(manifest, store) for manifest in shown]})
        _, card, _ = export_reference(store, f"models@{model.ref.key}", "safetensors", tmp_path / "out")
        figures = [line for line in card.read_text().splitlines() if line.startswith("| E_r")]
        assert figures == [f"| E_r, test | {0.2 if shown == made[1:2] else 0.1:g} m | |"]


@pytest.mark.parametrize("name", EXPORT_FORMATS)
def test_what_a_format_writes_is_read_back_and_credited_and_the_rest_refused_in_a_sentence(
    store: Store, tmp_path: Path, name: str
) -> None:
    kind = export_format(name)
    num_written = 0
    for table, text in references(store).items():
        out = tmp_path / table
        if not kind.can_write(parse_reference(text)):
            with pytest.raises(InputError) as found:
                export_reference(store, text, name, out, **options_of(name, tmp_path))
            sentence = str(found.value)
            assert sentence == f"'{text}' cannot be written as {name.upper()}; allowed are {kind.writes}"
            assert not out.exists()
            continue
        *written, notice = export_reference(store, text, name, out, **options_of(name, tmp_path))
        READ_BACK[name](written, text, store)
        (manifest,) = [manifest for manifest in store.artifacts() if manifest.ref.key in text]
        assert notice.name == "CREDITS.txt"
        for source in source_credits(store, manifest.ref):
            assert all(part in notice.read_text() for part in (source.name, source.licence, source.credit))
        num_written += 1
    assert num_written > 0


def named(store: Store, name: str, into: Store) -> None:
    """Copy artifacts whose takes, sequences, variants and splits somebody else has called so."""
    copies: dict[ArtifactRef, ArtifactRef] = {}
    renamed = dict.fromkeys(("take_id", "sequence_id", "split"), name)
    inputs_first = sorted(store.artifacts(), key=lambda made: (made.ref.stage != "ingest", len(made.inputs)))
    for manifest in inputs_first:
        tables = {}
        for table in manifest.tables:
            rows = store.read(manifest.ref, table)
            ids = {column: [name] * rows.num_rows for column in TABLES[table].id_columns}
            tables[table] = {column: rows[column] for column in rows} | ids
        copies[manifest.ref] = into.commit(
            stage=manifest.ref.stage,
            key=manifest.ref.key,
            partition=manifest.partition,
            name=manifest.name,
            version=1,
            parameters=manifest.parameters,
            seed=0,
            inputs=[copies.get(ref, ref) for ref in manifest.inputs],
            files=[],
            tables=tables,
            facts={key: renamed.get(key, fact) for key, fact in manifest.facts.items()},
            sources=manifest.sources,
        )


NASTY = ("../ESCAPED", "/etc/passwd", "..", "a/b", "a\\b", "a\0b", "", "~", "con:", "x" * 300, "take\n1", "-rf", "ä")


@given(name=st.sampled_from(NASTY) | st.text(st.characters(exclude_categories=["Cs"]), max_size=40))
def test_a_name_of_a_file_leads_nowhere(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    folder = tmp_path_factory.mktemp("names")
    with suppress(InputError):
        FileNames(folder).path("take", name, suffix=".bvh").touch()
        assert [path.parent for path in folder.rglob("*")] == [folder]


@pytest.mark.parametrize("name", ["../ESCAPED", "60_03.b-1"])
def test_no_name_in_rows_leads_out_of_the_folder_whatever_the_format(
    store: Store, tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    folder = tmp_path_factory.mktemp("named")
    options_of("smpl", folder)
    copy = Store(folder / "store")
    named(store, name, copy)
    before = {path for path in folder.rglob("*") if path.is_file()}
    for number, (file_format, (table, text)) in enumerate(product(EXPORT_FORMATS, references(copy).items())):
        out = folder / "out" / str(number) / "here"
        if export_format(file_format).can_write(parse_reference(text)):
            with suppress(InputError):
                export_reference(copy, text, file_format, out, **options_of(file_format, folder))
            assert (out / "CREDITS.txt").is_file()
            assert all(path.parent == out and path.is_file() for path in out.rglob("*")), (file_format, table)
        there = {path for path in folder.rglob("*") if path.is_file() and out not in path.parents}
        assert there == before, (file_format, table)
        before |= {path for path in folder.rglob("*") if path.is_file()}


def test_an_export_beside_another_keeps_its_credits(store: Store, tmp_path: Path) -> None:
    (tmp_path / "CREDITS.txt").write_text("Something of somebody else.\n")
    texts = references(store)
    for table in ("poses", "seeds"):
        *_, notice = export_reference(store, texts[table], "bvh", tmp_path)
    add_notice(notice, "Motions of a studio.\n")
    said = notice.read_text()
    assert said.startswith("Motions of a studio.\n\nSomething of somebody else.\n\nExported from ")
    for table in ("poses", "seeds"):
        (manifest,) = having(table, store.artifacts())
        assert f"Exported from {texts[table]} by pasdedeux." in said
        assert manifest.ref.content_digest in said
        assert all(source.credit in said and source.name in said for source in manifest.sources)
    names = re.findall(r"(.*)\n  licence:", said)
    assert names == ["a studio", "pasdedeux built-in duets"]
    export_reference(store, texts["poses"], "npz", tmp_path)
    add_notice(notice, "Motions of a studio.\n")
    assert notice.read_text() == said
    assert "waltz.A: 15 frames" in (tmp_path / "UNITS.txt").read_text()


def test_credits_stay_where_there_is_no_room_for_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notice = tmp_path / "CREDITS.txt"
    add_notice(notice, "Motions of a studio.\n")

    def full(path: Path, *_: object, **__: object) -> int:
        path.open("w").close()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        add_notice(notice, "Motions of another one.\n")
    assert notice.read_text() == "Motions of a studio.\n"


def test_credits_of_folders_that_somebody_has_joined_are_kept(store: Store, tmp_path: Path) -> None:
    texts = references(store)
    said = [
        export_reference(store, texts[table], "bvh", tmp_path / table)[-1].read_text() for table in ("poses", "seeds")
    ]
    notice = tmp_path / "CREDITS.txt"
    notice.write_text("".join(said))
    export_reference(store, texts["poses"], "npz", tmp_path)
    lines = notice.read_text().splitlines()
    assert {line for text in said for line in text.splitlines()} <= {*lines}
    assert lines.count("Sources, their licences and credits:") == 1


def test_a_rest_pose_and_units_are_refused_where_there_are_none(store: Store, tmp_path: Path) -> None:
    text = references(store)["poses"]
    with pytest.raises(InputError, match=r"chosen for BVH files of poses and variants, .* not for 'poses@.*' as CSV"):
        export_reference(store, text, "csv", tmp_path, rest_pose="standing")
    with pytest.raises(InputError, match=r"not for 'seeds@.*' as BVH"):
        export_reference(store, references(store)["seeds"], "bvh", tmp_path, units="m")


def test_an_unknown_format_is_answered_with_the_known_ones(store: Store, tmp_path: Path) -> None:
    for name, how in {"fbx": "; docs/formats-and-units.md has .* Blender .*", "gif": ""}.items():
        with pytest.raises(
            InputError, match=f"'{name}' is not known; known formats: {', '.join(EXPORT_FORMATS)}{how}$"
        ):
            export_reference(store, references(store)["poses"], name, tmp_path)


def test_what_is_worse_than_asked_for_lies_apart(store: Store, tmp_path: Path) -> None:
    text = references(store)["variants"]
    for file_format in ("glb", "bvh", "c3d"):
        out = tmp_path / file_format
        export_reference(store, text, file_format, out, verdict=Level.PASS)
        folders = {path.name: path.parent.relative_to(out).as_posix() for path in out.rglob(f"*.{file_format}")}
        assert {name.split("_")[1].split(".")[0]: at for name, at in folders.items()} == {
            "same": ".",
            "bad": "not_good",
        }
        units = (out / "UNITS.txt").read_text()
        assert "not_good/waltz_bad" in units
        assert "\nwaltz_same" in units
    with pytest.raises(InputError, match=r"--verdict is for bvh, .*, not for csv"):
        export_reference(store, text, "csv", tmp_path / "csv", verdict=Level.PASS)


@pytest.mark.parametrize("together", [True, False])
def test_people_are_laid_on_their_image_the_right_way_up_at_its_scale_and_place(*, together: bool) -> None:
    """Camera axes have y up, images have it down: two people, whole or one by one, of whom two thirds are given."""
    people_m = np.random.default_rng(0).normal(0.0, 0.5, (2, 17, 3))
    drawn_px = [900.0, 500.0] + 240.0 * people_m[..., :2] * [1.0, -1.0]
    is_given = np.arange(17) % 3 > 0
    given_px = np.where(is_given[:, None], drawn_px, np.nan)

    def laid_px(on_px: np.ndarray) -> np.ndarray:
        scales, shifts = _laid_on(people_m, on_px, np.tile(is_given, (2, 1)), together=together)
        return np.asarray(scales[:, None, None] * people_m[..., :2] * [1.0, -1.0] + shifts[:, None])

    np.testing.assert_allclose(laid_px(given_px), drawn_px)
    apart_px = given_px + np.array([[[0.0, 0.0]], [[300.0, 0.0]]])
    off_px = np.abs(laid_px(apart_px) - drawn_px).max(axis=(1, 2))
    assert (off_px[0].max() > 1.0) == together, "a pair is laid on as a whole"


def test_a_result_is_drawn_on_the_footage_that_is_named(store: Store, tmp_path: Path) -> None:
    text, film = references(store)["in_betweens"], tmp_path / "film.mp4"
    rows = open_table(references(store)["annotations"], store)
    size = int(rows["image_width_px"][0]), int(rows["image_height_px"][0])
    video = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, size)
    for level in (0, 60, 120, 180):
        video.write(np.full((size[1], size[0], 3), level, np.uint8))
    video.release()
    (path, *_) = export_reference(store, text, "mp4", tmp_path / "out", footage=film)
    drawn = cv2.VideoCapture(str(path))
    levels = [float(np.median(drawn.read()[1])) for _ in range(NUM_LIFTED)]
    np.testing.assert_allclose(levels, [60, 120, 180], atol=10)  # frames 1 to 3
    with pytest.raises(InputError, match=r"footage film\.mp4 has no frame 4"):
        export_reference(store, references(store)["lifted_pairs"], "mp4", tmp_path / "cut", footage=film)
    assert not [path for path in (tmp_path / "cut").iterdir() if path.suffix == ".mp4"], "half a film is none"
    (tmp_path / "notes.txt").write_text("no film")
    with pytest.raises(InputError, match=r"footage: film notes\.txt cannot be opened"):
        export_reference(store, text, "mp4", tmp_path / "out", footage=tmp_path / "notes.txt")


def level_at(footage: FilmImages, frame: int) -> int:
    """Return the frame of a film of `levels` that an image is."""
    return round(float(np.median(footage(frame))) / 20)


def test_footage_is_read_by_the_frames_of_its_annotations(tmp_path: Path) -> None:
    images = [np.full((48, 64, 3), 20 * at, np.uint8) for at in range(12)]
    film = write_film(tmp_path / "levels.mp4", iter(images))
    assert [level_at(FilmImages(film), frame) for frame in (7, 8, 11)] == [7, 8, 11]
    footage = FilmImages(film)
    assert [level_at(footage, frame) for frame in (5, 2, 3)] == [5, 2, 3]
    folder = tmp_path / "images"
    folder.mkdir()
    for at, image in enumerate(images):
        cv2.imwrite(str(folder / f"img_{100 + at}.png"), image)
    assert [level_at(FilmImages(folder), frame) for frame in (100, 111)] == [0, 11]
    with pytest.raises(InputError, match="footage images has no frame 99"):
        FilmImages(folder)(99)
    uneven = tmp_path / "uneven.mp4"
    uneven.write_bytes(with_durations(film.read_bytes(), [3 / 30, *[1 / 30] * 11]))
    # Ingest places such film on a constant rate: the first image is shown for three frames.
    assert [level_at(FilmImages(uneven, 30.0), frame) for frame in (0, 1, 2, 3, 4, 13)] == [0, 0, 0, 1, 2, 11]


def test_selected_pairs_leave_as_poses_those_of_doubtful_chains_apart(store: Store, tmp_path: Path) -> None:
    columns = random_columns("selected_pairs", 2) | {
        "verdict": ["pass", "fail"],
        "reference": ["draws@a#0", "draws@b#1"],
    }
    rows = TableData(TABLES["selected_pairs"], encode(TABLES["selected_pairs"], columns))
    reference = parse_reference(references(store)["draws"])
    export = Export(store, "x", replace(reference, table="selected_pairs"), (), selected=rows, verdict=Level.WARN)
    files = {path.relative_to(tmp_path).as_posix() for path in export_format("c3d").write(export, tmp_path)}
    assert files == {"selected_pairs_pass.c3d", "not_good/selected_pairs_fail.c3d", "UNITS.txt"}


def test_contacts_go_out_as_a_table_with_points_on_both_bodies(store: Store, tmp_path: Path) -> None:
    path, notice = export_reference(store, references(store)["poses"].replace("poses", "contacts"), "npz", tmp_path)
    assert (path.name, notice.name) == ("contacts.npz", "CREDITS.txt")
    with np.load(path) as archive:
        rows = dict(archive)
    columns = [column.name for column in TABLES["contacts"].columns]
    assert [name for name in rows if not name.endswith("_unit")] == columns
    body = dict(zip("AB", np.moveaxis(poses_of(references(store)["poses"], store), 1, 0), strict=True))
    assert len(rows["frame"]) > 20
    for row in range(len(rows["frame"])):
        for who, bone, share, point in (
            (rows["person"], rows["bone"], rows["share"], rows["point_m"]),
            (rows["partner"], rows["partner_bone"], rows["partner_share"], rows["partner_point_m"]),
        ):
            child = BODY22.index(str(bone[row]))
            start, end = (body[str(who[row])][rows["frame"][row], joint] for joint in (BODY22.parents[child], child))
            np.testing.assert_allclose(point[row], start + share[row] * (end - start), atol=1e-5)
    between = np.linalg.norm(rows["point_m"] - rows["partner_point_m"], axis=-1)
    np.testing.assert_allclose(rows["distance_m"], between, atol=1e-5)
    np.testing.assert_allclose(rows["time_s"], rows["frame"] / RATE_HZ, atol=1e-12)
    assert (rows["gap_m"] < rows["distance_m"]).all()
    assert np.abs(rows["gap_m"][rows["is_held"]]).max() < 0.2
    np.testing.assert_array_equal(rows["is_held"], rows["weight"] >= 0.5)


def test_contacts_of_variants_and_reconstructions_are_named_by_them(store: Store, tmp_path: Path) -> None:
    texts = {table: references(store)[table].replace(table, "contacts") for table in ("variants", "motions")}
    path, *_ = export_reference(store, texts["variants"], "csv", tmp_path / "variants")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {(row["origin"], row["take_id"], row["variant_id"]) for row in rows} == {
        ("variants", "waltz", "bad"),
        ("variants", "waltz", "same"),
    }
    path, _ = export_reference(store, texts["motions"], "npz", tmp_path / "motions")
    assert len(np.load(path)["frame"]) == 0  # they stand a metre apart
    path, *_ = export_reference(store, texts["motions"], "csv", tmp_path / "none_csv")
    assert path.read_text(encoding="utf-8").count("\n") == 1, "the header alone"
    with pytest.raises(InputError, match="cannot be written as GLB"):
        export_reference(store, texts["motions"], "glb", tmp_path / "glb")
    with pytest.raises(InputError, match="here are none"):
        export_reference(store, references(store)["seeds"].replace("seeds", "contacts"), "npz", tmp_path / "none")
