"""Test the laws of duets for all sizes, takes and speeds."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.choreography.duets import DUETS, make_duet
from tests.builders.choreography_laws import measure

HEIGHT = st.floats(1.5, 2.0)


@pytest.mark.parametrize("name", sorted(DUETS))
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_laws_hold_for_all_heights_takes_and_speeds(name, data):
    speed = data.draw(st.sampled_from([1.0, 0.85, 1.15]), label="speed")
    duet = make_duet(
        name,
        rate_hz=20.0,
        heights_m=data.draw(st.tuples(*[HEIGHT] * DUETS[name].num_people), label="heights_m"),
        variation=data.draw(st.integers(0, 50), label="variation"),
        speed=speed,
    )
    measured = measure(duet)
    assert measured.contact_error_m < 1e-4
    assert measured.slide_m < 1e-6
    # Half a centimetre more than for the bodies that ship: where flesh gives way.
    assert measured.between_m < 0.010
    assert measured.within_m < 0.010
    assert measured.acceleration < 40.0 * speed**2
    assert measured.num_invalid_angles == 0
    assert measured.lowest_m > 0.015
