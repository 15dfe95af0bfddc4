"""Long takes are solved in windows without visible seams."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.augmentation import AugmentationSettings, Augmenter, Source, UserContact, uniform_variations
from pasdedeux.augmentation.windows import blend_weights, plan_windows
from tests.builders.moving_pairs import swaying_pair


@given(
    num_frames=st.integers(1, 5000),
    rate_hz=st.sampled_from([5.0, 24.0, 30.0, 60.0]),
    longest_s=st.floats(8.0, 40.0),
    overlap_s=st.floats(0.5, 3.9),
)
def test_shares_of_windows_add_up_to_one(num_frames: int, rate_hz: float, longest_s: float, overlap_s: float) -> None:
    windows = plan_windows(num_frames, rate_hz, longest_s, overlap_s=overlap_s)
    total = np.zeros(num_frames)
    for window, share in zip(windows, blend_weights(windows), strict=True):
        assert window.stop - window.start <= max(longest_s * rate_hz, 4)
        total[window.start : window.stop] += share
    np.testing.assert_allclose(total, 1.0, atol=1e-12)


def test_seams_of_windows_cannot_be_found_by_jitter(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Source(swaying_pair(360), 30.0)
    variations = uniform_variations([0.75, 1.2], ["A", "AB"])
    whole = Augmenter(source).solve(variations)
    monkeypatch.setattr("pasdedeux.augmentation.augment.LONGEST_S", 6.5)
    parts = Augmenter(source).solve(variations)
    is_seam = np.zeros(360, dtype=bool)
    cut = plan_windows(360, 30.0, 6.5)
    assert len(cut) == 3
    for before, after in pairwise(cut):
        is_seam[after.start : before.stop] = True
    for plain, blended in zip(whole, parts, strict=True):
        jitter_whole, jitter_parts = (
            np.sqrt((np.diff(variant.positions_m, n=3, axis=0) ** 2).sum(axis=-1).mean(axis=(1, 2)))[is_seam[3:]]
            for variant in (plain, blended)
        )
        # Coarse frames of another window are other frames, which leaves micrometres, and jitter is less than that where
        # a sway turns round.
        assert (jitter_parts <= 1.15 * jitter_whole + 6e-6).all()
        assert np.sqrt((jitter_parts**2).mean() / (jitter_whole**2).mean()) < 1.02
        np.testing.assert_allclose(blended.positions_m, plain.positions_m, atol=0.01)
        assert np.linalg.norm(blended.positions_m - plain.positions_m, axis=-1).mean() < 0.001
        assert blended.quality.laplacian_error_m == pytest.approx(plain.quality.laplacian_error_m, rel=0.02)


def test_polished_windows_agree_where_they_meet_and_bones_stay_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Source(swaying_pair(90, apart_m=0.5), 10.0)
    settings = AugmentationSettings(solver="polished")
    variations = uniform_variations([0.75, 1.25], ["A"])
    whole = Augmenter(source, settings).solve(variations)
    monkeypatch.setattr("pasdedeux.augmentation.augment.LONGEST_S", 6.1)
    for variant, same in zip(Augmenter(source, settings).solve(variations), whole, strict=True):
        assert variant.solver == "polished"
        assert variant.quality.bone_error_m < 1e-9
        # Descents stop before they converge, so their seams are visible, unlike those of the bulk solver, but no steps.
        assert variant.quality.jerk_ratio < 1.6 * same.quality.jerk_ratio
        assert variant.energy <= variant.energy_fk


def test_a_users_contact_is_cut_to_each_window() -> None:
    contact = UserContact(joint_a="head", joint_b="head", start_frame=10, stop_frame=30)
    assert contact.within(20, 50) == contact.model_copy(update={"start_frame": 0, "stop_frame": 10})
    assert contact.within(5, 15) == contact.model_copy(update={"start_frame": 5, "stop_frame": 10})
    assert contact.within(30, 40) is None


def test_a_part_of_a_take_has_the_bones_and_the_floor_of_the_whole() -> None:
    source = Source(swaying_pair(30), 30.0)
    part = source.take_frames(slice(10, 20))
    np.testing.assert_array_equal(part.lengths_m, source.lengths_m)
    assert part.floor_m == source.floor_m
    np.testing.assert_array_equal(part.positions_m, source.positions_m[10:20])
