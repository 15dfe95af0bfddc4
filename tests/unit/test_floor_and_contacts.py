"""Where people touch and who stands: surfaces of bones, and one floor under everybody."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.choreography import make_duet
from pasdedeux.interaction.contacts import surface_gaps
from pasdedeux.interaction.floor import StandingSettings, find_standing, floor_under
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.plausibility import capsule_model, segment_distance
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
    other = surface_gaps(pair[:, ::-1], RADII[::-1], BODY22)
    np.testing.assert_allclose(other.gap_m.swapaxes(-1, -2), found.gap_m, atol=1e-9)
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
