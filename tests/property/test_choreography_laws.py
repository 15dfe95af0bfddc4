"""The laws of the duets hold for all sizes, takes and styles, not only for those that ship."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.choreography.duets import DUETS, make_duet
from tests.builders.choreography_laws import measure

HEIGHT = st.floats(1.5, 2.0)
STYLES = {
    "waltz": {
        "tempo_bpm": (60.0, 100.0),
        "turn_per_bar_rad": (-1.65, -1.2),
        "stride": (0.25, 0.4),
        "rise": (0.0, 0.012),
    },
    "hug": {"sway": (0.0, 0.03), "sway_s": (1.6, 5.0), "approach": (0.7, 1.0)},
    "judo": {"apart": (0.38, 0.42), "stride": (0.0, 0.15), "circle_rad": (-0.4, 0.4), "turn_rad": (1.3, 1.36)},
    "lift": {"lift": (0.05, 0.22), "turn_rad": (-1.5, 1.5), "stride": (0.0, 0.15)},
    "trio": {
        "tempo_bpm": (60.0, 110.0),
        "radius": (0.33, 0.36),
        "closing": (0.0, 0.06),
        "stride": (0.0, 0.05),
        "rise": (0.0, 0.08),
    },
    "push_hands": {"circle_s": (1.8, 6.0), "width": (0.0, 0.06), "depth": (0.03, 0.07), "shift": (0.03, 0.06)},
}


@pytest.mark.parametrize("name", sorted(DUETS))
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_laws_hold_for_all_heights_takes_and_styles(name, data):
    style = {key: data.draw(st.floats(low, high), label=key) for key, (low, high) in STYLES[name].items()}
    speed = data.draw(st.sampled_from([1.0, 0.85, 1.15]), label="speed")
    duet = make_duet(
        name,
        rate_hz=20.0,
        heights_m=data.draw(st.tuples(*[HEIGHT] * DUETS[name].style.num_people), label="heights_m"),
        variation=data.draw(st.integers(0, 50), label="variation"),
        speed=speed,
        **style,
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
