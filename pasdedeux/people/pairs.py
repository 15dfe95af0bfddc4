"""Pairs of partners: two people of similar size in the image whose bodies are close; at most one pair a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.people.identity import body_size_px

# Lengths are in mean sizes of both people in the image (about their height).  The constants were chosen on 60 films of
# couples with one to four bystanders, seen all the time or in the last third.
_NEAR = 2.0
"""Distance of the middles below which two people are near in a frame."""
_TOUCH, _MIDDLE = 0.2, 0.5
"""Distances of the nearest joints and of the middles at which closeness is half of its maximum."""
_SIZE = 0.4
"""Logarithm of the ratio of sizes that reduces a score to 1/e: a larger person is nearer to the camera."""
_MIN_SCORE, _MIN_NEAR = 0.3, 0.3
"""Minimum score of a pair, which excludes passers-by; minimum share of the common frames in which two people who are
alone in a film must be near to be a pair."""
_COMMON_POWER = 0.25
"""Exponent of the common share in the ranking of pairs, which prefers people seen for longer."""
_MIN_COMMON = (0.5, 0.1)
"""Minimum shares of the frames of a pair in which both are seen: of the person seen less, and of the other."""


@dataclass(frozen=True)
class NearPeople:
    """A pair, the smaller number first, and the number of frames in which they are near."""

    first: int
    second: int
    num_near: int


def choose_pairs(
    frame: Integers,
    person_id: Integers,
    keypoints_px: Array,
    confidence: Array,
    couples: Sequence[tuple[int, int]] = (),
) -> list[NearPeople]:
    """Return the pairs of a sequence, highest score first; a person is in at most one.

    The score is the mean closeness over the common frames, times exp(-(log size ratio / 0.4)^2), so that people who
    come late can have a partner, too; pairs that are seen for longer are ranked higher.  Closeness is
    1 / (1 + (j / 0.2)^2) / (1 + (m / 0.5)^2), where j is the distance of the nearest joints and m that of the middles
    (medians of the seen joints), in mean sizes.  People of unknown size are in no pair.

    Args:
        frame: Frame of each row (row,).
        person_id: Person of each row (row,), once a frame.
        keypoints_px: (row, joint, 2), NaN where not seen.
        confidence: (row, joint), 0 where not seen.
        couples: Stated pairs; they come first with any score.  Pairs that are not there are ignored.
    """
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (confidence > 0)
    rows = np.flatnonzero(is_seen.sum(axis=1) >= 2)
    points = np.where(is_seen[rows, :, None], keypoints_px[rows], np.nan)
    size, at_frame = body_size_px(points, confidence[rows]), frame[rows]
    rows_of = {int(person): np.flatnonzero(person_id[rows] == person) for person in np.unique(person_id[rows])}
    stated = [(min(couple), max(couple)) for couple in couples]
    ranked: list[tuple[float, NearPeople]] = []
    for first, second in combinations(rows_of, 2):
        first_rows, other = rows_of[first], rows_of[second]
        common, at, there = np.intersect1d(at_frame[first_rows], at_frame[other], return_indices=True)
        fewer, more = sorted((len(first_rows), len(other)))
        is_stated = (first, second) in stated
        is_common = len(common) >= max(_MIN_COMMON[0] * fewer, _MIN_COMMON[1] * more, 1)
        if not is_stated and not is_common:
            continue
        touch, middle, ratio = _apart(
            points[first_rows[at]], points[other[there]], size[first_rows[at]], size[other[there]]
        )
        closeness = 1.0 / ((1.0 + (touch / _TOUCH) ** 2) * (1.0 + (middle / _MIDDLE) ** 2))
        score = float(np.mean(closeness)) * float(np.exp(-((ratio / _SIZE) ** 2))) if len(common) else 0.0
        num_near = int(np.count_nonzero(middle < _NEAR))
        is_alone = len(rows_of) == 2 and num_near >= _MIN_NEAR * len(common)
        if is_stated or is_alone or score >= _MIN_SCORE:
            pair = NearPeople(first, second, num_near)
            ranked.append((np.inf if is_stated else score * (len(common) / more) ** _COMMON_POWER, pair))
    pairs: list[NearPeople] = []
    for _, pair in sorted(ranked, key=lambda scored: (-scored[0], scored[1].first, scored[1].second)):
        if not any({pair.first, pair.second} & {taken.first, taken.second} for taken in pairs):
            pairs.append(pair)
    return pairs


def _apart(points: Array, others: Array, size: Array, other_size: Array) -> tuple[Array, Array, float]:
    """Return the distance of two people in common frames, in mean sizes.

    Returns:
        Distances of the nearest joints and of the middles (frame,), and the median logarithm of the ratio of sizes.
    """
    mean = 0.5 * (size + other_size)
    between = np.linalg.norm(points[:, :, None] - others[:, None], axis=-1).reshape(len(points), -1)
    touch = np.nanmin(between, axis=1, initial=np.inf) / mean
    middle = np.linalg.norm(np.nanmedian(points, axis=1) - np.nanmedian(others, axis=1), axis=-1) / mean
    return touch, middle, float(np.median(np.log(size / other_size))) if len(mean) else 0.0
