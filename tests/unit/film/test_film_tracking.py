"""Track joints between key frames of rendered film, whose truth is known: gaps, hidden joints, cuts, rates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, interp1d

from pasdedeux.errors import InputError
from pasdedeux.film.annotating import AnnotatedShot, annotate_shot, correct_keypoint, frames_to_correct, with_identities
from pasdedeux.film.drawing import contact_sheet, draw_people
from pasdedeux.film.shots import ShotFinder, at_constant_rate, constant_rate_hz
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, join_frames
from pasdedeux.skeletons import PAIR17
from tests.builders.rendered_film import Film, duet_bodies, render, rows_of, salsa_bodies

EVERY = 15
WRIST = PAIR17.index("left_wrist")


@pytest.fixture(scope="module")
def waltz() -> Film:
    return render(duet_bodies("waltz", seconds=1.55), yaw_rad=0.2, seed=9)


@pytest.fixture(scope="module")
def salsa(data_dir: Path) -> Film:
    return render(salsa_bodies(data_dir, "07", slice(300, 346)), yaw_rad=2.0, seed=1)


def keys_of(film: Film, **options: float) -> AnnotatedFrames:
    return rows_of(film, sorted({*range(0, len(film.px), EVERY), len(film.px) - 1}), **options)


@pytest.fixture(scope="module")
def tracked(waltz: Film) -> AnnotatedShot:
    """Return the waltz tracked between its key frames."""
    return annotated(waltz, keys_of(waltz))


def annotated(film: Film, given: AnnotatedFrames, *, is_key: bool = True) -> AnnotatedShot:
    return annotate_shot(given, iter(film.images), 0, len(film.images), is_key=is_key)


def by_frame(film: Film, frames: AnnotatedFrames) -> tuple[np.ndarray, np.ndarray]:
    """Return places and statuses (frame, person, joint) as the truth has them."""
    px, status = np.full(film.px.shape, np.nan), np.zeros(film.px.shape[:-1], dtype=int)
    px[frames.frame, frames.person_id] = frames.keypoints_px
    status[frames.frame, frames.person_id] = frames.status
    return px, status


def error_of(film: Film, px: np.ndarray, chosen: np.ndarray) -> float:
    """Return the mean distance from the truth in body heights."""
    return float(np.linalg.norm(px - film.px, axis=-1)[chosen].mean()) / film.height_px


@pytest.mark.parametrize("name", ["waltz", "salsa"])
def test_between_key_frames_half_a_second_apart_joints_are_tracked_better_than_they_are_interpolated(
    name: str, request: pytest.FixtureRequest
) -> None:
    film: Film = request.getfixturevalue(name)
    given = keys_of(film)
    px, status = by_frame(film, annotated(film, given).frames)
    keys = np.unique(given.frame)
    is_between = ~np.isin(np.arange(len(px)), keys)[:, None, None] & film.is_visible
    linear, spline = (kind(keys, film.px[keys], axis=0)(np.arange(len(px))) for kind in (interp1d, CubicSpline))
    tracked = error_of(film, px, is_between)
    assert tracked < 0.02
    assert tracked < 0.5 * error_of(film, linear, is_between)
    assert tracked < error_of(film, spline, is_between)
    assert (status[is_between] > KeypointStatus.MISSING).all()
    assert (status[is_between] == KeypointStatus.TRACKED).mean() > 0.85
    assert (status[keys] == KeypointStatus.ANNOTATED).all()


def test_less_confident_places_are_less_exact(salsa: Film) -> None:
    shot = annotated(salsa, keys_of(salsa, hidden=0.0))
    px, status = by_frame(salsa, shot.frames)
    confidence = np.zeros(status.shape)
    confidence[shot.frames.frame, shot.frames.person_id] = shot.frames.confidence
    filled = salsa.is_visible & np.isin(status, [KeypointStatus.TRACKED, KeypointStatus.INTERPOLATED])
    doubted, sure = filled & (confidence < 0.8), filled & (confidence > 0.9)
    assert error_of(salsa, px, doubted) > 1.5 * error_of(salsa, px, sure)


def test_a_joint_that_key_frames_say_is_hidden_is_not_dragged_along(waltz: Film) -> None:
    given = keys_of(waltz)
    is_late = (given.frame >= EVERY) & (given.person_id == 0)
    confidence = given.confidence.copy()
    confidence[np.ix_(is_late, [WRIST])] = 0.0
    _, status = by_frame(waltz, annotated(waltz, replace(given, confidence=confidence)).frames)
    track = status[:, 0, WRIST]
    assert (track[1:5] == KeypointStatus.TRACKED).all()
    assert (track[10:] == KeypointStatus.MISSING).all()


def test_the_gaps_of_a_detector_are_filled_and_its_places_kept(waltz: Film) -> None:
    rng = np.random.default_rng(3)
    given = rows_of(waltz, [*range(len(waltz.px))])
    confidence = np.where(rng.random(given.confidence.shape) < 0.2, 0.0, given.confidence)
    confidence[np.ix_((given.frame >= 20) & (given.frame < 26), [WRIST])] = 0.0
    px, status = by_frame(waltz, annotated(waltz, replace(given, confidence=confidence), is_key=False).frames)
    filled = np.isin(status, [KeypointStatus.TRACKED, KeypointStatus.INTERPOLATED]) & waltz.is_visible
    assert filled.sum() > 100
    assert error_of(waltz, px, filled) < 0.01
    np.testing.assert_allclose(px[status == KeypointStatus.DETECTED], waltz.px[status == KeypointStatus.DETECTED])
    assert (status[20:26, :, WRIST] > KeypointStatus.MISSING).all()


def test_who_is_gone_for_long_is_missing_meanwhile_and_comes_back_as_the_same(waltz: Film) -> None:
    given = rows_of(waltz, [*range(len(waltz.px))])
    is_gone = (given.person_id == 1) & (given.frame >= 5) & (given.frame < 40)
    noise = np.random.default_rng(0).integers(0, 256, (35, *waltz.images[0].shape), dtype=np.uint8)
    film = replace(waltz, images=[*waltz.images[:5], *noise, *waltz.images[40:]])
    shot = annotated(film, given.rows(~is_gone), is_key=False)
    _, status = by_frame(waltz, shot.frames)
    assert (status[16:29, 1] == KeypointStatus.MISSING).all()
    assert set(shot.frames.person_id.tolist()) == {0, 1}
    assert (status[40:, 1] == KeypointStatus.DETECTED).all()


def test_key_frames_without_numbers_of_several_people_are_refused_and_one_person_needs_none(waltz: Film) -> None:
    given = replace(keys_of(waltz), has_identities=False)
    with pytest.raises(InputError, match="do not number the people"):
        with_identities(given, is_key=True)
    assert with_identities(given.rows(given.person_id == 1), is_key=True).has_identities


def test_the_frames_to_correct_are_those_of_a_wrong_key_frame(waltz: Film) -> None:
    given = keys_of(waltz)
    points = given.keypoints_px.copy()
    points[np.ix_((given.frame == 2 * EVERY) & (given.person_id == 0), [WRIST])] += 40.0
    wanted = frames_to_correct(annotated(waltz, replace(given, keypoints_px=points)), 3)
    assert EVERY < wanted[0] < 3 * EVERY
    assert np.diff(sorted(wanted)).min() >= 5


def test_the_frames_to_correct_are_those_in_which_a_detector_jumps(waltz: Film) -> None:
    given = rows_of(waltz, [*range(len(waltz.px))])
    points = given.keypoints_px.copy()
    points[np.ix_((given.frame == 20) & (given.person_id == 1), [PAIR17.index("neck")])] += 30.0
    wanted = frames_to_correct(annotated(waltz, replace(given, keypoints_px=points), is_key=False), 1)
    assert abs(wanted[0] - 20) <= 1


def test_larger_film_is_tracked_as_well_in_smaller_images() -> None:
    film = render(duet_bodies("waltz", seconds=0.5, frames=slice(7)), size=(1280, 720), yaw_rad=0.2, blur=1)
    px, _ = by_frame(film, annotated(film, rows_of(film, [0, len(film.px) - 1])).frames)
    is_between = film.is_visible.copy()
    is_between[[0, -1]] = False
    assert error_of(film, px, is_between) < 0.01


def test_shots_begin_at_cuts_and_neither_at_flashes_nor_where_the_camera_turns(waltz: Film, salsa: Film) -> None:
    images = [*waltz.images[:20], *salsa.images[:20], *waltz.images[20:40]]
    images[10] = np.full_like(images[10], 250)
    finder = ShotFinder()
    for image in images:
        finder.add(image)
    assert finder.starts() == [0, 20, 40]


def test_rates_follow_from_time_stamps_also_rounded_ones() -> None:
    assert constant_rate_hz(np.round(np.arange(50) / 29.97, 3)) == (pytest.approx(29.97, rel=1e-3), True)
    uneven = np.cumsum(np.r_[0.0, np.where(np.arange(49) % 3 == 0, 0.08, 0.04)])
    rate_hz, is_constant = constant_rate_hz(uneven)
    assert (round(rate_hz), is_constant) == (25, False)


def test_film_of_a_variable_rate_is_annotated_at_a_constant_one() -> None:
    time_s = np.cumsum(np.r_[0.0, np.where(np.arange(29) % 3 == 0, 0.08, 0.04)])
    steady = np.stack([100.0 + 50.0 * time_s, 200.0 - 30.0 * time_s], axis=-1)
    points = np.repeat(steady[:, None], 17, axis=1) + np.arange(17)[:, None]
    frames = AnnotatedFrames(
        "coco17", ("s",) * 30, np.arange(100, 130), np.zeros(30, dtype=int), points, np.ones((30, 17)), rate_hz=25.0
    )
    found = at_constant_rate(frames, 100, time_s, 25.0)
    assert found.frame.tolist() == list(range(int(time_s[-1] * 25.0 + 1e-6) + 1))
    expected = 100.0 + 50.0 * found.frame / 25.0
    np.testing.assert_allclose(found.keypoints_px[:, 0, 0], expected, atol=1e-9)


def test_faces_are_blurred_unless_asked_otherwise_and_people_are_drawn(waltz: Film) -> None:
    frames = rows_of(waltz, [0])
    image = waltz.images[0]
    x, y = waltz.px[0, 0, PAIR17.index("head")].round().astype(int)
    face = (slice(y - 12, y + 12), slice(x + 5, x + 12))  # beside the line to the neck
    hidden, shown = draw_people(image, frames, 0), draw_people(image, frames, 0, has_faces=True)

    def detail(part: np.ndarray) -> float:
        return float(cv2.Laplacian(cv2.cvtColor(part, cv2.COLOR_BGR2GRAY), cv2.CV_64F).std())

    assert detail(hidden[face]) < 0.5 * detail(shown[face])
    assert (shown != image).any()
    assert (draw_people(image, frames, 7, has_faces=True) == image).all()
    sheet = contact_sheet([hidden, shown, image], ["1", "2", "3"], num_columns=2)
    assert sheet.shape == (480, 640, 3)


def test_joints_of_a_key_frame_that_were_only_tracked_are_tracked_anew_and_not_hidden(
    waltz: Film, tracked: AnnotatedShot
) -> None:
    frames = tracked.frames
    is_corrected = (frames.frame == 7)[:, None] & (np.arange(17) == WRIST)
    corrected = replace(frames, status=np.where(is_corrected, KeypointStatus.ANNOTATED, frames.status))
    given = with_identities(corrected, is_key=True)
    assert sorted(set(given.frame.tolist())) == [0, 7, 15, 30, 45]
    _, status = by_frame(waltz, annotated(waltz, given).frames)
    assert (status[7, :, WRIST] == KeypointStatus.ANNOTATED).all()
    rest = np.arange(17) != WRIST
    assert (status[:16, :, rest] > KeypointStatus.MISSING).all()
    assert (status[7][:, rest] < KeypointStatus.DETECTED).all()


def corrected_wrist(film: Film, shot: AnnotatedShot, frame: int) -> AnnotatedFrames:
    place = film.px[frame, 1, WRIST]
    corrected = correct_keypoint(shot, frame, 1, WRIST, place, lambda *at: iter(film.images[slice(*at)]), is_key=True)
    assert len(corrected.doubt) == corrected.frames.num_rows
    is_missing = corrected.frames.status == KeypointStatus.MISSING
    np.testing.assert_array_equal(corrected.frames.confidence > 0.0, ~is_missing)
    np.testing.assert_array_equal(np.isfinite(corrected.frames.keypoints_px).all(axis=-1), ~is_missing)
    return corrected.frames


def test_a_corrected_keypoint_brings_a_person_into_frames_that_had_nothing_of_them(
    waltz: Film, tracked: AnnotatedShot
) -> None:
    is_kept = (tracked.frames.person_id == 0) | ~np.isin(tracked.frames.frame, range(5, 10))
    shot = AnnotatedShot(tracked.frames.rows(is_kept), tracked.doubt[is_kept])
    px, status = by_frame(waltz, corrected_wrist(waltz, shot, 3))
    assert (status[5:10, 1, WRIST] > KeypointStatus.MISSING).all()
    assert (status[5:10, 1, np.arange(17) != WRIST] == KeypointStatus.MISSING).all()
    chosen = np.zeros(status.shape, dtype=bool)
    chosen[5:10, 1, WRIST] = True
    assert error_of(waltz, px, chosen) < 0.03
    assert (status[5:10, 0] > KeypointStatus.MISSING).all()


def test_a_corrected_keypoint_leaves_no_old_track_in_frames_that_the_new_one_does_not_reach(
    waltz: Film, tracked: AnnotatedShot
) -> None:
    frames = tracked.frames
    is_late = (frames.frame > 20) & (frames.person_id == 1)
    is_wrist = np.arange(17) == WRIST
    old = replace(
        frames,
        confidence=np.where(is_late[:, None] & ~is_wrist, 0.0, frames.confidence),
        status=np.where(is_late[:, None], KeypointStatus.TRACKED, frames.status),
    )
    corrected = corrected_wrist(waltz, AnnotatedShot(old, tracked.doubt), 18)
    of_person = corrected.frame[corrected.person_id == 1]
    assert of_person.max() < 40  # a track with one known end is believed for 0.3 s, 9 frames
    assert set(range(19)) <= set(of_person.tolist())
    assert corrected.frame[corrected.person_id == 0].max() == len(waltz.images) - 1


def test_key_frames_of_which_nothing_was_annotated_are_refused(waltz: Film) -> None:
    given = keys_of(waltz)
    tracked = replace(given, status=np.full(given.confidence.shape, KeypointStatus.TRACKED))
    with pytest.raises(InputError, match="no keypoint of it was annotated or detected"):
        with_identities(tracked, is_key=True)


def test_statuses_stay_with_the_detections_of_which_some_are_dropped(waltz: Film) -> None:
    given = rows_of(waltz, [*range(len(waltz.px))])
    status = np.where(np.arange(17) == WRIST, KeypointStatus.ANNOTATED, KeypointStatus.DETECTED)
    ghost = rows_of(waltz, [20]).rows(np.array([True, False]))
    ghost = replace(ghost, person_id=np.array([2]), keypoints_px=ghost.keypoints_px + 300.0)
    both = join_frames([given, ghost])
    both = replace(both, has_identities=False, status=np.broadcast_to(status, both.confidence.shape))
    found = with_identities(both, is_key=False)
    assert found.num_rows == given.num_rows
    assert (found.status[:, WRIST] == KeypointStatus.ANNOTATED).mean() > 0.9
    assert not (np.delete(found.status, WRIST, axis=1) == KeypointStatus.ANNOTATED).any()
