"""Repair of a detector's keypoints: faults found on the joints of op14 apply to keypoints that move with them."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.people.faults import repair_faults, track_size_px, wild_points
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KeypointLayout
from pasdedeux.skeletons.layouts.keypoints import Keypoints

_MOVES_WITH = {
    **dict.fromkeys(("big_toe", "small_toe", "heel"), "ankle"),
    **dict.fromkeys(("pinky", "index", "thumb"), "wrist"),
}
"""Keypoints of hands and feet, and the joint of op14 with which they are swapped and exchanged."""


def repair_rows(
    frame: Integers,
    person_id: Integers,
    keypoints_px: Array,
    confidence: Array,
    op14: Keypoints,
    layout: KeypointLayout,
    *,
    rate_hz: float,
) -> tuple[Array, Array, Keypoints, int]:
    """Correct swapped sides and exchanged limbs in the rows of a video, and mask wild keypoints.

    A person who would have no keypoints left is not changed.

    Args:
        frame: (row,).
        person_id: (row,), once a frame.
        keypoints_px: (row, K, 2); NaN where not seen.
        confidence: (row, K); 0 where not seen.
        op14: Keypoints (row, 14, 2) derived from these.
        layout: What the keypoints are.
        rate_hz: Frames per second.

    Returns:
        Keypoints (row, K, 2) and confidences (row, K), their op14, and how many joints of it changed.
    """
    px, seen = keypoints_px.copy(), confidence.copy()
    if not len(frame):
        return px, seen, op14, 0
    people, person = np.unique(person_id, return_inverse=True)
    at = frame - int(frame.min())
    shape = (len(people), int(at.max()) + 1, OP14.num_joints)
    points, weight = np.full((*shape, 2), np.nan), np.zeros(shape)
    points[person, at], weight[person, at] = op14.positions, op14.confidence
    row_of = np.full(shape[:2], -1, dtype=np.int64)
    row_of[person, at] = np.arange(len(at))
    mended = repair_faults(points, weight, rate_hz=rate_hz)
    is_kept = np.asarray((mended.confidence > 0).any(axis=(1, 2)))[person]
    source_row = row_of[mended.source_person[person, at], at[:, None]]
    for keypoint, (joint, mirror) in enumerate(_joints_of(layout)):
        if joint < 0:
            continue
        source = np.where(mended.source_joint[person, at, joint] == joint, keypoint, mirror)
        change = is_kept & (source_row[:, joint] >= 0)
        px[change, keypoint] = keypoints_px[source_row[change, joint], source[change]]
        seen[change, keypoint] = confidence[source_row[change, joint], source[change]]
        masked = is_kept & mended.is_masked[person, at, joint]
        px[masked, keypoint], seen[masked, keypoint] = np.nan, 0.0
    joint_pairs = _own_joints(layout)
    others = np.array(
        [point for point, name in enumerate(layout.keypoint_names) if name not in joint_pairs], dtype=np.int64
    )
    for number in range(len(people)):  # other keypoints are only masked
        rows = np.flatnonzero(person == number)
        rows = rows[np.argsort(at[rows])]
        frames, there = at[rows] - at[rows[0]], np.ix_(rows, others)
        track, trust = np.full((frames[-1] + 1, len(others), 2), np.nan), np.zeros((frames[-1] + 1, len(others)))
        track[frames], trust[frames] = px[there], seen[there]
        size = np.full(len(track), float(track_size_px(mended.keypoints_px[number])[0]))
        is_wild = wild_points(track, trust, size, rate_hz=rate_hz)[frames]
        px[there], seen[there] = np.where(is_wild[..., None], np.nan, px[there]), np.where(is_wild, 0.0, seen[there])
    repaired = Keypoints(
        np.where(is_kept[:, None, None], mended.keypoints_px[person, at], op14.positions),
        np.where(is_kept[:, None], mended.confidence[person, at], op14.confidence),
    )
    is_touched = mended.is_touched[person, at] & (op14.confidence > 0) & is_kept[:, None]
    return px, seen, repaired, int(is_touched.sum())


def _joints_of(layout: KeypointLayout) -> list[tuple[int, int]]:
    """Return for each keypoint the joint of op14 with which it moves, -1 for none, and its mirrored keypoint."""
    names, own_joints = layout.keypoint_names, _own_joints(layout)
    joints = []
    for keypoint, name in enumerate(names):
        side, _, part = name.partition("_")
        joint = own_joints.get(name, f"{side}_{_MOVES_WITH[part]}" if part in _MOVES_WITH else "")
        other = {"left": f"right_{part}", "right": f"left_{part}"}.get(side, name)
        joints.append((OP14.index(joint) if joint else -1, names.index(other) if other in names else keypoint))
    return joints


def _own_joints(layout: KeypointLayout) -> dict[str, str]:
    """Return the joints of op14 that are equal to a keypoint, by the keypoint's name."""
    return {next(iter(means[0])): joint for joint, means in layout.recipes[OP14.name].items() if len(means[0]) == 1}
