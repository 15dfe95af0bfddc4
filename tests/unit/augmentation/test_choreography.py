"""Facts about the built-in duets as they ship."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.choreography.duet import Duet
from pasdedeux.choreography.duets import DUETS, make_duet
from pasdedeux.errors import InputError
from pasdedeux.interaction.contacts import stated_contacts
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import rotate, rotvec_from_unitquat
from pasdedeux.skeletons import BODY22
from tasks.ingest.parameters import IngestParameters
from tests.builders.choreography_laws import measure

NAMES = tuple(DUETS)


@pytest.fixture(scope="module", params=NAMES)
def duet(request) -> Duet:
    return make_duet(request.param)


def test_five_duets_and_a_trio_ship():
    assert set(DUETS) == {"waltz", "hug", "judo", "push_hands", "lift", "trio"}


def test_a_duet_lasts_ten_seconds_at_sixty_frames_with_two_body_sizes(duet):
    assert [motion.num_frames for motion in duet.motions] == [600] * (3 if duet.name == "trio" else 2)
    assert duet.rate_hz == 60.0
    lengths = [bone_lengths(BODY22, motion.world()[0][:1]).sum() for motion in duet.motions]
    assert lengths[0] / lengths[1] == pytest.approx(1.82 / 1.65)


def test_rotations_are_unit_and_continuous(duet):
    for motion in duet.motions:
        np.testing.assert_allclose(np.linalg.norm(motion.local_unitquat, axis=-1), 1.0, atol=1e-12)
        # 0.35 rad a frame is 20 rad/s; the quickest joint of a dancer turns at about half of that.
        steps = np.linalg.norm(np.diff(motion.local_unitquat, axis=0), axis=-1)
        assert steps.max() < 0.35 / 2


def test_contacts_hold_feet_stand_bodies_keep_apart_and_bend_as_bodies_do(duet):
    assert len(duet.contacts) >= 3
    assert {(stance.person, stance.foot) for stance in duet.stances} == {
        (person, foot) for person in range(len(duet.motions)) for foot in ("left", "right")
    }
    measured = measure(duet)
    assert measured.contact_error_m < 1e-4
    assert measured.slide_m < 1e-6
    assert measured.lowest_m > 0.015
    assert measured.between_m < 0.005
    assert measured.within_m < 0.005
    assert measured.acceleration < 40.0  # m/s2; a quick foot in a walk reaches about 30
    assert measured.jerk < 2500.0
    assert measured.num_invalid_angles == 0


def test_known_contacts_are_stated_for_any_rate(duet):
    for rate_hz in (24.0, 60.0):
        positions = np.stack([motion.resample(rate_hz).world()[0] for motion in duet.motions], axis=1)
        stated = duet.known_contacts(rate_hz)
        contacts = stated_contacts(stated, len(positions), BODY22)
        apart_m = np.linalg.norm(contacts.vectors(positions.reshape(len(positions), -1, 3)), axis=-1)[contacts.is_held]
        known = np.array([contact.distance_m for contact in duet.contacts])
        assert np.abs(apart_m[:, None] - known).min(axis=1).max() < 2e-3
        assert contacts.is_held.sum() == sum(contact.stop_frame - contact.start_frame for contact in stated)
        assert (contacts.num_hands[contacts.is_held] > 0).all()


def test_everybody_who_is_not_carried_stands_on_a_foot_at_every_moment(duet):
    for person in (0,) if duet.name == "lift" else range(len(duet.motions)):
        is_standing = np.zeros(duet.num_frames, dtype=bool)
        for stance in duet.stances:
            if stance.person == person:
                is_standing[duet.frames(stance)] = True
        assert is_standing.all()


@pytest.mark.parametrize("name", NAMES)
def test_half_the_rate_gives_every_second_frame(name):
    full, half = make_duet(name), make_duet(name, rate_hz=30.0)
    np.testing.assert_allclose(half.positions_m(), full.positions_m()[::2], atol=1e-9)


@pytest.mark.parametrize("name", ["waltz", "judo", "push_hands", "lift"])
def test_a_shorter_duet_is_the_beginning_of_a_longer_one(name):
    short, long = make_duet(name, duration_s=2.0), make_duet(name, duration_s=12.0)
    np.testing.assert_allclose(short.positions_m(), long.positions_m()[: short.num_frames], atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_a_variation_is_another_take_of_the_same_dance(name):
    plain, varied = make_duet(name), make_duet(name, variation=3)
    assert np.abs(plain.positions_m() - varied.positions_m()).max() > 0.02
    assert _touching(plain) == _touching(varied)


def _touching(duet: Duet) -> list[tuple[int, str, int, str]]:
    return [(c.point_a.person, c.point_a.bone, c.point_b.person, c.point_b.bone) for c in duet.contacts]


def _facing(duet: Duet, person: int) -> np.ndarray:
    _, world = duet.motions[person].world()
    return rotate(world[:, 0], np.broadcast_to([0.0, 0.0, 1.0], (duet.num_frames, 3)))


def test_people_face_each_other(duet):
    roots = duet.positions_m()[:, :, 0]
    partners = (roots.sum(axis=1, keepdims=True) - roots) / (roots.shape[1] - 1)
    towards = partners - roots
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    a, *rest = (np.sum(_facing(duet, person) * towards[:, person], axis=-1) for person in range(roots.shape[1]))
    assert np.min(rest) > 0.8
    assert np.median(a) > 0.8
    if duet.name == "judo":
        assert a.min() < 0.5  # turned in
    else:
        assert a.min() > 0.8


def test_left_is_left(duet):
    """A mirrored skeleton would have its left side at the right of the way it faces."""
    for person, motion in enumerate(duet.motions):
        positions, _ = motion.world()
        left = np.cross([0.0, 1.0, 0.0], _facing(duet, person))
        for part in ("hip", "shoulder"):
            across = positions[:, BODY22.index(f"left_{part}")] - positions[:, BODY22.index(f"right_{part}")]
            assert (np.sum(across * left, axis=-1) > 0).all()
        toes = positions[:, BODY22.index("left_toe")] - positions[:, BODY22.index("left_ankle")]
        assert np.mean(np.sum(toes * _facing(duet, person), axis=-1)) > 0


def test_knees_and_elbows_are_hinges_that_bend_one_way(duet):
    for motion in duet.motions:
        for joint, axis, signs in (("knee", 0, (1.0, 1.0)), ("elbow", 1, (-1.0, 1.0))):
            for side, sign in zip(("left", "right"), signs, strict=True):
                rotvec = rotvec_from_unitquat(motion.local_unitquat[:, BODY22.index(f"{side}_{joint}")])
                angle = sign * rotvec[:, axis]
                assert angle.min() > np.radians(3.0)
                assert angle.max() < np.radians(150.0)  # Soucie et al. 2011: 152 degrees for both
                assert np.abs(np.delete(rotvec, axis, axis=1)).max() < 1e-6


def test_the_waltz_has_its_hold_and_travels():
    duet = make_duet("waltz")
    assert _touching(duet) == [
        (0, "left_wrist", 1, "right_wrist"),
        (0, "right_wrist", 1, "spine3"),
        (1, "left_wrist", 0, "right_elbow"),
    ]
    assert all(contact.start_s == 0.0 and contact.stop_s == 10.0 for contact in duet.contacts)
    centre = duet.positions_m()[:, :, 0].mean(axis=1)
    assert np.linalg.norm(np.diff(centre, axis=0), axis=-1).sum() > 2.0
    facing = _facing(duet, 0)
    turned = np.unwrap(np.arctan2(facing[:, 0], facing[:, 2]))
    assert turned[-1] - turned[0] < -2.0 * np.pi  # natural turns go to the right


def test_in_the_hug_the_trunks_come_close():
    duet = make_duet("hug")
    positions = duet.positions_m()
    chest = BODY22.index("spine3")
    held = duet.frames(duet.contacts[0])
    apart = np.linalg.norm(positions[held, 0, chest] - positions[held, 1, chest], axis=-1)
    assert apart.max() < 0.35
    assert np.linalg.norm(positions[0, 0, 0] - positions[0, 1, 0]) > 1.2


@pytest.mark.parametrize(("duration_s", "open_s"), [(5.0, 4.3), (7.0, 4.3), (12.0, 9.0)])
def test_a_hug_holds_for_a_second_at_least_and_opens_three_seconds_before_the_end(duration_s, open_s):
    hug = make_duet("hug", duration_s=duration_s)
    held = [(contact.start_s, contact.stop_s) for contact in hug.contacts]
    assert held == [(pytest.approx(3.3), pytest.approx(open_s))] * 4
    if open_s == 4.3:
        begun = make_duet("hug", duration_s=4.0).positions_m()
        np.testing.assert_allclose(hug.positions_m()[: len(begun)], begun, atol=1e-9)


def test_in_the_lift_b_hangs_in_a_s_hands_with_both_feet_off_the_floor():
    duet = make_duet("lift")
    positions, time_s = duet.positions_m(), np.arange(duet.num_frames) / duet.rate_hz
    is_up = (time_s >= 3.2) & (time_s <= 6.8)
    feet = BODY22.indices(["left_toe", "right_toe"])
    assert positions[is_up, 1][:, feet, 1].min() > 0.2
    ankle_m = positions[:, 1, BODY22.index("left_ankle"), 1]
    np.testing.assert_allclose(ankle_m[time_s > 8.0], ankle_m[0], atol=1e-9)
    # Both hands of both people touch all the time that B is up.
    assert len(duet.contacts) == 4
    assert all(contact.start_s < 2.0 and contact.stop_s > 8.0 for contact in duet.contacts)
    went = positions[is_up, 1, 0][-1] - positions[0, 1, 0]
    assert np.hypot(went[0], went[2]) > 0.3


def test_the_trio_holds_hands_all_round_and_the_ring_turns_closes_and_opens():
    trio = make_duet("trio", heights_m=(1.8, 1.6))
    assert [body.height_m for body in trio.bodies] == pytest.approx([1.8, 1.6, 1.7])
    assert {(c.point_a.person, c.point_b.person) for c in trio.contacts} == {(0, 1), (1, 2), (2, 0)}
    assert all((c.start_s, c.stop_s) == (0.0, 10.0) for c in trio.contacts)
    assert all((c.point_a.bone, c.point_b.bone) == ("left_wrist", "right_wrist") for c in trio.contacts)
    roots = trio.positions_m()[:, :, 0]
    middle = roots.mean(axis=1, keepdims=True)
    apart = np.linalg.norm((roots - middle)[..., [0, 2]], axis=-1)
    assert np.ptp(apart, axis=0).min() > 0.03
    angle = np.unwrap(np.arctan2(*(roots - middle)[:, 0, [2, 0]].T))
    assert angle[-1] - angle[0] > 1.0  # to everybody's left


def test_push_hands_feet_never_leave_the_floor():
    duet = make_duet("push_hands")
    assert len(duet.stances) == 4
    assert all(stance.stop_s - stance.start_s == 10.0 for stance in duet.stances)


def test_an_unknown_name_is_answered_with_the_nearest_known_one():
    with pytest.raises(InputError, match="did you mean 'waltz'"):
        make_duet("walz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heights_m": (1.0, 1.7)}, "body height of 1 m"),
        ({"heights_m": (1.7, float("nan"))}, "body height of nan"),
        ({"heights_m": (1.7, 1.8, 1.9)}, "3 heights are given for 2 people"),
        ({"duration_s": 0.0}, "duration_s is 0"),
        ({"rate_hz": float("nan")}, "rate_hz is nan"),
        ({"variation": -1}, "variation is -1"),
        ({"tempo": 500.0}, "tempo is 500"),
    ],
)
def test_values_out_of_range_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        make_duet("waltz", **changes)


def test_a_faster_duet_is_the_same_motion_in_less_time() -> None:
    slow = make_duet("push_hands", duration_s=2.5, rate_hz=24.0, variation=3)
    fast = make_duet("push_hands", duration_s=2.0, rate_hz=30.0, variation=3, speed=1.25)
    assert (fast.num_frames, fast.rate_hz) == (60, 30.0)
    np.testing.assert_allclose(fast.positions_m(), slow.positions_m(), atol=1e-12)
    for soon, late in zip((*fast.contacts, *fast.stances), (*slow.contacts, *slow.stances), strict=True):
        assert (1.25 * soon.start_s, 1.25 * soon.stop_s) == pytest.approx((late.start_s, late.stop_s))


def test_drawn_takes_have_nobody_of_the_same_size_and_are_always_the_same() -> None:
    section = {"duets": [{"name": "hug", "count": 5}, {"name": "waltz", "count": 4}, {"name": "trio", "count": 2}]}
    section["duets"].append({"name": "hug"})
    duets = IngestParameters.model_validate(section).resolved_duets()
    names = [duet.take_id for duet in duets]
    assert names[:5] == ["hug-001", "hug-002", "hug-003", "hug-004", "hug-005"]
    assert len(set(names)) == len(names) == 12
    drawn = duets[:-1]
    heights = [height for duet in drawn for height in duet.heights_m]
    assert len(set(heights)) == len(heights) == 24
    assert min(heights) >= 1.5
    assert max(heights) <= 1.95
    assert len({(duet.variation, duet.speed) for duet in drawn}) == 11
    for duet in drawn:
        make_duet(duet.name, **(duet.settings | {"duration_s": 0.5, "rate_hz": 4.0}))
    assert IngestParameters.model_validate(section).resolved_duets() == duets
