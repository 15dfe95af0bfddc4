"""Speeds of annotated pairs, proposals that use them, and the ratio of the densities of a proposal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.synthetic import standing_pair
from pasdedeux.errors import InputError
from pasdedeux.sampling.chain import ChainState, proposal_from_json, proposal_to_json
from pasdedeux.sampling.densities.density import Evaluation
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS, PairChart
from pasdedeux.sampling.proposals import PROPOSALS
from pasdedeux.sampling.proposals.proposal import ProposalInputs
from pasdedeux.sampling.proposals.velocity import log_normal_ratio
from pasdedeux.sampling.speeds import Speeds, annotation_speeds
from pasdedeux.skeletons import PAIR17

ELBOW, WRIST = PAIR17.indices(("left_elbow", "left_wrist"))
STILL = standing_pair()[..., [2, 1]]
APART = np.array([[[0.0, 0.0]], [[0.03, 0.04]]])
"""How far each person goes in a frame."""


def tracks_of(change: np.ndarray) -> np.ndarray:
    """Five frames (1, 5, 2, 17, 2) round the standing pair seen from the side, moved by `change` per frame."""
    return (STILL + np.arange(-2, 3)[:, None, None, None] * change)[None]


@pytest.mark.parametrize(
    ("person", "joints", "pivot", "block"),
    [(0, [WRIST], ELBOW, WRIST), (1, list(range(17)), 0, NUM_JOINTS)],
    ids=["forearm", "whole person"],
)
def test_a_turning_part_has_its_rate_in_its_block_alone(person: int, joints: list[int], pivot: int, block: int) -> None:
    rate = 0.03
    tracks = np.repeat(STILL[None], 5, axis=0)
    around = STILL[person, joints] - STILL[person, pivot]
    for row, frame in enumerate(range(-2, 3)):
        c, s = np.cos(rate * frame), np.sin(rate * frame)
        tracks[row, person, joints] = STILL[person, pivot] + around @ np.array([[c, s], [-s, c]])
    turn = np.sqrt(annotation_speeds(tracks[None]).turn[0])
    assert turn[block] == pytest.approx(rate, rel=2e-3)
    np.testing.assert_allclose(np.delete(turn, block), 0.0, atol=1e-10)


def test_roots_are_displaced_against_the_centre_of_the_pair() -> None:
    together = annotation_speeds(tracks_of(np.broadcast_to([0.05, -0.02], STILL.shape)))
    np.testing.assert_allclose(together.shift, 0.0, atol=1e-20)
    # Each root moves away from the centre by half the distance, 0.025 m a frame, shared by the two image axes.
    speeds = annotation_speeds(tracks_of(APART))
    np.testing.assert_allclose(speeds.shift[0], 0.5 * 0.025**2, rtol=1e-9)
    np.testing.assert_allclose(speeds.turn, 0.0, atol=1e-20)


def test_the_speed_of_lone_annotations_is_not_known() -> None:
    alone = tracks_of(np.full(STILL.shape, 0.1))
    alone[:, [0, 1, 3, 4]] = np.nan
    speeds = annotation_speeds(alone)
    assert np.isnan(speeds.turn).all()
    assert np.isnan(speeds.shift).all()
    for mean in speeds.mean(np.array([0])):
        np.testing.assert_array_equal(mean, 0.0)


def test_an_annotation_that_does_not_show_a_bone_is_left_out_of_its_mean_speed() -> None:
    change = np.zeros(STILL.shape)
    change[0, WRIST] = [0.01, 0.02]
    both = np.concatenate([tracks_of(change)] * 2)
    hidden = both.copy()
    hidden[1, :, 0, WRIST] = np.nan
    entries = np.array([0, 1])
    turn, _ = annotation_speeds(hidden).mean(entries)
    assert turn[WRIST] == annotation_speeds(both).turn[0, WRIST] > 0.0


def test_missing_neighbours_do_not_change_a_steady_speed() -> None:
    change = np.zeros(STILL.shape)
    change[0] = [0.01, 0.0]
    whole = tracks_of(change)
    part = whole.copy()
    part[:, [0, 3]] = np.nan
    speeds, speeds_with_gaps = annotation_speeds(whole), annotation_speeds(part)
    np.testing.assert_allclose(speeds_with_gaps.shift, speeds.shift, rtol=1e-12)
    part[:, :, 1, WRIST] = np.nan
    missing = annotation_speeds(part)
    assert np.flatnonzero(np.isnan(missing.turn[0])).tolist() == [NUM_JOINTS + WRIST]


def test_a_joint_that_is_never_seen_leaves_the_speed_of_the_others() -> None:
    part = tracks_of(APART)
    part[:, :, :, WRIST] = np.nan
    speeds = annotation_speeds(part)
    np.testing.assert_allclose(speeds.shift[0], 0.5 * 0.025**2, rtol=1e-9)
    np.testing.assert_allclose(np.nan_to_num(speeds.turn), 0.0, atol=1e-20)


def test_an_annotation_that_is_nearest_under_several_views_counts_once() -> None:
    speeds = Speeds(np.array([[1.0] * NUM_BLOCKS, [3.0] * NUM_BLOCKS]), np.array([[1.0, 1.0], [3.0, 5.0]]))
    turn, shift = speeds.mean(np.array([0, 1, 1, 1, -1]))
    assert turn[0] == 2.0
    assert shift.tolist() == [2.0, 3.0]
    np.testing.assert_array_equal(speeds.mean(np.array([-1, -1]))[0], 0.0)


# The first call compiles.
@settings(deadline=None)
@given(
    count=st.integers(2, 3),
    square=st.floats(0.0, 50.0),
    here=st.floats(0.01, 10.0),
    least=st.floats(0.01, 10.0),
    beyond=st.floats(0.0, 10.0),
)
def test_the_ratio_never_exceeds_its_bound(count: int, square: float, here: float, least: float, beyond: float) -> None:
    there = least + beyond
    bound = log_normal_ratio(count, square, here, least, True)
    assert log_normal_ratio(count, square, here, there, False) <= bound + 1e-9


def test_a_proposal_survives_being_written_down() -> None:
    rng = np.random.default_rng(3)
    for context in (np.array([3, -1, 8]), None):
        state = ChainState(np.zeros(2), Evaluation(0.0), context, rng.normal(size=NUM_BLOCKS))
        log_scales, read = proposal_from_json(proposal_to_json(state))
        np.testing.assert_array_equal(log_scales, state.log_scales)
        np.testing.assert_array_equal(read, context)


def test_the_velocity_biased_proposal_refuses_to_leave_where_it_was_not_prepared() -> None:
    speeds = Speeds(np.zeros((1, NUM_BLOCKS)), np.zeros((1, 2)))
    chart = PairChart(standing_pair())
    proposal = PROPOSALS["velocity"].init(ProposalInputs(chart, lambda _: np.zeros(1, dtype=np.int64), speeds))
    with pytest.raises(InputError, match="must be prepared"):
        proposal.propose(np.random.default_rng(0), ChainState(chart.seed_parameters(), Evaluation(0.0)))
