"""The bandwidth that fits annotations left out in turn."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.synthetic import random_annotations, random_pairs
from pasdedeux.interaction.dissimilarity import interaction_dissimilarity
from pasdedeux.sampling.annotations import AnnotatedPairs, GatheredPairs
from pasdedeux.sampling.bandwidth import PUBLISHED_SIGMA_L, SAME_MOMENT, LeaveOneOut, leave_one_out


def annotated(spread_rad: float, count: int = 120) -> AnnotatedPairs:
    rng = np.random.default_rng(4)
    return random_annotations(rng, random_pairs(rng, count, spread_rad=spread_rad), count)


def gathered(pairs: AnnotatedPairs, moment: np.ndarray | None = None) -> GatheredPairs:
    count = len(pairs.points_m)
    more = {} if moment is None else {"moment": moment}
    return GatheredPairs(pairs, np.ones(count), 0, np.ones((count, 2)), **more)


@given(
    st.lists(st.tuples(st.floats(1e-3, 0.5), st.integers(20, 34)), min_size=1, max_size=20),
    st.floats(0.2, 5.0).filter(lambda factor: abs(factor - 1.0) > 0.01),
)
def test_no_other_bandwidth_makes_left_out_annotations_likelier(found: list[tuple[float, int]], factor: float) -> None:
    distance, joints = np.array(found).T
    left_out = LeaveOneOut(distance, 2.0 * joints - 3.0)
    assert left_out.log_likelihood(left_out.sigma_l) > left_out.log_likelihood(factor * left_out.sigma_l)


def test_the_bandwidth_is_that_of_annotations_with_such_neighbours() -> None:
    """Points are drawn round centres by the kernel of eq. 9: any direction, and a length of Gamma(D)."""
    rng, freedom, sigma_l = np.random.default_rng(2), 65.0, 0.03
    lengths = rng.gamma(freedom, 2.0 * sigma_l**2, size=400)
    assert abs(LeaveOneOut(lengths, np.full(400, freedom)).sigma_l / sigma_l - 1.0) < 0.02


def test_annotations_that_lie_closer_together_ask_for_a_smaller_bandwidth() -> None:
    near, far = (gathered(annotated(spread)).leave_one_out for spread in (0.05, 0.3))
    assert 0.0 < near.sigma_l < 0.7 * far.sigma_l
    # The published bandwidth finds annotations that are so far apart hardly possible.
    assert far.log_likelihood(far.sigma_l) > far.log_likelihood(PUBLISHED_SIGMA_L) + 50.0


def test_annotations_of_one_moment_are_left_out_together() -> None:
    once = annotated(0.2)
    twice = AnnotatedPairs(
        np.repeat(once.points_m, 2, axis=0), np.repeat(once.directions, 2, axis=0), np.arange(2 * len(once.points_m))
    )
    apart = gathered(twice).leave_one_out
    assert apart.nearest_m.max() < 1e-9
    together = gathered(twice, SAME_MOMENT * (np.arange(len(twice.points_m)) // 2)).leave_one_out
    assert abs(together.sigma_l / gathered(once).leave_one_out.sigma_l - 1.0) < 0.1


def test_no_frame_of_a_video_is_compared_with_one_just_before_or_after_it() -> None:
    first, last = annotated(0.2, 2).points_m
    frames = np.arange(90)
    points = first + (frames / 900.0)[:, None, None, None] * (last - first)
    found = leave_one_out(points, np.repeat([[0.0, 0.0, 1.0]], len(frames), axis=0), frames)
    assert len(found.nearest_m) == len(frames)
    apart = interaction_dissimilarity(points[0].reshape(-1, 2), points[SAME_MOMENT].reshape(-1, 2))
    np.testing.assert_allclose(found.nearest_m, apart, rtol=0.2)


def test_where_nothing_can_be_left_out_the_published_bandwidth_stays() -> None:
    pairs = annotated(0.2, 3)
    first = AnnotatedPairs(pairs.points_m[:1], pairs.directions[:1], np.zeros(1, dtype=np.int64))
    alone = gathered(first).leave_one_out
    assert alone.sigma_l == PUBLISHED_SIGMA_L
    assert np.isnan(alone.log_likelihood(0.01))
    same = (np.repeat(values[:1], 4, axis=0) for values in (pairs.points_m, pairs.directions))
    alike = leave_one_out(*same, SAME_MOMENT * np.arange(4))
    assert len(alike.nearest_m) == 4
    assert alike.sigma_l == PUBLISHED_SIGMA_L


def test_joints_that_are_not_seen_do_not_count() -> None:
    pairs = annotated(0.2, 60)
    points = pairs.points_m.copy()
    points[::2, 1, 14:] = np.nan
    moments = SAME_MOMENT * np.arange(len(points))
    found = leave_one_out(points, np.repeat([[0.0, 0.0, 1.0]], len(points), axis=0), moments)
    # Joints that one of two images lacks do not count for either.
    assert (found.freedom[::2] == 59.0).all()
    assert set(found.freedom[1::2]) == {65.0, 59.0}
