"""Some of many, evenly spread."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.spread import evenly_spread


@given(total=st.integers(0, 500), count=st.integers(0, 500))
def test_chosen_indices_are_as_many_as_asked_for_evenly_apart_and_hold_both_ends(total: int, count: int) -> None:
    chosen = evenly_spread(total, count)
    assert len(chosen) == min(total, count)
    if len(chosen) > 1:
        assert (chosen[0], chosen[-1]) == (0, total - 1)
        gaps = np.diff(chosen)
        assert gaps.min() >= 1
        assert gaps.max() - gaps.min() <= 2
