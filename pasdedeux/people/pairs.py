"""Who is whose partner: the two who are near each other for longest, a person in one pair at most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.people.identity import body_size_px

_NEAR = 2.0
"""Two people are near in a frame whose middles are less than so many body heights apart."""
_MIN_SHARE = 0.3
"""A pair is near in at least this share of the frames of the one of both who is seen longer: a passer-by is nobody's
partner."""


@dataclass(frozen=True)
class Paired:
    """Two people who are a pair, the smaller number first, and in how many frames they are near each other."""

    first: int
    second: int
    num_near: int


def choose_pairs(frame: Integers, person_id: Integers, keypoints_px: Array, confidence: Array) -> list[Paired]:
    """Return the pairs of a sequence, those near each other for longest first; a person is in one at most.

    In a frame two people count the more the nearer their middles (median over the joints seen) are: 1 / (1 + d^2), d in
    mean sizes of the two.  Nobody is near whose size is unknown.

    Args:
        frame: Frame of each row (row,).
        person_id: Person of each row (row,), once a frame.
        keypoints_px: (row, joint, 2), NaN where not seen.
        confidence: (row, joint), 0 where not seen.
    """
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (confidence > 0)
    rows = np.flatnonzero(is_seen.sum(axis=1) >= 2)
    size = body_size_px(keypoints_px[rows], confidence[rows])
    middle = np.nanmedian(np.where(is_seen[rows, :, None], keypoints_px[rows], np.nan), axis=1)
    people = [int(one) for one in np.unique(person_id[rows])]
    own = {one: np.flatnonzero(person_id[rows] == one) for one in people}
    found = []
    for number, first in enumerate(people):
        for second in people[number + 1 :]:
            _, at, there = np.intersect1d(frame[rows][own[first]], frame[rows][own[second]], return_indices=True)
            one, other = own[first][at], own[second][there]
            apart = np.linalg.norm(middle[one] - middle[other], axis=-1) / (0.5 * (size[one] + size[other]))
            num_near = int(np.count_nonzero(apart < _NEAR))
            if num_near and num_near >= _MIN_SHARE * max(len(own[first]), len(own[second])):
                found.append((-float(np.sum(1.0 / (1.0 + apart**2))), Paired(first, second, num_near)))
    pairs: list[Paired] = []
    for _, pair in sorted(found, key=lambda one: (one[0], one[1].first, one[1].second)):
        if not any({pair.first, pair.second} & {taken.first, taken.second} for taken in pairs):
            pairs.append(pair)
    return pairs
