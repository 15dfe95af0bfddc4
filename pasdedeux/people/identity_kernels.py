"""Compiled kernels for following people, because array calls take too long for live frames."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.skeletons import OP14

_TRUNK = np.array(OP14.indices(["left_shoulder", "right_shoulder", "left_hip", "right_hip", "neck"]))
MIN_TRUST = 0.3
_MIN_SIZE_PX = 4.0
_HIGHEST_BOX_PER_LENGTH = 4.0
_MIN_BOX_PER_LENGTH = 1.5
# Lengths are shares of the size of the body in the image (about its height).
GATE = 0.25
"""Mean joint distance from the prediction beyond which a detection is another person."""
_SIZE_COST = 0.2
"""Cost of a change of size by a factor of e."""
_NEW_COST = 0.05
"""Cost of a detection without joints that the person had before, so that parts of a split body keep their tracks."""
_PLACE_GAIN, _SPEED_GAIN = 0.7, 0.25
"""Alpha-beta filter of a joint: near the critically damped pair beta = alpha^2 / (2 - alpha), a little slower."""


@compiled()
def clean_detections(keypoints: Array, confidence: Array) -> tuple[Array, Array, Array, Array]:
    """Return keypoints (n, j, 2), NaN where not seen, confidences, 0 there, trust (n, j) in them, and sizes (n,).

    The trust in a joint is its confidence relative to the median of the detection, at most 1, and 0 below 0.3:
    detectors place joints that they do not find anywhere, with a low confidence.
    """
    count, joints = confidence.shape
    points, seen = np.empty((count, joints, 2)), np.empty((count, joints))
    trust, size = np.zeros((count, joints)), np.empty(count)
    for at in range(count):
        for joint in range(joints):
            x, y, c = keypoints[at, joint, 0], keypoints[at, joint, 1], confidence[at, joint]
            is_seen = np.isfinite(x) and np.isfinite(y) and c > 0
            points[at, joint, 0] = x if is_seen else np.nan
            points[at, joint, 1] = y if is_seen else np.nan
            seen[at, joint] = c if is_seen else 0.0
        usual = _median(seen[at], seen[at] > 0)
        if usual > 0:
            for joint in range(joints):
                share = min(seen[at, joint] / usual, 1.0)
                trust[at, joint] = share if share >= MIN_TRUST else 0.0
        size[at] = size_in_image(points[at], trust[at] > 0)
    return points, seen, trust, size


@inner_kernel()
def size_in_image(points: Array, is_seen: Flags) -> float:
    """Return `identity.body_size_px` of one person (j, 2)."""
    box, count = _diagonal(points, is_seen, np.arange(points.shape[0]))
    if count < 2:
        return np.nan
    trunk, in_trunk = _diagonal(points, is_seen, _TRUNK)
    if in_trunk >= 4:
        box = min(max(box, _MIN_BOX_PER_LENGTH * trunk), _HIGHEST_BOX_PER_LENGTH * trunk)
    return max(box, _MIN_SIZE_PX)


@inner_kernel()
def _diagonal(points: Array, is_seen: Flags, joints: Integers) -> tuple[float, int]:
    """Return the diagonal of the box of the seen joints, and their number."""
    count = 0
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for joint in joints:
        if is_seen[joint]:
            count += 1
            low_x, high_x = min(low_x, points[joint, 0]), max(high_x, points[joint, 0])
            low_y, high_y = min(low_y, points[joint, 1]), max(high_y, points[joint, 1])
    return (np.hypot(high_x - low_x, high_y - low_y) if count >= 2 else np.nan), count


@inner_kernel()
def _median(values: Array, is_counted: Flags) -> float:
    """Return the median of the counted values, NaN if there are none; `np.median` takes 2 s to compile."""
    rising, count = np.empty(len(values)), 0
    for at in range(len(values)):
        if is_counted[at]:
            place = count
            while place > 0 and rising[place - 1] > values[at]:
                rising[place] = rising[place - 1]
                place -= 1
            rising[place] = values[at]
            count += 1
    if count == 0:
        return np.nan
    half = count // 2
    return rising[half] if count % 2 else (rising[half - 1] + rising[half]) / 2


@compiled()
def predict_joints(place: Array, speed: Array, is_known: Flags, body_s: float, limb_s: float) -> Array:
    """Predict a person's joints (j, 2): the median speed acts for `body_s`, the remaining speed for `limb_s`."""
    out = np.empty(place.shape)
    for axis in range(2):
        body = _median(speed[:, axis], is_known)
        for joint in range(place.shape[0]):
            out[joint, axis] = place[joint, axis] + body * body_s + (speed[joint, axis] - body) * limb_s
    return out


@compiled()
def match_costs(predicted: Array, is_known: Flags, own_size: float, points: Array, trust: Array, size: Array) -> Array:
    """Return the cost (n,) of each detection for a person: mean distance of its joints from the prediction in sizes.

    Joints are weighted by trust (n, j), 0 for those not seen.

    A single joint that is far off is a fault of the detector, not another person, so it counts at most three gates.  If
    there are too few common joints, the distance of the centres is used.  Joints that the person never had cost a
    little.
    """
    cost = np.empty(points.shape[0])
    middle = np.zeros(2)
    num_known = 0
    for joint in range(is_known.shape[0]):
        if is_known[joint]:
            num_known += 1
            middle += predicted[joint]
    middle /= num_known
    for at in range(points.shape[0]):
        total, both, weight, num_seen = 0.0, 0, 0.0, 0
        centre = np.zeros(2)
        for joint in range(is_known.shape[0]):
            if trust[at, joint] <= 0:
                continue
            num_seen += 1
            centre += points[at, joint]
            if is_known[joint]:
                both += 1
                weight += trust[at, joint]
                away = np.hypot(points[at, joint, 0] - predicted[joint, 0], points[at, joint, 1] - predicted[joint, 1])
                total += trust[at, joint] * min(away / own_size, 3.0 * GATE)
        centre /= num_seen
        if both >= 2:
            cost[at] = total / weight
        else:
            cost[at] = np.hypot(centre[0] - middle[0], centre[1] - middle[1]) / own_size
        cost[at] += _SIZE_COST * abs(np.log(size[at] / own_size)) + _NEW_COST * (1.0 - both / num_seen)
    return cost


@compiled()
def update_joints(
    place: Array, speed: Array, is_known: Flags, predicted: Array, seen: Array, trust: Array, passed: float, fade: float
) -> None:
    """Update a person's joints (j, 2) by a matched detection, in place; speeds of joints not seen fade.

    Joints of lower trust (j,) move less.
    """
    for joint in range(place.shape[0]):
        is_seen = trust[joint] > 0
        both = is_seen and is_known[joint]
        for axis in range(2):
            off = trust[joint] * (seen[joint, axis] - predicted[joint, axis]) if both else 0.0
            if is_seen and not is_known[joint]:
                place[joint, axis] = seen[joint, axis]
            else:
                place[joint, axis] = predicted[joint, axis] + _PLACE_GAIN * off
            if passed > 0:
                if not is_seen:
                    speed[joint, axis] *= fade
                speed[joint, axis] += _SPEED_GAIN / passed * off
        is_known[joint] = is_known[joint] or is_seen
