"""`reconstruct`: 2D poses that lie there to BVH at once; bad options, and people who come and go."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from flows.console.display import LineListener
from flows.console.live import list_frames
from flows.progress import Progress
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.npz import read_npz
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction import people
from pasdedeux.reconstruction.body import SHARED
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.scene import SceneEstimate, estimate_scene
from pasdedeux.reconstruction.sizes import sized_by_stature
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from pasdedeux.verdict import Verdict
from storage_schema import Store
from storage_schema.errors import SchemaError
from tasks import ingest
from tasks import reconstruction as reconstruction_stage
from tasks.projections import read_database
from tasks.stage import StageInputs
from tasks.stage.judgements import PARTS_FACT
from tests.builders.command_line import CommandLine
from tests.builders.ingest_runs import judged
from tests.builders.pages import Page
from tests.builders.walkers import reconstruction, walk
from tests.builders.walkers_on_video import FRAMES, LAYOUT, build_store, openpose, reference, write_walkers


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walkers(tmp_path_factory.mktemp("video"))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return build_store(tmp_path_factory.mktemp("store"))


SIZE = ("--set", "image_size_px=[1920, 1080]")


@pytest.fixture
def reconstruct(store: Store, invoke: CommandLine) -> CommandLine:
    """Return the command with the database of the store."""
    return invoke.of("reconstruct", *reference(store))


@pytest.mark.parametrize(("units", "zoom"), [("cm", 1.0), ("m", 1.4)])
def test_files_that_lie_there_become_a_humanoid_a_person(
    video: Path, tmp_path: Path, reconstruct: CommandLine, monkeypatch: pytest.MonkeyPatch, units: str, zoom: float
) -> None:
    def with_other_lens(*told: Any, **more: Any) -> SceneEstimate:
        """Find a longer lens than was assumed, and everybody farther away."""
        estimate = estimate_scene(*told, **more)
        factors = tuple(zoom * factor for factor in estimate.factors)
        return replace(estimate, lens_factor=zoom * estimate.lens_factor, factors=factors)

    monkeypatch.setattr(people, "estimate_scene", with_other_lens)
    out = tmp_path / "out"
    said = reconstruct(video, "--out", out, *SIZE, *(["--units", "m"] if units == "m" else []))
    assert {"cm": "centimetres", "m": "are in metres"}[units] in (out / f"{video.name}_units.txt").read_text()
    for person in (0, 1):
        source = read_bvh((out / f"{video.name}_{person}.bvh").read_bytes())
        assert (source.num_frames, source.rate_hz) == (FRAMES, pytest.approx(30.0))
        arrays = read_npz((out / f"{video.name}_{person}.npz").read_bytes(), "motion")
        motion = source.to_motion(metres_per_unit={"cm": 0.01, "m": 1.0}[units], rate_hz=30.0)
        assert motion.skeleton.joint_names[motion.skeleton.root] == "Hips"
        at = [motion.skeleton.index(name) for name in arrays["joint_names"]]
        np.testing.assert_allclose(motion.world()[0][:, at], arrays["positions_m"], atol=1e-5)
        assert arrays["is_seen"].all()
        assert (float(arrays["rate_hz"]), int(arrays["first_frame"])) == (pytest.approx(30.0), 0)
    header, *lines, place, look = said.out.splitlines()
    assert header.split()[0] == "file"
    assert re.match(r"place of 0 and 1 +\d+ cm \(\d+ to \d+\) .*(pass|warn|fail)", place)
    assert [line.split()[:2] for line in lines] == [
        [str(out / f"{video.name}_{person}.bvh"), "0-39"] for person in (0, 1)
    ]
    assert all(re.search(r"\d+ cm .* (pass|warn|fail)", line) for line in lines)
    assert "camera pitch" in said.err
    assert "the database has only 288 poses of 1 take: enough for similar motion, not for other motion" in said.err
    assert "reading " in said.err
    page = Page((out / f"{video.name}.html").read_text())
    assert "in brackets the range of four in five cases" in page.text
    assert look == f"look at it: {out / video.name}.html"
    assert (page.problems, page.outside) == ([], [])
    (scene,) = page.scenes
    assert [panel["is_flat"] for panel in scene["panels"]] == [True, False], "over its 2D, and in 3D"
    values = np.frombuffer(base64.b64decode(scene["data"]), "<i2").reshape(scene["num_frames"], -1, 3) * scene["unit_m"]
    seen, *_, over = (figure["start"] for figure in scene["panels"][0]["figures"])
    apart = np.linalg.norm(values[:, seen + 14 : seen + 28] - values[:, over : over + 14], axis=-1)
    assert np.median(apart) < 0.05, "the result lies over the 2D poses that it was made from"
    higher = []
    for person, figure in zip((0, 1), scene["panels"][1]["figures"], strict=True):
        arrays = read_npz((out / f"{video.name}_{person}.npz").read_bytes(), "motion")
        there = [list(arrays["joint_names"]).index(HUMANOID_NAMES[name]) for name in SHARED]
        shown = values[0, [figure["start"] + OP14.index(name) for name in SHARED], 1]
        higher += (shown - arrays["positions_m"][0, there, 1]).tolist()
    assert np.ptp(higher) < 0.01, "people stand upright on the page, on one floor, however the camera is pitched"


def test_a_reconstruction_says_how_far_it_is(
    video: Path, reconstruct: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[Progress] = []
    monkeypatch.setattr(LineListener, "progressed", lambda _, progress: heard.append(progress))
    reconstruct(video, "--out", tmp_path, *SIZE)
    done = [progress.num_done for progress in heard]
    assert done == sorted(done)
    assert heard[-1].num_done == heard[-1].num_shards > 4
    assert heard[0].left_s > heard[-1].left_s == 0.0


def second_comes_later(text: str, number: int) -> str:
    """Return a frame in which only the first person is seen, if it is one of the first eight."""
    frame = json.loads(text)
    if number < 8:
        frame["people"] = frame["people"][:1] if number % 2 == 0 else frame["people"][1:]
    return json.dumps(frame)


def test_files_of_late_people_start_with_the_others(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    frames = {number: second_comes_later(path.read_text(), number) for number, path in list_frames(video)}
    folder, out = written(tmp_path / "late", frames), tmp_path / "out"
    reconstruct(folder, "--out", out)
    first, late = (read_npz((out / f"late_{person}.npz").read_bytes(), "motion") for person in (0, 1))
    assert len(first["positions_m"]) == len(late["positions_m"]) == FRAMES
    assert first["is_seen"].all()
    assert late["is_seen"].tolist() == [frame >= 8 for frame in range(FRAMES)]
    np.testing.assert_array_equal(late["positions_m"][:8], np.repeat(late["positions_m"][8:9], 8, axis=0))


def test_without_a_database_it_is_said_how_to_get_one(video: Path, store: Store, invoke: CommandLine) -> None:
    said = invoke.refusal("reconstruct", video, "--store", store)
    assert "no projections, which `reconstruct` needs as its database; `pasdedeux fetch database`" in said


def test_camera_height_gives_people_their_size(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    sizes = []
    for height, stated in (("1.2", ["--height", "1.2"]), ("1.8", ["--set", "camera_height_m=1.8"])):
        reconstruct(video, "--out", tmp_path / height, *stated, *SIZE, "--pitch", "6")
        first = read_bvh(min((tmp_path / height).glob("*.bvh")).read_bytes())
        sizes.append(np.linalg.norm(first.rest_offsets, axis=-1).sum())
    assert sizes[1] / sizes[0] == pytest.approx(1.5, rel=0.05)


def test_a_changed_table_of_people_overrules(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    assert "0 and 1 are partners" in reconstruct(video, *SIZE, "--out", tmp_path / "all").err
    header, *rows = (tmp_path / "all" / f"{video.name}_people.csv").read_text().splitlines()
    changed = tmp_path / "people.csv"
    names = (row.rsplit(",", 1)[0] + (",nobody" if at else ",5") for at, row in enumerate(rows))
    changed.write_text("\n".join([header, *names]))
    command = reconstruct.of(video, *SIZE, "--set", f"people_file={changed}", "--out", tmp_path / "one")
    command()
    assert [path.name for path in (tmp_path / "one").glob("*.bvh")] == [f"{video.name}_5.bvh"]
    changed.write_text(f"{header}\n{video.name},0,3,9,1\n")
    assert "there is no person 9; persons: 0, 1" in command.refusal()
    changed.unlink()
    assert "people.csv does not exist" in command.refusal()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--set min_confidence", "=0"), ("--set people_file", "=a.csv"), ("--units", " m"), ("--height", " 1.5")],
)
def test_options_of_videos_are_refused_live(video: Path, reconstruct: CommandLine, option: str, value: str) -> None:
    said = reconstruct.refusal(video, "--follow", *f"{option}{value}".split())
    assert f"{option} is for whole videos; leave it out with --follow" in said


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (["--set", "rate_hz=fast"], "--set rate_hz: "),
        (["--set", "rate"], "--set rate: "),
        (["--database", "poses@00"], "poses"),
    ],
)
def test_bad_options_are_named(video: Path, reconstruct: CommandLine, change: list[str], says: str) -> None:
    assert says in reconstruct.refusal(video, *change)


def test_a_folder_without_frames_is_named(reconstruct: CommandLine, tmp_path: Path) -> None:
    said = reconstruct.refusal(tmp_path, "--stature", "172")
    assert "stature '172' is neither METRES nor PERSON=METRES" in said, "before anything is read"
    assert "holds no files of 2D poses" in reconstruct.refusal(tmp_path)
    assert "does not exist" in reconstruct.refusal(tmp_path / "none")


def written(folder: Path, frames: dict[int, str], camera: str = "film") -> Path:
    """Write OpenPose files by frame number."""
    folder.mkdir(exist_ok=True)
    for number, text in frames.items():
        (folder / f"{camera}_{number:012d}_keypoints.json").write_text(text)
    return folder


def padded(text: str) -> str:
    """COCO-18 keypoints in files that say BODY_25 by their number of values."""
    frame = json.loads(text)
    for person in frame["people"]:
        person["pose_keypoints_2d"] += [0.0] * 21
    return json.dumps(frame)


@pytest.mark.parametrize("mode", [[], ["--follow", "--idle", "0"]])
def test_coco_18_as_body_25_is_noticed(video: Path, reconstruct: CommandLine, tmp_path: Path, mode: list[str]) -> None:
    frames = {number: padded(path.read_text()) for number, path in list_frames(video)}
    folder = written(tmp_path / "padded", frames)
    assert "'coco18' fits" in reconstruct.refusal(folder, *mode, "--out", tmp_path / "x")


def test_people_without_any_joint_are_nobody(reconstruct: CommandLine, tmp_path: Path) -> None:
    empty = openpose(np.zeros((1, 14, 2))).replace("0.9", "0.0")
    folder, lines = written(tmp_path / "empty", dict.fromkeys(range(12), empty)), tmp_path / "lines"
    assert "nobody is seen" in reconstruct.refusal(folder, "--out", tmp_path / "x")
    said = reconstruct(folder, "--follow", "--idle", "0", "--out", lines).err
    assert "12 frames, nobody to be seen" in said
    assert len(lines.read_text().splitlines()) == 1


def test_frames_keep_their_numbers_over_gaps(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    """Of every third frame of a faster camera three were lost; the second person comes later."""
    frames = {
        3 * number: second_comes_later(path.read_text(), number)
        for number, path in list_frames(video)
        if not 18 <= number < 21
    }
    folder, out = written(tmp_path / "gaps", frames), tmp_path / "lines"
    reconstruct(folder, "--follow", "--idle", "0", "--out", out, "--set", "rate_hz=90")
    _, *lines = [json.loads(line) for line in out.read_text().splitlines()]
    seen = {person: [line["frame"] for line in lines if line["person_id"] == person] for person in (0, 1)}
    assert seen == {0: sorted(frames), 1: [number for number in sorted(frames) if number >= 24]}


def test_a_database_of_other_columns_is_refused(video: Path, store: Store, tmp_path: Path, invoke: CommandLine) -> None:
    copy = tmp_path / "store"
    shutil.copytree(store.root, copy)
    (path,) = copy.rglob("projections.parquet")
    pyarrow.parquet.write_table(pyarrow.parquet.read_table(path).drop_columns(["joint_radius_m"]), path)
    with pytest.raises(SchemaError, match=r"'projections'.*other columns; run its stage again"):
        read_database(Store(copy), [manifest.ref for manifest in store.artifacts("projections")])
    assert "projections" in invoke.refusal("reconstruct", video, "--store", copy, *reference(store)[2:])


def results(video: Path) -> str:
    """Return the video as AlphaPose would list it: names of images, tracks, 17 keypoints."""
    names = KEYPOINT_LAYOUTS["coco17"].keypoint_names
    columns = [LAYOUT.keypoint_names.index(name) for name in names]
    items = []
    for number, path in list_frames(video):
        people = json.loads(path.read_text())["people"]
        for place, person in enumerate(people[::-1] if number % 2 else people):
            table = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)[columns]
            items.append({"image_id": f"{number}.jpg", "keypoints": table.reshape(-1).tolist(), "idx": place + 3})
    return json.dumps(items)


def test_a_file_of_results_says_what_was_assumed(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    path = tmp_path / "clip.json"
    path.write_text(results(video))
    command = reconstruct.of(path, "--out", tmp_path / "out", "--pitch", "6")
    said = command("--person", "4", "--stature", "1.60", "--set", "fov_deg=70", *SIZE).err
    assert [file.name for file in (tmp_path / "out").glob("*.bvh")] == ["clip_4.bvh"]
    assert "clip: format 'coco', layout 'coco17', 30 frames a second assumed (rate_hz), 1920 x 1080" in said
    assert "focal length 1371 px" in said
    assert "clip: the input has no person 7; people: 3, 4" in command.refusal("--person", "7")


def test_two_cameras_of_a_folder_are_two_sequences(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    folder, out = tmp_path / "both", tmp_path / "out"
    for camera, num_frames in (("left", 20), ("right", FRAMES)):
        written(folder, {number: path.read_text() for number, path in list_frames(video)[:num_frames]}, camera)
    out.mkdir()
    (out / "README.txt").write_text("of somebody else")
    reconstruct(folder, "--pitch", "6", "--out", out)
    names = {file.name for file in out.glob("*.bvh")}
    assert names == {f"both.{camera}_{person}.bvh" for camera in ("left", "right") for person in (0, 1)}
    for camera, num_frames in (("left", 20), ("right", FRAMES)):
        assert f"same {num_frames} frames" in (out / f"both.{camera}_units.txt").read_text()
    assert (out / "README.txt").read_text() == "of somebody else"


def test_a_camera_without_people_is_skipped(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    folder, two_joints = tmp_path / "both", np.zeros((1, 14, 2))
    two_joints[0, :2] = 100.0
    written(folder, {number: path.read_text() for number, path in list_frames(video)}, "left")
    written(folder, dict.fromkeys(range(FRAMES), openpose(two_joints)), "right")
    command = reconstruct.of(folder, "--pitch", "6", "--out", tmp_path / "out")
    nobody = "no frame shows enough joints of a person"
    assert f"skipped: annotations both.right: {nobody}" in command().err
    assert {file.name for file in (tmp_path / "out").glob("*.bvh")} == {"both.left_0.bvh", "both.left_1.bvh"}
    for path in folder.glob("left_*"):
        path.unlink()
    assert nobody in command.refusal()


def test_a_sequence_without_people_is_skipped(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    items = [{key: item[key] for key in ("image_id", "keypoints")} for item in json.loads(results(video))]
    left = [item | {"image_id": f"left_{item['image_id']}"} for item in items]
    ghost = {"keypoints": [100.0, 100.0, 0.9] * 2 + [0.0] * 45}
    right = [item | ghost | {"image_id": f"right_{item['image_id']}"} for item in items]
    path, out = tmp_path / "clip.json", tmp_path / "out"
    path.write_text(json.dumps(left + right))
    said = reconstruct(path, "--pitch", "6", "--out", out).err
    assert {file.name for file in out.glob("*.bvh")} == {"clip.left_0.bvh", "clip.left_1.bvh"}
    assert "skipped: clip.right: no frame shows enough joints of a person" in said


def test_jumps_of_frame_numbers_are_gaps_in_time(video: Path, reconstruct: CommandLine, tmp_path: Path) -> None:
    """There is one person in the whole video, and only every second frame."""
    frames = {number: path.read_text() for number, path in list_frames(video)[:24]}
    alone = {1000 + number: json.loads(text) for number, text in frames.items() if number % 2 == 0}
    for frame in alone.values():
        frame["people"] = frame["people"][:1]
    folder = written(tmp_path / "one", {number: json.dumps(frame) for number, frame in alone.items()})
    out = tmp_path / "out"
    assert "1000-1022" in reconstruct(folder, "--pitch", "6", "--set", "rate_hz=60", "--out", out).out
    (file,) = out.glob("*.bvh")
    source = read_bvh(file.read_bytes())
    assert (source.num_frames, source.rate_hz) == (23, pytest.approx(60.0))
    far = written(tmp_path / "far", {100_000 * number: text for number, text in frames.items()})
    assert "far: 24 frames spread over 2,300,001 are single images, not a video" in reconstruct.refusal(far)


def test_people_of_known_stature_come_out_that_tall() -> None:
    people = [reconstruction(walk(30, seed=1), person_id=name) for name in (0, 1)]

    def heights(found: Sequence[ReconstructedTrack]) -> list[float]:
        lengths = [bone_lengths(OP14, track.positions_m) for track in found]
        return [float(np.median(body_height_m(OP14, length))) for length in lengths]

    assert heights(sized_by_stature(people, {0: 1.9, 1: 1.5})) == pytest.approx([1.9, 1.5])
    assert heights(sized_by_stature(people, {1: 1.5})) == pytest.approx([1.5, 1.5])
    assert heights(sized_by_stature(people, {0: 1.8, 1: 1.8}, has_one_size=True)) == pytest.approx([1.8, 1.8])
    assert sized_by_stature(people, {}) == tuple(people)


def test_a_study_and_the_command_agree(video: Path, store: Store, reconstruct: CommandLine, tmp_path: Path) -> None:
    statures = ("--set", "statures_m=[[0, 1.75], [3, 1.6]]")
    # Of whom nothing else is stated, the person is 1.65 m tall.
    output = reconstruct(video, "--out", tmp_path, "--stature", "1.65", *SIZE, *statures)
    source = {"id": video.name, "path": video, "image_size_px": [1920, 1080]}
    source["statures_m"] = [[0, 1.75], [1, 1.65], [3, 1.6]]
    read = ingest.STAGE.plan(StageInputs({}, seed=5), ingest.IngestParameters.model_validate({"annotations": [source]}))
    seen = [store.manifest(ingest.STAGE.run_shard(shard, store)) for shard in read]
    of_nobody = "a stature is stated for person 3, who is not there; people: 0, 1"
    assert output.err.count(of_nobody) == 1, "once, not for each person or sequence"
    assert of_nobody in judged(seen[0]).reason
    tables = {"annotations": seen, "projections": list(store.artifacts("projections"))}
    parameters = reconstruction_stage.ReconstructionParameters(sequences="given")
    (shard,) = reconstruction_stage.plan(StageInputs(tables, seed=9), parameters)
    motions = store.manifest(reconstruction_stage.run_shard(shard, store))
    for person in (0, 1):
        files = [(tmp_path / f"{video.name}_{person}.npz").read_bytes()]
        files.append(store.attachment(motions.ref, f"{video.name}_{person}.npz"))
        of_command, of_study = (read_npz(data, "motion")["positions_m"] for data in files)
        np.testing.assert_allclose(of_study, of_command, atol=1e-4)
        reason = Verdict.from_json(motions.facts[PARTS_FACT][f"person {person}"]).reason
        assert "stature" not in reason
        assert reason in output.out
