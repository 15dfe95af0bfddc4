"""Stable identities of the people of a video: matching the detections of each frame to people in the frames before.

Detectors list people in any order.  People are followed by their 2D pose: every joint of a track is predicted from its
place and speed, and detections are assigned to tracks with minimum total cost.  Two people who cross hardly ever have
all joints at the same places with the same labels, so the pose distinguishes them where the place does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.people.identity_kernels import GATE, clean_detections, match_costs, predict_joints, update_joints

_SIZE_GAIN = 0.1
_LIMB_FADE_S, _BODY_FADE_S = 0.2, 1.0
"""Unseen people move on: the speed of the body fades slowly, that of limbs relative to it fast."""


# Lengths are shares of the size of the body in the image (about its height).
_GATE_GROWTH_PER_S, _MAX_GATE = 0.5, 0.6
"""Growth of `GATE` while a person is not seen, and its maximum."""
MAX_ABSENT_S = 1.5
"""A person unseen for longer than this gets a new track."""
_DUPLICATE = 0.06
"""Distance below which two detections of a frame are one person."""
_FRAGMENT = 0.1
"""Mean distance from the predicted joints of a person below which a detection is a part of that person."""
_MAX_COMMON = 2
"""Maximum number of common joints of parts of a person, such as the hips, which must coincide."""
_FRAGMENT_MEMORY_S = 0.5
"""A track that was unseen for longer than this is not a part of another person."""
_GHOST_S = 0.25
"""Shorter tracks are dropped, if the sequence is four times as long."""
MIN_JOINTS = 3
"""Detections with fewer joints are dropped."""
_GIVEN_COST = 0.05
"""Cost of a detection with another number in the source than the person's last one; it grows with the time between like
the gate, because motion is less certain then."""


@dataclass(frozen=True)
class FollowedRows:
    """Detections with their persons.

    Args:
        track_id: Person of each row (row,), counted from 0 by first appearance; -1 for dropped rows.
        keypoints_px: (row, joint, 2); rows into which a double was merged have the mean of both.
        confidence: (row, joint).
        twin: Row into which a double or another part of a person was merged (row,); -1 for others.
    """

    track_id: Integers
    keypoints_px: Array
    confidence: Array
    twin: Integers

    @property
    def num_merged(self) -> int:
        """Number of doubled detections and parts of people that were merged into others."""
        return int(np.count_nonzero(self.twin >= 0))

    @property
    def num_ghosts(self) -> int:
        """Number of dropped rows: of short tracks, and with too few joints."""
        return int(np.count_nonzero((self.track_id < 0) & (self.twin < 0)))


@dataclass
class _Followed:
    """State of one followed person."""

    track_id: int
    place_px: Array
    speed_px_s: Array
    is_known: Flags
    size_px: float
    last_time_s: float
    given_id: int

    def predict(self, time_s: float) -> Array:
        """Return the predicted joints; speeds fade, so that unseen people do not move too far."""
        passed = time_s - self.last_time_s
        body_s, limb_s = _faded(passed, _BODY_FADE_S), _faded(passed, _LIMB_FADE_S)
        return predict_joints(self.place_px, self.speed_px_s, self.is_known, body_s, limb_s)


def body_size_px(keypoints_px: Array, confidence: Array) -> Array:
    """Return the size (*batch,) of people in the image, about their height, pixels; NaN with fewer than two joints.

    This is the diagonal of the box of trusted joints, limited to 1.5 to 4 times that of the trunk.
    """
    batch, joints = confidence.shape[:-1], confidence.shape[-1]
    flat, seen = keypoints_px.reshape(-1, joints, 2), confidence.reshape(-1, joints)
    return np.asarray(clean_detections(flat.astype(np.float64), seen.astype(np.float64))[3]).reshape(batch)


class Follower:
    """Follows people frame by frame."""

    def __init__(self) -> None:
        self._people: list[_Followed] = []
        self._num_tracks = 0
        self.part_of: dict[int, int] = {}
        """Tracks of parts of a person, such as the legs alone, with the track of the person."""

    def step(
        self, time_s: float, keypoints_px: Array, confidence: Array, given_id: Integers | None = None
    ) -> FollowedRows:
        """Return the people of one frame.

        Args:
            time_s: Time of the frame, later than the one before.
            keypoints_px: Detections (detection, 14, 2), NaN where not seen.
            confidence: (detection, 14), 0 where not seen.
            given_id: Number of each detection's person in the source (detection,), if it numbers them over time; then
                every detection with a joint is a person or a part of one.
        """
        points, seen, trust, size = clean_detections(
            np.asarray(keypoints_px, dtype=np.float64), np.asarray(confidence, dtype=np.float64)
        )
        is_seen = trust > 0
        min_joints = MIN_JOINTS if given_id is None else 1
        is_usable = (is_seen.sum(axis=1) >= min_joints) & np.isfinite(size)
        track_id = np.full(len(points), -1, dtype=np.int64)
        usable = np.flatnonzero(is_usable)
        self._people = [p for p in self._people if time_s - p.last_time_s <= MAX_ABSENT_S]
        matched: dict[int, _Followed] = {}
        if len(usable) and self._people:
            cost, limit = self._costs(time_s, points[usable], trust[usable], size[usable])
            if given_id is not None:
                passed = time_s - np.array([person.last_time_s for person in self._people])
                claim = _GIVEN_COST + _GATE_GROWTH_PER_S * passed
                given_ids = np.array([person.given_id for person in self._people])
                cost += claim[:, None] * (given_ids[:, None] != given_id[usable])
                limit += claim[:, None]
            from scipy.optimize import linear_sum_assignment  # here: 0.3 s that planning does not need

            # No match costs 0; an unseen person has a wider gate but no advantage.
            gated = np.where(cost <= limit, cost - 2.0 * _MAX_GATE, 0.0)
            for row, column in zip(*linear_sum_assignment(gated), strict=True):
                if cost[row, column] <= limit[row, column]:
                    matched[int(usable[column])] = self._people[row]
        twins = np.full(len(points), -1, dtype=np.int64)
        for index in usable.tolist():
            if index in matched:
                continue
            twin = _twin(index, matched, points, is_seen, size) if given_id is None else None
            if twin is None:
                twin = _other_part(index, matched, time_s, points, is_seen)
            if twin is None:
                self._num_tracks += 1
                matched[index] = _Followed(
                    self._num_tracks - 1,
                    np.nan_to_num(points[index]),
                    np.zeros(points[index].shape),
                    is_seen[index].copy(),
                    float(size[index]),
                    time_s,
                    -1 if given_id is None else int(given_id[index]),
                )
                self._people.append(matched[index])
            else:
                points[twin], seen[twin] = mean_of_two(points[np.array([twin, index])], seen[np.array([twin, index])])
                trust[twin] = np.maximum(trust[twin], trust[index])
                is_seen = trust > 0
                twins[index] = twin
        self._join_parts(matched, time_s, points, is_seen)
        for index, person in matched.items():
            track_id[index] = person.track_id
            _update(person, time_s, points[index], trust[index], float(size[index]))
            if given_id is not None:
                person.given_id = int(given_id[index])
        return FollowedRows(track_id, points, seen, twins)

    def _join_parts(self, matched: dict[int, _Followed], time_s: float, points: Array, is_seen: Flags) -> None:
        """End the tracks of parts of people that are seen whole in this frame."""
        tracked = {person.track_id for person in matched.values()}
        for index, person in matched.items():
            for other in [track for track in self._people if track.track_id not in tracked]:
                is_recent = time_s - other.last_time_s <= _FRAGMENT_MEMORY_S
                parts = [(track.place_px, track.is_known) for track in (person, other)]
                is_part = _are_parts(*parts[0], *parts[1], person.size_px)
                if is_recent and is_part and _fits(other, time_s, points[index], is_seen[index]):
                    self.part_of[other.track_id] = person.track_id
                    self._people.remove(other)

    def _costs(self, time_s: float, points: Array, trust: Array, size: Array) -> tuple[Array, Array]:
        """Return the cost (person, detection), in body sizes, and its allowed maximum."""
        cost = np.empty((len(self._people), len(points)))
        limit = np.zeros(cost.shape)
        for row, person in enumerate(self._people):
            cost[row] = match_costs(person.predict(time_s), person.is_known, person.size_px, points, trust, size)
            limit[row] = min(GATE + _GATE_GROWTH_PER_S * (time_s - person.last_time_s), _MAX_GATE)
        return cost, limit


def follow_people(
    frame: Integers, keypoints_px: Array, confidence: Array, *, rate_hz: float, given_id: Integers | None = None
) -> FollowedRows:
    """Return the person of every detection of a sequence; the order of people within frames does not matter.

    If the source numbers people, a change of number is evidence against a match, and no doubles or short tracks are
    removed.

    Args:
        frame: Frame number of each row (row,), in any order; numbers may have gaps.
        keypoints_px: op14 keypoints (row, 14, 2), pixels; NaN where not seen.
        confidence: (row, 14), 0 where not seen.
        rate_hz: Frames per second.
        given_id: Number of each row's person in the source (row,), over time.

    Returns:
        The rows in the given order.
    """
    points, seen = np.array(keypoints_px, dtype=np.float64), np.array(confidence, dtype=np.float64)
    track_id, twin = np.full((2, len(frame)), -1, dtype=np.int64)
    follower = Follower()
    for number in np.unique(frame):
        rows = np.flatnonzero(frame == number)
        followed = follower.step(
            float(number) / rate_hz, points[rows], seen[rows], None if given_id is None else given_id[rows]
        )
        track_id[rows], points[rows], seen[rows] = followed.track_id, followed.keypoints_px, followed.confidence
        twin[rows] = np.where(followed.twin >= 0, rows[followed.twin], -1)
    for part, whole in reversed(follower.part_of.items()):
        track_id, twin, points, seen = _joined_rows(frame, track_id, twin, points, seen, part, whole)
    if given_id is None:
        track_id[_ghosts(frame, track_id, rate_hz)] = -1
    kept = [int(number) for number in dict.fromkeys(track_id[np.argsort(frame, kind="stable")].tolist()) if number >= 0]
    renamed = {old: new for new, old in enumerate(kept)} | {-1: -1}
    final = np.array([renamed[int(number)] for number in track_id], dtype=np.int64)
    return FollowedRows(final, points, seen, twin)


def identity_switches(true_id: Integers, track_id: Integers, frame: Integers) -> int:
    """Count how often the track of a person changes; dropped rows (-1) are skipped."""
    switches = 0
    for person in np.unique(true_id):
        rows = np.flatnonzero((true_id == person) & (track_id >= 0))
        ids = track_id[rows[np.argsort(frame[rows], kind="stable")]]
        switches += int(np.count_nonzero(np.diff(ids)))
    return switches


def mean_of_two(points: Array, confidence: Array) -> tuple[Array, Array]:
    """Return the mean (joint, 2) of two detections (2, joint, 2), weighted by confidence, and the higher confidence."""
    total = confidence.sum(axis=0)
    mean = np.einsum("dj,djc->jc", confidence, np.nan_to_num(points)) / np.where(total > 0, total, 1.0)[:, None]
    return np.where((total > 0)[:, None], mean, np.nan), confidence.max(axis=0)


def _faded(passed_s: float, fade_s: float) -> float:
    """Return the effective time of a fading speed."""
    return fade_s * (1.0 - float(np.exp(-passed_s / fade_s)))


def _twin(index: int, matched: dict[int, _Followed], points: Array, is_seen: Flags, size: Array) -> int | None:
    """Return the matched detection of which this one is a double, or None."""
    for other in matched:
        both = is_seen[index] & is_seen[other]
        if both.sum() < min(4, is_seen[index].sum()):
            continue
        apart = np.linalg.norm(points[index, both] - points[other, both], axis=-1)
        if float(np.median(apart)) < _DUPLICATE * float(size[other]):
            return other
    return None


def _fits(person: _Followed, time_s: float, points: Array, is_seen: Flags) -> bool:
    """Return whether joints (joint, 2) are near those predicted for a person; at least three must be known."""
    both = person.is_known & is_seen
    if both.sum() < MIN_JOINTS:
        return False
    apart = np.linalg.norm(points[both] - person.predict(time_s)[both], axis=-1)
    return float(np.mean(apart)) < _FRAGMENT * person.size_px


def _other_part(index: int, matched: dict[int, _Followed], time_s: float, points: Array, is_seen: Flags) -> int | None:
    """Return the matched detection of another part of the same person, or None."""
    for other, person in matched.items():
        is_part = _are_parts(points[index], is_seen[index], points[other], is_seen[other], person.size_px)
        if is_part and person.last_time_s < time_s and _fits(person, time_s, points[index], is_seen[index]):
            return other
    return None


def _are_parts(points: Array, is_seen: Flags, others: Array, is_other_seen: Flags, size_px: float) -> bool:
    """Return whether two sets of joints (joint, 2) can be parts of one body of this size."""
    both = is_seen & is_other_seen
    apart = np.linalg.norm(points[both] - others[both], axis=-1)
    return int(both.sum()) <= _MAX_COMMON and bool((apart < _DUPLICATE * size_px).all())


def _joined_rows(
    frame: Integers, track_id: Integers, twin: Integers, points: Array, seen: Array, part: int, whole: int
) -> tuple[Integers, Integers, Array, Array]:
    """Join the rows of one track to another, and return tracks, twins, keypoints and confidences."""
    row_of = {int(frame[row]): int(row) for row in np.flatnonzero(track_id == whole)}
    for row in np.flatnonzero(track_id == part).tolist():
        other = row_of.get(int(frame[row]))
        if other is None:
            track_id[row] = whole
            continue
        both = np.array([other, row])
        points[other], seen[other] = mean_of_two(points[both], seen[both])
        track_id[row], twin[row] = -1, other
        twin[twin == row] = other
    return track_id, twin, points, seen


def _update(person: _Followed, time_s: float, points: Array, trust: Array, size_px: float) -> None:
    """Update a person by a matched detection."""
    passed, state = time_s - person.last_time_s, (person.place_px, person.speed_px_s, person.is_known)
    fade = float(np.exp(-passed / _LIMB_FADE_S))
    update_joints(*state, person.predict(time_s), points, trust, passed, fade)
    person.size_px += _SIZE_GAIN * (size_px - person.size_px)
    person.last_time_s = time_s


def _ghosts(frame: Integers, track_id: Integers, rate_hz: float) -> Flags:
    """Return the rows of tracks that are too short for people."""
    length = int(np.ptp(frame)) + 1 if len(frame) else 0
    min_count = min(round(_GHOST_S * rate_hz), length // 4)
    ids, counts = np.unique(track_id, return_counts=True)
    return np.isin(track_id, ids[(counts < min_count) & (ids >= 0)])
