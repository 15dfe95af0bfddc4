"""Find where people touch and who stands: surfaces of bones, and one floor for all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.choreography.duets import make_duet
from pasdedeux.interaction.contacts import Contacts, find_contacts
from pasdedeux.interaction.floor import StandingSettings, find_standing, floor_under
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.interaction.surfaces import standing_out, surface_gaps
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.plausibility.capsules import capsule_model, segment_distance
from pasdedeux.skeletons import BODY22

ANKLES = BODY22.indices(["left_ankle", "right_ankle"])
RADII = capsule_model(BODY22).radii_m(np.array([1.8, 1.65]))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_gaps_are_segment_distances_less_radii_blind_to_rigid_motion_and_to_who_is_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = rng.normal(0.0, 0.5, (3, 2, 22, 3))
    found = surface_gaps(pair, RADII, BODY22)
    assert found.gap_m.shape == (3, 21, 21)
    assert found.share.min() >= 0.0
    assert found.share.max() <= 1.0
    parents = np.array(BODY22.parents)
    i, j = rng.integers(0, 21, 2)
    a, b = found.bones[i], found.bones[j]
    expected = segment_distance(pair[0, 0, parents[a]], pair[0, 0, a], pair[0, 1, parents[b]], pair[0, 1, b])
    assert found.gap_m[0, i, j] == pytest.approx(expected - RADII[0, a] - RADII[1, b], abs=1e-9)
    points = [
        pair[0, person, parents[bone]] + share * (pair[0, person, bone] - pair[0, person, parents[bone]])
        for person, bone, share in zip((0, 1), (a, b), found.share[0, i, j], strict=True)
    ]
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(expected, abs=1e-9)
    moved = np.einsum("ij,...j->...i", yaw_rotmat(rng.uniform(-3, 3)), pair) + rng.normal(0, 1, 3)
    np.testing.assert_allclose(surface_gaps(moved, RADII, BODY22).gap_m, found.gap_m, atol=1e-9)
    exchanged = surface_gaps(pair[:, ::-1], RADII[::-1], BODY22)
    np.testing.assert_allclose(exchanged.gap_m.swapaxes(-1, -2), found.gap_m, atol=1e-9)
    np.testing.assert_allclose(found.closest_m, found.gap_m.reshape(3, -1).min(axis=1))


@pytest.mark.parametrize("name", ["lift", "hug", "waltz", "push_hands"])
def test_known_contacts_of_a_duet_are_where_surfaces_meet_and_known_stances_stand(name: str) -> None:
    duet = make_duet(name, rate_hz=30.0)
    positions = duet.positions_m()
    gaps = surface_gaps(positions, np.stack([body.radii_m for body in duet.bodies]), BODY22)
    bones = list(gaps.bones)
    for contact in duet.contacts:
        ends = sorted((contact.point_a, contact.point_b), key=lambda point: point.person)
        at = [bones.index(BODY22.index(point.bone)) for point in ends]
        held = gaps.gap_m[duet.frames(contact)][:, at[0], at[1]]
        radii = [duet.bodies[point.person].radius_m(point.bone) for point in ends]
        between_m = contact.distance_m - sum(radii)
        assert 0.0 <= between_m < 0.05
        # The rest of the bone may be nearer than the point that the contact names.
        assert held.max() < between_m + 1e-4
        assert held.min() > -0.03
    feet = positions[:, :, ANKLES]
    standing = find_standing(feet, rate_hz=30.0, settings=StandingSettings())
    known = np.zeros(standing.shape, dtype=bool)
    for stance in duet.stances:
        known[duet.frames(stance), stance.person, ("left", "right").index(stance.foot)] = True
    assert standing[known].mean() > 0.85
    assert floor_under(feet, standing) == pytest.approx(0.039 * 1.65, abs=0.01)
    if name == "lift":
        assert not standing[100:200, 1].any()
    absent = np.ones(standing.shape[:2], dtype=bool)
    absent[:, 1] = False
    alone = find_standing(feet, rate_hz=30.0, settings=StandingSettings(), is_present=absent)
    np.testing.assert_array_equal(alone[:, :1], find_standing(feet[:, :1], rate_hz=30.0, settings=StandingSettings()))
    assert not alone[:, 1].any()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_contacts_are_blind_to_rigid_motion_and_their_points_lie_on_the_bones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = make_duet("hug", rate_hz=6.0).positions_m()[24:36]
    found = find_contacts(pair, RADII, BODY22, rate_hz=6.0)
    moved = np.einsum("ij,...j->...i", yaw_rotmat(rng.uniform(-3, 3)), pair) + rng.normal(0, 1, 3)
    again = find_contacts(moved, RADII, BODY22, rate_hz=6.0)
    np.testing.assert_array_equal(found.points, again.points)
    for name in ("shares", "weights", "hand"):
        np.testing.assert_allclose(getattr(found, name), getattr(again, name), atol=1e-9)
    lengths = [np.linalg.norm(c.vectors(m.reshape(-1, 44, 3)), axis=-1) for c, m in ((found, pair), (again, moved))]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=1e-9)
    used = found.weights > 0
    np.testing.assert_allclose(found.shares[used][:, :2].sum(axis=-1), 1.0)
    np.testing.assert_allclose(found.shares[used][:, 2:].sum(axis=-1), -1.0)
    np.testing.assert_array_equal(np.array(BODY22.parents)[found.bones()[used] % 22], found.points[used][:, ::2] % 22)


def test_weights_of_contacts_move_little_when_people_move_little_and_none_is_found_apart() -> None:
    pair = make_duet("waltz", rate_hz=10.0).positions_m()
    nudged = pair + np.random.default_rng(0).normal(0, 1e-4, pair.shape)
    before, after = (find_contacts(motion, RADII, BODY22, rate_hz=10.0) for motion in (pair, nudged))
    sum_before, sum_after = (contacts.weights.sum(axis=1) for contacts in (before, after))
    assert np.abs(sum_before - sum_after).max() < 0.02 * sum_before.max()
    apart = pair + np.array([[[0.0] * 3], [[3.0, 0.0, 0.0]]])
    assert find_contacts(apart, RADII, BODY22, rate_hz=10.0).weights.size == 0


def test_hands_reach_beyond_wrists_and_other_bones_do_not() -> None:
    pair = make_duet("push_hands", rate_hz=10.0).positions_m()[:1]
    wrist, knee = BODY22.index("right_wrist"), BODY22.index("right_knee")
    for joint, is_found in ((wrist, True), (knee, False)):
        moved = pair.copy()
        moved[:, 1] += pair[:, 0, joint] - pair[:, 1, joint] + [0.0, 0.0, RADII[:, joint].sum() + 0.1]
        found = find_contacts(moved, RADII, BODY22, rate_hz=10.0)
        assert ((found.bones() == [joint, joint + 22]).all(axis=-1) & (found.weights > 0.5)).any() == is_found


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_closest_bones_meet_by_themselves_whoever_is_first_and_those_that_follow_them_do_not(seed: int) -> None:
    pair = np.random.default_rng(seed).normal(0.0, 0.5, (4, 2, 22, 3))
    weight, share, gap = _stand_out(pair, RADII)
    assert (weight >= 0.0).all()
    assert (weight.reshape(4, -1)[range(4), gap.reshape(4, -1).argmin(axis=1)] == 1.0).all()
    is_inside = ((share > 0.2) & (share < 0.8)).all(axis=-1)
    assert (weight[is_inside] == 1.0).all()
    np.testing.assert_allclose(_stand_out(pair[:, ::-1], RADII[::-1])[0].swapaxes(-1, -2), weight, atol=1e-9)


def _stand_out(pair: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how bones of A and B stand out, shares and gaps, by bone of A and bone of B."""
    gaps = surface_gaps(pair, radii, BODY22)
    bones = np.stack(np.broadcast_arrays(gaps.bones[:, None], gaps.bones + 22), axis=-1).reshape(-1, 2)
    flat = standing_out(bones, gaps.share.reshape(len(pair), -1, 2), gaps.gap_m.reshape(len(pair), -1), BODY22)
    return flat.reshape(gaps.gap_m.shape), gaps.share, gaps.gap_m


def test_a_shank_that_lies_on_a_back_touches_it_where_it_crosses_it_and_the_thigh_does_not() -> None:
    pair = make_duet("waltz", rate_hz=1.0).positions_m()[:1]
    hip, knee, ankle, toe, spine = BODY22.indices(["right_hip", "right_knee", "right_ankle", "right_toe", "spine2"])
    middle = 0.5 * (pair[0, 1, spine] + pair[0, 1, BODY22.parents[spine]])
    pair[:, 0] += [0.0, 3.0, 0.0]
    leg = np.array([[0.15, 0.0, 0.5], [0.15, 0.0, 0.05], [-0.25, 0.0, 0.05], [-0.4, 0.0, 0.05]])
    pair[0, 0, [hip, knee, ankle, toe]] = middle + leg
    gaps = surface_gaps(pair, RADII, BODY22)
    found = find_contacts(pair, RADII, BODY22, rate_hz=0.1)
    weights = dict(zip(map(tuple, found.bones()[0]), found.weights[0], strict=True))
    place = {bone: row for row, bone in enumerate(gaps.bones)}
    assert gaps.gap_m[0, place[knee], place[spine]] < 0.02
    assert weights[ankle, spine + 22] == 1.0
    assert weights.get((knee, spine + 22), 0.0) < 0.02


@pytest.mark.parametrize("name", ["lift", "judo"])
def test_a_hand_touches_one_place(name: str) -> None:
    pair = make_duet(name, rate_hz=10.0).positions_m()
    found = find_contacts(pair, RADII, BODY22, rate_hz=10.0)
    lays = (found.hand[..., 0] > 0.9) & (found.weights > 0)
    for wrist in BODY22.indices(["left_wrist", "right_wrist"]):
        mine = np.where(lays & (found.bones()[..., 0] == wrist), found.weights, 0.0)
        assert mine.max() > 0.9
        assert mine.sum(axis=1).max() < 2.0


def test_a_stated_contact_replaces_what_is_found_between_its_bones() -> None:
    # One frame in ten seconds: weights are not averaged with those of other frames.
    pair = make_duet("waltz", rate_hz=1.0).positions_m()
    bones = [BODY22.index("left_wrist"), BODY22.index("right_wrist") + 22]
    for weight in (0.0, 0.7):
        stated = UserContact(
            joint_a="left_wrist", joint_b="right_wrist", share_b=0.4, start_frame=2, stop_frame=5, weight=weight
        )
        found = find_contacts(pair, RADII, BODY22, rate_hz=0.1, stated=[stated])
        mine = (found.bones() == bones).all(axis=-1) & (found.weights > 0)
        assert mine[[0, 1, 5, 6]].sum(axis=1).tolist() == [1] * 4
        assert mine[2:5].sum(axis=1).tolist() == [int(weight > 0)] * 3
        assert (found.weights[2:5][mine[2:5]] == weight).all()
        np.testing.assert_allclose(
            found.shares[2:5][mine[2:5]], [[0.0, 1.0, -0.6, -0.4]] * 3 if weight else np.zeros((0, 4))
        )


def test_what_is_stated_of_a_hand_stands_in_place_of_all_that_is_found_of_it() -> None:
    pair = make_duet("lift", rate_hz=1.0).positions_m()[3:7]
    stated = UserContact(joint_a="left_wrist", joint_b="head", stop_frame=4)
    before, after = (find_contacts(pair, RADII, BODY22, rate_hz=0.1, stated=given) for given in ((), [stated]))
    left, right, head = BODY22.indices(["left_wrist", "right_wrist", "head"])

    def touched(found: Contacts, wrist: int) -> set[int]:
        lies = (found.bones()[..., 0] == wrist) & (found.hand[..., 0] == 1.0) & (found.weights > 0)
        return set(found.bones()[..., 1][lies])

    assert touched(before, left)
    assert touched(after, left) == {head + 22}
    assert touched(after, right) == touched(before, right)
