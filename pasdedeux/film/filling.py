"""Joints between where they are known: tracks from both sides joined with shape-preserving interpolation.

At the other end of a gap a track has come to some place, and the joint is known to be at another: that drift says how
good the track was, and is spread over the gap.  Both tracks so bridged and the interpolation are weighted by the
inverse of their variances, in body heights.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.film.tracking import Tracks
from pasdedeux.formats.annotated_frames import KeypointStatus
from pasdedeux.skeletons.layouts.names import SIDES
from pasdedeux.skeletons.skeleton import ARM, LEG

# Lengths are shares of the size of the person in the image (about its height).
_TRACK_DEVIATION, _CURVE_DEVIATION = 0.015, 0.06
"""Deviation of a track without drift, and of the interpolation in the middle of a gap: tuned on rendered salsa."""
_MAX_INTERPOLATED_S, _MAX_ONE_SIDED_S = 1.0, 0.3
"""Gaps that are longer are only filled where a track runs through; a track with one known end is believed so long."""
_MAX_DRIFT = 0.15
"""A track that ends farther than this from the known place runs through nothing."""
_DOUBTED = 0.06
"""Deviation at which a filled joint has half the confidence of its ends."""
_LEAST_CONFIDENCE = 0.25
"""Of a filled joint: above what ingest takes for missing."""
_MIN_FOLLOWED = 3
"""Joints of a person that are followed, by which the others are taken along."""
_MAX_STRETCH = 1.1
"""A limb may be so much longer than at any of its known places."""
_LIMBS = [bone for side in SIDES for limb in (ARM, LEG) for bone in pairwise(f"{side}_{joint}" for joint in limb)]


@dataclass(frozen=True)
class FilledPoints:
    """Points in every frame.

    Args:
        px: (frame, point, 2), NaN where missing.
        confidence: (frame, point), 0 where missing.
        status: (frame, point) of `KeypointStatus`.
        doubt: How far tracks and known places disagree (frame, point), a share of the person's size; 0 where nothing
            says so.
    """

    px: Array
    confidence: Array
    status: Integers
    doubt: Array


def fill_points(
    known_px: Array,
    confidence: Array,
    status: Integers,
    tracks: Tracks,
    size_px: Array,
    *,
    rate_hz: float,
    is_hidden: Flags,
    person: Integers,
) -> FilledPoints:
    """Fill the gaps between known places of points.

    Args:
        known_px: (frame, point, 2), NaN where not known.
        confidence: (frame, point), 0 where not known.
        status: What known places are (frame, point).
        tracks: Tracks of the same points.
        size_px: Size of each point's person (point,).
        rate_hz: Frames per second.
        is_hidden: Where a point is known not to be seen (frame, point); nothing goes through there.
        person: Person of each point (point,), with whom it moves where it cannot be followed.
    """
    px, sure, kind = known_px.copy(), confidence.copy(), status.copy()
    doubt = np.zeros(confidence.shape)
    paths = _paths(known_px, tracks.forward, person)
    for point, size in enumerate(size_px.tolist()):
        known = np.flatnonzero(np.isfinite(known_px[:, point, 0]))
        if len(known) == 0:
            continue
        path = paths[:, point]
        curve = path + _curve(known, known_px[known, point] - path[known], len(px))
        forward, backward = (track[:, point] for track in (tracks.forward, tracks.backward))
        ends = [-1, *known.tolist(), len(px)]
        for start, stop in pairwise(ends):
            inside = np.arange(start + 1, stop)
            if len(inside) == 0:
                continue
            hidden = is_hidden[inside, point]
            is_two_sided = start >= 0 and stop < len(px) and not hidden.any()
            share = (inside - start) / (stop - start)
            candidates = [
                _bridged(forward, known_px[:, point], inside, share, start, stop, size, is_two_sided),
                _bridged(backward, known_px[:, point], inside, 1.0 - share, stop, start, size, is_two_sided),
            ]
            apart = np.linalg.norm(forward[inside] - backward[inside], axis=-1) / size
            doubt[inside, point] = np.nan_to_num(apart)
            if is_two_sided:
                deviation = _CURVE_DEVIATION * 2.0 * np.sqrt(share * (1.0 - share))
                is_curve = np.full(len(inside), (stop - start) / rate_hz <= _MAX_INTERPOLATED_S)
                candidates.append((curve[inside], np.where(is_curve, deviation**2, np.inf)))
            else:
                reach = _MAX_ONE_SIDED_S * rate_hz
                after = inside - start if start >= 0 else np.inf
                before = stop - inside if stop < len(px) else np.inf
                # Where it is known to be hidden, and behind that as seen from its known place, it is not.
                is_cut = np.logical_or.accumulate(hidden), np.logical_or.accumulate(hidden[::-1])[::-1]
                for (_, variance), away, cut in zip(candidates, (after, before), is_cut, strict=True):
                    variance[cut | (away > reach)] = np.inf
            places = np.stack([np.nan_to_num(place) for place, _ in candidates])
            weights = np.stack([1.0 / variance for _, variance in candidates])
            total = weights.sum(axis=0)
            filled, is_filled = inside[total > 0], total > 0
            px[filled, point] = (np.einsum("ci,cik->ik", weights, places)[is_filled]) / total[is_filled, None]
            ends_sure = [confidence[end, point] for end in (start, stop) if 0 <= end < len(px)]
            belief = min(ends_sure) / (1.0 + (1.0 / np.sqrt(total[is_filled]) / _DOUBTED) ** 2)
            sure[filled, point] = np.maximum(belief, _LEAST_CONFIDENCE)
            is_tracked = weights[:2].sum(axis=0) >= 0.5 * total
            kind[inside, point] = np.where(is_tracked, KeypointStatus.TRACKED, KeypointStatus.INTERPOLATED)
            kind[inside[~is_filled], point] = KeypointStatus.MISSING
        for reached in (forward, backward):
            drift = np.linalg.norm(reached[known] - known_px[known, point], axis=-1) / size
            is_found = status[known, point] != KeypointStatus.ANNOTATED  # what a person placed is not doubted
            doubt[known, point] = np.maximum(doubt[known, point], is_found * np.nan_to_num(drift))
    return FilledPoints(px, np.where(kind == KeypointStatus.MISSING, 0.0, sure), kind, doubt)


def shorten_limbs(filled: FilledPoints, joint_names: tuple[str, ...]) -> Array:
    """Return the places (frame, point, 2) with filled limbs no longer than they were known to be in this shot.

    The end of a limb that is too long is moved towards its beginning; known places stay.

    Args:
        filled: Points person by person, of each all joints.
        joint_names: Joints of a person.
    """
    px = filled.px.copy()
    is_known = filled.status >= KeypointStatus.DETECTED
    for person in range(px.shape[1] // len(joint_names)):
        for limb in _LIMBS:
            if not set(limb) <= set(joint_names):
                continue
            parent, child = (person * len(joint_names) + joint_names.index(name) for name in limb)
            along = px[:, child] - px[:, parent]
            length = np.linalg.norm(along, axis=-1)
            both = is_known[:, parent] & is_known[:, child]
            if both.any():
                limit = _MAX_STRETCH * float(length[both].max())
                is_long = (length > limit) & ~is_known[:, child]
                px[is_long, child] = px[is_long, parent] + along[is_long] * (limit / length[is_long])[:, None]
    return px


def _paths(known_px: Array, forward: Array, person: Integers) -> Array:
    """Return how the person of each point moves (frame, point, 2), from 0, by the joints that are followed.

    The step from a frame to the next is the median of the steps of these joints; it is 0 where there are fewer than
    three.
    """
    steps = forward[1:] - np.where(np.isfinite(known_px), known_px, forward)[:-1]
    paths = np.zeros(known_px.shape)
    for who in np.unique(person):
        own_steps = steps[:, person == who]
        is_told = np.isfinite(own_steps[..., 0]).sum(axis=1) >= _MIN_FOLLOWED
        step = np.zeros((len(own_steps), 1, 2))
        step[is_told, 0] = np.nanmedian(own_steps[is_told], axis=1)
        paths[1:, person == who] = np.cumsum(step, axis=0)
    return paths


def _curve(known: Integers, places: Array, num_frames: int) -> Array:
    """Return shape-preserving interpolation (frame, 2), NaN outside."""
    if len(known) == 1:
        return np.full((num_frames, 2), np.nan)
    from scipy.interpolate import PchipInterpolator  # here: others need not wait for it

    return np.asarray(PchipInterpolator(known, places, extrapolate=False)(np.arange(num_frames)))


def _bridged(
    reached: Array,
    known: Array,
    inside: Integers,
    share: Array,
    start: int,
    stop: int,
    size_px: float,
    is_two_sided: bool,
) -> tuple[Array, Array]:
    """Return the places (inside, 2) of a track with its drift spread over the gap, and their variances (inside,).

    Args:
        reached: The track (frame, 2).
        known: Known places (frame, 2).
        inside: Frames of the gap.
        share: How far each is from where the track begins, from 0 to 1.
        start: Known frame at which the track begins.
        stop: The one at which it ends.
        size_px: Size of the person.
        is_two_sided: Both ends are known, and nothing between them says that the point is hidden.
    """
    place, variance = reached[inside].copy(), np.full(len(inside), _TRACK_DEVIATION**2)
    drift = reached[stop] - known[stop] if is_two_sided else np.full(2, np.nan)
    if np.isfinite(drift).all():
        place -= share[:, None] * drift
        lost = float(np.linalg.norm(drift)) / size_px
        variance = share * (1.0 - 0.5 * share) * (variance + lost**2)
        if lost > _MAX_DRIFT:
            variance = variance + _CURVE_DEVIATION**2
    else:
        variance = variance * (1.0 + 4.0 * share)
    return place, np.where(np.isfinite(place[:, 0]), variance + 1e-9, np.inf)
