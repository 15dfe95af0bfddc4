"""Faults of 2D detectors in close contact: sides swapped, limbs given to the wrong person, wild keypoints.

All are detected by continuity: joints jump when a label becomes wrong, and jump back when it is right again.

- *Swapped sides* (arms, legs, or the whole body) and *exchanged limbs* (limbs of two people exchanged) have right
  keypoints with wrong labels.  The labelling of every frame is found by Viterbi over pairs of frames, which minimises
  the second differences of the joints over time; wrong labels are corrected.  Joints of a much lower confidence than
  usual for the person do not count.
- *Wild keypoints* (a limb detected on the other person only, a mixture of two people) cannot be explained by labels.
  For each joint, frames that can be reached from each other at a plausible speed are kept; the others, and ends of
  bones that are longer than usual, are masked with confidence 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.people.identity import body_size_px
from pasdedeux.people.identity_kernels import MIN_TRUST
from pasdedeux.skeletons import OP14

_ARMS, _LEGS = ([*left, *right] for left, right in (OP14.arms, OP14.legs))
_EXCHANGED_LIMBS = tuple(limb[1:] for limb in OP14.limbs)
_MIRROR = np.array(OP14.mirror)
_SIDE_STATES = 4
_MEMORY_S = 0.2
"""Joints not seen for longer than this do not count for continuity."""

_USUAL_QUANTILE = 0.95
# Lengths are shares of the size of the body in the image (about its height).
_RELABEL_COST = 0.004
"""Cost of a frame with changed labels, in second differences (mean over joints)."""
_SWITCH_COST = 0.02
"""Cost of a change of the labelling between two frames."""
_SPEED_PER_S, _USUAL_SPEEDS = 3.0, 2.0
"""Speed of a joint that costs nothing, and its limit as a multiple of the joint's usual top speed."""
_MASK_COST = 0.012
"""Cost of masking a joint in one frame, relative to a jump of the body's size."""
_LONGEST_WILD_S = 0.4
"""A joint that is elsewhere for longer than this is not masked."""
_BONE_EXCESS = 1.4
"""Ratio to the usual maximum length from which a bone is impossible."""


@dataclass(frozen=True)
class RepairedCrowd:
    """Keypoints of people after repair, over the same frames.

    Args:
        keypoints_px: (person, frame, 14, 2); masked joints are NaN.
        confidence: (person, frame, 14); 0 where masked.
        source_person: Person of each joint before repair (person, frame, 14): the other one if a limb was exchanged.
        source_joint: Label of each joint before repair (person, frame, 14): the mirrored one if sides were swapped.
        is_masked: Joints masked as wild (person, frame, 14).
    """

    keypoints_px: Array
    confidence: Array
    source_person: Integers
    source_joint: Integers
    is_masked: Flags

    @property
    def is_touched(self) -> Flags:
        """Joints that were changed (person, frame, 14)."""
        is_own = self.source_person == np.arange(len(self.source_person))[:, None, None]
        return self.is_masked | ~is_own | (self.source_joint != np.arange(OP14.num_joints))


def repair_faults(keypoints_px: Array, confidence: Array, *, rate_hz: float) -> RepairedCrowd:
    """Repair or mask the faults of people seen together.

    Args:
        keypoints_px: (person, frame, 14, 2), people whose identities are known; NaN where not seen.
        confidence: (person, frame, 14), 0 where not seen.
        rate_hz: Frames per second.

    People seen over fewer than three frames are not changed.
    """
    people = len(keypoints_px)
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (np.nan_to_num(confidence) > 0)
    points = np.where(is_seen[..., None], keypoints_px, np.nan)
    weight = np.where(is_seen, confidence, 0.0)
    source_person = np.zeros(is_seen.shape, dtype=np.int64) + np.arange(people)[:, None, None]
    source_joint = np.zeros(is_seen.shape, dtype=np.int64) + np.arange(14)
    is_masked = np.zeros(is_seen.shape, dtype=bool)
    spans = [_span(seen.any(axis=-1)) for seen in is_seen]
    for person, span in enumerate(spans):
        if span.stop - span.start < 3:
            continue
        source = repair_sides(_trusted(points[person, span], weight[person, span]), rate_hz=rate_hz)
        points[person, span] = np.take_along_axis(points[person, span], source[..., None], axis=1)
        weight[person, span] = np.take_along_axis(weight[person, span], source, axis=1)
        source_joint[person, span] = source
    for both in combinations(range(people), 2):
        common = range(max(spans[person].start for person in both), min(spans[person].stop for person in both))
        if len(common) < 3:
            continue
        at = np.ix_(both, common)
        pair = np.stack([_trusted(points[person, common], weight[person, common]) for person in both])
        exchanged = repair_exchanges(pair, rate_hz=rate_hz)
        for given in (points, weight, source_person, source_joint):
            two = given[at]
            given[at] = np.where(exchanged.reshape(1, *exchanged.shape, *(1,) * (two.ndim - 3)), two[::-1], two)
    for person, span in enumerate(spans):
        if span.stop - span.start >= 3:
            is_masked[person, span] = wild_joints(points[person, span], weight[person, span], rate_hz=rate_hz)
    points = np.where(is_masked[..., None], np.nan, points)
    return RepairedCrowd(points, np.where(is_masked, 0.0, weight), source_person, source_joint, is_masked)


def repair_sides(keypoints_px: Array, *, rate_hz: float) -> Integers:
    """Return for each frame and joint of a person the true source joint (frame, 14).

    A frame has four possible labellings: as given, arms swapped, legs swapped, both.
    """
    sources = np.tile(np.arange(14), (_SIDE_STATES, 1))
    for state in range(_SIDE_STATES):
        for bit, side in ((1, _ARMS), (2, _LEGS)):
            if state & bit:
                sources[state, side] = _MIRROR[side]
    used = [*_ARMS, *_LEGS]
    states = keypoints_px[:, sources][:, :, used]
    changed = np.array([np.count_nonzero(source != np.arange(14)) for source in sources]) / len(used)
    path = _smoothest(states, changed, track_size_px(keypoints_px), rate_hz)
    return np.asarray(sources[path], dtype=np.int64)


def repair_exchanges(pair_px: Array, *, rate_hz: float) -> Flags:
    """Return which joints of two people (2, frame, 14, 2) are exchanged (frame, 14), limb by limb."""
    exchanged = np.zeros(pair_px.shape[1:3], dtype=bool)
    size = np.nanmax([track_size_px(pair_px[0]), track_size_px(pair_px[1])], axis=0)
    for limb in _EXCHANGED_LIMBS:
        limb_px = pair_px[:, :, np.array(limb)]
        given = np.concatenate([limb_px[0], limb_px[1]], axis=1)
        other = np.concatenate([limb_px[1], limb_px[0]], axis=1)
        path = _smoothest(np.stack([given, other], axis=1), np.array([0.0, 1.0]), size, rate_hz)
        # Both limbs are needed; if one is missing, the exchange is not sure, and masking decides.
        is_complete = np.isfinite(given).all(axis=(-1, -2))
        exchanged[:, np.array(limb)] = ((path == 1) & is_complete)[:, None]
    return exchanged


def wild_joints(keypoints_px: Array, confidence: Array, *, rate_hz: float) -> Flags:
    """Return which joints of a person (frame, 14) are at unreachable places, or end a bone that is too long."""
    size = track_size_px(_trusted(keypoints_px, confidence))
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (confidence > 0)
    is_wild = wild_points(keypoints_px, confidence, size, rate_hz=rate_hz)
    for parent, child in OP14.bones:
        both = is_seen[:, parent] & is_seen[:, child] & ~is_wild[:, parent] & ~is_wild[:, child]
        if both.sum() < 10:
            continue
        length = np.linalg.norm(keypoints_px[:, child] - keypoints_px[:, parent], axis=-1) / size
        usual = float(np.quantile(length[both], _USUAL_QUANTILE))
        is_wild[:, child] |= both & (length > _BONE_EXCESS * usual)
    return is_wild


def wild_points(keypoints_px: Array, confidence: Array, size_px: Array, *, rate_hz: float) -> Flags:
    """Return which keypoints of a person (frame, K) are at unreachable places.

    For each keypoint, the cheapest chain of frames is kept: dropping a frame costs `_MASK_COST` times its trust, and
    going from one kept frame to the next costs the distance beyond what the speed allows.

    Args:
        keypoints_px: (frame, K, 2); NaN where not seen.
        confidence: (frame, K); 0 where not seen.
        size_px: Size of the person in the image (frame,).
        rate_hz: Frames per second.
    """
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (confidence > 0)
    trust, is_wild = _trust(confidence), np.zeros(is_seen.shape, dtype=bool)
    reach = max(2, round(_LONGEST_WILD_S * rate_hz))
    for point in range(is_seen.shape[1]):
        frames = np.flatnonzero(is_seen[:, point])
        if len(frames) < 3:
            continue
        places, point_trust = keypoints_px[frames, point] / size_px[frames, None], trust[frames, point]
        speed = np.linalg.norm(np.diff(places, axis=0), axis=-1) / np.diff(frames) * rate_hz
        speed = speed[(point_trust[1:] >= MIN_TRUST) & (point_trust[:-1] >= MIN_TRUST)]
        usual = _USUAL_SPEEDS * float(np.quantile(speed, _USUAL_QUANTILE)) if len(speed) else np.inf
        kept = _kept(frames, places, min(usual, _SPEED_PER_S) / rate_hz, reach, _MASK_COST * point_trust)
        is_wild[frames[~kept], point] = True
    return is_wild


def _span(is_there: Flags) -> slice:
    """Return the frames from the first to the last in which a person is seen; empty if never."""
    frames = np.flatnonzero(is_there)
    return slice(int(frames[0]), int(frames[-1]) + 1) if len(frames) else slice(0, 0)


def _trust(confidence: Array) -> Array:
    """Return the confidence of a person's joints (frame, 14) as a share of the usual one, at most 1."""
    known = confidence[confidence > 0]
    return np.asarray(np.minimum(confidence / np.median(known), 1.0)) if len(known) else np.zeros(confidence.shape)


def _trusted(keypoints_px: Array, confidence: Array) -> Array:
    """Return a person's keypoints (frame, 14, 2), NaN for those with low trust."""
    return np.asarray(np.where((_trust(confidence) >= MIN_TRUST)[..., None], keypoints_px, np.nan))


def track_size_px(keypoints_px: Array) -> Array:
    """Return the size of a person over the frames (frame,): the median over the track."""
    size = body_size_px(keypoints_px, np.isfinite(keypoints_px).all(axis=-1).astype(float))
    known = size[np.isfinite(size)]
    return np.full(len(size), float(np.median(known)) if len(known) else 1.0)


def _smoothest(states: Array, changed: Array, size: Array, rate_hz: float) -> Integers:
    """Return the labelling of each frame (frame,) with the least second differences.

    Viterbi over pairs of labellings of neighbouring frames.  An unseen joint keeps its last place for a short time,
    then it does not count.

    Args:
        states: Joints under each labelling (frame, state, joint, 2), NaN where not seen.
        changed: Share of the joints that each labelling changes (state,).
        size: Size of the body (frame,).
        rate_hz: Frames per second.
    """
    frames, count = states.shape[:2]
    scaled = _hold(states, round(_MEMORY_S * rate_hz)) / size[:, None, None, None]
    unary = _RELABEL_COST * changed
    switch = _SWITCH_COST * (1.0 - np.eye(count))
    cost = unary[:, None] + unary[None, :] + switch  # (state of frame 0, state of frame 1)
    back = np.zeros((frames, count, count), dtype=np.int64)
    for frame in range(2, frames):
        before, last, current = scaled[frame - 2], scaled[frame - 1], scaled[frame]
        second = current[None, None] - 2.0 * last[None, :, None] + before[:, None, None]
        away = np.sqrt(np.sum(second**2, axis=-1))
        known = np.isfinite(away)
        bend = np.where(known, away, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        total = cost[:, :, None] + bend + switch[None] + unary[None, None, :]
        back[frame] = np.argmin(total, axis=0)
        cost = np.min(total, axis=0)
    path = np.zeros(frames, dtype=np.int64)
    path[-2], path[-1] = np.unravel_index(int(np.argmin(cost)), cost.shape)
    for frame in range(frames - 1, 1, -1):
        path[frame - 2] = back[frame, path[frame - 1], path[frame]]
    return path


def _hold(states: Array, longest: int) -> Array:
    """Keep the last place of a joint for up to `longest` frames in which it was not seen."""
    held = np.array(states)
    age = np.zeros(states.shape[1:-1], dtype=np.int64)
    for frame in range(1, len(states)):
        is_missing = ~np.isfinite(states[frame]).all(axis=-1)
        age = np.where(is_missing, age + 1, 0)
        held[frame] = np.where((is_missing & (age <= longest))[..., None], held[frame - 1], held[frame])
    return held


def _kept(frames: Integers, places: Array, free_distance: float, reach: int, mask_cost: Array) -> Flags:
    """Return which frames of a joint (n,) are in the cheapest chain; `places` (n, 2) are in body sizes."""
    count = len(frames)
    cost = np.zeros(count)
    dropped = np.concatenate([[0.0], np.cumsum(mask_cost)])  # cost of dropping all frames before this one
    back = np.full(count, -1, dtype=np.int64)
    for index in range(count):
        start = max(0, index - reach)
        cost[index] = dropped[index] if index <= reach else np.inf
        if start == index:
            continue
        others = np.arange(start, index)
        distance = np.linalg.norm(places[index] - places[others], axis=-1)
        excess = np.maximum(distance - free_distance * (frames[index] - frames[others]), 0.0)
        total = cost[others] + excess + dropped[index] - dropped[others + 1]
        best = int(np.argmin(total))
        if total[best] < cost[index]:
            cost[index], back[index] = total[best], int(others[best])
    tail = np.arange(max(0, count - 1 - reach), count)
    at = int(tail[np.argmin(cost[tail] + dropped[count] - dropped[tail + 1])])
    kept = np.zeros(count, dtype=bool)
    while at >= 0:
        kept[at] = True
        at = int(back[at])
    return kept
