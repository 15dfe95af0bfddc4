"""The selection of representative pairs agrees with the greedy choice, which is written out here."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.sampling.selection import DUPLICATE_M, PairSelector, Selection

RNG = np.random.default_rng(0)
# As in chains, each pair comes a few times in a row, a little different, turned and shifted as a whole.
PAIRS = np.repeat(random_pairs(RNG, 60, spread_rad=0.3), 3, axis=0) + RNG.normal(scale=0.004, size=(180, 2, 17, 3))
PAIRS[1::3] = PAIRS[1::3] @ yaw_rotmat(0.4).T + [1.0, 0.0, -2.0]
WEIGHT = RNG.uniform(size=180)
POINTS = PAIRS.reshape(180, -1, 3)
APART = np.array([cartesian_dissimilarity(POINTS, points) for points in POINTS])


def select(count: int, *, cuts: tuple[int, ...] = (), room: int = 200) -> Selection:
    selector = PairSelector(count, min_room=room)
    for part in np.split(np.arange(len(PAIRS)), cuts):
        selector.add(PAIRS[part], WEIGHT[part])
    return selector.selection()


def test_each_selected_pair_brings_the_others_nearest_to_the_selection_and_weighs_what_is_nearest_to_it() -> None:
    kept: list[int] = []
    weight = np.zeros(len(PAIRS))
    for pair in range(len(PAIRS)):
        near = [before for before in kept if APART[pair, before] < DUPLICATE_M]
        weight[near[0] if near else pair] += WEIGHT[pair]
        kept += [] if near else [pair]
    chosen: list[int] = []
    while len(chosen) < 12:
        left = {
            pair: weight[kept] @ APART[np.ix_(kept, [*chosen, pair])].min(axis=1) for pair in kept if pair not in chosen
        }
        chosen.append(min(left, key=left.__getitem__))
    found = select(12)
    assert found.index.tolist() == chosen
    far = [APART[pair, chosen[:rank]].min(initial=np.inf) for rank, pair in enumerate(chosen)]
    np.testing.assert_allclose(found.distance_m, far, atol=1e-6)
    owner = APART[np.ix_(kept, chosen)].argmin(axis=1)
    np.testing.assert_allclose(found.weight, np.bincount(owner, weight[kept], 12), atol=1e-12)
    np.testing.assert_array_equal(select(5).index, chosen[:5])


def test_with_little_room_batches_change_nothing_and_the_selection_is_nearly_as_good() -> None:
    found, cut, plain = select(6, room=24), select(6, cuts=(1, 2, 50, 170), room=24), select(6)
    for name in ("index", "distance_m", "weight", "radius_m"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(found, name))
    assert found.radius_m > DUPLICATE_M == plain.radius_m
    # What was dropped is at most two radii from what was kept (D_C bends the triangle a little).
    left, wide = (np.average(APART[:, selection.index].min(axis=1), weights=WEIGHT) for selection in (found, plain))
    assert wide <= left <= wide + 2.0 * found.radius_m
    np.testing.assert_allclose(found.weight.sum(), WEIGHT.sum())


def test_no_more_is_selected_than_differs_and_bad_input_is_refused() -> None:
    selector = PairSelector(1000)
    assert len(selector.selection().index) == 0
    np.testing.assert_array_equal(selector.add(PAIRS, WEIGHT), np.arange(180) % 3 == 0)
    assert len(selector.selection().index) == 60
    with pytest.raises(InputError, match="not finite"):
        selector.add(np.full((1, 2, 17, 3), np.nan), np.ones(1))
    with pytest.raises(InputError, match="at least 1"):
        PairSelector(0)
