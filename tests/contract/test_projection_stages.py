"""The stages `projections` and `reconstruction` keep their promises over a real store."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths, forward_kinematics
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.body import REFERENCE_REST_M, SHARED
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.matching import Method
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from storage_schema import ArtifactRef, Manifest, Store, source_credits
from tasks import projections, reconstruction
from tasks.stage import StageInputs
from tests.builders.storage_rows import put, random_columns
from tests.builders.walkers import walk
from tests.builders.walking_takes import put_take


def put_video(
    store: Store, sequence_id: str, takes: list[str], *, purpose: str = "video", **stated: Any
) -> tuple[Manifest, np.ndarray]:
    """Return the artifact of a sequence of two people, and the truth (person, frame, 14, 3) in camera axes."""
    frames = 40
    worlds = np.stack(
        [walk(frames, seed=40 + person, rate_hz=30.0) + np.array([1.2 * person, 0, 0]) for person in range(2)]
    )
    camera = look_at_camera(
        mid_hip(worlds).mean(axis=(0, 1)), distance_m=4.0, yaw_rad=0.5, pitch_rad=0.15, focal_px=1400.0
    )
    px = camera.project(worlds).px
    px[1, 10:13] = np.nan
    count = 2 * frames
    frame = np.tile(np.arange(frames), 2)
    columns = random_columns("annotations", count) | {
        "sequence_id": [sequence_id] * count,
        "frame": frame,
        "person_id": np.repeat([0, 1], frames),
        "partner_id": np.repeat([1, 0], frames),
        "time_s": frame / 30.0,
        "take_id": [takes[0] if takes else None] * count,
        "op14_px": px.reshape(count, 14, 2),
        "op14_confidence": np.isfinite(px).all(axis=-1).astype(float).reshape(count, 14),
        "image_width_px": [1920] * count,
        "image_height_px": [1080] * count,
        "focal_px": [None] * count,
    }
    facts = {"kind": "sequences", "takes": takes, "sequence_ids": [sequence_id], "is_held_out": True}
    facts |= {"purpose": purpose, "num_frames": frames, **stated}
    manifest = put(store, "ingest", sequence_id, {"annotations": columns}, facts)
    return manifest, (worlds - camera.position_m) @ camera.camera_from_world_rotmat.T


def build(
    store: Store, takes: list[Manifest], *, settings: dict[str, Any] | None = None, **tables: list[Manifest]
) -> list[Manifest]:
    inputs = StageInputs({"poses": takes, **tables}, seed=0)
    parameters = projections.ProjectionsParameters(include_draws="draws" in tables, **(settings or {}))
    return [store.manifest(projections.run_shard(shard, store)) for shard in projections.plan(inputs, parameters)]


def reconstruct(
    store: Store, annotations: list[Manifest], databases: list[Manifest], **settings: Any
) -> list[ArtifactRef]:
    inputs = StageInputs({"annotations": annotations, "projections": databases}, seed=0)
    parameters = reconstruction.ReconstructionParameters(**settings)
    return [reconstruction.run_shard(shard, store) for shard in reconstruction.plan(inputs, parameters)]


def test_takes_that_are_not_held_out_become_poses_at_the_rate_of_the_database(store: Store) -> None:
    built = build(store, [put_take(store, "a"), put_take(store, "b", is_held_out=True)])
    assert [manifest.facts["takes"] for manifest in built] == [["a"]]
    table = store.read(built[0].ref, "projections")
    assert table.num_rows == 2 * 72  # 90 frames at 30 Hz, 24 Hz
    assert np.flatnonzero(table["is_sequence_start"]).tolist() == [0, 72]
    np.testing.assert_allclose(mid_hip(np.asarray(table["op14_m"], dtype=float)), 0.0, atol=1e-6)
    played, _ = forward_kinematics(
        BODY22, REFERENCE_REST_M, np.zeros((144, 3)), np.asarray(table["body22_unitquat"], dtype=float)
    )
    across = [
        joints[:, skeleton.index("left_hip")] - joints[:, skeleton.index("right_hip")]
        for joints, skeleton in ((played, BODY22), (np.asarray(table["op14_m"], dtype=float), OP14))
    ]
    np.testing.assert_allclose(*map(normalise, across), atol=0.05, err_msg="rotations face where the pose does")
    assert set(table["origin"]) == {"take"}
    assert [credit.name for credit in source_credits(store, built[0].ref)] == ["made up"]


def test_draws_enter_when_asked_with_all_the_takes_they_come_from(store: Store) -> None:
    drawn_pairs = np.random.default_rng(0).normal(size=(2, 2, 17, 3))
    draws = []
    for density in ("prior_only", "ic", "repaired"):
        rows = random_columns("draws", 2) | {"density": [density] * 2, "take_id": ["a", None]}
        rows["pair17_m"] = drawn_pairs if density == "ic" else -drawn_pairs
        facts = {"takes": ["a", "c"], "density": density, "num_starts": 2 * (density == "repaired")}
        sampled = density.replace("repaired", "ic")
        draws.append(put(store, "chains", density, {"draws": rows}, facts, density=sampled))
    asked = projections.ProjectionsParameters(include_draws=True)
    for given, entering in [(draws, draws[1]), ([draws[0], draws[2]], draws[2])]:
        (shard,) = projections.plan(StageInputs({"draws": given}, seed=0), asked)
        assert shard.all_inputs == (entering.ref,), "repaired pairs enter where no chain draws"
    take, drawn = build(store, [put_take(store, "a")], draws=draws)
    assert take.facts["takes"] == ["a"]
    assert drawn.facts["takes"] == ["a", "c"]
    table = store.read(drawn.ref, "projections")
    assert table["origin"][0] == "draw"
    assert drawn.inputs == (draws[1].ref,)
    assert table["frame"].tolist() == [0, 1, 0, 1]
    assert table["is_sequence_start"].all()
    assert list(table["take_id"]) == ["a", "", "a", ""]
    assert table["partner_row"].tolist() == [2, 3, 0, 1]
    refs = [take.ref, drawn.ref]
    pairs = projections.read_pairs(store, refs)
    assert pairs.shape == (72 + 2, 2, 14, 3)
    assert len(projections.read_pairs(store, refs, max_pairs=30)) == 24 + 1  # every third
    # The people of a draw stand to each other as they were drawn: retargeting keeps the mid-hips.
    across = np.diff(mid_hip(pairs[72:74]), axis=1)[:, 0]
    truth = np.diff(mid_hip(op14_from_working(drawn_pairs, PAIR17)), axis=1)[:, 0]
    np.testing.assert_allclose(across[:, 1], truth[:, 1], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(across, axis=-1), np.linalg.norm(truth, axis=-1), atol=1e-5)
    np.testing.assert_allclose(across[:, 2], 0.0, atol=1e-5)


def test_a_sequence_is_never_matched_against_its_own_take(store: Store) -> None:
    built = build(store, [put_take(store, name) for name in "abc"])
    video, _ = put_video(store, "seen", ["b"])
    (ref,) = reconstruct(store, [video], built)
    allowed = {store.manifest(read).facts["takes"][0] for read in store.manifest(ref).inputs if read != video.ref}
    assert allowed == {"a", "c"}
    assert store.manifest(ref).facts["database_takes"] == ["a", "c"]
    assert "b" not in set(store.read(ref, "motions")["match_take_id"])


def test_motions_are_near_the_truth_finite_and_written_as_bvh(store: Store) -> None:
    built = build(store, [put_take(store, name) for name in "abcd"])
    video, truth = put_video(store, "film", ["held"])
    (ref,) = reconstruct(store, [video], built)
    table, manifest = store.read(ref, "motions"), store.manifest(ref)
    assert table.num_rows == 4 * 2 * 40
    positions, bodies = (table[name].astype(float) for name in ("op14_m", "body22_m"))
    assert np.isfinite(positions).all()
    shared = np.linalg.norm(bodies[:, BODY22.indices(SHARED)] - positions[:, OP14.indices(SHARED)], axis=-1)
    assert shared.max() < 1e-5
    for name, person in product(("nearest", "viterbi", "fit", "fit_clean"), (0, 1)):
        chosen = (table["method"] == name) & (table["person_id"] == person)
        assert table["frame"][chosen].tolist() == list(range(40))
        assert root_centred_error_m(positions[chosen], truth[person]).mean() < 0.12
        assert np.ptp(bone_lengths(BODY22, bodies[chosen]), axis=0).max() < 2e-6  # stored as float32
        assert np.ptp(bone_lengths(OP14, positions[chosen]), axis=0).max() < 2e-6
    is_bridged = table["is_bridged"]
    of_a, of_b = ((table["method"] == "viterbi") & (table["person_id"] == person) for person in (0, 1))
    assert np.count_nonzero(is_bridged & of_b) == 3
    assert set(table["match_take_id"][is_bridged]) == {""}
    assert sorted(manifest.attachments) == ["film_0.bvh", "film_0.npz", "film_1.bvh", "film_1.npz"]
    assert manifest.facts["skipped"] == []
    assert 0.0 < manifest.facts["pitch_deviation_deg"] < 10.0
    assert manifest.facts["camera_height_m"] > 0.0
    # The two people stand in one frame, person 1 on the truth's side of person 0.
    apart = positions[of_b].mean(axis=(0, 1)) - positions[of_a].mean(axis=(0, 1))
    np.testing.assert_allclose(apart, truth[1].mean(axis=(0, 1)) - truth[0].mean(axis=(0, 1)), atol=0.5)


def test_a_film_of_a_take_is_made_with_a_level_camera_as_well_in_which_people_lean(store: Store) -> None:
    built = build(store, [put_take(store, name) for name in "ab"])
    video, _ = put_video(store, "film", ["held"], purpose="given")
    (ref,) = reconstruct(store, [video], built, methods=(Method.NEAREST,))
    table, lean_deg = store.read(ref, "motions"), {}
    assert sorted(table["method"]) == ["level"] * 80 + ["nearest"] * 80 + ["nearest_clean"] * 80
    for name in ("level", "nearest_clean"):
        pose = table["op14_m"][table["method"] == name].astype(float)
        up = (pose[:, OP14.index("neck")] - mid_hip(pose)).mean(axis=0)
        lean_deg[name] = np.rad2deg(np.arctan2(up[2], up[1]))
    pitch_deg = store.manifest(ref).facts["pitch_deg"]
    assert pitch_deg > 5.0
    assert lean_deg["nearest_clean"] - lean_deg["level"] == pytest.approx(pitch_deg, abs=1.0)


def test_the_body_of_a_draw_does_not_depend_on_the_draws_beside_it() -> None:
    poses = np.random.default_rng(1).normal(size=(6, 14, 3))
    np.testing.assert_array_equal(projections.bodies_of_op14(poses)[:2], projections.bodies_of_op14(poses[:2]))


def test_which_sequences_are_reconstructed_follows_their_purpose(store: Store) -> None:
    video, _ = put_video(store, "video", ["t"])
    given, _ = put_video(store, "given", [], purpose="given")
    views, _ = put_video(store, "views", ["t"], purpose="random_views")
    inputs = StageInputs({"annotations": [video, given, views], "projections": []}, seed=0)
    for choice, expected in (("held_out", ["video", "given"]), ("given", ["given"]), ("all", ["video", "given"])):
        parameters = reconstruction.ReconstructionParameters(sequences=choice)
        assert [shard.partition for shard in reconstruction.plan(inputs, parameters)] == expected


@pytest.mark.parametrize("stated", [{"camera_height_m": 2.2}, {"statures_m": {"0": 2.2, "1": 2.2}}])
def test_a_stated_height_of_the_camera_or_of_people_gives_them_their_size(store: Store, stated: dict[str, Any]) -> None:
    databases = build(store, [put_take(store, "a")], settings={"pitches_deg": (8.0,)})
    legs = []
    for facts in ({}, stated):
        video, _ = put_video(store, f"film{len(facts)}", [], purpose="given", **facts)
        (ref,) = reconstruct(store, [video], databases, methods=("fit",))
        op14 = store.read(ref, "motions")["op14_m"]
        legs.append(np.linalg.norm(np.diff(op14[:, OP14.legs[0][1:]], axis=1), axis=-1).mean())
    assert legs[1] > 1.2 * legs[0]


def test_without_a_database_or_a_person_nothing_is_made_up_and_the_reason_is_kept(store: Store) -> None:
    video, _ = put_video(store, "film", ["a"])
    only_own = build(store, [put_take(store, "a")])
    (ref,) = reconstruct(store, [video], only_own)
    assert store.read(ref, "motions").num_rows == 0
    assert "no projection database" in store.manifest(ref).facts["skipped"][0]


def test_cameras_reach_the_database_and_who_reads_it(store: Store) -> None:
    built = build(store, [put_take(store, name) for name in "ab"], settings={"pitches_deg": (8.5,)})
    assert projections.read_cameras(built) == (DatabaseCamera(np.deg2rad(8.5)),)
    video, truth = put_video(store, "film", ["held"])
    (ref,) = reconstruct(store, [video], built, methods=("nearest", "fit"))
    facts, table = store.manifest(ref).facts, store.read(ref, "motions")
    assert facts["pitch_deg"] == pytest.approx(8.5)
    assert facts["num_projections"] == 30 * 4 * 72
    chosen = (table["method"] == "fit") & (table["person_id"] == 0)
    assert root_centred_error_m(table["op14_m"][chosen].astype(float), truth[0]).mean() < 0.12


@pytest.mark.parametrize("pitches_deg", [(), (90.0,)])
def test_views_that_cannot_be_are_refused_with_the_study(pitches_deg: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="pitches_deg"):
        projections.ProjectionsParameters(pitches_deg=pitches_deg)


def test_parts_of_other_views_or_of_none_make_no_database(store: Store) -> None:
    built = build(store, [put_take(store, "a")])
    of_other_views = build(store, [put_take(store, "b")], settings={"pitches_deg": (1.0,)})
    with pytest.raises(InputError, match="differ in their cameras"):
        projections.read_database(store, [part.ref for part in (*built, *of_other_views)])
    with pytest.raises(InputError, match="run its study again"):
        projections.read_cameras([put_take(store, "c")])


def test_clusters_come_where_a_study_asks_for_them_and_the_published_method_needs_them(store: Store) -> None:
    takes, (video, truth) = [put_take(store, name) for name in "ba"], put_video(store, "film", ["held"])
    *parts, clusters = build(store, takes, settings={"num_clusters": 20, "pitches_deg": (0.0,)})
    assert [part.ref for part in build(store, takes, settings={"pitches_deg": (0.0,)})] == [
        part.ref for part in parts
    ], "a database is the same with clusters and without"
    assert clusters.facts["takes"] == ["a", "b"]
    found = projections.read_clusters(store, clusters.ref)
    assert sorted(np.concatenate(found.members).tolist()) == list(range(30 * 4 * 72))
    inputs = {"annotations": [video], "projections": parts[::-1], "projection_clusters": [clusters]}
    parameters = reconstruction.ReconstructionParameters(methods=("nearest", "published"))
    (shard,) = reconstruction.plan(StageInputs(inputs, seed=0), parameters)
    assert shard.refs("projections") == tuple(part.ref for part in parts), "projections are numbered in this order"
    table = store.read(reconstruction.run_shard(shard, store), "motions")
    for person in range(2):
        is_mine = (table["method"] == "published") & (table["person_id"] == person)
        assert root_centred_error_m(table["op14_m"][is_mine].astype(float), truth[person]).mean() < 0.2
    for lacking in ({"projections": parts[:1]}, {"projection_clusters": []}):
        with pytest.raises(InputError, match=r"film: .* has no clusters; .* set num_clusters \(500 in the paper\)"):
            reconstruction.plan(StageInputs(inputs | lacking, seed=0), parameters)


def test_a_study_of_the_published_method_without_clusters_is_refused_before_any_work() -> None:
    sections: dict[str, Any] = {
        "projections": projections.ProjectionsParameters(),
        "reconstruction": reconstruction.ReconstructionParameters(methods=("published",)),
    }
    with pytest.raises(InputError, match=r"set num_clusters \(500 in the paper\) of \[projections\]"):
        reconstruction.check_study(sections)
    reconstruction.check_study(sections | {"projections": projections.ProjectionsParameters(num_clusters=500)})
