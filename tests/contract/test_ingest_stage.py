"""Ingest end to end on small real files: tables, facts, leakage flags, sides, and bad input refused while planning."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.cameras.virtual_video import VirtualView
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.placement import place_motion
from pasdedeux.kinematics.rotations import multiply
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from pasdedeux.verdict import Level, Verdict
from storage_schema import Store
from tasks.evaluation import STAGE as EVALUATION
from tasks.ingest import IngestParameters
from tasks.ingest.takes.parameters import PairOptions
from tasks.ingest.virtual_video import run as virtual_video
from tests.builders.ingest_runs import ingest_take, judged, planned, run, write_figure_pair
from tests.builders.source_samples import AMC, ASF, figure_motion, positions_npz


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return write_figure_pair(tmp_path)


def test_one_of_a_pair_may_lie_on_the_floor_all_the_time(store: Store, pair: tuple[Path, Path]) -> None:
    motion = figure_motion(num_frames=40, rate_hz=60.0)
    lying = motion.local_unitquat.copy()
    onto_x = np.array([0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)])
    lying[:, motion.skeleton.root] = multiply(onto_x, lying[:, motion.skeleton.root])
    pair[0].write_text(write_bvh(dataclasses.replace(motion, local_unitquat=lying)))
    made = ingest_take(store, {"id": "pin", "files": pair}, rate_hz=60.0)
    assert list(store.read(made.ref, "takes")["up_axis"]) == ["y", "y"]
    body = store.read(made.ref, "poses")["body22_m"].reshape(2, 40, 22, 3)
    trunk = body[..., BODY22.index("neck"), :] - body[..., BODY22.root, :]
    assert (np.argmax(np.abs(trunk), axis=-1) == np.array([[0], [1]])).all(), "the first lies along x, the other stands"


def test_another_licence_is_in_no_bytes_so_that_nothing_after_is_computed(
    store: Store, pair: tuple[Path, Path]
) -> None:
    made = []
    for licence in ("CC-BY-4.0", "CC-BY-NC-ND-4.0"):
        take = {"id": "dance", "files": list(pair), "licence": licence, "credit": f"A studio ({licence})"}
        made.append(run(store, planned(takes=[take], rate_hz=30.0)))
        assert made[-1]["dance", "take"].sources[0].licence == licence
    refs = [{place: manifest.ref for place, manifest in found.items()} for found in made]
    assert refs[0] == refs[1], "stage and content are the same"
    assert all(refs[0][place].key != refs[1][place].key for place in refs[0])


def test_a_pair_becomes_takes_poses_annotations_and_cameras(store: Store, pair: tuple[Path, Path]) -> None:
    shards = planned(
        takes=[{"id": "dance", "files": list(pair)}],
        rate_hz=30.0,
        virtual_video={"num_random_views": 6, "noise_px": 0.0},
    )
    assert [(shard.partition, shard.name) for shard in shards] == [
        ("dance", "take"), ("dance", "video"), ("dance", "random_views"),
    ]  # fmt: skip
    assert all(shard.after == (shards[0].key,) for shard in shards[1:])
    manifests = run(store, shards)
    facts = manifests["dance", "take"].facts
    assert facts["takes"] == ["dance"]
    assert (facts["num_persons"], facts["num_frames"], facts["rate_hz"]) == (2, 20, 30.0)
    assert not facts["is_prior"], "nothing is learned from a take that is not named"
    assert not facts["is_held_out"]

    ref = manifests["dance", "take"].ref
    takes = store.read(ref, "takes")
    assert list(takes["source_name"]) == ["60_01.bvh", "61_01.bvh"]
    assert list(takes["layout"]) == ["body22"] * 2
    np.testing.assert_allclose(takes["metres_per_unit"], 0.01)
    poses = store.read(ref, "poses")
    assert poses.num_rows == 40
    expected, unitquat = figure_motion(num_frames=40, rate_hz=60.0).world()
    np.testing.assert_allclose(poses["body22_m"][:20], expected[::2], atol=1e-5)
    assert np.abs(np.abs((poses["body22_world_unitquat"][:20] * unitquat[::2]).sum(-1)) - 1).max() < 1e-5
    np.testing.assert_allclose(poses["time_s"][:20], np.arange(20) / 30.0)

    video = store.read(manifests["dance", "video"].ref, "annotations")
    assert video.num_rows == 40
    assert np.isfinite(video["pair17_px"]).all()
    views = store.read(manifests["dance", "random_views"].ref, "annotations")
    assert int(np.sum(views["is_key"])) == 6 * 2
    assert views.num_rows == 6 * 5 * 2
    assert manifests["dance", "random_views"].facts["purpose"] == "random_views"
    assert manifests["dance", "random_views"].facts["num_frames"] == 6


def test_the_shortest_start_of_takes_is_two_frames_of_files_and_half_a_second_of_duets(
    store: Store, pair: tuple[Path, Path]
) -> None:
    take = {"id": "dance", "files": list(pair)}
    shards = planned(takes=[take], duets=[{"name": "hug"}], rate_hz=20.0, take_seconds=0.001)
    made = run(store, [shard for shard in shards if shard.name == "take"])
    assert {partition: manifest.facts["num_frames"] for (partition, _), manifest in made.items()} == {
        "dance": 1,
        "hug": 10,
    }


def test_virtual_video_shows_the_pose_through_its_stored_camera_unmirrored(
    store: Store, pair: tuple[Path, Path]
) -> None:
    video = {"num_random_views": 3, "noise_px": 0.0, "distance_m": 5.0}
    manifests = run(store, planned(takes=[{"id": "dance", "files": list(pair)}], virtual_video=video))
    poses = store.read(manifests["dance", "take"].ref, "poses")
    for name in ("video", "random_views"):
        ref = manifests["dance", name].ref
        cameras, seen = store.read(ref, "cameras"), store.read(ref, "annotations")
        by_id = {sequence: row for row, sequence in enumerate(cameras["sequence_id"])}
        x, y, z = cameras["camera_from_world_rotmat"][:, 2].T  # from the people to the camera
        np.testing.assert_allclose(cameras["yaw_rad"], np.arctan2(x, z), atol=1e-6)
        np.testing.assert_allclose(cameras["pitch_rad"], np.arcsin(y), atol=1e-6)
        for row in range(0, seen.num_rows, 7):
            camera = by_id[seen["sequence_id"][row]]
            pose = np.flatnonzero(
                (poses["person"] == seen["person_id"][row]) & (poses["frame"] == seen["take_frame"][row])
            )[0]
            for skeleton, column in ((PAIR17, "pair17"), (OP14, "op14")):
                points = poses[f"{column}_m"][pose].astype(np.float64) - cameras["camera_position_m"][camera]
                x, y, z = (points @ cameras["camera_from_world_rotmat"][camera].T).T
                u = cameras["principal_point_px"][camera][0] + cameras["focal_px"][camera] * x / -z
                v = cameras["principal_point_px"][camera][1] - cameras["focal_px"][camera] * y / -z
                np.testing.assert_allclose(seen[f"{column}_px"][row], np.stack([u, v], -1), atol=0.05)
                head, ankle = skeleton.index("head"), skeleton.index("left_ankle")
                assert seen[f"{column}_px"][row][head, 1] < seen[f"{column}_px"][row][ankle, 1]


def test_the_two_skeletons_share_the_noise_of_their_common_joints(store: Store, pair: tuple[Path, Path]) -> None:
    video = {"num_random_views": 0, "noise_px": 5.0, "occlusion": 0.2}
    shards = planned(takes=[{"id": "d", "files": list(pair)}], virtual_video=video)
    seen = store.read(run(store, shards)["d", "video"].ref, "annotations")
    for name in ("left_wrist", "right_knee"):
        np.testing.assert_array_equal(seen["pair17_px"][:, PAIR17.index(name)], seen["op14_px"][:, OP14.index(name)])
    is_missing = np.isnan(seen["pair17_px"]).any(axis=-1)
    np.testing.assert_array_equal(is_missing, seen["pair17_confidence"] == 0)
    assert 0.1 < is_missing.mean() < 0.3


def test_no_path_is_in_a_key(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    copies = [moved / path.name for path in pair]
    for path, copy in zip(pair, copies, strict=True):
        copy.write_bytes(path.read_bytes())
    keys = [[s.key for s in planned(takes=[{"id": "d", "files": list(files)}])] for files in (pair, copies)]
    assert keys[0] == keys[1]
    copies[0].write_bytes(copies[0].read_bytes() + b"\n")
    assert planned(takes=[{"id": "d", "files": copies}])[0].key != keys[0][0]


def test_scales_ranges_and_placement_are_overridden_per_take_and_person(store: Store, pair: tuple[Path, Path]) -> None:
    persons = [{"metres_per_unit": 0.01, "translation_m": [0, 3, 0]}, {"metres_per_unit": 0.02}]
    take = {"id": "d", "files": list(pair)[::-1], "rate_hz": 30.0, "frames": [10, 30]}
    manifest = ingest_take(store, {**take, "floor": "keep", "persons": persons})
    takes, poses = store.read(manifest.ref, "takes"), store.read(manifest.ref, "poses")
    assert list(takes["source_name"]) == ["61_01.bvh", "60_01.bvh"]
    np.testing.assert_allclose(takes["metres_per_unit"], [0.01, 0.02])
    assert manifest.facts["num_frames"] == 20
    first = place_motion(figure_motion(40, 60.0), translation_m=(1.0, 3.0, 0.0), yaw_rad=np.pi).world()[0][10:30]
    second = 2.0 * figure_motion(40, 60.0).world()[0][10:30]
    np.testing.assert_allclose(poses["body22_m"][:20], first, atol=1e-5)
    np.testing.assert_allclose(poses["body22_m"][20:], second, atol=1e-5)


def test_a_take_in_the_air_is_put_on_the_floor_and_one_on_the_floor_is_left(
    store: Store, pair: tuple[Path, Path]
) -> None:
    high = [{"translation_m": [0.0, 5.0, 0.0]}] * 2
    feet = BODY22.indices(["left_toe", "right_toe", "left_ankle", "right_ankle"])
    lowest = {}
    for name, persons in (("low", []), ("high", high)):
        made = ingest_take(store, {"id": name, "files": pair, "persons": persons})
        lowest[name] = store.read(made.ref, "poses")["body22_m"][:, feet, 1].min()
    assert lowest["low"] == pytest.approx(figure_motion(40, 60.0).world()[0][:, feet, 1].min(), abs=1e-5)
    assert abs(lowest["high"]) < 0.02


def test_z_up_files_come_out_standing(store: Store, tmp_path: Path) -> None:
    motion = figure_motion(20)
    # The same motion with its axes renamed x -> y -> z -> x is right-handed and z-up.
    text = re.sub(r"\b[XYZ](?=(position|rotation))", lambda axis: "YZX"["XYZ".index(axis[0])], write_bvh(motion))
    path = tmp_path / "z.bvh"
    path.write_text(re.sub(r"OFFSET (\S+) (\S+) (\S+)", r"OFFSET \3 \1 \2", text))
    made = ingest_take(store, {"id": "z", "files": [path]})
    assert list(store.read(made.ref, "takes")["up_axis"]) == ["z"]
    found = store.read(made.ref, "poses")["body22_m"]
    expected = motion.world()[0]
    head, ankle, left, right = BODY22.indices(["head", "left_ankle", "left_hip", "right_hip"])
    assert (found[:, head, 1] > found[:, ankle, 1] + 1).all()
    # Not mirrored: all distances and one signed volume agree.
    volume = [np.linalg.det(p[0][[head, left, ankle]] - p[0][right]) for p in (found, expected)]
    assert volume[0] == pytest.approx(volume[1], rel=1e-3)


def test_held_out_takes_have_no_random_views_and_are_no_prior(store: Store, pair: tuple[Path, Path]) -> None:
    takes = [{"id": "a", "files": list(pair), "frames": [0, 20]}, {"id": "b", "files": list(pair), "frames": [20, 40]}]
    shards = planned(takes=takes, held_out=["b"])
    names = [(shard.partition, shard.name) for shard in shards]
    assert ("a", "random_views") in names
    assert ("b", "random_views") not in names
    manifests = run(store, [shard for shard in shards if shard.partition == "b"])
    assert not manifests["b", "take"].facts["is_prior"]
    for manifest in manifests.values():
        assert (manifest.facts["is_held_out"], manifest.facts["takes"]) == (True, ["b"])


def test_a_study_that_names_nothing_gets_the_built_in_duets_and_others_do_not(pair: tuple[Path, Path]) -> None:
    parameters = IngestParameters()
    assert [duet.name for duet in parameters.resolved_duets()] == ["waltz", "hug", "judo", "push_hands"]
    assert IngestParameters.model_validate({"takes": [{"id": "d", "files": list(pair)}]}).resolved_duets() == ()


def test_a_duet_becomes_a_take(store: Store) -> None:
    shards = planned(duets=[{"name": "waltz", "duration_s": 1.0, "id": "w"}], virtual_video={"num_random_views": 2})
    manifests = run(store, shards)
    manifest = manifests["w", "take"]
    assert manifest.facts["num_frames"] == 30
    assert list(store.read(manifest.ref, "takes")["source_format"]) == ["duet"] * 2
    assert manifests["w", "random_views"].sources == manifest.sources
    assert manifest.sources[0].licence == "Apache-2.0"


def test_families_of_files_are_paired_by_name(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    section = {"folder": tmp_path, "subjects": ["60", "61"], "takes": ["01"], "rate_hz": 60.0}
    shards = planned(pairs={"salsa": section})
    assert shards[0].parameters.take_id == "60_01"
    assert [person.source_name for person in shards[0].parameters.persons] == ["60_01.bvh", "61_01.bvh"]
    with pytest.raises(InputError, match=r"file 60_02.bvh or 60_02.amc does not exist in"):
        planned(pairs={"salsa": section | {"takes": ["02"]}})


def test_a_family_without_names_is_what_is_there_and_says_what_it_skips_and_awaits(
    tmp_path: Path, pair: tuple[Path, Path]
) -> None:
    for name in ("60_02", "60_a b", "61_a b", "61_03"):
        (tmp_path / f"{name}.bvh").write_bytes(pair[0].read_bytes().replace(b"ROOT", b"ROOT" + b" " * len(name)))
    (tmp_path / "60_03.bvh").write_text("no motion")
    family = {"folder": tmp_path, "subjects": ["60", "61"], "rate_hz": 60.0, "is_watched": True}
    takes = {(shard.partition, shard.name): shard for shard in planned(pairs={"salsa": family}, held_out=["60_09"])}
    assert ("60_01", "take") in takes
    skipped = takes["salsa", "skipped"].parameters.skipped
    assert set(skipped) == {"60_02", "60_03", "60_a b", "60_09"}
    assert skipped["60_02"] == f"file 61_02.bvh or 61_02.amc does not exist in {tmp_path}"
    assert "60_03.bvh" in skipped["60_03"]
    assert skipped["60_a b"] == "'60_a b' cannot be the name of a take"
    assert skipped["60_09"] == "the study names it, and it has not come yet"
    whole = [shard for shard in planned(pairs={"salsa": family | {"takes": ["01"]}}) if shard.name == "skipped"]
    assert whole == [], "nothing is skipped of what is named"
    assert planned(pairs={"salsa": family | {"takes": []}}) == []


def test_files_of_a_family_are_found_by_any_pattern(tmp_path: Path) -> None:
    for name in ("a/60-a.bvh", "a/60-b.bvh", "b/61-b.bvh", "c/62-c.bvh", "b/x/61-b.bvh"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    family = PairOptions(
        folder=tmp_path, subjects=("60", "61"), pattern="{take}/{subject}-{take}.bvh", id="{take}.{subject}"
    )
    assert family.take_names() == ("a", "b")
    assert family.take_id("b") == "b.60"
    for change, words in (
        ({"pattern": "{subject}.bvh"}, "it must contain {take}"),
        ({"id": "{take}_{who}"}, "only {subject} and {take} may stand in braces"),
        ({"id": "{take}{"}, "only {subject} and {take}"),
    ):
        with pytest.raises(ValidationError, match=re.escape(words)):
            PairOptions.model_validate({"folder": tmp_path, "subjects": ["60"], **change})


def test_amc_files_find_their_skeleton_and_rate(tmp_path: Path) -> None:
    (tmp_path / "60_01.amc").write_text(AMC)
    with pytest.raises(InputError, match=r"take t: 60_01.amc: its skeleton 60_01.asf or 60.asf is not beside it"):
        planned(takes=[{"id": "t", "files": [tmp_path / "60_01.amc"]}])
    (tmp_path / "60.asf").write_text(ASF)
    with pytest.raises(InputError, match="its joints fit none of the known layouts"):
        planned(takes=[{"id": "t", "files": [tmp_path / "60_01.amc"]}])


def test_positions_without_rotations_are_flagged(store: Store, tmp_path: Path) -> None:
    path = tmp_path / "p.npz"
    path.write_bytes(positions_npz())
    made = ingest_take(store, {"id": "p", "files": [path]})
    assert list(store.read(made.ref, "takes")["is_position_only"]) == [True]


def test_a_take_is_doubted_where_its_unit_was_guessed_or_it_has_one_person_only(
    store: Store, pair: tuple[Path, Path]
) -> None:
    # The figure of the tests slides and leans, and both people are it.
    wide = {"skate_m_s": [9, 9], "twin_m": [0, 0], "body_difference_m": [0, 0], "tilt_rad": [9, 9]}

    def verdict(**take: Any) -> Verdict:
        return judged(ingest_take(store, {"id": "dance", "files": pair, **take}, capture={"limits": wide}))

    two, alone = verdict(), verdict(files=[pair[0]])
    assert (two.level, two.reason) == (Level.PASS, "")
    assert two.value >= 0.5
    assert (alone.level, alone.reason) == (Level.WARN, "it has one person only: what needs pairs passes it over")
    for path, x in zip(pair, (0.0, 1.0), strict=True):  # in inches a person of 1.4 m
        placed = place_motion(figure_motion(40, 60.0), translation_m=(x, 0.0, 0.0), yaw_rad=0.0)
        path.write_text(write_bvh(placed, units_per_metre=32.0))
    assert verdict().level is Level.WARN
    assert "its length unit is a guess" in verdict().reason
    assert verdict(metres_per_unit=1 / 32.0).level is Level.PASS


def test_a_take_whose_capture_fails_is_kept_and_marked_or_skipped_loudly(store: Store, pair: tuple[Path, Path]) -> None:
    kept, left = (
        run(store, planned(takes=[{"id": "d", "files": list(pair)}], capture={"skip_failing": is_out}))
        for is_out in (False, True)
    )
    assert {"poses", "takes", "take_quality"} == set(kept["d", "take"].tables)
    assert judged(kept["d", "take"]).level is Level.FAIL
    assert "the same motion twice" in judged(kept["d", "take"]).reason
    quality = store.read(kept["d", "take"].ref, "take_quality")
    assert list(quality["verdict"]) == ["fail", "fail"]
    assert all("the same motion twice" in reason for reason in quality["reason"])
    assert quality["twin_m"] == pytest.approx(0.0, abs=1e-6)
    assert set(left["d", "take"].tables) == {"take_quality"}
    assert "take_quality" in EVALUATION.reads, "or the report does not say so"
    for name in ("take", "video", "random_views"):
        (said,) = left["d", name].facts["skipped"]
        assert said.startswith("Take d was skipped, its capture fails: ")
    assert not left["d", "video"].tables
    assert judged(left["d", "take"]).level is Level.FAIL


@pytest.mark.slow
def test_salsa_takes_in_which_a_foot_jumps_fail(store: Store, data_dir: Path) -> None:
    salsa = {"folder": data_dir / "cmu_salsa_bvh", "subjects": ["60", "61"], "takes": ["04", "07"], "id": "{take}"}
    found = run(store, [shard for shard in planned(pairs={"s": salsa}) if shard.name == "take"])
    quiet = judged(found["07", "take"])
    assert (quiet.level, quiet.reason[:48]) == (Level.WARN, "A: jumps by 0.28 m out of its first frame, perha")
    assert "A: the left_toe jumps by 0.60 m at 5.73 s" in judged(found["04", "take"]).reason


def test_a_video_is_judged_by_the_share_of_the_joints_in_its_image(
    tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    video = {"num_videos": 2, "num_random_views": 0}
    shards = planned(takes=[{"id": "d", "files": list(pair)}], virtual_video=video)
    levels = {"large": judged(run(Store(tmp_path / "large"), shards)["d", "video"])}
    take_whole = virtual_video.frame_take

    def take_middle(*args: Any, **kwargs: Any) -> VirtualView:
        view = take_whole(*args, **kwargs)
        middle = {"principal_point_px": np.full(2, 100.0), "image_size_px": (200, 200)}
        return dataclasses.replace(view, camera=dataclasses.replace(view.camera, **middle))

    monkeypatch.setattr(virtual_video, "frame_take", take_middle)
    levels["small"] = judged(run(Store(tmp_path / "small"), shards)["d", "video"])
    assert (levels["large"].level, levels["large"].value) == (Level.PASS, 100.0)
    assert levels["small"].level is Level.FAIL
    assert levels["small"].value < 50
