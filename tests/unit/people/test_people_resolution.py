"""Resolve the people of a source: identities, faults and partners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.people.decisions import read_decisions
from pasdedeux.people.pairs import choose_pairs
from pasdedeux.people.resolution import PeopleSettings, ResolvedPeople, resolve_people
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tests.builders.crowds import duet_couple
from tests.builders.filmed_people import Detections, film, joined
from tests.builders.own_sources import film_duet
from tests.builders.walkers import walk


def rows_of(seen: Detections, *, has_identities: bool = False) -> AnnotatedFrames:
    """Return detections as a source lists them: numbered from 0 in every frame, or as the people they are."""
    order = np.argsort(seen.frame, kind="stable")
    place = np.concatenate([np.arange(count) for count in np.unique(seen.frame, return_counts=True)[1]])
    return AnnotatedFrames(
        layout="op14",
        sequence_id=("video",) * len(order),
        frame=seen.frame[order],
        person_id=seen.true_id[order] if has_identities else place,
        keypoints_px=seen.keypoints_px[order],
        confidence=seen.confidence[order],
        rate_hz=seen.rate_hz,
        has_identities=has_identities,
    )


def dance(noise_px: float = 2.0, *, num_people: int = 2) -> Detections:
    couple = duet_couple("waltz", duration_s=4.0)
    if num_people == 3:
        passing = walk(len(couple), seed=2, rate_hz=30.0, turn_rad=0.0)[:, None]
        passing[..., 0] += np.linspace(-3.0, 3.0, len(couple))[:, None, None]
        couple = np.concatenate([couple, passing], axis=1)
    return film(np.random.default_rng(1), couple, noise_px=noise_px, yaw_rad=0.3)


def people_in(resolved: ResolvedPeople, seen: Detections) -> set[tuple[int, int]]:
    """Return which true people each person of the resolved rows really is, by the keypoints."""
    found = set()
    for frame, person, px in zip(
        resolved.frames.frame, resolved.frames.person_id, resolved.frames.keypoints_px, strict=True
    ):
        rows = np.flatnonzero(seen.frame == frame)
        apart = np.nanmedian(np.linalg.norm(seen.keypoints_px[rows] - px, axis=-1), axis=-1)
        found.add((int(person), int(seen.true_id[rows[np.argmin(apart)]])))
    return found


def test_people_numbered_anew_in_every_frame_are_followed_and_partners() -> None:
    seen = dance()
    resolved = resolve_people(rows_of(seen))
    assert len(people_in(resolved, seen)) == 2
    np.testing.assert_array_equal(resolved.partner_id, 1 - resolved.frames.person_id)
    assert set(resolved.source_person_id[resolved.frames.person_id == 0].tolist()) == {0, 1}
    assert "0 and 1 are partners" in resolved.sequences[0].in_words()
    kept = resolve_people(rows_of(seen), PeopleSettings(identities="given"))
    assert len(people_in(kept, seen)) == 4


@pytest.mark.parametrize("kind", ["half of the frames", "from the middle on", "not at all"])
@pytest.mark.parametrize("every", [1, 3])
def test_people_whom_a_source_takes_for_each_other_are_put_right(kind: str, every: int) -> None:
    seen = dance(5.0)
    seen = replace(seen.rows(seen.frame % every == 0), rate_hz=30.0 / every)
    seen = replace(seen, frame=seen.frame // every)
    middle = seen.frame.max() // 2
    swapped = {
        "half of the frames": np.random.default_rng(0).random(seen.frame.max() + 1)[seen.frame] < 0.5,
        "from the middle on": seen.frame > middle,
        "not at all": np.zeros(len(seen.frame), dtype=bool),
    }[kind]
    given = replace(seen, true_id=np.where(swapped, 1 - seen.true_id, seen.true_id))
    resolved = resolve_people(rows_of(given, has_identities=True))
    assert len(people_in(resolved, seen)) == 2
    renamed = resolved.sequences[0].num_renamed_rows
    assert renamed in (swapped.sum(), (~swapped).sum())
    assert ("somebody else" in resolved.sequences[0].in_words()) == (kind != "not at all")
    kept = resolve_people(rows_of(given, has_identities=True), PeopleSettings(identities="given"))
    np.testing.assert_array_equal(kept.frames.person_id, kept.source_person_id)


def test_a_person_who_comes_back_keeps_the_number_that_the_source_gives() -> None:
    seen = dance()
    away = (seen.true_id == 1) & (seen.frame > 30) & (seen.frame < 90)
    resolved = resolve_people(rows_of(seen.rows(~away), has_identities=True))
    np.testing.assert_array_equal(resolved.frames.person_id, resolved.source_person_id)


def test_a_passer_by_is_nobodys_partner() -> None:
    seen = dance(num_people=3)
    seen = seen.rows((seen.true_id < 2) | ((seen.frame > 40) & (seen.frame <= 70)))
    resolved = resolve_people(rows_of(seen))
    assert len(people_in(resolved, seen)) == 3
    partners = {(int(a), int(b)) for a, b in zip(resolved.frames.person_id, resolved.partner_id, strict=True)}
    (passer,) = {a for a, b in partners if b < 0}
    assert partners == {(passer, -1), *((a, b) for a in range(3) for b in range(3) if passer not in (a, b) and a != b)}
    assert resolved.sequences[0].num_people == 3


def test_faults_are_put_right_in_the_keypoints_that_move_with_the_joints() -> None:
    layout = KEYPOINT_LAYOUTS["body25"]
    filmed_px = film_duet("waltz", duration_s=4.0, rate_hz=30.0).keypoints_px("body25")
    frame, person_id = (number.ravel() for number in np.indices(filmed_px.shape[:2]))
    px = filmed_px.reshape(-1, 25, 2)
    confidence = np.isfinite(px).all(axis=-1).astype(float)
    right = AnnotatedFrames("body25", ("v",) * len(px), frame, person_id, px, confidence, rate_hz=30)
    wrong = px.copy()
    row = 60
    mirrored = [
        layout.keypoint_names.index(name.replace("left", "*").replace("right", "left").replace("*", "right"))
        for name in layout.keypoint_names
    ]
    wrong[row] = px[row, mirrored]
    wild = layout.keypoint_names.index("left_wrist")
    wrong[100, wild] += 400.0
    resolved = resolve_people(replace(right, keypoints_px=wrong))
    np.testing.assert_array_equal(resolved.frames.keypoints_px[row], px[row])
    assert resolved.frames.confidence[100, wild] == 0.0
    assert resolved.op14.confidence[100, OP14.index("left_wrist")] == 0.0
    op14 = layout.derive("op14", resolved.frames.keypoints_px, resolved.frames.confidence)
    np.testing.assert_allclose(resolved.op14.positions, op14.positions)
    left = resolve_people(replace(right, keypoints_px=wrong), PeopleSettings(has_repair=False))
    np.testing.assert_array_equal(left.frames.keypoints_px, wrong)


def test_single_images_are_not_followed_and_paired_one_by_one() -> None:
    seen = dance(num_people=3)
    seen = seen.rows(seen.frame % 20 == 0)
    images = rows_of(replace(seen, frame=seen.frame * 1000))
    resolved = resolve_people(images)
    np.testing.assert_array_equal(resolved.frames.person_id, images.person_id)
    np.testing.assert_array_equal(resolved.frames.keypoints_px, images.keypoints_px)
    assert "single images" in resolved.sequences[0].why_not_followed
    for frame in np.unique(resolved.frames.frame):
        rows = resolved.frames.frame == frame
        assert np.count_nonzero(resolved.partner_id[rows] >= 0) == 2


@pytest.mark.parametrize("num_images", [2, 3, 7, 40])
def test_stills_numbered_one_by_one_lose_nobody(num_images: int) -> None:
    images = photos(num_images)
    for settings in (PeopleSettings(), PeopleSettings(identities="given")):
        resolved = resolve_people(images, settings)
        np.testing.assert_array_equal(resolved.frames.person_id, images.person_id)
        np.testing.assert_array_equal(resolved.frames.keypoints_px, images.keypoints_px)
        np.testing.assert_array_equal(resolved.partner_id, 1 - images.person_id)
        assert "single images, not a video" in resolved.sequences[0].why_not_followed


@pytest.mark.parametrize("has_identities", [False, True])
def test_key_frames_farther_apart_than_anybody_is_followed_lose_nobody(has_identities: bool) -> None:
    couple = duet_couple("hug", duration_s=30.0)
    seen = film(np.random.default_rng(1), couple, noise_px=2.0)
    keys = rows_of(seen.rows(seen.frame % 72 == 0), has_identities=has_identities)
    resolved = resolve_people(keys)
    assert ("single images" in resolved.sequences[0].why_not_followed) is not has_identities
    assert resolved.sequences[0].num_repaired_joints == 0
    np.testing.assert_array_equal(resolved.frames.keypoints_px, keys.keypoints_px)


def test_a_video_full_of_false_detections_is_a_video() -> None:
    seen = dance()
    rng = np.random.default_rng(5)
    false = np.repeat(np.unique(seen.frame), 4)
    at = rng.integers(len(seen.frame), size=len(false))
    spread = seen.keypoints_px[at] * rng.uniform(0.3, 0.9, (len(at), 1, 1)) + rng.uniform(0, 1500, (len(at), 1, 2))
    ghosts = replace(seen.rows(at), frame=false, true_id=np.full(len(false), 9), keypoints_px=spread)
    resolved = resolve_people(rows_of(joined(seen, ghosts)))
    assert resolved.sequences[0].why_not_followed == ""
    assert resolved.sequences[0].num_ghost_rows > 3 * len(np.unique(false))


def photos(num_images: int) -> AnnotatedFrames:
    """Return couples of single images, numbered 0, 1, 2 ...: other poses, sizes and places in each."""
    seen, rng = dance(), np.random.default_rng(3)
    chosen = rng.choice(np.unique(seen.frame), num_images, replace=False)
    parts = []
    for number, frame in enumerate(chosen):
        part = seen.rows(seen.frame == frame)
        px = part.keypoints_px * rng.uniform(0.4, 1.2) + rng.uniform(0.0, 500.0, 2)
        parts.append(replace(part, frame=np.full(len(part.frame), number), keypoints_px=px))
    return rows_of(joined(*parts))


def test_of_three_the_two_nearest_are_partners_and_nobody_is_who_is_far_away() -> None:
    person = np.full((10, 14, 2), np.nan)
    person[:, :4] = [[0.0, 0.0], [0.0, 100.0], [30.0, 50.0], [-30.0, 50.0]]
    frame = np.tile(np.arange(10), 3)
    ids = np.repeat([0, 1, 2], 10)
    px = np.concatenate([person + np.array([shift, 0.0]) for shift in (0.0, 150.0, 60.0)])
    seen = np.isfinite(px).all(axis=-1).astype(float)
    (pair,) = choose_pairs(frame, ids, px, seen)
    assert (pair.first, pair.second, pair.num_near) == (0, 2, 10)
    far, px[ids == 1] = ids != 2, px[ids == 1] + [150.0, 0.0]
    assert choose_pairs(frame[far], ids[far], px[far], seen[far]) == []


def crowd(*, first: int = 0) -> Detections:
    """Film a waltz whose partner comes late, before and behind people as near in the image as a partner."""
    couple = duet_couple("waltz", duration_s=4.0)
    still = np.repeat(couple[:1], len(couple), axis=0)
    people = [couple[:, 0], couple[:, 1], still[:, 0] + [0.3, 0.0, -2.2], still[:, 1] + [-0.5, 0.0, 1.9]]
    seen = film(np.random.default_rng(1), np.stack(people, axis=1), noise_px=2.0, yaw_rad=0.0)
    return seen.rows((seen.true_id != 1) | (seen.frame >= first))


def couples_in(resolved: ResolvedPeople) -> list[tuple[int, int]]:
    return [(pair.first, pair.second) for pair in resolved.sequences[0].pairs]


@pytest.mark.parametrize("first", [0, 85])
def test_partners_are_of_one_size_and_close_also_who_comes_late(first: int) -> None:
    resolved = resolve_people(rows_of(crowd(first=first), has_identities=True))
    assert couples_in(resolved) == [(0, 1)]
    partner = {tuple(pair) for pair in np.stack([resolved.frames.person_id, resolved.partner_id], axis=1).tolist()}
    assert partner == {(0, 1), (1, 0), (2, -1), (3, -1)}


def test_couples_that_are_stated_come_before_what_is_seen() -> None:
    rows = rows_of(crowd(), has_identities=True)
    resolved = resolve_people(rows, PeopleSettings(couples=((3, 0),)))
    assert couples_in(resolved)[0] == (0, 3)
    table = b"sequence,first_frame,last_frame,person,is,partner\nvideo,0,119,1,5,2\nvideo,0,119,2,2,\n"
    resolved = resolve_people(rows, decisions=read_decisions(table))
    assert couples_in(resolved)[0] == (2, 5)
    with pytest.raises(InputError, match=r"couple \[0, 9\] is never seen together; persons: 0, 1, 2, 3"):
        resolve_people(rows, PeopleSettings(couples=((0, 9),)))
    with pytest.raises(ValueError, match="a person is in two couples"):
        PeopleSettings(couples=((0, 1), (1, 2)))
    two = b"sequence,first_frame,last_frame,person,is,partner\nvideo,0,119,1,1,0\nvideo,0,119,2,2,0\n"
    with pytest.raises(InputError, match=r"people of 'video', row .*: 0 cannot be the partner of 2 and of 1"):
        resolve_people(rows, decisions=read_decisions(two))


LEGS = frozenset(OP14.indices([f"{side}_{joint}" for side in ("left", "right") for joint in ("knee", "ankle")]))
HIPS = frozenset(OP14.indices(["left_hip", "right_hip"]))
SIDE = frozenset(joint for joint, name in enumerate(OP14.joint_names) if name.startswith("left"))
EVERYTHING = frozenset(range(OP14.num_joints))
PARTS = {
    "legs": (LEGS | HIPS, EVERYTHING - LEGS - HIPS),
    "hips in both": (LEGS | HIPS, EVERYTHING - LEGS),
    "shanks": (LEGS, EVERYTHING - LEGS),
    "sides": (SIDE, EVERYTHING - SIDE),
}


def only(seen: Detections, rows: np.ndarray, joints: frozenset[int]) -> Detections:
    """Return detections in which only these joints of these rows are seen."""
    confidence = seen.confidence.copy()
    confidence[np.ix_(rows, sorted(EVERYTHING - joints))] = 0.0
    return replace(seen, confidence=confidence)


@pytest.mark.parametrize(("first", "has_identities"), [(0, False), (0, True), (45, False), (91, True)])
@pytest.mark.parametrize("parts", PARTS)
def test_a_person_split_into_two_detections_is_one(parts: str, first: int, has_identities: bool) -> None:
    seen, (some, others) = dance(), PARTS[parts]
    rows = np.flatnonzero((seen.true_id == 0) & (seen.frame >= first) & (seen.frame < first + 30))
    part = replace(only(seen, rows, some).rows(rows), true_id=np.full(len(rows), 7))
    split = joined(only(seen, rows, others), part)
    resolved = resolve_people(rows_of(split, has_identities=has_identities), PeopleSettings(has_repair=False))
    assert resolved.sequences[0].num_people == 2
    assert resolved.sequences[0].num_merged_rows == len(rows)
    assert (resolved.frames.confidence > 0).sum() == (seen.confidence > 0).sum()
    assert len(people_in(resolved, seen)) == 2


@pytest.mark.parametrize("hidden", [range(40, 60), range(40, 100), range(60)])
@pytest.mark.parametrize("part", ["legs", "sides"])
def test_two_people_of_whom_one_was_hidden_are_never_joined(part: str, hidden: range) -> None:
    couple = duet_couple("hug", duration_s=4.0)
    seen = film(np.random.default_rng(1), couple, noise_px=2.0, yaw_rad=0.3)
    again = range(hidden.stop, hidden.stop + 12)
    is_again, is_second = np.isin(seen.frame, again), seen.true_id == 1
    some, others = PARTS[part]
    seen = only(seen, np.flatnonzero(is_again & is_second), some)
    seen = only(seen, np.flatnonzero(is_again & ~is_second), others)
    seen = seen.rows(~is_second | ~np.isin(seen.frame, hidden))
    assert resolve_people(rows_of(seen)).sequences[0].num_merged_rows == 0


def test_without_a_rate_or_anybody_the_reason_is_named() -> None:
    seen = rows_of(dance())
    with pytest.raises(InputError, match="frame rate"):
        resolve_people(replace(seen, rate_hz=None))
    with pytest.raises(InputError, match="no frame shows enough joints of a person"):
        resolve_people(replace(seen, confidence=np.zeros(seen.confidence.shape)))
