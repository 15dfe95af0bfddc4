"""Live reconstruction: fixed lag, bounded delay, the same choice as offline when the lag is long."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths, forward_kinematics
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.reconstruction.body import SHARED
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.live.chain import EVERYBODY_ELSE, LivePeople
from pasdedeux.reconstruction.live.person import LiveOptions, LivePose
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.reconstruction.people import SequenceOptions, reconstruct_people
from pasdedeux.reconstruction.temporal import FixedLagViterbi, choose_viterbi
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import BODY22, OP14
from tests.builders.walkers import database_of, walk

RATE_HZ = 30.0
SIZE_PX = (1920, 1080)


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    return Searcher.of(database_of([walk(120, seed=seed) for seed in range(6)]))


def video(num_frames: int, *, noise_px: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (frame, 2, 14, 2) of two walkers, and the truth in camera axes."""
    walks = [walk(num_frames, seed=30 + person, rate_hz=RATE_HZ) for person in (0, 1)]
    worlds = np.stack(walks, axis=1) + np.array([[0.0, 0.0, 0.0], [1.3, 0.0, 0.0]])[:, None]
    middle = mid_hip(worlds).mean(axis=(0, 1))
    camera = look_at_camera(middle, distance_m=5.0, yaw_rad=0.4, pitch_rad=0.0, focal_px=1400.0)
    px = camera.project(worlds).px + np.random.default_rng(0).normal(0, noise_px, (*worlds.shape[:-1], 2))
    return px, (worlds - camera.position_m) @ camera.camera_from_world_rotmat.T


def run(people: LivePeople, px: np.ndarray) -> list[LivePose]:
    rng = np.random.default_rng(1)
    poses: list[LivePose] = []
    for frame, points in enumerate(px):
        poses += people.push(frame, points[rng.permutation(len(points))], np.ones(points.shape[:-1]))
    return poses + people.finish()


def test_a_long_lag_is_the_viterbi_of_the_whole_sequence_and_a_short_one_is_near(searcher: Searcher) -> None:
    px, _ = video(40)
    metres = (px[:, 0] - mid_hip(px[:, 0])[:, None]) * np.array([1.0, -1.0]) * 5.0 / 1400.0
    found = searcher.index.search(metres, np.ones(metres.shape[:-1]), num_neighbours=12)
    whole = choose_viterbi(searcher.database, found, rate_hz=RATE_HZ)
    for lag, min_same in ((100, 1.0), (6, 0.8)):
        live = FixedLagViterbi(searcher.database, rate_hz=RATE_HZ, lag=lag)
        decided = []
        for frame in range(40):
            new = live.push(np.array([frame]), found.row[[frame]], found.yaw_index[[frame]], found.distance_m[[frame]])
            assert len(new) == (frame >= lag)
            decided += new
        decided += live.decide_until(39)
        assert len(decided) == 40
        assert np.mean(np.array(decided) == whole) >= min_same
    assert live.decide_until(39) == []


def test_two_people_in_any_order_come_out_near_the_truth_with_bounded_delay(searcher: Searcher) -> None:
    px, truth = video(60)
    people = LivePeople(searcher, rate_hz=RATE_HZ, image_size_px=SIZE_PX, options=LiveOptions(lag=5))
    poses = run(people, px)
    for person in (0, 1):
        poses_of_person = [pose for pose in poses if pose.person_id == person]
        assert [pose.frame for pose in poses_of_person] == list(range(60))
        found = np.stack([pose.positions_m for pose in poses_of_person])
        error = min(root_centred_error_m(found, truth[:, walker]).mean() for walker in (0, 1))
        assert error < 0.15
        np.testing.assert_allclose(mid_hip(found), np.stack([pose.root_m for pose in poses_of_person]), atol=1e-9)


def test_clean_up_can_be_switched_off_and_keeps_bones(searcher: Searcher) -> None:
    px, _ = video(40)
    poses = []
    for has_clean_up in (True, False):
        options = LiveOptions(has_clean_up=has_clean_up)
        people = LivePeople(searcher, rate_hz=RATE_HZ, image_size_px=SIZE_PX, options=options)
        poses.append([pose for pose in run(people, px[:, :1]) if pose.person_id == 0])
    clean_m, plain_m = (np.stack([pose.positions_m for pose in of_person]) for of_person in poses)
    np.testing.assert_allclose(bone_lengths(OP14, clean_m), bone_lengths(OP14, plain_m), atol=1e-9)
    np.testing.assert_allclose(mid_hip(clean_m), np.stack([pose.root_m for pose in poses[0]]), atol=1e-9)
    assert np.abs(clean_m - plain_m).max() > 0


@pytest.mark.parametrize("has_clean_up", [True, False])
def test_no_bone_ever_changes_and_first_poses_wait_for_the_own_bones(searcher: Searcher, has_clean_up: bool) -> None:
    px, _ = video(90)
    px[60:] = px[59:60] + 1.3 * (px[60:] - px[59:60])  # later frames that say otherwise of the person
    options = LiveOptions(lag=4, has_clean_up=has_clean_up)
    people = LivePeople(searcher, rate_hz=RATE_HZ, image_size_px=SIZE_PX, options=options)
    poses: list[LivePose] = []
    for frame in range(90):
        new = people.push(frame, px[frame, :1], np.ones((1, 14)))
        due = [] if frame < 59 else list(range(56)) if frame == 59 else [frame - 4]
        assert [pose.frame for pose in new] == due
        poses += new
    poses += people.finish()
    assert [pose.frame for pose in poses] == list(range(90))
    op14 = np.stack([pose.positions_m for pose in poses])
    body22 = np.stack(
        [forward_kinematics(BODY22, pose.body.offsets_m, pose.pelvis_m, pose.body22_unitquat)[0] for pose in poses]
    )
    for skeleton, joints in ((OP14, op14), (BODY22, body22)):
        assert np.ptp(bone_lengths(skeleton, joints), axis=0).max() < 1e-9
    np.testing.assert_allclose(body22[:, BODY22.indices(SHARED)], op14[:, OP14.indices(SHARED)], atol=1e-8)
    assert np.abs(bone_lengths(OP14, op14[:1])[0] - REFERENCE_LENGTHS_M).max() > 1e-3


def test_a_person_who_leaves_before_the_bones_are_known_is_still_emitted(searcher: Searcher) -> None:
    px, _ = video(90)
    people = LivePeople(searcher, rate_hz=RATE_HZ, options=LiveOptions(lag=4))
    due: list[tuple[int, int]] = []
    for frame in range(90):
        seen = px[frame, : 1 if frame > 20 else 2]
        new = people.push(frame, seen, np.ones(seen.shape[:-1]))
        due += [(frame, pose.frame) for pose in new if pose.person_id == 1]
    assert [frame for _, frame in due] == list(range(21))
    assert {at for at, _ in due} == {59}
    short = LivePeople(searcher, rate_hz=RATE_HZ, options=LiveOptions(lag=4))
    assert [pose.frame for pose in run(short, px[:10, :1])] == list(range(10))


def test_a_pose_leaves_exactly_the_lag_after_its_image_whatever_comes_later(searcher: Searcher) -> None:
    px, _ = video(30)
    options, early = LiveOptions(lag=4, has_own_proportions=False), []
    first, second = (LivePeople(searcher, rate_hz=RATE_HZ, image_size_px=SIZE_PX, options=options) for _ in range(2))
    for frame in range(20):
        new = first.push(frame, px[frame], np.ones((2, 14)))
        assert {pose.frame for pose in new} == ({frame - 4} if frame >= 4 else set())
        early += new
    for frame in range(30):
        points = px[frame] if frame < 20 else px[frame] + 50.0
        for pose in second.push(frame, points, np.ones((2, 14))):
            same = [before for before in early if (before.frame, before.person_id) == (pose.frame, pose.person_id)]
            if same:
                np.testing.assert_array_equal(pose.positions_m, same[0].positions_m)


def test_a_stated_lens_puts_people_as_far_away_as_it_says(searcher: Searcher) -> None:
    px, truth = video(12)
    away = []
    for focal_px in (1400.0, 2800.0):
        people = LivePeople(searcher, rate_hz=RATE_HZ, image_size_px=SIZE_PX, focal_px=focal_px)
        away.append(np.median([-pose.root_m[2] for pose in run(people, px[:, :1])]))
    assert away[1] / away[0] == pytest.approx(2.0, rel=0.05)
    assert away[0] == pytest.approx(-mid_hip(truth)[:12, 0, 2].mean(), rel=0.15)


def test_a_stated_stature_holds_from_the_first_frame_and_gives_the_bones_of_the_video(searcher: Searcher) -> None:
    px, _ = video(70)
    options, found = LiveOptions(has_clean_up=False), []
    for stated in ({}, {0: 1.9}, {0: 1.9, EVERYBODY_ELSE: 1.5}, {EVERYBODY_ELSE: 1.9}):
        people = LivePeople(
            searcher, rate_hz=RATE_HZ, image_size_px=SIZE_PX, statures_m=stated, options=options, focal_px=1400.0
        )
        found.append(np.stack([pose.positions_m for pose in run(people, px[:, :1])]))
    plain, *tall = found
    bones = bone_lengths(OP14, tall[0])
    assert np.ptp(bones, axis=0).max() < 1e-9
    assert body_height_m(OP14, bones[0]) == pytest.approx(1.9)
    growth = 1.9 / body_height_m(OP14, bone_lengths(OP14, plain[0]))
    for positions_m in tall:
        np.testing.assert_allclose(positions_m, growth * plain, atol=1e-9)
    track = Track(px[:, 0], np.ones((70, 14)), RATE_HZ, Lens(1400.0, (960.0, 540.0), is_known=True), 0)
    film = reconstruct_people(searcher, [track], SequenceOptions(statures_m={0: 1.9})).methods[-1].people[0]
    np.testing.assert_allclose(bones[0], bone_lengths(OP14, film.positions_m)[0], atol=0.01)


def test_people_who_leave_are_given_out_within_the_lag_and_gaps_are_bridged_over(searcher: Searcher) -> None:
    px, _ = video(50)
    people = LivePeople(searcher, rate_hz=RATE_HZ, options=LiveOptions(lag=4, has_own_proportions=False))
    due = []
    for frame in range(50):
        if 20 < frame < 26:
            continue
        seen = px[frame, :1] if frame > 10 else px[frame]
        for pose in people.push(frame, seen, np.ones(seen.shape[:-1])):
            due.append((frame, pose.frame, pose.person_id))
    lost = [(at, frame) for at, frame, person in due if person == 1]
    assert max(frame for _, frame in lost) == 10
    assert max(at for at, _ in lost) == 14
    kept = [frame for _, frame, person in due if person == 0]
    assert kept == [frame for frame in range(46) if not 20 < frame < 26]


def test_frames_with_little_or_nothing_seen_give_no_pose(searcher: Searcher) -> None:
    px, _ = video(12)
    people = LivePeople(searcher, rate_hz=RATE_HZ, options=LiveOptions(lag=0, has_own_proportions=False))
    assert people.push(0, np.zeros((0, 14, 2)), np.zeros((0, 14))) == []
    assert people.push(1, np.full((1, 14, 2), np.nan), np.zeros((1, 14))) == []
    scraps = np.zeros((2, 14))
    scraps[:, :3] = 1.0
    assert people.push(2, px[2], scraps) == []
    assert [pose.frame for pose in people.push(3, px[3], np.ones((2, 14)))] == [3, 3]


def test_bad_input_is_named(searcher: Searcher) -> None:
    px, _ = video(3)
    people = LivePeople(searcher, rate_hz=RATE_HZ)
    people.push(2, px[2], np.ones((2, 14)))
    with pytest.raises(InputError, match="frame 1 comes after frame 2"):
        people.push(1, px[1], np.ones((2, 14)))
    with pytest.raises(ValidationError, match="lag"):
        LiveOptions(lag=-1)
    with pytest.raises(ValidationError, match="metres_per_pixel"):
        LiveOptions(metres_per_pixel=0.0)
